"""Trains the small autoencoder on the pictures of rendered examples, all four groups alike.

The linear code comes first, in closed form; then the decoder learns to mend what it loses.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from stages.base import Context
from stages.errors import InputError
from stages.precision import products_in
from stages.settings.training import AutoencoderTrainingConfig
from svim3d.diffusion.autoencoder import encode
from svim3d.diffusion.groups import as_network_input
from svim3d.diffusion.patch_autoencoder import PatchAutoencoder
from svim3d.diffusion.training import picture_loss
from svim3d.io.training_data import read_example
from svim3d.optim import NamedAdam, Rate, cosine

ADAM_EPS = 1e-8
WARM_UP_STEPS, FINAL_RATE = 100, 0.01
# Pictures whose patches tell the components, and the variance that latents are scaled to.
COMPONENT_PICTURES = 8192


def train_autoencoder(
    autoencoder: nn.Module,
    examples: Sequence[Path],
    config: AutoencoderTrainingConfig,
    ctx: Context,
) -> float:
    """Train in place; goes on from a checkpoint of an interrupted run.

    Returns:
        The factor that brings latents to unit variance.

    Raises:
        InputError: no examples, or an autoencoder that is only ever taken as it is.
    """
    if not isinstance(autoencoder, PatchAutoencoder):
        raise InputError(
            "an autoencoder of this kind is not trained here; start from a model folder that has a "
            "trained one: svim3d train --model FOLDER"
        )
    pictures = load_pictures(examples[: config.objects])
    some = _some(pictures, COMPONENT_PICTURES, ctx.generator("components")).to(ctx.device)
    autoencoder.fit_components(some)
    autoencoder.analysis.requires_grad_(False)
    named = {n: p for n, p in autoencoder.named_parameters() if p.requires_grad}
    adam = NamedAdam(named, {name: Rate(config.rate, ADAM_EPS) for name in named})
    saved = ctx.checkpoints.load()
    first = 0
    if saved is not None:
        first, tensors = saved
        adam.load_state(tensors)
    autoencoder.train()
    for step in range(first, config.steps):
        if ctx.checkpoints.due():
            ctx.checkpoints.save(step, adam.state())
        batch = _some(pictures, config.batch, ctx.generator(f"batch {step}")).to(ctx.device)
        terms = _losses(autoencoder, batch, config)
        if ctx.is_finite(step, terms):
            adam.zero_grad()
            torch.stack(list(terms.values())).sum().backward()
            if ctx.is_finite(step, adam.gradients()):
                adam.step(cosine(step, config.steps, WARM_UP_STEPS, FINAL_RATE))
        ctx.report(step + 1, config.steps, {n: float(t.detach()) for n, t in terms.items()})
    ctx.checkpoints.save(config.steps, adam.state())
    autoencoder.eval()
    with torch.no_grad():
        return float(1.0 / encode(autoencoder, some).std())


def load_pictures(examples: Sequence[Path]) -> UInt8[Tensor, "n H W 3"]:
    """Every picture of the examples; RGB in the first light alone, so that no group prevails."""
    found = []
    for file in examples:
        example = read_example(file)
        found += [example.rgb[0], example.basecolor, example.orm, example.normal]
    if not found:
        raise InputError("wanted examples to train on, got none; make some: svim3d data render")
    return torch.cat(found)


def _some(
    pictures: UInt8[Tensor, "n H W 3"], count: int, generator: torch.Generator
) -> Float[Tensor, "b 3 H W"]:
    """Pictures drawn at random, as the network wants them."""
    chosen = torch.randint(len(pictures), (count,), generator=generator)
    return as_network_input(pictures[chosen].float() / 255.0)


def _losses(
    autoencoder: PatchAutoencoder,
    pictures: Float[Tensor, "b 3 H W"],
    config: AutoencoderTrainingConfig,
) -> dict[str, Tensor]:
    with products_in(config.precision, pictures.device):
        answer = autoencoder.decode(autoencoder.encode(pictures)).float()
    return picture_loss(answer, pictures, edge_weight=config.edge_weight)
