"""Find each view's warp by least squares against what the fitted object looks like from there.

A pixel of a render and the view's picture at the warped pixel differ by the picture's gradient
times what is still missing from the warp: eight unknowns per view, whose normal equations are
summed over the pixels that the optimisation renders anyway (Gauss-Newton). Their matrix is the
structure tensor of the picture; where it says nothing about a direction, the warp is kept at the
identity there. No step length has to be tuned to a loss's weights, and a handful of visits suffices
where gradient steps would take hundreds.

What all views have in common is not a warp but a motion of the object: see `CommonMotion`.
Source: Lucas and Kanade 1981; Baker and Matthews 2004 (the family); SViM3D sec. 4 (the purpose).
Differs from the paper: Gauss-Newton instead of Adam.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.color import srgb_from_linear
from svim3d.render import view_warps
from svim3d.render.view_warps import CORNERS, FREEDOMS

FEATURES = ("basecolor", "mask", "normal_world", "roughness", "metallic")
SCALES = (1.0, 1.0, 0.5, 0.5, 0.5)  # normals and the rest are drawn less surely than colours
OUTLIER = 1.0  # a difference from which on pixels count ever less: not moved, but another thing
MEMORY = 0.9  # share of the structure tensor that an update keeps from before
WEAK_SHARE = 3e-3  # of a view's best determined direction: a weaker one is noise
WORTH = 0.1  # of what a view differs by anyway; a warp that changes it by less is none
MIN_CONTRAST = 2e-4  # mean square of feature per half picture; below it nothing is determined
MIN_COUNT = 1e-3  # guards the division by the pixels of a view of which none was seen
FRONT = 0.25  # what is seen lies about this much nearer than the object's middle, world units
RIDGE = 1e-6  # of the common motions: some of them are nearly alike


def features(images: Mapping[str, Float[Tensor, "*batch _"]]) -> Float[Tensor, "*batch F"]:
    """What pictures are aligned by: premultiplied materials, normals and coverage, weighted."""
    encoded = {**images, "basecolor": srgb_from_linear(images["basecolor"])}
    scaled = zip(FEATURES, SCALES, strict=True)
    return torch.cat([encoded[name] * scale for name, scale in scaled], -1)


@dataclass(frozen=True)
class CommonMotion:
    """Corner shifts that a motion of the object, or the same warp of all views, would give.

    The reference view is never warped, and holds the object in place: if it would have to be warped
    to fit, the object has moved, and all other views are moved back.

    Attributes:
        motions: corner shifts of every view for each motion.
        solve: from the corner shifts of all views to the motions that explain them best.
    """

    motions: Float[Tensor, "V 8 M"]
    solve: Float[Tensor, "M V8"]

    @classmethod
    def of(cls, cameras: Cameras, reference: int) -> Self:
        """Similarities of a plane that faces each camera, and one warp for all views.

        The reference counts as much as all others together.
        """
        views = len(cameras)
        alike = torch.eye(FREEDOMS, dtype=torch.float64, device=cameras.c2w.device)
        motions = torch.cat([_similarity_shifts(cameras), alike.expand(views, -1, -1)], 2)
        weight = torch.ones(views, 1, 1, dtype=motions.dtype, device=motions.device)
        weight[reference] = views - 1.0
        flat = motions.flatten(0, 1)
        weighted = (motions * weight).flatten(0, 1)
        normal = flat.T @ weighted
        ridge = RIDGE * torch.diagonal(normal).mean() * torch.eye(len(normal)).to(normal)
        solve = torch.linalg.solve(normal + ridge, weighted.T)
        return cls(motions.float(), solve.float())

    def without(self, steps: Float[Tensor, "V 8"]) -> Float[Tensor, "V 8"]:
        """The part of all views' steps that no common motion explains."""
        return steps - self.motions @ (self.solve @ steps.reshape(-1))


def _similarity_shifts(cameras: Cameras) -> Float[Tensor, "V 8 7"]:
    """Corner shifts per unit of translation (3), rotation (3) and growth of the object."""
    cameras = replace(cameras, c2w=cameras.c2w.double())
    columns = []
    for view in range(len(cameras)):
        camera = cameras[view]
        rotation, position = camera.c2w[0, :3, :3], camera.positions[0]
        depth = float(position.norm()) - FRONT
        half_y = math.tan(math.radians(cameras.fov_y_deg) / 2)
        half = rotation.new_tensor([half_y * cameras.width / cameras.height, -half_y])
        corners = rotation.new_tensor(CORNERS) * half
        local = torch.cat([corners, -torch.ones_like(corners[:, :1])], 1) * depth
        points = local @ rotation.T + position
        axes = torch.eye(3, dtype=points.dtype, device=points.device)
        moves = [a.expand_as(points) for a in axes]
        moves += [torch.linalg.cross(a.expand_as(points), points) for a in axes]
        moves += [points]
        columns.append(torch.stack([_image_motion(m @ rotation, local, half) for m in moves], 1))
    return torch.stack(columns)


def _image_motion(
    move: Float[Tensor, "4 3"], local: Float[Tensor, "4 3"], half: Float[Tensor, "2"]
) -> Float[Tensor, "8"]:
    """Derivative of the normalised picture position of points (camera axes) that move."""
    ahead = -local[:, 2:]
    return ((move[:, :2] * ahead + local[:, :2] * move[:, 2:]) / ahead.square() / half).reshape(-1)


class ViewAlignment:
    """The warps of V views, and what has been seen of their errors since they last changed.

    Args:
        cameras: the views' poses and size.
        pictures: the views' `FEATURES`, premultiplied.
        reference: the view that is never warped.
        limit: largest corner shift, in half pictures.
        shifts: where to start.
    """

    def __init__(
        self,
        cameras: Cameras,
        pictures: Mapping[str, Float[Tensor, "V H W _"]],
        *,
        reference: int,
        limit: float,
        shifts: Float[Tensor, "V 4 2"] | None = None,
    ) -> None:
        self.height, self.width, self.views = cameras.height, cameras.width, len(cameras)
        self.reference, self.limit = reference, limit
        # What is no number is for the losses to complain of.
        self._pictures = features(pictures).flatten(0, 2).nan_to_num()
        zeros = self._pictures.new_zeros
        self.shifts = zeros(self.views, 4, 2) if shifts is None else shifts.clone()
        self._common = CommonMotion.of(cameras, reference)
        self.structure = zeros(self.views, FREEDOMS, FREEDOMS)
        self._fresh = zeros(self.views, FREEDOMS, FREEDOMS)
        self._slope = zeros(self.views, FREEDOMS)
        self.difference, self._energy, self._count = zeros(3, self.views).unbind()
        self.reach_px = 1.0  # of the differences that slopes are taken from; far sees farther

    def observe(
        self,
        pixels: Int[Tensor, "P"],
        rendered: Float[Tensor, "P F"],
        weight: Float[Tensor, "P 1"] | None = None,
    ) -> None:
        """Add pixels to the normal equations of their views.

        Args:
            pixels: flat indices into all views' pixels.
            rendered: their `features`, detached.
            weight: how far each pixel is to be trusted.
        """
        view = pixels // (self.height * self.width)
        position = view_warps.pixel_positions(pixels, self.height, self.width)
        moved = view_warps.pixel_shifts(self.shifts, view, position)
        # A render that is not finite is skipped by its optimisation; it must not linger here.
        counts = view_warps.is_inside(position + moved) & torch.isfinite(rendered).all(1)
        trust = counts.float()[:, None] if weight is None else counts[:, None] * weight
        value, slope_x, slope_y = self._look(pixels, moved)
        difference = torch.where(counts[:, None], value - rendered, 0.0)
        robust = trust / (1.0 + difference.square().sum(1, keepdim=True) / OUTLIER**2)
        basis = view_warps.corner_basis(position)
        x, y = basis.unbind(1)

        def product(a: Tensor, b: Tensor) -> Tensor:
            return (a * b).sum(1, keepdim=True) * robust

        along_x = product(slope_x, slope_x) * x + product(slope_x, slope_y) * y
        along_y = product(slope_x, slope_y) * x + product(slope_y, slope_y) * y
        outer = x[:, :, None] * along_x[:, None] + y[:, :, None] * along_y[:, None]
        slope = product(slope_x, difference) * x + product(slope_y, difference) * y
        self._fresh.index_add_(0, view, outer)
        self._slope.index_add_(0, view, slope)
        self._energy.index_add_(0, view, product(difference, difference)[:, 0])
        self._count.index_add_(0, view, trust[:, 0])

    def _look(self, pixels: Tensor, moved: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Values at shifted pixels and their central differences, per half picture."""
        unit = self.reach_px * moved.new_tensor([2.0 / self.width, 2.0 / self.height])
        steps = torch.tensor([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]).to(moved) * unit
        values = [
            view_warps.read(self._pictures, pixels, moved + step, self.height, self.width)
            for step in steps
        ]
        slope_x = (values[1] - values[2]) * (0.25 * self.width / self.reach_px)
        slope_y = (values[3] - values[4]) * (0.25 * self.height / self.reach_px)
        return values[0], slope_x, slope_y

    def forget(self, view: int) -> None:
        """Begin anew with one view."""
        self.shifts = self.shifts.clone()
        self.shifts[view] = 0.0
        for total in (self.structure, self.difference):
            total[view] = 0.0

    def update(self, gain: float) -> None:
        """Move each warp by `gain` of what its normal equations ask for, and begin new ones."""
        count, met = self._count.clamp_min(MIN_COUNT), self._count > 0.0
        begun = self.difference > 0.0

        def mixed(old: Tensor, total: Tensor) -> Tensor:
            shape = (-1,) + (1,) * (total.dim() - 1)
            fresh = total / count.view(shape)
            kept = torch.where(begun.view(shape), MEMORY * old + (1.0 - MEMORY) * fresh, fresh)
            return torch.where(met.view(shape), kept, old)

        self.structure = mixed(self.structure, self._fresh)
        self.difference = mixed(self.difference, self._energy)
        shifts = self.shifts.flatten(1)
        steps = determined_step(self.structure, -self._slope / count[:, None], shifts)
        steps = torch.where(self._is_worth_it(shifts + steps), steps, -shifts) * met[:, None]
        moved = shifts + gain * self._common.without(steps)
        moved[self.reference] = 0.0
        self.shifts = view_warps.bounded(moved.view_as(self.shifts), self.limit)
        for total in (self._fresh, self._slope, self._energy, self._count):
            total.zero_()

    def _is_worth_it(self, shifts: Float[Tensor, "V 8"]) -> Bool[Tensor, "V 1"]:
        """Whether warps change what their views show by more than a part of what is wrong anyway.

        Smaller ones cannot be told from the unfinished object's own errors, and would follow them.
        """
        change = (shifts[:, None] @ self.structure @ shifts[..., None])[:, :, 0]
        return change > WORTH * self.difference[:, None]


def determined_step(
    structure: Float[Tensor, "V 8 8"],
    wanted: Float[Tensor, "V 8"],
    shifts: Float[Tensor, "V 8"],
) -> Float[Tensor, "V 8"]:
    """Solve the normal equations where they say something; elsewhere go back to the identity.

    Args:
        structure: mean square motion of the features by the eight corner shifts.
        wanted: mean product of that motion and what is missing.
        shifts: the warps as they are.
    """
    values, vectors = torch.linalg.eigh(structure)
    floor = (WEAK_SHARE * values[:, -1:]).clamp_min(MIN_CONTRAST)
    known = values > floor
    along = (vectors.transpose(1, 2) @ wanted[..., None])[..., 0]
    back = (vectors.transpose(1, 2) @ shifts[..., None])[..., 0]
    step = torch.where(known, along / values.clamp_min(MIN_CONTRAST), -back)
    return (vectors @ step[..., None])[..., 0]
