"""EfficientNet-Lite0 as a source of features: what its head gives, averaged over the picture.

It was trained to classify photos (ImageNet). Its weights are small and free, which Inception's of
FID are not everywhere; a Fréchet distance of these features is `frechet_efficientnet`, not FID.
Source: Tan and Le 2019, "EfficientNet", table 1, and the published description of the lite
variants: no squeeze and excitation, ReLU6, fixed stem and head.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

SIDE_PX = 224
SHIFT, SCALE = 127.0, 128.0  # of pictures in [0, 255]
NORM_EPS = 1e-3
STEM_STRIDE = 2
# Strides of the blocks; their widths and kernels are read off the weights.
STRIDES = (1, 2, 1, 2, 1, 2, 1, 1, 1, 1, 1, 2, 1, 1, 1, 1)
NORM_PARTS = ("weight", "bias", "running_mean", "running_var")
BATCH = 16  # pictures that go through the network at once


@dataclass(frozen=True)
class EfficientNetLite0:
    """The network with its weights.

    Attributes:
        state: tensors by the names of the published state.
    """

    state: Mapping[str, Tensor]

    @classmethod
    def of(cls, state: Mapping[str, Tensor]) -> Self:
        """Check a state.

        Raises:
            ValueError: it is not that of this network.
        """
        lacking = [name for name in _names(len(STRIDES)) if name not in state]
        last = f"_blocks.{len(STRIDES)}._project_conv.weight"
        if lacking or last in state:
            what = f"one without {lacking[0]}" if lacking else "one of a larger network"
            raise ValueError(f"wanted the state of EfficientNet-Lite0, got {what}")
        return cls({name: tensor.float() for name, tensor in state.items()})

    def to(self, device: torch.device | str) -> "EfficientNetLite0":
        """The same on another device."""
        return EfficientNetLite0({name: t.to(device) for name, t in self.state.items()})

    @torch.no_grad()
    def __call__(self, pictures: Float[Tensor, "N H W 3"]) -> Float[Tensor, "N _"]:
        """Features of display-encoded pictures in [0, 1]; they are squeezed to a square."""
        return torch.cat([self._features(batch) for batch in pictures.split(BATCH)])

    def _features(self, pictures: Float[Tensor, "N H W 3"]) -> Float[Tensor, "N _"]:
        planes = pictures.float().movedim(-1, 1)
        sized = functional.interpolate(
            planes, (SIDE_PX, SIDE_PX), mode="bilinear", align_corners=False, antialias=True
        )
        x = (255.0 * sized - SHIFT) / SCALE
        x = self._layer(x, "_conv_stem", "_bn0", STEM_STRIDE).clamp(0.0, 6.0)
        for index, stride in enumerate(STRIDES):
            x = self._block(x, f"_blocks.{index}.", stride)
        return self._layer(x, "_conv_head", "_bn1").clamp(0.0, 6.0).mean((2, 3))

    def _block(
        self, x: Float[Tensor, "N _ _ _"], stem: str, stride: int
    ) -> Float[Tensor, "N _ _ _"]:
        """Expand, filter each channel, project; what came in is added where it fits."""
        y = x
        if f"{stem}_expand_conv.weight" in self.state:
            y = self._layer(y, f"{stem}_expand_conv", f"{stem}_bn0").clamp(0.0, 6.0)
        y = self._layer(y, f"{stem}_depthwise_conv", f"{stem}_bn1", stride).clamp(0.0, 6.0)
        y = self._layer(y, f"{stem}_project_conv", f"{stem}_bn2")
        return x + y if stride == 1 and x.shape[1] == y.shape[1] else y

    def _layer(
        self, x: Float[Tensor, "N _ _ _"], convolution: str, norm: str, stride: int = 1
    ) -> Float[Tensor, "N _ _ _"]:
        """A convolution and its normalisation, padded as TensorFlow does: more at the far side."""
        weight = self.state[f"{convolution}.weight"]
        margins: list[int] = []
        for axis in (3, 2):
            size, kernel = x.shape[axis], weight.shape[axis]
            total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
            margins += [total // 2, total - total // 2]
        groups = x.shape[1] // weight.shape[1]
        x = functional.conv2d(functional.pad(x, margins), weight, stride=stride, groups=groups)
        gain, bias, mean, variance = (self.state[f"{norm}.{part}"] for part in NORM_PARTS)
        return functional.batch_norm(x, mean, variance, gain, bias, eps=NORM_EPS)


def _names(blocks: int) -> list[str]:
    """What a state has to hold."""
    pairs = [("_conv_stem", "_bn0"), ("_conv_head", "_bn1")]
    for index in range(blocks):
        stem = f"_blocks.{index}."
        if index:
            pairs.append((f"{stem}_expand_conv", f"{stem}_bn0"))
        pairs.append((f"{stem}_depthwise_conv", f"{stem}_bn1"))
        pairs.append((f"{stem}_project_conv", f"{stem}_bn2"))
    names = [f"{convolution}.weight" for convolution, _ in pairs]
    return names + [f"{norm}.{part}" for _, norm in pairs for part in NORM_PARTS]
