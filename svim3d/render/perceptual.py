"""Likeness of renders to views as pictures rather than pixels: what forgives a small shift.

A network or a window compares three channels at a time. What a view shows has eleven, so each
comparison draws three of them, the same of render and view: over the steps every combination
comes up. Source: SViM3D sec. 4.
"""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.color import srgb_from_linear
from svim3d.metrics import structural_similarity
from svim3d.render.ray_losses import tonemap

CHANNELS = 11  # radiance 3, basecolor 3, roughness, metallic, normal 3
NORMAL_SPLIT = [8, 3]  # all but normals, and these
INSTANCES = 2  # comparisons of a step; Source: SViM3D sec. 4

# Pictures [N, H, W, 3] and what they should look like, encoded to [0, 1] -> mean distance.
Distance = Callable[[Tensor, Tensor], Tensor]


def structural_distance(
    pictures: Float[Tensor, "N H W 3"], truths: Float[Tensor, "N H W 3"]
) -> Float[Tensor, ""]:
    """DSSIM: half of what structural similarity lacks to one, in [0, 1]."""
    return 0.5 * (1.0 - structural_similarity(pictures, truths).mean())


def encoded_channels(
    images: Mapping[str, Float[Tensor, "*batch _"]],
) -> Float[Tensor, "*batch 11"]:
    """All channels of premultiplied images, encoded so that equal steps look about equal.

    Radiance is tone-mapped, basecolor sRGB; normals fill [0, 1], with grey off the object.
    """
    return torch.cat(
        [
            tonemap(images["radiance"]),
            srgb_from_linear(images["basecolor"]),
            images["roughness"],
            images["metallic"],
            0.5 * images["normal_world"] + 0.5,
        ],
        -1,
    )


def draw_triplets(generator: torch.Generator) -> Int[Tensor, "2 3"]:
    """For each comparison of a step three different channels, in any order."""
    drawn = [torch.randperm(CHANNELS, generator=generator)[:3] for _ in range(INSTANCES)]
    return torch.stack(drawn)


def perceptual_loss(
    rendered: Mapping[str, Float[Tensor, "H W _"]],
    targets: Mapping[str, Float[Tensor, "H W _"]],
    triplets: Int[Tensor, "N 3"],
    distance: Distance,
    *,
    trust: Float[Tensor, "H W 1"] | None = None,
    normal_trust: Float[Tensor, "H W 1"] | None = None,
) -> Float[Tensor, ""]:
    """Mean distance over triplets of channels.

    What is not to be trusted is drawn toward the render, so that it asks for nothing: a weight on
    pixels would not do, since a window that holds one sees its neighbours by it.

    Args:
        rendered: premultiplied images.
        targets: the same.
        triplets: of channels.
        distance: of pictures of three channels.
        trust: in radiance and materials, 1 and more is wholly, as is None.
        normal_trust: the same in normals.
    """
    shown, wanted = encoded_channels(rendered), encoded_channels(targets)
    wanted = torch.cat(
        [
            # Exactly the render's values where the trust is zero, exactly the target's at one.
            part if t is None else torch.lerp(own, part, t.clamp(max=1.0).expand_as(part))
            for own, part, t in zip(
                shown.detach().split(NORMAL_SPLIT, -1),
                wanted.split(NORMAL_SPLIT, -1),
                (trust, normal_trust),
                strict=True,
            )
        ],
        -1,
    )
    index = triplets.to(shown.device)
    pictures, truths = (image[..., index].movedim(2, 0) for image in (shown, wanted))
    return distance(pictures, truths)


def crop_around(pixel: int, cameras: Cameras, size: int) -> Int[Tensor, "H W"]:
    """A square of `size` pixels with a pixel in its middle, as far as its view reaches.

    Args:
        pixel: flat index into the pixels of all views.
        cameras: the views.
        size: of a side; views that are smaller are taken whole along that side.

    Returns:
        flat indices, row by row.
    """
    view, local = divmod(pixel, cameras.height * cameras.width)
    ranges = []
    for centre, length in zip(
        divmod(local, cameras.width), (cameras.height, cameras.width), strict=True
    ):
        side = min(size, length)
        first = min(max(centre - side // 2, 0), length - side)
        ranges.append(torch.arange(first, first + side, device=cameras.c2w.device))
    rows, columns = ranges
    return (view * cameras.height + rows)[:, None] * cameras.width + columns
