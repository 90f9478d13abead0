"""How large a drawn object is: its silhouettes tell in units of the cameras' distance.

Put the cameras at distance 1. A silhouette that ends at the angle t from the optical axis touches
the plane through the camera with outward normal n = cos(t) s + sin(t) b, where s points to that
side of the picture and b back to the camera; its distance from the origin, the camera's centre
times n, is sin(t). So every side of every silhouette is one exact value of the object's support
function h(n), the largest n.x of all its points x; perspective is part of it.

Left and right sides give h all around the horizon. No side gives it straight up or down: the planes
of the upper and lower sides lean by a, the elevation and t together. With q = h of the horizontal
direction in which they lean,

    smooth shape (ellipsoid):  h(n)^2 = (y cos a)^2 + (q sin a)^2
    edge (upright box):        h(n) = y cos a + q sin a

and the surface normal that the picture shows at that side tells which: on a smooth shape it is n.

A sphere comes out exact. Upright boxes are overrated in width, where h has a dent at each face that
planes 9 degrees apart do not hit and where sides lean with the camera: a cube by 14 %, a pot or a
slab by 5 %, a slab that stands askew by 13 %.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras

COVERED = 0.5
RIM = 0.03  # share of the silhouette's height whose normals tell of its upper or lower side
SMOOTH_COSINE = math.cos(math.radians(45.0))  # between surface normal and n; edges are 65 apart
MAX_LEAN = math.radians(75.0)  # beyond this a side says nothing of the height


def longest_side(
    cameras: Cameras, mask: Float[Tensor, "V H W 1"], normal_camera: Float[Tensor, "V H W 3"]
) -> float:
    """Longest side of the object's bounding box, in units of the cameras' distance.

    Args:
        cameras: looking at the origin; their distance from it plays no part.
        mask: coverage.
        normal_camera: unit; x right, y up, z to the camera.

    Raises:
        ValueError: no view shows anything.
    """
    seen = [view for view in range(len(cameras)) if bool((mask[view] > COVERED).any())]
    if not seen:
        raise ValueError("wanted silhouettes to tell the object's size by, all views are empty")
    angles = {view: _side_angles(mask[view, ..., 0] > COVERED, cameras.focal_px) for view in seen}
    around = _Horizon.of(cameras, angles)
    width = around(math.pi / 2) + around(-math.pi / 2)
    depth = around(0.0) + around(math.pi)
    heights = []
    for side in (1, -1):
        reaches = [
            _vertical_reach(cameras.c2w[v], side, angles[v], around, mask[v], normal_camera[v])
            for v in seen
        ]
        known = torch.tensor([reach for reach in reaches if reach is not None])
        heights.append(float(known.median()) if len(known) else 0.0)
    return max(width, depth, sum(heights))


def _side_angles(covered: Tensor, focal_px: float) -> dict[str, float]:
    """Angle from the optical axis at which the silhouette ends on each side, radians."""
    rows = torch.nonzero(covered.any(1))[:, 0]
    columns = torch.nonzero(covered.any(0))[:, 0]
    height, width = covered.shape
    ends = {
        "left": width / 2 - int(columns[0]),
        "right": int(columns[-1]) + 1 - width / 2,
        "top": height / 2 - int(rows[0]),
        "bottom": int(rows[-1]) + 1 - height / 2,
    }
    return {side: math.atan(end / focal_px) for side, end in ends.items()}


class _Horizon:
    """The support function in horizontal directions, linear between those that were seen."""

    def __init__(self, azimuths: list[float], reaches: list[float]) -> None:
        order = sorted(range(len(azimuths)), key=azimuths.__getitem__)
        self._azimuths = [azimuths[i] for i in order]
        self._reaches = [reaches[i] for i in order]

    @classmethod
    def of(cls, cameras: Cameras, angles: dict[int, dict[str, float]]) -> "_Horizon":
        """From the left and right sides of all silhouettes, whose planes stand nearly upright."""
        azimuths, reaches = [], []
        for view, found in angles.items():
            right, backward = cameras.c2w[view, :3, 0], cameras.c2w[view, :3, 2]
            for side, sign in (("left", -1.0), ("right", 1.0)):
                angle = found[side]
                normal = sign * math.cos(angle) * right + math.sin(angle) * backward
                azimuths.append(math.atan2(float(normal[0]), float(normal[2])))
                reaches.append(math.sin(angle))
        return cls(azimuths, reaches)

    def __call__(self, azimuth: float) -> float:
        """Largest extent towards an azimuth, radians."""
        turns = [(other - azimuth) % math.tau for other in self._azimuths]
        after = min(range(len(turns)), key=turns.__getitem__)
        before = max(range(len(turns)), key=turns.__getitem__)
        ahead, behind = turns[after], math.tau - turns[before]
        share = behind / (ahead + behind) if ahead + behind > 0.0 else 0.0
        return self._reaches[before] + share * (self._reaches[after] - self._reaches[before])


def _vertical_reach(
    c2w: Float[Tensor, "4 4"],
    side: int,
    angles: dict[str, float],
    around: _Horizon,
    mask: Float[Tensor, "H W 1"],
    normal_camera: Float[Tensor, "H W 3"],
) -> float | None:
    """Extent upwards (`side` 1) or downwards (-1) as one view shows it; None where it cannot."""
    elevation = math.asin(max(-1.0, min(1.0, float(c2w[1, 2]))))
    azimuth = math.atan2(float(c2w[0, 2]), float(c2w[2, 2]))
    angle = angles["top" if side == 1 else "bottom"]
    lean = angle - side * elevation
    if abs(lean) > MAX_LEAN:
        return None
    along = around(azimuth if lean > 0.0 else azimuth + math.pi) * abs(math.sin(lean))
    reach = math.sin(angle)
    plane = normal_camera.new_tensor([0.0, side * math.cos(angle), math.sin(angle)])
    shown = _rim_normal(side, mask, normal_camera)
    if float(shown @ plane) > SMOOTH_COSINE:
        return math.sqrt(max(reach * abs(reach) - along**2, 0.0)) / math.cos(lean)
    return (reach - along) / math.cos(lean)


def _rim_normal(
    side: int, mask: Float[Tensor, "H W 1"], normal_camera: Float[Tensor, "H W 3"]
) -> Float[Tensor, "3"]:
    """Mean surface normal in the outermost rows of a silhouette; not unit where they differ."""
    rows = torch.nonzero((mask[..., 0] > COVERED).any(1))[:, 0]
    rim = max(1, round(RIM * len(rows)))
    chosen = rows[:rim] if side == 1 else rows[-rim:]
    weight = mask[chosen] * (mask[chosen] > COVERED)
    return (normal_camera[chosen] * weight).sum((0, 1)) / weight.sum()
