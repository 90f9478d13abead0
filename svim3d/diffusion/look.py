"""What a picture's colours tell of its object's materials: mean roughness and metallic.

At 64 pixels a highlight is a pixel or two, and a network that draws whole orbits learns next to
nothing of gloss. What stuff of that look mostly is can be learnt, from statistics of the reference
view alone: bright and saturated is mostly glossy, muted is dull. A small network tells the two
means, and the drawn maps are moved to them.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from svim3d.diffusion.groups import GeneratedViews

WHITE = 0.985  # pixels of which no channel is below are the white background
DARKEST = 0.02  # protects the saturation of black
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
# Mean and spread of three channels, the same of their distance from grey, and quantiles of value
# and saturation.
STATISTICS = 4 * 3 + 2 * len(QUANTILES)
COVERED = 0.5


class Look(nn.Module):
    """Mean roughness and metallic of an object from a picture of it.

    Args:
        hidden: width of the network.
    """

    centre: Tensor
    spread: Tensor

    def __init__(self, *, hidden: int) -> None:
        super().__init__()
        self.register_buffer("centre", torch.zeros(STATISTICS))
        self.register_buffer("spread", torch.ones(STATISTICS))
        self.body = nn.Sequential(
            nn.Linear(STATISTICS, hidden),
            nn.GELU(),
            nn.Linear(hidden, hidden),
            nn.GELU(),
            nn.Linear(hidden, 2),
        )

    def forward(self, picture: Float[Tensor, "b 3 t t"]) -> Float[Tensor, "b 2"]:
        """Of pictures over white, display-referred, in [-1, 1]; as in `Conditioning`."""
        return self.of(self.scaled(look_statistics(picture)))

    def scaled(self, statistics: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
        """Statistics of zero mean and unit variance over the training set."""
        scaled: Tensor = (statistics - self.centre) / self.spread
        return scaled

    def of(self, scaled: Float[Tensor, "b n"]) -> Float[Tensor, "b 2"]:
        """What the network answers to scaled statistics."""
        means: Tensor = self.body(scaled.to(next(self.body.parameters())))
        return means

    @torch.no_grad()
    def fit_scale(self, statistics: Float[Tensor, "n m"]) -> None:
        """Learn what statistics are usual."""
        self.centre.copy_(statistics.mean(0))
        self.spread.copy_(statistics.std(0).clamp(min=1e-3))


def look_statistics(picture: Float[Tensor, "b 3 t t"]) -> Float[Tensor, "b n"]:
    """Statistics of the pixels that are not white; of all of them, where all are."""
    pixels = (picture.float().flatten(2).transpose(1, 2).clamp(-1.0, 1.0) + 1.0) / 2.0
    inside = pixels.amin(-1) < WHITE
    inside = inside | ~inside.any(1, keepdim=True)
    value, least = pixels.amax(-1), pixels.amin(-1)
    saturation = (value - least) / value.clamp(min=DARKEST)
    hue = pixels - pixels.mean(-1, keepdim=True)
    moments = [part for planes in (pixels, hue) for part in _moments(planes, inside)]
    return torch.cat([*moments, _quantiles(value, inside), _quantiles(saturation, inside)], 1)


def _moments(planes: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
    weight = inside[..., None].to(planes)
    count = weight.sum(1)
    mean = (planes * weight).sum(1) / count
    squared = ((planes - mean[:, None]).square() * weight).sum(1) / count
    return mean, squared.sqrt()


def _quantiles(values: Tensor, inside: Tensor) -> Tensor:
    """Of each row's values inside, the nearest ranks."""
    ordered = values.masked_fill(~inside, torch.inf).sort(1).values
    last = inside.sum(1, keepdim=True) - 1
    ranks = (last * torch.tensor(QUANTILES, device=values.device)).round().long()
    return ordered.gather(1, ranks)


def with_means(views: GeneratedViews, means: Float[Tensor, "2"], detail: float) -> GeneratedViews:
    """Views whose roughness and metallic are moved, inside their masks, to these means.

    Args:
        views: as drawn.
        means: of roughness and metallic. Values stay in [0, 1], so that a map that is cut off there
            misses its mean by what was cut.
        detail: share of the drawn differences from the mean that is kept.
    """
    covered = (views.mask > COVERED).to(views.mask)
    seen = (views.mask > 0.0).to(views.mask)
    moved = {}
    for name, mean in zip(("roughness", "metallic"), means.clamp(0.0, 1.0), strict=True):
        plane = getattr(views, name)
        drawn = (plane * covered).sum() / covered.sum().clamp(min=1.0)
        moved[name] = (mean.to(plane) + detail * (plane - drawn)).clamp(0.0, 1.0) * seen
    return replace(views, **moved)
