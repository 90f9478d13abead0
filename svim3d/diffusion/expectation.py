"""What the reference view lets one expect of all views: where the diffusion starts from.

Most of an orbit is no matter of chance: colours, heights, and how an outline swells and shrinks
follow from the reference view. A transformer over the cells of its latent tells the mean of all
views at once, as a Fourier series of the azimuth, for a hundredth of what a step of the video
network costs. The video network then draws only what the mean leaves open: it diffuses the
residual, scaled to unit variance. Source: Mardani et al. 2023, "Residual Corrective Diffusion
Modeling for Km-scale Atmospheric Downscaling" (CorrDiff), section 3.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

ELEVATION_TERMS = 3  # 1, cos and sin of the azimuth, times the climb from the reference view
POSITION_SPREAD = 0.02  # standard deviation of fresh position embeddings, as in BERT and ViT


class Expectation(nn.Module):
    """Expected latents of all groups, of unit variance.

    Args:
        latent_channels: of one group.
        side: of a latent picture.
        picture_side: of the reference view as the image encoder sees it; a multiple of `side`.
        groups: how many.
        width: of the transformer.
        layers: of the transformer.
        heads: of its attention.
        harmonics: of the azimuth's Fourier series; 21 even views tell 10 of them.
    """

    def __init__(
        self,
        *,
        latent_channels: int,
        side: int,
        picture_side: int,
        groups: int,
        width: int,
        layers: int,
        heads: int,
        harmonics: int,
    ) -> None:
        super().__init__()
        self.harmonics = harmonics
        self.pixels_per_cell = picture_side // side
        self.channels = groups * latent_channels
        self.cell = nn.Linear(latent_channels, width)
        # Highlights, which tell gloss from metal, are finer than latents of a small autoencoder.
        self.pixels = nn.Linear(3 * self.pixels_per_cell**2, width)
        self.position = nn.Parameter(POSITION_SPREAD * torch.randn(side * side, width))
        self.height = nn.Linear(2, width)
        layer = nn.TransformerEncoderLayer(
            width,
            heads,
            4 * width,
            dropout=0.0,
            activation="gelu",
            batch_first=True,
            norm_first=True,
        )
        self.body = nn.TransformerEncoder(
            layer, layers, norm=nn.LayerNorm(width), enable_nested_tensor=False
        )
        self.head = nn.Linear(width, (1 + 2 * harmonics + ELEVATION_TERMS) * self.channels)
        # From nothing, nothing is expected.
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(
        self,
        latent: Float[Tensor, "b z h w"],
        picture: Float[Tensor, "b 3 t t"],
        camera: Float[Tensor, "b k 3"],
    ) -> Float[Tensor, "b k c h w"]:
        """The mean of each frame; without a reference view (zeros), that of all objects.

        Args:
            latent: the reference view's, as in `Conditioning`.
            picture: the reference view, as in `Conditioning`.
            camera: of each frame, as in `Conditioning`; the last is the reference view's.
        """
        polar = camera[:, -1:, 1]
        height = self.height(torch.cat([polar.cos(), polar.sin()], -1))[:, None]
        pixels = functional.pixel_unshuffle(picture, self.pixels_per_cell)
        seen = self.cell(_cells(latent)) + self.pixels(_cells(pixels))
        cells = seen + self.position + height
        series = self.head(self.body(cells)).to(camera)
        series = series.unflatten(-1, (-1, self.channels))
        frames = torch.einsum("bkn,bpnc->bkcp", self.turn(camera), series)
        return frames.unflatten(-1, latent.shape[-2:])

    def turn(self, camera: Float[Tensor, "b k 3"]) -> Float[Tensor, "b k n"]:
        """What the series' terms are worth at each camera."""
        _, polar, azimuth = camera.unbind(-1)
        waves = [torch.ones_like(azimuth)]
        for order in range(1, self.harmonics + 1):
            waves += [(order * azimuth).cos(), (order * azimuth).sin()]
        climb = polar[:, -1:] - polar
        return torch.stack([*waves, climb, climb * azimuth.cos(), climb * azimuth.sin()], -1)


def _cells(picture: Float[Tensor, "b c h w"]) -> Float[Tensor, "b h_w c"]:
    """A picture's cells, row by row."""
    return picture.flatten(2).transpose(1, 2)
