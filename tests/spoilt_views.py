"""Views with a patch that shows something else, and a confidence that knows of it."""

from dataclasses import replace

import torch

from stages.artifacts import MaterialViews

SPOILT = ("radiance", "basecolor", "roughness", "metallic", "normal_world")


def trusted(views: MaterialViews) -> MaterialViews:
    """The same views, with a confidence of one everywhere."""
    return replace(views, confidence=torch.ones_like(views.mask))


def warned(views: MaterialViews) -> MaterialViews:
    """The same views, with no confidence in the middle of two of them."""
    confidence = torch.ones_like(views.mask)
    confidence[_patch(views)] = 0.0
    return replace(views, confidence=confidence)


def spoilt(views: MaterialViews) -> MaterialViews:
    """The warned views with nonsense where they warn; masks are right."""
    images = {}
    for name in SPOILT:
        image = getattr(views, name).clone()
        image[_patch(views)] = 1.0 - image[_patch(views)]
        images[name] = image * views.mask
    return replace(warned(views), **images)


def _patch(views: MaterialViews) -> tuple[slice, slice, slice]:
    size = views.mask.shape[1]
    middle = slice(size // 3, 2 * size // 3)
    return slice(1, 3), middle, middle
