"""From rendered examples to clips: backgrounds, mirrors, flags, and what is already there."""

from pathlib import Path

import pytest
import torch
from tiny_model import TINY, tiny_model

from stages.base import Context
from stages.errors import InputError
from stages.latents import precompute_latents
from stages.settings.training import LatentsConfig
from svim3d.diffusion.autoencoder import encode
from svim3d.diffusion.groups import as_network_input
from svim3d.io.clip_file import read_clip
from svim3d.io.training_data import write_example
from svim3d.synthesis.example import TrainingExample

LIGHTS, SIZE = 2, TINY.image_size


def example(seed: int, quality: str = "good", size: int = SIZE) -> TrainingExample:
    draw = torch.Generator().manual_seed(seed)

    def picture(*lead: int) -> torch.Tensor:
        shape = (*lead, TINY.views, size, size, 3)
        return torch.randint(256, shape, generator=draw, dtype=torch.uint8)

    mask = torch.zeros(TINY.views, size, size, 1, dtype=torch.uint8)
    mask[:, 4:12, 4:10] = 255
    rgb = torch.where(mask[None] > 0, picture(LIGHTS), torch.full((), 255, dtype=torch.uint8))
    return TrainingExample(
        rgb=rgb,
        basecolor=picture(),
        orm=picture(),
        normal=torch.minimum(picture(), mask),
        mask=mask,
        elevation_deg=torch.linspace(0.0, 20.0, TINY.views),
        azimuth_deg=torch.tensor([50.0, 100.0, 200.0, 300.0, 0.0]),
        metadata={"quality": quality},
    )


def run(folder: Path, examples: list[TrainingExample], **changes: object) -> list[Path]:
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    files = [data / f"{i:06d}.safetensors" for i in range(len(examples))]
    for file, made in zip(files, examples, strict=True):
        write_example(file, made)
    with Context("training latents", torch.device("cpu"), 0, folder / "w", folder / "s") as ctx:
        config = LatentsConfig.model_validate(changes)
        return precompute_latents(
            tiny_model(), files, folder / "latents", config, ctx, embedded=True
        )


def latents_of(pictures: torch.Tensor) -> torch.Tensor:
    inputs = as_network_input(pictures.float() / 255.0)
    with torch.no_grad():
        return encode(tiny_model().autoencoder, inputs).half()


def test_clips_hold_the_latents_of_their_pictures(tmp_path):
    made = example(0)
    (file,) = run(tmp_path, [made], white_share=1.0)
    clip = read_clip(file)
    assert torch.equal(clip.rgb[0], latents_of(made.rgb[0]))
    assert torch.equal(clip.materials[0, 0], latents_of(made.basecolor))
    assert torch.equal(clip.materials[0, 2], latents_of(made.normal))
    assert clip.form.tolist() == [0, 1]
    assert clip.has_good_materials


def test_every_other_light_sees_the_mirrored_object(tmp_path):
    made = example(0)
    (file,) = run(tmp_path, [made], white_share=1.0)
    clip = read_clip(file)
    assert clip.azimuth_deg[1].tolist() == [60.0, 160.0, 260.0, 310.0, 0.0]
    # The first mirrored frame is the fourth of the object, left and right exchanged.
    assert torch.equal(clip.rgb[1, 0], latents_of(made.rgb[1, 3].flip(1)[None])[0])
    assert torch.equal(clip.elevation_deg[1], made.elevation_deg[[3, 2, 1, 0, 4]])
    (file,) = run(tmp_path / "plain", [made], mirrored=False)
    assert read_clip(file).form.tolist() == [0, 0]
    assert len(read_clip(file).materials) == 1


def test_backgrounds_change_the_background_alone(tmp_path):
    made = example(0)
    (file,) = run(tmp_path, [made], white_share=0.0, mirrored=False)
    shown = read_clip(file).pictures.permute(0, 1, 3, 4, 2)  # the encoder sees 16 px, as rendered
    inside = made.mask[..., 0] > 0
    assert torch.equal(shown[0][inside], made.rgb[0][inside])
    outside = shown[0][~inside]
    assert torch.equal(outside, outside[:1].expand_as(outside))
    assert outside[0].tolist() != [255, 255, 255]
    assert not torch.equal(outside[0], shown[1][~inside][0])


def test_poor_materials_are_flagged(tmp_path):
    file, *_ = run(tmp_path, [example(0, quality="low")])
    assert not read_clip(file).has_good_materials


def test_clips_that_are_there_are_not_made_again(tmp_path):
    files = run(tmp_path, [example(0), example(1)])
    files[1].unlink()
    kept = files[0].stat().st_mtime_ns
    run(tmp_path, [example(0), example(1)])
    assert files[0].stat().st_mtime_ns == kept
    assert files[1].exists()


def test_examples_of_another_size_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"wanted 5 views of 16 x 16 .* --views 5 --size 16"):
        run(tmp_path, [example(0, size=24)])
