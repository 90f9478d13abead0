"""Latents of rendered examples: what the generator learns from, computed once.

RGB stands before white or a random colour, basecolor before white, the rest before black.
Source: Engelhardt et al. 2025, SViM3D, section 4.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from stages.base import Context
from stages.errors import InputError
from stages.settings.training import LatentsConfig
from svim3d.diffusion import clips
from svim3d.diffusion.autoencoder import encode
from svim3d.diffusion.clips import StoredClip
from svim3d.diffusion.conditioning import embed_picture, shrink_picture
from svim3d.diffusion.groups import as_network_input, over_background
from svim3d.diffusion.model import MaterialDiffusion, ModelSpec
from svim3d.io.clip_file import write_clip
from svim3d.io.training_data import read_example
from svim3d.synthesis.example import TrainingExample


def precompute_latents(
    model: MaterialDiffusion,
    examples: Sequence[Path],
    folder: Path,
    config: LatentsConfig,
    ctx: Context,
    *,
    embedded: bool,
) -> list[Path]:
    """A clip file for each example; those that are there already stay.

    Args:
        model: whose autoencoder and image encoder are used.
        examples: files.
        folder: of the clips.
        config: settings.
        ctx: gives random numbers.
        embedded: compute the reference views' tokens as well; an image encoder that learns has no
            use for them.

    Raises:
        InputError: examples of another size or another number of views than the model's.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / file.name for file in examples]
    missing = [(e, f) for e, f in zip(examples, files, strict=True) if not f.exists()]
    for done, (source, file) in enumerate(missing):
        example = read_fitting(source, model.spec)
        write_clip(file, _clip(model, example, source.stem, config, ctx, embedded))
        ctx.report(done + 1, len(missing), {})
    return files


def read_fitting(source: Path, spec: ModelSpec) -> TrainingExample:
    """An example whose pictures are like the model's.

    Raises:
        InputError: no example, or another size or another number of views.
    """
    try:
        example = read_example(source)
    except ValueError as error:
        raise InputError(str(error)) from error
    _, views, height, width, _ = example.rgb.shape
    if (views, height, width) != (spec.views, spec.image_size, spec.image_size):
        raise InputError(
            f"wanted {spec.views} views of {spec.image_size} x {spec.image_size} for "
            f"{spec.name}, {source} has {views} of {width} x {height}; render them with "
            f"svim3d data render --views {spec.views} --size {spec.image_size}"
        )
    return example


@torch.no_grad()
def _clip(
    model: MaterialDiffusion,
    example: TrainingExample,
    name: str,
    config: LatentsConfig,
    ctx: Context,
    embedded: bool,
) -> StoredClip:
    generator = ctx.generator(f"backgrounds {name}")
    lights = len(example.rgb)
    form = torch.arange(lights) % 2 if config.mirrored and lights > 1 else torch.zeros(lights)
    plain = torch.stack([example.basecolor, example.orm, example.normal])
    mirrored = torch.stack(
        [
            clips.mirrored_pictures(example.basecolor),
            clips.mirrored_pictures(example.orm),
            clips.mirrored_normals(example.normal, example.mask),
        ]
    )
    azimuths = [example.azimuth_deg, clips.mirrored_azimuths(example.azimuth_deg)]
    elevations = [example.elevation_deg, clips.in_mirrored_order(example.elevation_deg, axis=0)]
    forms = 1 + int(form.max())
    rgb = _before_backgrounds(example, config, generator)
    rgb = torch.stack(
        [clips.mirrored_pictures(r) if f else r for r, f in zip(rgb, form.tolist(), strict=True)]
    )
    pictures = _encoder_pictures(model, rgb)
    return StoredClip(
        rgb=_latents(model, rgb),
        materials=_latents(model, torch.stack([plain, mirrored][:forms])),
        form=form.long(),
        pictures=pictures,
        elevation_deg=torch.stack(elevations[:forms]),
        azimuth_deg=torch.stack(azimuths[:forms]),
        has_good_materials=example.has_good_materials,
        tokens=_tokens(model, pictures) if embedded else None,
    )


def _before_backgrounds(
    example: TrainingExample, config: LatentsConfig, generator: torch.Generator
) -> UInt8[Tensor, "l k H W 3"]:
    """RGB of each light before its own background."""
    lights = len(example.rgb)
    color = torch.rand(lights, 1, 1, 1, 3, generator=generator)
    is_white = torch.rand(lights, generator=generator) < config.white_share
    color[is_white] = 1.0
    mask = example.mask.float() / 255.0
    shown = over_background(example.rgb.float() / 255.0, mask[None], color)
    return (shown * 255.0).round().clamp(0.0, 255.0).byte()


def _latents(
    model: MaterialDiffusion, pictures: UInt8[Tensor, "*b H W 3"]
) -> Float[Tensor, "*b z h w"]:
    flat = pictures.flatten(0, -4)
    inputs = as_network_input(flat.float() / 255.0).to(model.device)
    return encode(model.autoencoder, inputs).half().cpu().unflatten(0, pictures.shape[:-3])


def _encoder_pictures(
    model: MaterialDiffusion, rgb: UInt8[Tensor, "l k H W 3"]
) -> UInt8[Tensor, "l k 3 t t"]:
    """Frames at the image encoder's size."""
    side = model.spec.image_encoder["image_size"]
    flat = as_network_input(rgb.flatten(0, 1).float() / 255.0)
    small = (shrink_picture(flat, side, model.spec.shrink) + 1.0) * 127.5
    return small.round().clamp(0.0, 255.0).byte().unflatten(0, rgb.shape[:2])


def _tokens(
    model: MaterialDiffusion, pictures: UInt8[Tensor, "l k 3 t t"]
) -> Float[Tensor, "l k d"]:
    """What the image encoder makes of each frame, one light at a time."""
    shown = (light.float() / 127.5 - 1.0 for light in pictures)
    tokens = [embed_picture(model.image_encoder, light.to(model.device)) for light in shown]
    return torch.stack(tokens)[:, :, 0].half().cpu()
