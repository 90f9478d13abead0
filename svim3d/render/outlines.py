"""Outlines that fade too far, and background that shines through along them.

Coverage that ramps over many pixels says of none where the object ends; half of it lies where the
outline was before something blurred it. What was cut out of a picture carries the picture's
background where it is half covered: a white rim that the surface would learn as its colour.
Straight colours of such pixels all differ from the ones just inside in the same direction, which
textures, shading and noise do not.
"""

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

WHOLE, FAINT = 0.97, 0.03  # coverage beyond which a pixel is the object alone, or the background
REACH_PX = 4.0  # from a whole pixel; farther ones have no neighbour to speak of
# Length of the mean difference of basecolor against its root mean square. Path-traced views of five
# objects reach 0.06, the cat 0.18; a white background that fades over one pixel reaches 0.9.
# Radiance does not tell: what is dark and glossy brightens towards its rims.
COHERENT = 0.5
VISIBLE = 0.02  # mean difference below which nothing is gained
MIN_PIXELS = 50  # along all outlines; fewer tell nothing
LEAST_COVERAGE = 1e-3  # divides premultiplied radiance; pixels below FAINT are never used

Images = dict[str, Float[Tensor, "V H W _"]]
SHARP_PX = 1.0  # width that ramps are brought to: about what a pixel's own box makes of an edge


def sharpened(images: Images, width_px: float) -> Images:
    """Images whose coverage ramps over `SHARP_PX` instead of `width_px`, about its half.

    Radiance stays premultiplied: with the new coverage.
    """
    mask = images["mask"]
    sharp = ((mask - 0.5) * (width_px / SHARP_PX) + 0.5).clamp(0.0, 1.0)
    radiance = images["radiance"] / mask.clamp_min(LEAST_COVERAGE) * sharp
    return images | {"mask": sharp, "radiance": radiance}


def without_bleed(images: Images) -> tuple[Images, float]:
    """Images whose half-covered pixels take the colours just inside, where background bleeds in.

    Args:
        images: the images of an orbit; radiance is premultiplied and stays so.

    Returns:
        The images, the very same where nothing bleeds, and by how much the basecolor along the
        outline was off on average, zero where it was not.
    """
    outline, row, column = _outline(images["mask"])
    if int(outline.sum()) < MIN_PIXELS:
        return images, 0.0
    view = torch.arange(len(outline), device=row.device)[:, None, None]
    inside = images["basecolor"][view, row, column]
    difference = (images["basecolor"] - inside)[outline].double()
    mean = float(torch.linalg.vector_norm(difference.mean(0)))
    if mean < max(VISIBLE, COHERENT * float(difference.square().mean(0).sum().sqrt())):
        return images, 0.0
    # The nearest whole pixel's coverage is almost one, but not quite.
    straight = images["radiance"] / images["mask"].clamp_min(LEAST_COVERAGE)
    radiance = straight[view, row, column] * images["mask"]
    basecolor = torch.where(outline[..., None], inside, images["basecolor"])
    radiance = torch.where(outline[..., None], radiance, images["radiance"])
    return images | {"basecolor": basecolor, "radiance": radiance}, mean


def _outline(
    mask: Float[Tensor, "V H W 1"],
) -> tuple[Bool[Tensor, "V H W"], Tensor, Tensor]:
    """Half-covered pixels near whole ones, and of every pixel the nearest whole one."""
    coverage = mask[..., 0].cpu()
    outline = (coverage > FAINT) & (coverage < WHOLE)
    rows = torch.zeros(mask.shape[:3], dtype=torch.long)
    columns = torch.zeros_like(rows)
    for view, picture in enumerate(coverage):
        whole = picture >= WHOLE
        if not bool(whole.any()):
            outline[view] = False
            continue
        distance, nearest = distance_transform_edt((~whole).numpy(), return_indices=True)
        outline[view] &= torch.from_numpy(distance) < REACH_PX
        rows[view], columns[view] = torch.from_numpy(nearest).long()
    return outline.to(mask.device), rows.to(mask.device), columns.to(mask.device)
