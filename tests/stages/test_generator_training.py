"""Training: what moves, what does not, that it learns, and that pieces end like one run."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_model import TINY, tiny_model

from stages.base import Context
from stages.errors import InputError
from stages.generator_training import draw_clips, train_generator
from stages.settings.training import GeneratorTrainingConfig
from svim3d.diffusion.clips import StoredClip
from svim3d.diffusion.conditioning import Conditioning, camera_numbers, embed_picture
from svim3d.diffusion.model import MaterialDiffusion, Sampling
from svim3d.io.clip_file import read_clip, write_clip

CPU = torch.device("cpu")


def stored_clip(seed: int, good: bool = True) -> StoredClip:
    draw = torch.Generator().manual_seed(seed)
    views, side, z = TINY.views, TINY.latent_side, TINY.latent_channels
    return StoredClip(
        rgb=torch.randn(2, views, z, side, side, generator=draw).half(),
        materials=torch.randn(2, 3, views, z, side, side, generator=draw).half(),
        form=torch.tensor([0, 1]),
        pictures=torch.randint(256, (2, views, 3, 16, 16), generator=draw, dtype=torch.uint8),
        elevation_deg=torch.full((2, views), 10.0),
        azimuth_deg=((torch.arange(1, views + 1) * (360.0 / views)) % 360.0).expand(2, -1).clone(),
        has_good_materials=good,
    )


def settings(**changes: object) -> GeneratorTrainingConfig:
    values = {
        "phase_1_steps": 3,
        "phase_2_steps": 3,
        "batch": 2,
        "rate_1": 1e-3,
        "rate_2": 1e-3,
        "warm_up": 1,
        "decay": 0.5,
        "precision": "float32",
        "checkpoint_every_s": 1e9,
    }
    return GeneratorTrainingConfig.model_validate(values | changes)


def run(
    folder: Path,
    config: GeneratorTrainingConfig,
    clips: list[StoredClip],
    model: MaterialDiffusion | None = None,
    stop_after_s: float | None = None,
    from_scratch: bool = False,
) -> MaterialDiffusion:
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{i}.safetensors" for i in range(len(clips))]
    for file, clip in zip(files, clips, strict=True):
        write_clip(file, clip)
    model = model or tiny_model()
    with Context("training generator", CPU, 0, folder / "work", folder / "shared") as ctx:
        train_generator(
            model,
            files,
            config,
            ctx,
            from_scratch=from_scratch,
            on_checkpoint=lambda steps: None,
            on_sheet=lambda steps: None,
            stop_after_s=stop_after_s,
        )
    return model


def weights(model: MaterialDiffusion) -> dict[str, torch.Tensor]:
    return {
        f"{part}.{name}": value.clone()
        for part, network in model.parts.items()
        for name, value in network.state_dict().items()
    }


def moved(before: dict[str, torch.Tensor], after: dict[str, torch.Tensor]) -> set[str]:
    return {name for name in before if not torch.equal(before[name], after[name])}


def test_clips_survive_their_file(tmp_path):
    clip = stored_clip(3, good=False)
    write_clip(tmp_path / "clip.safetensors", clip)
    back = read_clip(tmp_path / "clip.safetensors")
    assert not back.has_good_materials
    for name, value in vars(clip).items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(getattr(back, name), value), name


def test_phase_1_leaves_temporal_attention_alone(tmp_path):
    before = weights(tiny_model())
    after = weights(run(tmp_path, settings(phase_2_steps=0), [stored_clip(0)]))
    changed = moved(before, after)
    assert not [n for n in changed if "temporal_transformer_blocks" in n or "time_pos_embed" in n]
    assert not [n for n in changed if n.startswith(("autoencoder.", "image_encoder."))]
    assert "unet.conv_in.weight" in changed
    assert any("temporal_res_block" in name for name in changed)


def test_phase_2_frees_everything_in_the_unet(tmp_path):
    before = weights(tiny_model())
    after = weights(run(tmp_path, settings(phase_1_steps=0), [stored_clip(0)]))
    still = {n for n in before if n.startswith("unet.")} - moved(before, after)
    # With one token, cross-attention answers the same whatever is asked: its queries and keys, and
    # the norm before them, have no gradient.
    assert all("attn2" in name or "norm2" in name for name in still), still


def test_the_image_encoder_learns_in_phase_1_of_a_model_from_scratch(tmp_path):
    before = weights(tiny_model())
    config = settings(phase_2_steps=0)
    after = weights(run(tmp_path / "1", config, [stored_clip(0)], from_scratch=True))
    assert any(name.startswith("image_encoder.") for name in moved(before, after))
    config = settings(phase_1_steps=0)
    after = weights(run(tmp_path / "2", config, [stored_clip(0)], from_scratch=True))
    assert not any(name.startswith("image_encoder.") for name in moved(before, after))


def test_pieces_end_like_one_run(tmp_path):
    """Stopped after any step, a run goes on to the same bytes."""
    clips = [stored_clip(0), stored_clip(1, good=False)]
    config = settings()
    whole = weights(run(tmp_path / "whole", config, clips, from_scratch=True))
    for _ in range(config.phase_1_steps + config.phase_2_steps):
        pieces = run(tmp_path / "pieces", config, clips, stop_after_s=0.0, from_scratch=True)
    assert moved(whole, weights(pieces)) == set()


def test_same_seed_same_batches_and_other_steps_others(tmp_path):
    clips, model = [stored_clip(0), stored_clip(1)], tiny_model()
    ctx = Context("training generator", CPU, 0, tmp_path / "work", tmp_path / "shared")
    config = settings()
    one, two, other = (draw_clips(clips, model, step, config, ctx) for step in (5, 5, 6))
    assert torch.equal(one.latents, two.latents)
    assert not torch.equal(one.latents, other.latents)


def test_a_batch_shows_one_frame_as_reference_everywhere(tmp_path):
    """Latent, picture and camera of the reference view are those of the last frame."""
    clip, model = stored_clip(0), tiny_model()
    ctx = Context("training generator", CPU, 0, tmp_path / "work", tmp_path / "shared")
    batch = draw_clips([clip], model, 0, settings(batch=16), ctx)
    scale, z = model.spec.latent_scale, model.spec.latent_channels
    seen = set()
    for index in range(16):
        reference = batch.conditioning.latent[index]
        torch.testing.assert_close(batch.latents[index, -1, :z], reference * scale)
        (light, frame), *others = [
            (light, frame)
            for light in range(2)
            for frame in range(TINY.views)
            if torch.equal(clip.rgb[light, frame].float(), reference)
        ]
        assert not others
        shown = clip.pictures[light, frame][None].float() / 127.5 - 1.0
        torch.testing.assert_close(
            batch.conditioning.token[index], embed_picture(model.image_encoder, shown)[0]
        )
        assert float(batch.conditioning.camera[index, -1, 2]) == 0.0
        seen.add((light, frame))
    assert len(seen) > 5


def test_stored_tokens_are_what_the_encoder_says(tmp_path):
    """Precomputed embeddings train like embeddings made at each step."""
    clip, model = stored_clip(0), tiny_model()
    shown = clip.pictures.float() / 127.5 - 1.0
    with torch.no_grad():
        tokens = torch.stack([embed_picture(model.image_encoder, p)[:, 0] for p in shown])
    ctx = Context("training generator", CPU, 0, tmp_path / "work", tmp_path / "shared")
    config = settings(batch=8)
    made = draw_clips([clip], model, 0, config, ctx)
    stored = draw_clips([replace(clip, tokens=tokens.half())], model, 0, config, ctx)
    # Half precision keeps 11 bits.
    torch.testing.assert_close(
        stored.conditioning.token, made.conditioning.token, rtol=2**-11, atol=1e-6
    )


def test_recomputed_activations_change_nothing(tmp_path):
    calls = {"plain": 0, "frugal": 0}
    ended = {}
    for name, frugal in (("plain", False), ("frugal", True)):
        model = tiny_model()
        norm = model.unet.mid_block.attentions[0].transformer_blocks[0].norm1
        norm.register_forward_hook(lambda *_, name=name: calls.update({name: calls[name] + 1}))
        config = settings(gradient_checkpointing=frugal)
        ended[name] = weights(run(tmp_path / name, config, [stored_clip(0)], model))
    assert moved(ended["plain"], ended["frugal"]) == set()
    assert calls["frugal"] == 2 * calls["plain"]


def test_without_good_materials_phase_2_has_nothing_to_learn_from(tmp_path):
    with pytest.raises(InputError, match="0 of them with good materials"):
        run(tmp_path, settings(), [stored_clip(0, good=False)])


@pytest.mark.slow
def test_it_overfits_one_clip(tmp_path):
    """After 240 steps on one clip, drawing from its reference view gives it back."""
    clip = stored_clip(0)
    config = settings(
        phase_1_steps=40,
        phase_2_steps=200,
        batch=4,
        rate_1=3e-3,
        rate_2=3e-3,
        final_rate=0.05,
        decay=0.98,
        drop_share=0.0,
    )
    one_light = replace(
        clip,
        rgb=clip.rgb[:1],
        form=clip.form[:1],
        pictures=clip.pictures[:1],
        elevation_deg=clip.elevation_deg + torch.arange(TINY.views),  # one reference view alone
    )
    model = run(tmp_path, config, [one_light], from_scratch=True)
    picture = clip.pictures[0, -1].float() / 127.5 - 1.0
    camera = camera_numbers(one_light.elevation_deg[0], clip.azimuth_deg[0], TINY.cond_aug)
    told = Conditioning(
        token=embed_picture(model.image_encoder, picture[None]),
        latent=clip.rgb[0, -1][None].float(),
        camera=camera[None],
    )
    drawn = model.draw(told, 7, Sampling(steps=20, guidance_max=1.0))
    truth = torch.cat([clip.rgb[0][None], clip.materials[0]]).float().transpose(0, 1).flatten(1, 2)
    # Latents have unit variance: an answer that knows nothing is wrong by 1, noise by 2.
    assert float(((drawn - truth) ** 2).mean()) < 0.4
