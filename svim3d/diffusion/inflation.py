"""From a network of one group of latents to one of several: new channels begin as copies.

Input channels are the noisy latents of all groups and then the one latent of the reference view;
output channels are those of all groups.

Source: Engelhardt et al. 2025, SViM3D, section 3; the scale as in Ke et al. 2025, Marigold.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Copies = Literal["mean", "copy"]


@dataclass(frozen=True)
class Inflation:
    """How a UNet of one group becomes one of several.

    Attributes:
        latent_channels: of a group.
        groups: how many there will be.
        copies: how the weights of new input channels are scaled, see `inflate_input`.
    """

    latent_channels: int
    groups: int
    copies: Copies

    def carry_out(self, name: str, tensor: Tensor) -> Tensor:
        """A tensor of the new UNet from that of the old; only three differ."""
        if name == "conv_in.weight":
            return inflate_input(tensor, self.latent_channels, self.groups, self.copies)
        if name in ("conv_out.weight", "conv_out.bias"):
            return inflate_output(tensor, self.groups)
        return tensor


def inflate_input(
    weight: Float[Tensor, "o c kh kw"], latent_channels: int, groups: int, copies: Copies
) -> Float[Tensor, "o d kh kw"]:
    """The first convolution's weight for noisy latents of several groups.

    Differs from the paper: it copies unscaled (`copy`), which adds up the answers to all groups.
    By default each copy is divided by their number (`mean`), so that a network given the same
    latent in all groups answers as it did before.

    Args:
        weight: for noisy latents of one group, then the latent of the reference view.
        latent_channels: of a group.
        groups: how many there will be.
        copies: how they are scaled.

    Raises:
        ValueError: the weight is not for one group and a reference view.
    """
    if weight.shape[1] != 2 * latent_channels:
        raise ValueError(
            f"wanted {2 * latent_channels} input channels, noisy and reference latent, got "
            f"{weight.shape[1]}; only a model of one group can be inflated"
        )
    noisy, reference = weight.split(latent_channels, 1)
    scale = 1.0 / groups if copies == "mean" else 1.0
    return torch.cat([scale * noisy] * groups + [reference], 1)


def inflate_output(
    parameter: Float[Tensor, "c *kernel"], groups: int
) -> Float[Tensor, "d *kernel"]:
    """The last convolution's weight or bias for several groups, each answering as the one did."""
    return parameter.repeat(groups, *[1] * (parameter.ndim - 1))
