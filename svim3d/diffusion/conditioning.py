"""What the generator is told: the reference view as a token and as a latent, and all cameras."""

from dataclasses import dataclass
from typing import Literal, Self

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from transformers import CLIPVisionModelWithProjection

# Mean and standard deviation of the pictures that CLIP was trained on, display-referred RGB.
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
Shrinking = Literal["antialias", "blur"]


@dataclass(frozen=True)
class Conditioning:
    """What the network is told beside the noisy latents.

    Attributes:
        token: the reference view as a whole.
        latent: the reference view's latent, not scaled as the noisy latents are.
        camera: of each frame, see `camera_numbers`.
        picture: the reference view at the image encoder's size, in [-1, 1]; for an `Expectation`.
        expected: mean of all groups' latents, from a model that has an `Expectation`.
    """

    token: Float[Tensor, "b 1 d"]
    latent: Float[Tensor, "b z h w"]
    camera: Float[Tensor, "b k 3"]
    picture: Float[Tensor, "b 3 t t"] | None = None
    expected: Float[Tensor, "b k c h w"] | None = None

    def dropped(self, drop: Float[Tensor, "b"]) -> Self:
        """Without the reference view where `drop` is 1; the cameras stay.

        What is expected of the rest has to be asked anew.
        """
        keep = 1.0 - drop
        return type(self)(
            token=self.token * keep.view(-1, 1, 1).to(self.token),
            latent=self.latent * keep.view(-1, 1, 1, 1).to(self.latent),
            camera=self.camera,
            picture=None
            if self.picture is None
            else self.picture * keep.view(-1, 1, 1, 1).to(self.picture),
        )

    def beside_unconditional(self) -> Self:
        """A batch twice as long: first without the reference view, then with it."""
        nothing = self.dropped(torch.ones(len(self.token), device=self.token.device))
        return type(self)(
            token=torch.cat([nothing.token, self.token]),
            latent=torch.cat([nothing.latent, self.latent]),
            camera=torch.cat([self.camera, self.camera]),
            picture=None
            if nothing.picture is None or self.picture is None
            else torch.cat([nothing.picture, self.picture]),
        )

    @property
    def pictures(self) -> Float[Tensor, "b k_or_1 p h w"]:
        """What the network sees beside the noisy latents: what is expected, the reference view."""
        latent = self.latent[:, None]
        if self.expected is None:
            return latent
        frames = self.expected.shape[1]
        return torch.cat([self.expected, latent.expand(-1, frames, -1, -1, -1)], 2)

    def beside(self, noisy: Float[Tensor, "b k c h w"]) -> Float[Tensor, "b k c_and_p h w"]:
        """The network's picture input: noisy latents, and `pictures` beside each."""
        pictures = self.pictures.expand(-1, noisy.shape[1], -1, -1, -1)
        return torch.cat([noisy, pictures.to(noisy)], 2)


def camera_numbers(
    elevation_deg: Float[Tensor, "*b k"], azimuth_deg: Float[Tensor, "*b k"], added_noise: float
) -> Float[Tensor, "*b k 3"]:
    """Per frame: noise added to the reference view, polar angle and azimuth in radians.

    The elevation is absolute; the azimuth counts from the reference view, which is the last frame,
    and lies in [0, 2 pi). Source: SV3D's sampling script.
    """
    turned = (azimuth_deg - azimuth_deg[..., -1:]).remainder(360.0)
    # The remainder of a tiny negative angle rounds to 360 itself.
    turned = torch.where(turned < 360.0, turned, torch.zeros_like(turned))
    polar = torch.deg2rad(90.0 - elevation_deg)
    return torch.stack([torch.full_like(polar, added_noise), polar, torch.deg2rad(turned)], -1)


def embed_picture(
    encoder: CLIPVisionModelWithProjection,
    picture: Float[Tensor, "b 3 H W"],
    shrink: Shrinking = "antialias",
) -> Float[Tensor, "b 1 d"]:
    """The reference view's token: CLIP's pooled and projected answer.

    Args:
        encoder: a CLIP image tower of any size.
        picture: display-referred, in [-1, 1].
        shrink: how it is brought to the encoder's size, as in training: by torch's antialiased
            bicubic filter, or as SV3D does, see `blur_and_resize`.
    """
    resized = shrink_picture(picture.float(), encoder.config.image_size, shrink)
    mean = resized.new_tensor(CLIP_MEAN).view(1, 3, 1, 1)
    std = resized.new_tensor(CLIP_STD).view(1, 3, 1, 1)
    pixels = ((resized + 1.0) / 2.0 - mean) / std
    embedded: Tensor = encoder(pixel_values=pixels.to(encoder.dtype)).image_embeds
    return embedded[:, None]


def shrink_picture(
    picture: Float[Tensor, "b 3 H W"], side: int, shrink: Shrinking
) -> Float[Tensor, "b 3 side side"]:
    """A picture at the image encoder's size; one that has it already stays."""
    if picture.shape[-2:] == (side, side):
        return picture
    if shrink == "blur":
        return blur_and_resize(picture, side)
    return functional.interpolate(
        picture, size=(side, side), mode="bicubic", align_corners=False, antialias=True
    )


def blur_and_resize(picture: Float[Tensor, "b c H W"], side: int) -> Float[Tensor, "b c side side"]:
    """The resizing that SV3D was trained with: a Gaussian where it shrinks, then bicubic.

    Corners stay corners. Source: kornia's `resize` with `antialias` and `align_corners`.
    """
    size = (side, side)
    if picture.shape[-2:] == size:
        return picture
    for axis in (2, 3):
        picture = _blur(picture, picture.shape[axis] / side, axis)
    return functional.interpolate(picture, size=size, mode="bicubic", align_corners=True)


def _blur(
    picture: Float[Tensor, "b c H W"], shrinkage: float, axis: int
) -> Float[Tensor, "b c H W"]:
    """Along one axis, by half of what the scale exceeds 1; within 2 standard deviations."""
    if shrinkage <= 1.0:
        return picture
    sigma = (shrinkage - 1.0) / 2.0
    half = int(max(4.0 * sigma, 3.0)) // 2
    offset = torch.arange(-half, half + 1, device=picture.device, dtype=picture.dtype)
    taps = (-0.5 * (offset / sigma) ** 2).exp()
    shape = [1, 1, 1, 1]
    shape[axis] = len(taps)
    kernel = (taps / taps.sum()).view(shape).expand(picture.shape[1], -1, -1, -1)
    margins = (half, half, 0, 0) if axis == 3 else (0, 0, half, half)
    padded = functional.pad(picture, margins, mode="reflect")
    return functional.conv2d(padded, kernel, groups=picture.shape[1])
