"""The photo in the view that shows it: its own colours and, in the materials, its detail.

A generator draws views of few pixels and blurs what it is not sure of. Of its orbit one view is
known, the photo's: this one takes what the photo tells.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.diffusion.groups import GeneratedViews
from svim3d.numerics import normalize

SMALLEST_COVERAGE = 1.0 / 510.0  # rounds to 0 of 255; protects divisions by coverage
# Detail is what a blur of this width, as a share of the picture's side, takes away: two pixels of a
# picture of 64. On five scanned and modelled objects widths from half to four times that differ by
# 0.06 dB of basecolor.
DETAIL_WIDTH = 1.0 / 32.0
BLUR_REACH = 3.0  # standard deviations at which the Gaussian is cut off


def enlarged(views: GeneratedViews, size: int) -> GeneratedViews:
    """Views of `size` pixels a side, bilinear; premultiplied meanwhile, so that rims stay clean."""
    if size == views.mask.shape[1]:
        return views
    mask = resized(views.mask, size)
    planes = {
        name: resized(plane * views.mask, size) / mask.clamp_min(SMALLEST_COVERAGE)
        for name, plane in vars(views).items()
        if name != "mask"
    }
    seen = (mask > 0.0).to(mask)
    planes["normal_camera"] = normalize(planes["normal_camera"])
    return GeneratedViews(mask=mask, **{name: plane * seen for name, plane in planes.items()})


def with_photo(
    views: GeneratedViews, rgb: Float[Tensor, "N N 3"], mask: Float[Tensor, "N N 1"]
) -> GeneratedViews:
    """The photo's colours and outline in the last view, and its detail in that view's basecolor.

    Fine changes of a picture are the material's more often than the light's: basecolor keeps its
    own broad colour and takes the photo's departures from its blur, both sRGB-encoded. Where the
    photo shows more of the object than the generator drew, materials and normals go on as they are
    beside it.

    Args:
        views: the last of which shows what the photo does.
        rgb: the photo, sRGB-encoded, straight.
        mask: its coverage.
    """
    size = views.mask.shape[1]
    share = resized(mask[None], size)[0]
    straight = resized(linear_from_srgb(rgb)[None] * mask, size)[0]
    straight = straight / share.clamp_min(SMALLEST_COVERAGE)
    drawn = views.mask[-1]
    known = {name: _continued(planes[-1], drawn) for name, planes in vars(views).items()}
    encoded = srgb_from_linear(straight)
    detailed = encoded + _blurred(srgb_from_linear(known["basecolor"]) - encoded, share)
    known |= {
        "rgb_linear": straight,
        "basecolor": linear_from_srgb(detailed.clamp(0.0, 1.0)),
        "normal_camera": normalize(known["normal_camera"]),
    }
    inside = (share > 0.0).to(share)
    last = {name: plane * inside for name, plane in known.items()} | {"mask": share}
    return GeneratedViews(
        **{name: torch.cat([p[:-1], last[name][None]]) for name, p in vars(views).items()}
    )


def _continued(
    plane: Float[Tensor, "H W C"], mask: Float[Tensor, "H W 1"]
) -> Float[Tensor, "H W C"]:
    """The plane, and where the mask is empty the mean of what lies near; farther off, of all."""
    mean = (plane * mask).sum((0, 1)) / mask.sum().clamp_min(SMALLEST_COVERAGE)
    # Far from the mask the blur's weight is nothing, and the mean takes over.
    near = mean + _blurred(plane - mean, mask)
    # Rounding takes a mean out of the range of its values.
    near = near.clamp(plane.amin((0, 1)), plane.amax((0, 1)))
    return torch.where(mask > 0.0, plane, near)


def resized(images: Float[Tensor, "K H W C"], size: int) -> Float[Tensor, "K N N C"]:
    """Square images of `size` pixels a side, bilinear, averaged where that is less."""
    return torch.nn.functional.interpolate(
        images.permute(0, 3, 1, 2),
        size=(size, size),
        mode="bilinear",
        align_corners=False,
        antialias=True,
    ).permute(0, 2, 3, 1)


def _blurred(
    image: Float[Tensor, "H W C"], weight: Float[Tensor, "H W 1"]
) -> Float[Tensor, "H W C"]:
    """Gaussian mean over pixels by their weight (normalised convolution)."""
    width = DETAIL_WIDTH * image.shape[0]
    reach = int(BLUR_REACH * width) + 1
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / width).square()).to(image)
    planes = torch.cat([image * weight, weight], -1).permute(2, 0, 1)[:, None]
    for shape in ((1, 1, 1, -1), (1, 1, -1, 1)):
        planes = torch.nn.functional.conv2d(planes, kernel.view(shape), padding="same")
    total = planes[:, 0].permute(1, 2, 0)
    return total[..., :-1] / total[..., -1:].clamp_min(torch.finfo(total.dtype).tiny)
