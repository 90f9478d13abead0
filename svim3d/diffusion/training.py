"""The training objective, and what is trained when.

The loss is EDM's in its v form (`karras.velocity`), with one noise level for all frames and groups
of a clip. Source: Karras et al. 2022, section 5; Blattmann et al. 2023, SVD, appendix D;
Engelhardt et al. 2025, SViM3D, section 3.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from svim3d.diffusion.conditioning import Conditioning
from svim3d.diffusion.groups import FULL_COVERAGE, GROUPS, coverage
from svim3d.diffusion.karras import c_in, c_noise, draw_noise_levels, over_batch, velocity
from svim3d.diffusion.unet import MaterialVideoUNet

MATERIAL_GROUPS = ("basecolor", "orm")  # what a clip with poor materials must not teach
# Where an answer covers less of a pixel, it has hardly told what the pixel is made of.
TOLD_COVERAGE = 0.3
# What ends each branch of a temporal transformer; zero here, and frames do not meet.
TEMPORAL_EXITS = ("ff_in.net.2", "attn1.to_out.0", "attn2.to_out.0", "ff.net.2")


@dataclass(frozen=True)
class Clips:
    """A batch of clips to learn from.

    Attributes:
        latents: all groups, of unit variance; for `velocity_errors` what is diffused of them.
        conditioning: what the network is told.
        has_good_materials: whether basecolor, roughness and metallic can be trusted.
    """

    latents: Float[Tensor, "b k c h w"]
    conditioning: Conditioning
    has_good_materials: Bool[Tensor, "b"]


@dataclass(frozen=True)
class Draws:
    """The random numbers of one step.

    Attributes:
        sigma: noise level of each clip.
        noise: standard normal.
        drop: 1 where the reference view is withheld.
    """

    sigma: Float[Tensor, "b"]
    noise: Float[Tensor, "b k c h w"]
    drop: Float[Tensor, "b"]

    @classmethod
    def of(
        cls,
        shape: torch.Size,
        generator: torch.Generator,
        *,
        mean: float,
        spread: float,
        drop_share: float,
    ) -> "Draws":
        """Draw them.

        Args:
            shape: of the latents.
            generator: on the CPU, so that a seed means the same everywhere.
            mean: of ln sigma.
            spread: standard deviation of ln sigma.
            drop_share: of clips without reference view, which teaches guidance its zero.
        """
        return cls(
            sigma=draw_noise_levels(shape[0], generator, mean=mean, spread=spread),
            noise=torch.randn(shape, generator=generator),
            drop=(torch.rand(shape[0], generator=generator) < drop_share).float(),
        )

    def to(self, device: torch.device) -> "Draws":
        """On another device."""
        return replace(
            self,
            sigma=self.sigma.to(device),
            noise=self.noise.to(device),
            drop=self.drop.to(device),
        )


def velocity_errors(
    unet: MaterialVideoUNet, clips: Clips, draws: Draws
) -> Float[Tensor, "b groups"]:
    """Mean squared error of the network's answer, per clip and group."""
    level = over_batch(draws.sigma, clips.latents)
    noisy = clips.latents + level * draws.noise
    told = clips.conditioning
    answer = unet(
        told.beside(noisy * c_in(level)), c_noise(draws.sigma), told.token, told.camera
    ).float()
    target = velocity(clips.latents, draws.noise, draws.sigma)
    squares = (answer - target) ** 2
    return squares.unflatten(2, (len(GROUPS), -1)).mean((1, 3, 4, 5))


def weighted_loss(
    errors: Float[Tensor, "b groups"], has_good_materials: Bool[Tensor, "b"]
) -> Float[Tensor, ""]:
    """Mean over each clip's groups that can be trusted, then over clips."""
    is_material = torch.tensor([g in MATERIAL_GROUPS for g in GROUPS], device=errors.device)
    trusted = has_good_materials[:, None] | ~is_material[None]
    weights = trusted.to(errors)
    return ((errors * weights).sum(1) / weights.sum(1)).mean()


def material_difference(
    answer: Mapping[str, Float[Tensor, "n 3 H W"]],
    truth: Mapping[str, Float[Tensor, "n 3 H W"]],
    normal_length: float,
) -> Float[Tensor, "n"]:
    """Absolute differences of roughness and metallic, summed, mean over the object's pixels.

    Absolute, because matter is metal or it is not: the mean of both is wrong either way, and the
    median is what most of it is. Pictures without an object give zero.

    Args:
        answer: decoded groups `orm` and `normal`, in [-1, 1].
        truth: the same of what was to be told.
        normal_length: of the answer's normals, see `coverage`.
    """
    told, told_normal, true, true_normal = (
        ((side[name] + 1.0) / 2.0).movedim(1, -1)
        for side in (answer, truth)
        for name in ("orm", "normal")
    )
    share = coverage(told_normal, normal_length).detach()
    inside = ((coverage(true_normal) > FULL_COVERAGE) & (share > TOLD_COVERAGE)).to(told)[..., 0]
    straight = told[..., 1:] / share.clamp(min=TOLD_COVERAGE)
    difference = (straight - true[..., 1:]).abs().sum(-1) * inside
    return difference.sum((1, 2)) / inside.sum((1, 2)).clamp(min=1.0)


def separate_frames(unet: MaterialVideoUNet) -> None:
    """Keep frames apart at first: temporal transformers add the frame's index alone.

    A network that is trained from nothing would otherwise see its frames mixed by random weights
    that the first phase leaves as they are.
    """
    for name, module in unet.named_modules():
        if "temporal_transformer_blocks" in name and name.endswith(TEMPORAL_EXITS):
            for parameter in module.parameters():
                nn.init.zeros_(parameter)


def picture_loss(
    answer: Float[Tensor, "n 3 H W"],
    pictures: Float[Tensor, "n 3 H W"],
    *,
    edge_weight: float,
) -> dict[str, Float[Tensor, ""]]:
    """Weighted terms: colours, and their differences between neighbours."""
    edges = sum((answer.diff(dim=axis) - pictures.diff(dim=axis)).abs().mean() for axis in (-1, -2))
    return {
        "color": (answer - pictures).abs().mean() + ((answer - pictures) ** 2).mean(),
        "edges": edge_weight * torch.as_tensor(edges),
    }


class MovingAverage:
    """Exponential moving average of parameters, quick to forget at first.

    Attributes:
        values: averages by name.

    Source: the ramp min(decay, (1 + n) / (10 + n)) is TensorFlow's (ExponentialMovingAverage).
    """

    def __init__(self, parameters: Iterable[tuple[str, nn.Parameter]], decay: float) -> None:
        self.decay = decay
        self.values = {name: p.detach().clone() for name, p in parameters}

    def update(self, parameters: Mapping[str, nn.Parameter], step: int) -> None:
        """Take in the parameters after step `step`, counted from 0."""
        decay = min(self.decay, (1.0 + step) / (10.0 + step))
        names = list(self.values)
        now = [parameters[name].detach() for name in names]
        torch._foreach_lerp_([self.values[name] for name in names], now, 1.0 - decay)
