"""LPIPS: how unlike two pictures look, by features of a network that was trained on photos.

The weights are the user's own, in the form that the `lpips` package keeps them in; which network
they belong to is read off them. The shift-tolerant one blurs before it drops pixels, so that a
shift of less than a pixel costs less than what it would else.
Source: Zhang et al. 2018, "The unreasonable effectiveness of deep features as a perceptual metric"
(weights v0.1); Ghildyal and Liu 2022, "Shift-tolerant perceptual similarity metric".
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

SHIFT = (-0.030, -0.088, -0.188)  # of pictures in [-1, 1]; mean and deviation of ImageNet
SCALE = (0.458, 0.448, 0.450)
MIN_SQUARE = 1e-20  # of a feature vector: where all are off it has a gradient, and it is zero
BINOMIAL = (0.25, 0.5, 0.25)  # the shift-tolerant network's blur, along each axis
MIN_SIDE = 32  # pixels; the networks shrink smaller pictures to nothing
CONVOLUTION = re.compile(r"net\.slice(\d+)\.(\d+)\.weight")
BLUR = re.compile(r"net\.slice\d+\.\d+\.filt")

Layer = Callable[[Tensor, Iterator[Tensor]], Tensor]
Parts = tuple[tuple[Layer, ...], ...]


def _convolution(stride: int, padding: int) -> Layer:
    """The network's next convolution."""
    return lambda x, weights: functional.conv2d(x, next(weights), next(weights), stride, padding)


def _largest(size: int, stride: int) -> Layer:
    """Maximum over a square of pixels."""
    return lambda x, _: functional.max_pool2d(x, size, stride)


def _relu(x: Tensor, _: Iterator[Tensor]) -> Tensor:
    return x.relu()


def _halve(x: Tensor, _: Iterator[Tensor]) -> Tensor:
    """Blur, then take every second pixel."""
    channels = x.shape[1]
    along = x.new_tensor(BINOMIAL)
    blur = (along[:, None] * along).expand(channels, 1, 3, 3)
    return functional.conv2d(functional.pad(x, [2] * 4, "reflect"), blur, stride=2, groups=channels)


def _twice(layer: Layer) -> tuple[Layer, ...]:
    return layer, _relu, layer, _relu


_SAME = _convolution(1, 1)
# The features compared are what each part gives.
ALEXNET = (
    (_convolution(4, 2), _relu),
    (_largest(3, 2), _convolution(1, 2), _relu),
    (_largest(3, 2), _SAME, _relu),
    (_SAME, _relu),
    (_SAME, _relu),
)
SHIFT_TOLERANT_ALEXNET = (
    (_convolution(1, 2), _halve, _relu),
    (_largest(3, 1), _halve, _convolution(1, 2), _relu),
    (_largest(3, 1), _halve, _SAME, _relu),
    (_SAME, _relu),
    (_SAME, _relu),
)
VGG16 = (
    _twice(_SAME),
    (_largest(2, 2), *_twice(_SAME)),
    (_largest(2, 2), *_twice(_SAME), _SAME, _relu),
    (_largest(2, 2), *_twice(_SAME), _SAME, _relu),
    (_largest(2, 2), *_twice(_SAME), _SAME, _relu),
)
# Shape of the first convolution and number of convolutions by network.
ALEXNET_FORM, VGG16_FORM = ((64, 3, 11, 11), 5), ((64, 3, 3, 3), 13)


@dataclass(frozen=True)
class Lpips:
    """The distance with its weights.

    Attributes:
        parts: layers of the network up to each level of features.
        weights: kernels and biases of its convolutions, in order.
        shares: how much each channel of each level counts.
        is_shift_tolerant: whether it blurs before it drops pixels.
    """

    parts: Parts
    weights: tuple[Tensor, ...]
    shares: tuple[Float[Tensor, "1 _ 1 1"], ...]
    is_shift_tolerant: bool

    @classmethod
    def of(cls, state: Mapping[str, Tensor]) -> Self:
        """Read off the network that a state of `lpips.LPIPS` or `stlpips.LPIPS` belongs to.

        Raises:
            ValueError: it is none, or of a network that is not known here.
        """
        found = [match for name in state if (match := CONVOLUTION.fullmatch(name))]
        stems = sorted((int(m[1]), int(m[2]), m[0].removesuffix("weight")) for m in found)
        blurred = any(BLUR.fullmatch(name) for name in state)
        first = tuple(state[f"{stems[0][2]}weight"].shape) if stems else ()
        form = first, len(stems)
        networks: dict[tuple[tuple[tuple[int, ...], int], bool], Parts] = {
            (ALEXNET_FORM, False): ALEXNET,
            (ALEXNET_FORM, True): SHIFT_TOLERANT_ALEXNET,
            (VGG16_FORM, False): VGG16,
        }
        parts = networks.get((form, blurred))
        names = [f"{stem}{end}" for _, _, stem in stems for end in ("weight", "bias")]
        ends = [f"lin{level}.model.1.weight" for level in range(5)]
        lacking = [name for name in (*names, *ends) if name not in state]
        if parts is None or lacking:
            what = f"a state without {lacking[0]}" if lacking else f"a network of form {form}"
            raise ValueError(
                "wanted the whole state of lpips.LPIPS(net='alex' or 'vgg'), or that of the "
                f"shift-tolerant AlexNet, got {what}; the backbone belongs into the file too"
            )
        weights = tuple(state[name].float() for name in names)
        return cls(parts, weights, tuple(state[name].float() for name in ends), blurred)

    def to(self, device: torch.device | str) -> "Lpips":
        """The same on another device."""
        weights = tuple(w.to(device) for w in self.weights)
        shares = tuple(share.to(device) for share in self.shares)
        return Lpips(self.parts, weights, shares, self.is_shift_tolerant)

    def __call__(
        self, pictures: Float[Tensor, "N H W 3"], truths: Float[Tensor, "N H W 3"]
    ) -> Float[Tensor, ""]:
        """Mean distance of pairs of pictures, encoded to [0, 1]; differentiable in both.

        Raises:
            ValueError: the pictures are too small for the network.
        """
        if min(pictures.shape[1:3]) < MIN_SIDE:
            raise ValueError(
                f"LPIPS compares pictures of at least {MIN_SIDE} x {MIN_SIDE} pixels, got "
                f"{tuple(pictures.shape[1:3])}; take larger ones, or structural similarity"
            )
        seen, wanted = self._features(pictures), self._features(truths)
        levels = zip(seen, wanted, self.shares, strict=True)
        apart = [((a - b).square() * share).sum(1).mean() for a, b, share in levels]
        return torch.stack(apart).sum()

    def _features(self, pictures: Float[Tensor, "N H W 3"]) -> list[Float[Tensor, "N _ _ _"]]:
        """Unit feature vectors at each level, channels first."""
        straight = 2.0 * pictures - 1.0
        x = ((straight - straight.new_tensor(SHIFT)) / straight.new_tensor(SCALE)).movedim(-1, 1)
        weights = iter(self.weights)
        levels = []
        for part in self.parts:
            for layer in part:
                x = layer(x, weights)
            square = x.square().sum(1, keepdim=True)
            levels.append(x * square.clamp_min(MIN_SQUARE).rsqrt())
        return levels
