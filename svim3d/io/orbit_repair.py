"""What is mended, dropped or refused in views that come from outside."""

import logging
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from svim3d.cameras import Cameras

log = logging.getLogger(__name__)

MAX_NON_FINITE_SHARE = 0.01  # of a view's pixels; more than a few is a broken render
MAX_NORMAL_LENGTH_ERROR = 0.01  # half-float rounding stays below 0.001
LARGEST_HALF = 65504.0  # what writers of half floats make of infinity
MIN_VIEWS = 3  # two silhouettes leave the depth of almost every point open
OBJECT_HALF_EXTENT = 0.5  # the object's longest side is 1, centred
MAX_SHARE_OUTSIDE = 0.01  # of covered pixels that look past the object's cube

Notify = Callable[[str, str], None]
Images = dict[str, Float[Tensor, "_ _ _ _"]]  # [views, rows, columns, channels]


UNBOUNDED = ("radiance", "confidence")  # above; all else but normals and depth ends at 1


def _log(kind: str, message: str) -> None:
    log.warning("%s: %s", kind, message)


def repair_images(images: Images, names: Sequence[str], notify: Notify | None) -> Images:
    """Bring every value into its range; valid images pass through bit for bit.

    Few pixels that are not finite, or as bright as a half float can be, take the values of the
    nearest that is; negative radiance becomes zero,
    coverage and materials are clamped to [0, 1], normals of wrong length are rescaled, depths that
    are no distance become zero.

    Args:
        images: the images of an orbit, see `svim3d.io.orbit.CHANNELS`.
        names: file name per view, for messages.
        notify: told (kind, message) once per view and kind of repair; None writes to the log.

    Raises:
        ValueError: too many pixels of a view are NaN or infinite.
    """
    notify = notify or _log
    images = dict(images)
    for view, name in enumerate(names):
        _fill_non_finite(images, view, name, notify)
    for name, image in images.items():
        if name == "depth":
            images[name] = _known_depth(image, names, notify)
        elif name == "normal_world":
            images[name] = _unit_normals(image, images["mask"], names, notify)
        else:
            highest = float("inf") if name in UNBOUNDED else 1.0
            images[name] = _clamped(image, name, highest, names, notify)
    return images


def _fill_non_finite(images: Images, view: int, name: str, notify: Notify) -> None:
    """Give pixels with any NaN or infinity the values of their nearest finite neighbour."""
    # Renderers write infinity for the depth of the background.
    needed = [image for key, image in images.items() if key != "depth"]
    bad = torch.stack([~torch.isfinite(i[view]).all(-1) for i in needed]).any(0)
    if "radiance" in images:
        bad |= (images["radiance"][view] >= LARGEST_HALF).any(-1)
    count = int(bad.sum())
    if not count:
        return
    if count > MAX_NON_FINITE_SHARE * bad.numel():
        raise ValueError(
            f"wanted finite pixels in {name}, got NaN or infinity in {count} of {bad.numel()}; "
            f"at most {MAX_NON_FINITE_SHARE:.0%} can be mended, so render the view again"
        )
    row, column = _nearest_good(bad)
    for key, image in images.items():
        filled = image.clone()
        filled[view] = image[view][row, column]
        images[key] = filled
    notify("non_finite_pixels", f"{name}: {count} pixels filled from their nearest neighbour")


def _nearest_good(bad: Bool[Tensor, "H W"]) -> tuple[Tensor, Tensor]:
    """Row and column of the nearest pixel that is not bad, for every pixel."""
    nearest = distance_transform_edt(bad.numpy(), return_distances=False, return_indices=True)
    row, column = torch.from_numpy(nearest).long()
    return row, column


def _clamped(
    image: Float[Tensor, "V H W C"],
    what: str,
    highest: float,
    names: Sequence[str],
    notify: Notify,
) -> Float[Tensor, "V H W C"]:
    """Clamp to [0, highest] and tell how many values of which view were outside."""
    outside = ((image < 0.0) | (image > highest)).flatten(1).sum(1)
    for view in torch.nonzero(outside)[:, 0].tolist():
        notify("clamped", f"{names[view]}: {int(outside[view])} values of {what} out of range")
    return image.clamp(0.0, highest) if bool(outside.any()) else image


def _known_depth(
    depth: Float[Tensor, "V H W 1"], names: Sequence[str], notify: Notify
) -> Float[Tensor, "V H W 1"]:
    """Depth with zero, which means "nothing here", for all that lies behind or nowhere."""
    behind = (depth < 0.0) | torch.isnan(depth)
    for view in torch.nonzero(behind.flatten(1).any(1))[:, 0].tolist():
        notify("depth_dropped", f"{names[view]}: {int(behind[view].sum())} depths mean nothing")
    return torch.where(behind | torch.isinf(depth), 0.0, depth)


def _unit_normals(
    normal: Float[Tensor, "V H W 3"],
    mask: Float[Tensor, "V H W 1"],
    names: Sequence[str],
    notify: Notify,
) -> Float[Tensor, "V H W 3"]:
    """Rescale covered normals whose length is off; those within rounding keep their bits."""
    length = torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    off = ((length - 1.0).abs() > MAX_NORMAL_LENGTH_ERROR) & (mask > 0.0)
    counts = off.flatten(1).sum(1)
    for view in torch.nonzero(counts)[:, 0].tolist():
        notify("normals_rescaled", f"{names[view]}: {int(counts[view])} normals were not unit")
    # A zero normal has no direction to keep; it stays zero.
    scale = torch.where(off & (length > 0.0), length, torch.ones_like(length))
    return torch.where(off, normal / scale, normal)


def admit_views(
    cameras: Cameras, images: Images, reference: int, notify: Notify | None = None
) -> tuple[Cameras, Images, int]:
    """Keep the views that a reconstruction can use and refuse what none could.

    Views whose mask is all empty or all full are dropped and told to `notify`; a dropped
    reference is replaced by the view that looks most like it.

    Raises:
        ValueError: a camera stands inside the object, the object does not fit its cube, or fewer
            than `MIN_VIEWS` views remain.
    """
    notify = notify or _log
    inside = (cameras.positions.abs() < OBJECT_HALF_EXTENT).all(1)
    if bool(inside.any()):
        raise ValueError(
            "wanted cameras outside the object's cube [-0.5, 0.5]^3, but views "
            f"{torch.nonzero(inside)[:, 0].tolist()} stand inside it; scale the poses so that "
            "the object's longest side is 1"
        )
    covered = (images["mask"] > 0.5).flatten(1)
    usable = covered.any(1) & ~covered.all(1)
    for view in torch.nonzero(~usable)[:, 0].tolist():
        state = "full" if bool(covered[view].any()) else "empty"
        notify("view_dropped", f"view {view} dropped: its mask is all {state}")
    kept: list[int] = torch.nonzero(usable)[:, 0].tolist()
    if len(kept) < MIN_VIEWS:
        raise ValueError(
            f"wanted at least {MIN_VIEWS} views with an object before a background, got "
            f"{len(kept)} of {len(cameras)}; check the masks (channel A) or add views"
        )
    past = share_outside(cameras[kept], images["mask"][kept])
    if past > MAX_SHARE_OUTSIDE:
        raise ValueError(
            "wanted the object inside the cube [-0.5, 0.5]^3, but "
            f"{past:.0%} of the covered pixels look past it; scale and centre the "
            "poses so that the object's longest side is 1, or check the masks"
        )
    backward = cameras.c2w[:, :3, 2]
    likeness = backward[kept] @ backward[reference]
    return cameras[kept], {n: i[kept] for n, i in images.items()}, int(likeness.argmax())


def share_outside(cameras: Cameras, mask: Float[Tensor, "V H W 1"]) -> float:
    """Share of the covered pixels that look past the object's cube."""
    covered = outside = 0
    for view in range(len(cameras)):
        pixels = torch.nonzero(mask[view].reshape(-1) > 0.5)[:, 0]
        origin, direction = (rays[pixels] for rays in cameras.rays(view))
        covered += len(pixels)
        outside += int((~_hits_cube(origin, direction)).sum())
    return outside / covered if covered else 0.0


def _hits_cube(origin: Float[Tensor, "P 3"], direction: Float[Tensor, "P 3"]) -> Bool[Tensor, "P"]:
    """Whether rays meet the object's cube (slab test)."""
    inverse = 1.0 / direction
    one, two = (-OBJECT_HALF_EXTENT - origin) * inverse, (OBJECT_HALF_EXTENT - origin) * inverse
    nearest = torch.minimum(one, two).amax(1)
    return torch.maximum(one, two).amin(1) >= nearest.clamp_min(0.0)
