"""What phases 1 and 2 do against views that contradict each other, as far as they do the same."""

import torch
from torch import Tensor

from stages.base import Context
from stages.settings.dmtet import DmtetConfig
from stages.settings.nerf import NerfConfig
from svim3d.cameras import Cameras
from svim3d.render.aligned_views import AlignedViews
from svim3d.render.hull import lone_carving
from svim3d.render.view_trust import facing_trust, view_weights
from svim3d.render.view_warps import ViewCorrections

TOLD_WEIGHT = 0.7  # of a view; a lower one is told
TOLD_LIMIT = 0.99  # share of the largest corner shift; a warp beyond it is told as bound
TOLD_MOTION = 0.005  # of the picture, mean over views and corners; true views stay below 0.002
FACING = "facing"  # name of the plane that holds the trust by angle
MIN_MASKS = 8  # of fewer, each has to carve what the others leave
LEAST_TAKEN = 0.04  # of a hull: shifted views take as much, and their homographies mend them
COARSE_NODES = 48  # of the grid on which masks are held against each other


def silhouettes(
    cameras: Cameras,
    planes: dict[str, Tensor],
    reference: int,
    config: NerfConfig,
    ctx: Context,
) -> Tensor:
    """Masks that carve the hull only where they are to be trusted.

    One that takes far more from it than any other does is wrong: a hull that it has carved would
    lack what all other views show. It carves nothing, and is told; its loss stays. A hull that is
    to reject masks point by point has no need of this.
    """
    mask = planes["mask"]
    if "confidence" in planes:
        mask = torch.maximum(mask, 1.0 - planes["confidence"])
    asked_to_reject = config.hull_rejections not in (0, "auto")
    if not config.weigh_views or asked_to_reject or len(mask) < MIN_MASKS:
        return mask
    taken = lone_carving(
        mask[..., 0],
        cameras.clip_from_world(),
        nodes=COARSE_NODES,
        half_extent=config.half_extent,
    )
    outvoted = view_weights(taken.clamp_min(LEAST_TAKEN), reference) < TOLD_WEIGHT
    for view in torch.nonzero(outvoted)[:, 0].tolist():
        ctx.event(
            "mask_outvoted", f"the mask of view {view} fits none of the others: it shapes no hull"
        )
    return torch.where(outvoted[:, None, None, None], 1.0, mask)


def align_views(
    cameras: Cameras,
    planes: dict[str, Tensor],
    reference: int,
    config: NerfConfig | DmtetConfig,
    start: ViewCorrections | None = None,
) -> AlignedViews | None:
    """The views with a warp and a weight each, if they are asked for."""
    if config.warp_start >= 1.0:
        return None
    return AlignedViews(
        cameras,
        planes,
        reference=reference,
        limit=config.warp_limit,
        weigh=config.weigh_views,
        start=None if start is None else start.to(cameras.c2w.device),
    )


def with_facing_trust(
    cameras: Cameras, planes: dict[str, Tensor], config: NerfConfig | DmtetConfig
) -> dict[str, Tensor]:
    """Premultiplied planes and, if it is asked for, the trust in normals by the angle."""
    if config.facing_gamma == 0.0:
        return planes
    trust = facing_trust(planes["normal_world"], planes["mask"], cameras, gamma=config.facing_gamma)
    return planes | {FACING: trust}


def realign(aligned: AlignedViews, done: float, config: NerfConfig) -> None:
    """Let phase 1's warps and weights follow what was seen since, in ever smaller, finer steps."""
    aligned.update(config.warp_gain * config.final_rate ** (0.5 * done))
    alignment = aligned.alignment
    reach = config.warp_reach * (1.0 - done) * max(alignment.height, alignment.width)
    alignment.reach_px = max(1.0, reach)


def view_terms(aligned: AlignedViews) -> dict[str, float]:
    """Figures of the warps and weights for a stage's scalars."""
    shifts = aligned.corrections.shifts.norm(dim=-1)
    size = max(aligned.alignment.height, aligned.alignment.width)
    return {
        "warp_px": float(shifts.mean()) * 0.5 * size,
        "largest_warp_px": float(shifts.max()) * 0.5 * size,
        "least_view_weight": float(aligned.weights.min()),
    }


def tell_of_views(aligned: AlignedViews, ctx: Context) -> None:
    """Name views that were held against the others, and warps that are large or at their bound."""
    for view in torch.nonzero(aligned.weights < TOLD_WEIGHT)[:, 0].tolist():
        ctx.event(
            "view_outvoted",
            f"view {view} disagrees with the others: it counts {float(aligned.weights[view]):.2f}",
        )
    motion = aligned.corrections.shifts.norm(dim=-1)
    mean, most = (0.5 * float(value) for value in (motion.mean(), motion.max()))
    if mean > TOLD_MOTION:
        ctx.event(
            "views_bent",
            f"the views do not fit together as they are: they were moved by {mean:.1%} of the "
            f"picture on average, by {most:.1%} at most",
        )
    largest = motion.amax(1)
    bound = torch.nonzero(largest > TOLD_LIMIT * aligned.alignment.limit)[:, 0].tolist()
    if bound:
        ctx.event("warp_bound", f"the homographies of views {bound} have reached their bound")
