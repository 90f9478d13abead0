"""Pictures by which a person follows a training run."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from svim3d.diffusion.autoencoder import Autoencoder, decode, encode
from svim3d.diffusion.conditioning import Conditioning, camera_numbers, embed_picture
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
        truth = torch.cat([clip.rgb[0][None], clip.materials[int(clip.form[0])]]).float()
        shown = clip.pictures[0, -1].to(model.device).float() / 127.5 - 1.0
        camera = camera_numbers(clip.elevation_deg[0], clip.azimuth_deg[0], model.spec.cond_aug).to(
            model.device
        )
        conditioning = Conditioning(
            token=embed_picture(model.image_encoder, shown[None]).detach(),
            latent=truth[0, -1][None].to(model.device),
            camera=camera[None],
            picture=shown[None],
        )
        drawn = (
            model.draw(conditioning, seed, Sampling(steps=STEPS)).cpu() / model.spec.latent_scale
        )
        ours = drawn.unflatten(1, (len(model.spec.groups), -1)).transpose(0, 1)
        frames = torch.linspace(0, len(camera) - 1, COLUMNS).round().long()
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
