"""A small autoencoder: principal components of patches, and a network that mends what they lose.

The code of a patch is linear, so that it is found in closed form and needs no training: no other
linear code of that length loses less. The decoder starts from the same components and learns, from
a patch and its neighbours, what the linear code cannot tell.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pixel_unshuffle

# Components are divided by this power of their standard deviation. At 1 all have the same variance
# and the faintest detail weighs as much as colour; at 0 colour drowns the rest.
WHITENING = 0.5
SMALLEST_DEVIATION = 1e-4  # protects the scale of components that training data lack


class PatchAutoencoder(nn.Module):
    """Codes each square patch of a picture on its own.

    Args:
        patch: side of a patch, pixels.
        latent_channels: numbers per patch.
        hidden: width of the mending network.
        layers: its residual blocks.
    """

    def __init__(self, *, patch: int, latent_channels: int, hidden: int, layers: int) -> None:
        super().__init__()
        values = 3 * patch**2
        self.patch = patch
        self.analysis = nn.Conv2d(values, latent_channels, 1)
        self.synthesis = nn.Conv2d(latent_channels, values, 1)
        self.mending = nn.Sequential(
            nn.Conv2d(latent_channels, hidden, 3, padding=1),
            *[_Residual(hidden) for _ in range(layers)],
            nn.SiLU(),
            nn.Conv2d(hidden, values, 3, padding=1),
        )
        self.to_picture = nn.PixelShuffle(patch)
        # Untrained, it adds nothing to the components.
        for parameter in self.mending[-1].parameters():
            nn.init.zeros_(parameter)

    def encode(self, pictures: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n z h w"]:
        """The code of each patch."""
        code: Tensor = self.analysis(pixel_unshuffle(pictures, self.patch))
        return code

    def decode(self, latents: Float[Tensor, "n z h w"]) -> Float[Tensor, "n 3 H W"]:
        """Pictures in about [-1, 1]."""
        picture: Tensor = self.to_picture(self.synthesis(latents) + self.mending(latents))
        return picture

    @torch.no_grad()
    def fit_components(self, pictures: Float[Tensor, "n 3 H W"]) -> None:
        """Set the linear parts to the principal components of all patches, strongest first."""
        patches = pixel_unshuffle(pictures, self.patch).movedim(1, -1).flatten(0, 2).double()
        mean = patches.mean(0)
        covariance = (patches - mean).T @ (patches - mean) / len(patches)
        variances, directions = torch.linalg.eigh(covariance)
        count = self.analysis.out_channels
        deviations = variances.flip(0)[:count].clamp(min=SMALLEST_DEVIATION**2).sqrt()
        basis = directions.flip(1)[:, :count]
        # A direction and its opposite are equally good; the sum of entries decides.
        basis = basis * torch.where(basis.sum(0) < 0.0, -1.0, 1.0)
        forward = (basis / deviations**WHITENING).T
        backward = basis * deviations**WHITENING
        for layer, weight, bias in (
            (self.analysis, forward, -forward @ mean),
            (self.synthesis, backward, mean),
        ):
            assert layer.bias is not None
            layer.weight.copy_(weight[:, :, None, None])
            layer.bias.copy_(bias)


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=1),
        )

    def forward(self, hidden: Tensor) -> Tensor:
        return hidden + self.body(hidden)
