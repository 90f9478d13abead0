"""Inception v3 as FID uses it: the weights of 2015 in the form that pytorch-fid keeps them in.

It differs from the later published network: its averages leave the padding out, and its last block
takes a maximum where the others take a mean.
Sources: Szegedy et al. 2016, "Rethinking the Inception architecture for computer vision"; Heusel et
al. 2017, "GANs trained by a two time-scale update rule".
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, Self

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

SIDE_PX = 299
NORM_EPS = 1e-3
NORM_PARTS = ("weight", "bias", "running_mean", "running_var")
CLASSES = 1008  # of the weights of 2015; the later network has 1000
BATCH = 16  # pictures that go through the network at once

# A branch is a chain of convolutions; a pair of names is two side by side.
Branch = tuple[str | tuple[str, str], ...]
Pool = Literal["mean", "max", "shrink"]
POOLED = "branch_pool"  # the convolution after the pool, where it does not shrink

# Convolution, stride, padding; None is a maximum over 3 x 3 at every second pixel.
STEM = (
    ("Conv2d_1a_3x3", 2, 0),
    ("Conv2d_2a_3x3", 1, 0),
    ("Conv2d_2b_3x3", 1, 1),
    None,
    ("Conv2d_3b_1x1", 1, 0),
    ("Conv2d_4a_3x3", 1, 0),
    None,
)
_DOUBLE_3X3 = ("branch3x3dbl_1", "branch3x3dbl_2", "branch3x3dbl_3")
_SQUARES: tuple[Branch, ...] = (("branch1x1",), ("branch5x5_1", "branch5x5_2"), _DOUBLE_3X3)
_STRIPES: tuple[Branch, ...] = (
    ("branch1x1",),
    ("branch7x7_1", "branch7x7_2", "branch7x7_3"),
    tuple(f"branch7x7dbl_{i}" for i in range(1, 6)),
)
_FORKS: tuple[Branch, ...] = (
    ("branch1x1",),
    ("branch3x3_1", ("branch3x3_2a", "branch3x3_2b")),
    ("branch3x3dbl_1", "branch3x3dbl_2", ("branch3x3dbl_3a", "branch3x3dbl_3b")),
)
_TO_STRIPES: tuple[Branch, ...] = (("branch3x3",), _DOUBLE_3X3)
_TO_FORKS: tuple[Branch, ...] = (
    ("branch3x3_1", "branch3x3_2"),
    tuple(f"branch7x7x3_{i}" for i in range(1, 5)),
)
BLOCKS: tuple[tuple[str, tuple[Branch, ...], Pool], ...] = (
    ("Mixed_5b", _SQUARES, "mean"),
    ("Mixed_5c", _SQUARES, "mean"),
    ("Mixed_5d", _SQUARES, "mean"),
    ("Mixed_6a", _TO_STRIPES, "shrink"),
    ("Mixed_6b", _STRIPES, "mean"),
    ("Mixed_6c", _STRIPES, "mean"),
    ("Mixed_6d", _STRIPES, "mean"),
    ("Mixed_6e", _STRIPES, "mean"),
    ("Mixed_7a", _TO_FORKS, "shrink"),
    ("Mixed_7b", _FORKS, "mean"),
    ("Mixed_7c", _FORKS, "max"),
)


@dataclass(frozen=True)
class FidInception:
    """The network with its weights.

    Attributes:
        state: tensors by the names of pytorch-fid's state.
    """

    state: Mapping[str, Tensor]

    @classmethod
    def of(cls, state: Mapping[str, Tensor]) -> Self:
        """Check a state.

        Raises:
            ValueError: it is not that of FID's Inception.
        """
        lacking = [name for name in _names() if name not in state]
        if lacking:
            raise ValueError(
                f"wanted the state of FID's Inception as pytorch-fid has it, got one without "
                f"{lacking[0]}"
            )
        classes = len(state["fc.bias"]) if "fc.bias" in state else CLASSES
        if classes != CLASSES:
            raise ValueError(
                f"wanted FID's Inception with {CLASSES} classes, got one with {classes}: with the "
                "later network's weights the figure is no FID"
            )
        return cls({name: state[name].float() for name in _names()})

    def to(self, device: torch.device | str) -> "FidInception":
        """The same on another device."""
        return FidInception({name: t.to(device) for name, t in self.state.items()})

    @torch.no_grad()
    def __call__(self, pictures: Float[Tensor, "N H W 3"]) -> Float[Tensor, "N _"]:
        """Features of display-encoded pictures in [0, 1]; they are squeezed to a square.

        Pictures are resized without a filter, as the common implementation does: large ones alias,
        and equal figures need equal sizes.
        """
        return torch.cat([self._features(batch) for batch in pictures.split(BATCH)])

    def _features(self, pictures: Float[Tensor, "N H W 3"]) -> Float[Tensor, "N _"]:
        planes = pictures.float().movedim(-1, 1)
        sized = functional.interpolate(
            planes, (SIDE_PX, SIDE_PX), mode="bilinear", align_corners=False
        )
        x = 2.0 * sized - 1.0
        for layer in STEM:
            x = self._convolve(x, *layer) if layer else functional.max_pool2d(x, 3, 2)
        for name, branches, pool in BLOCKS:
            x = self._block(x, name, branches, pool)
        return x.mean((2, 3))

    def _block(
        self, x: Float[Tensor, "N _ _ _"], name: str, branches: tuple[Branch, ...], pool: Pool
    ) -> Float[Tensor, "N _ _ _"]:
        """All branches and the pool side by side; a block that shrinks does so at their ends."""
        parts = []
        for branch in branches:
            y = x
            for place, step in enumerate(branch):
                stride = 2 if pool == "shrink" and place == len(branch) - 1 else 1
                names = (step,) if isinstance(step, str) else step
                padding = None if stride == 1 else 0
                y = torch.cat([self._convolve(y, f"{name}.{n}", stride, padding) for n in names], 1)
            parts.append(y)
        if pool == "shrink":
            return torch.cat([*parts, functional.max_pool2d(x, 3, 2)], 1)
        if pool == "max":
            pooled = functional.max_pool2d(x, 3, 1, 1)
        else:
            pooled = functional.avg_pool2d(x, 3, 1, 1, count_include_pad=False)
        return torch.cat([*parts, self._convolve(pooled, f"{name}.{POOLED}", 1, 0)], 1)

    def _convolve(
        self, x: Float[Tensor, "N _ _ _"], name: str, stride: int, padding: int | None
    ) -> Float[Tensor, "N _ _ _"]:
        """Convolution, normalisation, cut at zero; a padding of None keeps the size."""
        weight = self.state[f"{name}.conv.weight"]
        height, width = weight.shape[2:]
        margins = (height // 2, width // 2) if padding is None else (padding, padding)
        x = functional.conv2d(x, weight, stride=stride, padding=margins)
        gain, bias, mean, variance = (self.state[f"{name}.bn.{part}"] for part in NORM_PARTS)
        return functional.batch_norm(x, mean, variance, gain, bias, eps=NORM_EPS).relu()


def _names() -> Iterator[str]:
    """What a state has to hold."""
    convolutions = [layer[0] for layer in STEM if layer]
    for block, branches, pool in BLOCKS:
        steps = [step for branch in branches for step in branch]
        flat = [n for step in steps for n in ((step,) if isinstance(step, str) else step)]
        convolutions += [f"{block}.{n}" for n in flat]
        if pool != "shrink":
            convolutions.append(f"{block}.{POOLED}")
    for convolution in convolutions:
        yield f"{convolution}.conv.weight"
        yield from (f"{convolution}.bn.{part}" for part in NORM_PARTS)
