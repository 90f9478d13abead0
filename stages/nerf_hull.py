"""The hull that phase 1 starts from: carved by silhouettes as far as they agree."""

import torch
from torch import Tensor

from stages import view_remedies
from stages.base import Context
from stages.errors import InputError
from stages.settings.nerf import NerfConfig
from svim3d.cameras import Cameras
from svim3d.fields.distance import signed_distance
from svim3d.render.hull import INSIDE_COVERAGE, MAX_REJECTIONS, coverage_votes, missed_shares

HULL_NODES = 128  # fine enough for parts of one pixel, and still computed in half a second
MIN_HULL_NODES = 8  # a hull of fewer nodes is noise
FURTHER = 2  # masks that may be wrong beside those that were allowed for, if no hull is left
MAX_MISSED = 0.05  # of the reference's silhouette; more masks overruled fill holes and gaps


def start_hull(
    planes: dict[str, Tensor], cameras: Cameras, reference: int, config: NerfConfig, ctx: Context
) -> Tensor:
    """Signed distance of the visual hull, positive inside, on a grid of `HULL_NODES`.

    Masks of some views may exclude a point by mistake, but never the reference view's. How many may
    is found where the settings leave it open: as few as let the hull fill that view's silhouette.
    If the masks disagree so much that nothing is left, more of them may be wrong.

    Raises:
        InputError: no point lies in enough of the masks.
    """
    masks = view_remedies.silhouettes(cameras, planes, reference, config, ctx)[..., 0]
    matrices = cameras.clip_from_world()

    def votes(views: slice, rejections: int) -> Tensor:
        return coverage_votes(
            masks[views],
            matrices[views],
            nodes=HULL_NODES,
            half_extent=config.half_extent,
            rejections=rejections,
        )

    own = slice(reference, reference + 1)
    vouched = votes(own, 0)
    most = min(MAX_REJECTIONS, len(cameras) - 2)
    asked = config.hull_rejections
    is_open = asked == "auto"
    allowed = 0 if asked == "auto" else min(asked, most)
    last = most if is_open else min(allowed + FURTHER, most)
    for rejections in range(allowed, last + 1):
        inside = torch.minimum(votes(slice(None), rejections), vouched) >= INSIDE_COVERAGE
        if int(inside.sum()) < MIN_HULL_NODES:
            continue
        missed = float(missed_shares(inside, masks[own], matrices[own], config.half_extent))
        if is_open and missed > MAX_MISSED and rejections < last:
            continue
        if rejections > allowed:
            ctx.event(
                "inconsistent_masks",
                f"hull found with {rejections} masks rejected; it fills the reference view's "
                f"silhouette but for {missed:.1%}",
            )
        return signed_distance(inside, config.half_extent)
    raise InputError(
        f"no point of the cube of half side {config.half_extent} lies in all masks but "
        f"{last}: the views contradict each other or their cameras are wrong; check that the "
        "object is centred at the origin with longest side 1 and that poses are OpenGL c2w"
    )
