"""Training the expectation: it learns what follows from the reference view, and resumes exactly."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_model import EXPECTING, tiny_model

from stages.base import Context
from stages.errors import InputError
from stages.expectation_training import train_expectation
from stages.settings.training import ExpectationTrainingConfig
from svim3d.diffusion.clips import StoredClip
from svim3d.diffusion.conditioning import Conditioning, camera_numbers
from svim3d.diffusion.model import MaterialDiffusion
from svim3d.io.clip_file import write_clip

CPU = torch.device("cpu")


def turning_clip(seed: int) -> StoredClip:
    """An object of one colour, whose materials follow from its reference view and the azimuth."""
    draw = torch.Generator().manual_seed(seed)
    views, side, z = EXPECTING.views, EXPECTING.latent_side, EXPECTING.latent_channels
    azimuth = (torch.arange(1, views + 1) * (360.0 / views)) % 360.0
    turn = torch.deg2rad(azimuth).cos().view(-1, 1, 1, 1)
    color = torch.randn(1, z, 1, 1, generator=draw).expand(views, z, side, side)
    materials = torch.stack([color, turn * color, color * 0.0])
    return StoredClip(
        rgb=color[None].half(),
        materials=materials[None].half(),
        form=torch.tensor([0]),
        pictures=torch.zeros(1, views, 3, 16, 16, dtype=torch.uint8),
        elevation_deg=torch.arange(views, dtype=torch.float32)[None],  # one reference view alone
        azimuth_deg=azimuth[None],
        has_good_materials=True,
    )


def run(
    folder: Path,
    clips: list[StoredClip],
    steps: int,
    stop_after_s: float | None = None,
    material_weight: float = 0.0,
) -> tuple[MaterialDiffusion, float | None]:
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{i}.safetensors" for i in range(len(clips))]
    for file, clip in zip(files, clips, strict=True):
        write_clip(file, clip)
    model = tiny_model(EXPECTING)
    config = ExpectationTrainingConfig(
        steps=steps,
        batch=16,
        rate=5e-3,
        warm_up=5,
        drop_share=0.0,
        precision="float32",
        material_weight=material_weight,
    )
    with Context("training expectation", CPU, 0, folder / "work", folder / "shared") as ctx:
        return model, train_expectation(model, files, config, ctx, stop_after_s=stop_after_s)


def test_it_learns_what_follows_from_the_reference_view(tmp_path):
    model, scale = run(tmp_path, [turning_clip(seed) for seed in range(64)], 200)
    unseen = turning_clip(99)
    told = model.expecting(
        Conditioning(
            token=torch.zeros(1, 1, 16),
            latent=unseen.rgb[0, -1][None].float(),
            camera=camera_numbers(unseen.elevation_deg, unseen.azimuth_deg, 1e-5),
            picture=torch.full((1, 3, 16, 16), -1.0),  # of no colour, as in training
        )
    )
    truth = torch.cat([unseen.rgb, unseen.materials[0]]).float().transpose(0, 1).flatten(1, 2)
    error = (told.expected[0] - truth).square().mean().sqrt()
    assert scale is not None
    assert float(error) < 0.3 * float(truth.square().mean().sqrt())
    # What is left open is about what it errs by.
    assert 0.0 < scale < 0.3


def test_pieces_end_like_one_run(tmp_path):
    clips = [turning_clip(0), turning_clip(1)]
    whole, scale = run(tmp_path / "whole", clips, 4, material_weight=1.0)
    for _ in range(3):
        _, unknown = run(tmp_path / "pieces", clips, 4, stop_after_s=0.0, material_weight=1.0)
        assert unknown is None
    pieces, same = run(tmp_path / "pieces", clips, 4, stop_after_s=0.0, material_weight=1.0)
    assert scale == same
    for name, value in whole.expectation.state_dict().items():
        assert torch.equal(value, pieces.expectation.state_dict()[name]), name


def test_materials_are_told_where_they_can_be_trusted(tmp_path):
    """The term is in the losses, and poor materials leave no trace of it in the weights."""
    good, poor = turning_clip(0), replace(turning_clip(0), has_good_materials=False)
    run(tmp_path / "good", [good], 3, material_weight=1.0)
    rows = (tmp_path / "good" / "work" / "scalars.csv").read_text()
    assert rows.count(",materials,") == 3
    one, _ = run(tmp_path / "one", [poor], 3, material_weight=1.0)
    two, _ = run(tmp_path / "two", [poor], 3)
    assert torch.equal(one.expectation.head.weight, two.expectation.head.weight)


def test_the_unet_stays(tmp_path):
    before = tiny_model(EXPECTING).unet.state_dict()
    after, _ = run(tmp_path, [turning_clip(0)], 2)
    assert all(torch.equal(value, after.unet.state_dict()[name]) for name, value in before.items())


def test_without_clips_there_is_nothing_to_learn_from(tmp_path):
    with pytest.raises(InputError, match="wanted clips"):
        run(tmp_path, [], 2)
