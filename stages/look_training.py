"""Trains the look: mean roughness and metallic of an object, from statistics of one picture of it.

It learns from rendered examples of good materials, not from latents, and takes seconds: there is
nothing to check-point, a run that was stopped takes it up from the start.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.base import Context
from stages.errors import InputError
from stages.settings.training import LookTrainingConfig
from svim3d.diffusion.conditioning import shrink_picture
from svim3d.diffusion.groups import as_network_input
from svim3d.diffusion.look import STATISTICS, look_statistics
from svim3d.diffusion.model import MaterialDiffusion
from svim3d.io.training_data import read_example
from svim3d.optim import NamedAdam, Rate, cosine
from svim3d.synthesis.example import TrainingExample

ADAM_EPS, FINAL_RATE, WARM_UP = 1e-8, 0.01, 50
FULL = 0.99  # coverage of pixels that show the object alone


def train_look(
    model: MaterialDiffusion, examples: Sequence[Path], config: LookTrainingConfig, ctx: Context
) -> None:
    """Train in place, from the weights that are there.

    Args:
        model: whose look is trained.
        examples: files; those of poor materials are passed over.
        config: settings.
        ctx: gives random numbers.

    Raises:
        InputError: no example of good materials.
    """
    look = model.look
    if look is None:
        raise ValueError("wanted a model with a look")
    statistics, means = _pairs(model, examples, config)
    if not len(means):
        raise InputError("wanted examples of good materials to learn a look from, got none")
    look.fit_scale(statistics)
    scaled, means = look.scaled(statistics.to(ctx.device)), means.to(ctx.device)
    look.train().requires_grad_(True)
    named = dict(look.named_parameters())
    adam = NamedAdam(named, {name: Rate(config.rate, ADAM_EPS) for name in named})
    generator = ctx.generator("look")
    for step in range(config.steps):
        chosen = torch.randint(len(scaled), (config.batch,), generator=generator)
        noise = torch.randn(config.batch, scaled.shape[1], generator=generator)
        answer = look.of(scaled[chosen] + config.noise * noise.to(ctx.device))
        squares = (answer - means[chosen]).square().mean(0)
        adam.zero_grad()
        squares.sum().backward()
        adam.step(cosine(step, config.steps, WARM_UP, FINAL_RATE))
        roughness, metallic = squares.detach().tolist()
        ctx.report(step + 1, config.steps, {"roughness": roughness, "metallic": metallic})
    look.eval().requires_grad_(False)


def _pairs(
    model: MaterialDiffusion, examples: Sequence[Path], config: LookTrainingConfig
) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n 2"]]:
    """Statistics of views in all lights, and what the object in each is made of."""
    side = int(model.spec.image_encoder["image_size"])
    statistics, means = [torch.zeros(0, STATISTICS)], [torch.zeros(0, 2)]
    for file in examples:
        example = read_example(file)
        if not example.has_good_materials:
            continue
        views = slice(None, None, config.every_view)
        pictures = as_network_input(example.rgb[:, views].flatten(0, 1).float() / 255.0)
        statistics.append(look_statistics(shrink_picture(pictures, side, model.spec.shrink)))
        means.append(_object_means(example).expand(len(statistics[-1]), 2))
    return torch.cat(statistics), torch.cat(means)


def _object_means(example: TrainingExample) -> Float[Tensor, "2"]:
    """Roughness and metallic, over the object's pixels of all views."""
    full = (example.mask.float() / 255.0 > FULL).float()
    orm = example.orm.float() / 255.0
    return (orm * full).sum((0, 1, 2))[1:] / full.sum().clamp(min=1.0)
