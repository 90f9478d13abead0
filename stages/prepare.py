"""Prepare: photo -> the object, cut out and centred in a square.

The object is told from its background by the file's own transparency, else by a matting network,
else as what stands out from a plain background. Colours along its edge are freed of the
background's share. Mixing and resampling happen in linear light, weighted by coverage.
"""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from stages.base import Context, Stage
from stages.errors import InputError
from stages.photo_artifact import Placement, PreparedPhoto
from stages.settings.prepare import PrepareConfig
from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.io.matting_network import FETCH, find_network, network_coverage
from svim3d.io.photo import Photo, read_photo
from svim3d.matting import cut_out_plain
from svim3d.placement import Box, bounding_box, centred_square, drop_specks
from svim3d.unmixing import foreground_colour, sharpen_coverage

LONGEST_PX = 2048  # of a photo as it is worked on: an object of a quarter of it fills 576 pixels
NETWORK_BLUR = 1.0 / 80.0  # of the longer side: four pixels of the 320 that a network sees
LIKE_SIZE = 0.25  # of the largest object's pixels; such objects are worth telling of
BLURRED_SCALE = 1.5  # pixels of the square per pixel of the photo; beyond this it looks soft


def run(source: Path, *, config: PrepareConfig, ctx: Context) -> PreparedPhoto:
    """The object in a photo, ready for the generator.

    Raises:
        InputError: no picture, or no object can be told from its background; says what was wanted,
            what came, what to do.
    """
    try:
        photo = read_photo(source, ctx.event, longest_px=LONGEST_PX)
        rgb_linear, mask, cut_out = _cut_out(photo, config, ctx)
        mask = _one_object(mask, config.min_coverage, ctx)
        box = bounding_box(mask)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(str(error)) from error
    placement = _placement(photo, box, config)
    _tell_of_limits(photo, box, placement, ctx)
    rgb, mask = centred_square(rgb_linear, mask, box, size=config.size, fill=config.fill)
    return PreparedPhoto(rgb=rgb, mask=mask, placement=placement, cut_out=cut_out)


def _cut_out(
    photo: Photo, config: PrepareConfig, ctx: Context
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 1"], str]:
    """Straight linear colour, coverage, and what it was found by."""
    linear = linear_from_srgb(photo.rgb)
    if photo.mask is not None and config.matting in ("auto", "alpha"):
        return linear, photo.mask, "alpha"
    if config.matting == "alpha":
        raise InputError(
            "wanted a picture with transparency, but all of it is opaque; cut the object out, or "
            "leave out --matting alpha"
        )
    if photo.mask is not None:
        ctx.event("opacity_ignored", "the photo's transparency was not asked for: laid on white")
        linear = linear * photo.mask + (1.0 - photo.mask)
    rgb = srgb_from_linear(linear)
    network = config.network or (None if config.matting == "plain" else find_network())
    if network is not None:
        coarse = network_coverage(rgb, network)
        radius = max(1, round(NETWORK_BLUR * max(rgb.shape[:2])))
        coverage = sharpen_coverage(rgb, coarse, radius_px=radius)
        return foreground_colour(linear, coverage), coverage, "network"
    if config.matting == "network":
        raise InputError(f"wanted a matting network, none is installed; give one, or {FETCH}")
    if config.matting == "auto":
        ctx.event(
            "plain_cut_out",
            "no transparency and no matting network: the object is what stands out from a plain "
            "background",
        )
    coverage = cut_out_plain(rgb, ctx.event)
    return foreground_colour(linear, coverage), coverage, "plain"


def _one_object(
    mask: Float[Tensor, "H W 1"], min_coverage: float, ctx: Context
) -> Float[Tensor, "H W 1"]:
    """Coverage without specks; several large objects stay together."""
    mask, sizes, dropped = drop_specks(mask)
    share = sum(sizes) / mask.numel()
    if not sizes or share < min_coverage:
        raise InputError(
            f"wanted an object that covers at least {100 * min_coverage:g} % of the photo, got "
            f"{100 * share:.2g} %; crop the photo closer to it, or check its transparency"
        )
    if dropped:
        ctx.event("specks_dropped", f"specks beside the object that were left out: {dropped}")
    alike = sum(size >= LIKE_SIZE * sizes[0] for size in sizes)
    if alike > 1:
        ctx.event(
            "several_objects",
            f"{alike} separate objects of like size: all are kept, as if they were one; crop the "
            "photo if one of them was meant",
        )
    return mask


def _placement(photo: Photo, box: Box, config: PrepareConfig) -> Placement:
    """The box in pixels of the photo as it was given."""
    down = photo.height / photo.rgb.shape[0]
    along = photo.width / photo.rgb.shape[1]
    return Placement(
        height=photo.height,
        width=photo.width,
        top=box.top * down,
        left=box.left * along,
        bottom=box.bottom * down,
        right=box.right * along,
        scale=config.fill * config.size / (box.longest * max(down, along)),
    )


def _tell_of_limits(photo: Photo, box: Box, placement: Placement, ctx: Context) -> None:
    """Say what the square cannot show well."""
    height, width = photo.rgb.shape[:2]
    touched = box.sides_touched(height, width)
    if touched:
        ctx.event(
            "object_cut_off",
            f"the object reaches the photo's {', '.join(touched)} border: what lies beyond is "
            "missing from the asset",
        )
    enlarged = placement.scale * photo.height / height
    if enlarged > BLURRED_SCALE:
        ctx.event(
            "photo_enlarged",
            f"the object is {box.longest} pixels long and was enlarged {enlarged:.1f} times: "
            "detail is missing; give a larger photo",
        )


PREPARE = Stage(run)
