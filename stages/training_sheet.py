"""Pictures by which a person follows a training run."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from stages.training_batches import SeenClip
from svim3d.diffusion.autoencoder import Autoencoder, decode, encode
from svim3d.diffusion.conditioning import Conditioning, embed_picture
from svim3d.diffusion.groups import as_network_input
from svim3d.diffusion.model import MaterialDiffusion, Sampling
from svim3d.io.clip_file import read_clip
from svim3d.io.image import contact_sheet, write_png
from svim3d.io.training_data import read_example

COLUMNS = 7  # frames of an orbit that are shown
STEPS = 10  # of the sampler: enough to see what is learnt
SCALE = 2  # pixels of the sheet per pixel of a picture


def draw_generator_sheet(
    model: MaterialDiffusion, clips: Sequence[Path], file: Path, seed: int
) -> None:
    """Orbits of some clips, drawn from their reference views, under the truth."""
    rows: list[Tensor] = []
    labels: list[str] = []
    for clip in map(read_clip, clips):
        seen = SeenClip(clip, light=0, order=torch.arange(clip.azimuth_deg.shape[1]))
        shown = seen.picture[None].to(model.device)
        conditioning = Conditioning(
            token=embed_picture(model.image_encoder, shown).detach(),
            latent=seen.reference[None].to(model.device),
            camera=seen.camera(model.spec)[None].to(model.device),
            picture=shown,
        )
        drawn = (
            model.draw(conditioning, seed, Sampling(steps=STEPS)).cpu() / model.spec.latent_scale
        )
        truth, ours = (
            latents.unflatten(1, (len(model.spec.groups), -1)).transpose(0, 1)
            for latents in (seen.latents, drawn)
        )
        frames = torch.linspace(0, len(seen.order) - 1, COLUMNS).round().long()
        for group, name in enumerate(model.spec.groups):
            for kind, latents in (("truth", truth), ("ours", ours)):
                rows += _pictures(model.autoencoder, latents[group, frames])
                labels += [f"{name}, {kind}, {float(a):.0f}" for a in clip.azimuth_deg[0][frames]]
    write_png(file, contact_sheet(rows, labels, columns=COLUMNS))


def draw_autoencoder_sheet(autoencoder: Autoencoder, example: Path, file: Path) -> None:
    """Pictures of an example above what comes back of them."""
    read = read_example(example)
    some = torch.cat([read.rgb[0, ::7], read.basecolor[::7], read.orm[::7], read.normal[::7]])
    inputs = as_network_input(some.float() / 255.0)
    device = next(autoencoder.parameters()).device
    with torch.no_grad():
        latents = encode(autoencoder, inputs.to(device))
    back = _pictures(autoencoder, latents.cpu())
    there = list(_enlarged(some.float() / 255.0))
    write_png(file, contact_sheet([*there, *back], [""] * (2 * len(there)), columns=len(there)))


@torch.no_grad()
def _pictures(
    autoencoder: Autoencoder, latents: Float[Tensor, "n z h w"]
) -> list[Float[Tensor, "H W 3"]]:
    device = next(autoencoder.parameters()).device
    decoded = decode(autoencoder, latents.float().to(device)).cpu().permute(0, 2, 3, 1)
    return list(_enlarged(((decoded + 1.0) / 2.0).clamp(0.0, 1.0)))


def _enlarged(pictures: Float[Tensor, "n H W 3"]) -> Float[Tensor, "n _ _ 3"]:
    grown = interpolate(pictures.permute(0, 3, 1, 2), scale_factor=SCALE, mode="nearest")
    return grown.permute(0, 2, 3, 1)
