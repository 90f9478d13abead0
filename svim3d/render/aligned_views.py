"""Views as an optimisation compares with: read through their warps, each with its weight."""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.render import view_warps
from svim3d.render.ray_losses import color_loss
from svim3d.render.registration import ViewAlignment, features
from svim3d.render.view_trust import view_weights
from svim3d.render.view_warps import ViewCorrections

DOUBT = "doubt"  # name of the plane that is not zero where a view is not to be trusted at all
MIN_COUNT = 1e-3  # guards the division by the pixels of a view of which none was seen
RESIDUAL_MEMORY = 0.8  # share of a view's residual that an update keeps from before


class AlignedViews:
    """V views with what is learnt of them on the way: a warp and a weight each.

    Args:
        cameras: their poses and size.
        planes: what they show, premultiplied; perhaps with a `confidence`.
        reference: the view that is neither warped nor weighed.
        limit: largest corner shift of a warp, in half pictures.
        weigh: give less weight to views that differ from the object more than the others do.
        start: corrections to start from.
    """

    def __init__(
        self,
        cameras: Cameras,
        planes: Mapping[str, Float[Tensor, "V H W _"]],
        *,
        reference: int,
        limit: float,
        weigh: bool,
        start: ViewCorrections | None = None,
    ) -> None:
        planes = _without_doubtful(planes)
        self.alignment = ViewAlignment(
            cameras,
            planes,
            reference=reference,
            limit=limit,
            shifts=None if start is None else start.shifts,
        )
        self._names, self._widths = list(planes), [p.shape[-1] for p in planes.values()]
        self._pictures = torch.cat([p.flatten(0, 2) for p in planes.values()], 1)
        self._reference, self._weigh = reference, weigh
        zeros = self._pictures.new_zeros
        self._residual = zeros(len(cameras)) - 1.0  # of views never seen
        self._sum, self._count, self._rejections = zeros(3, len(cameras)).unbind()
        self.weights = torch.ones_like(self._residual) if start is None else start.weights.clone()

    @property
    def corrections(self) -> ViewCorrections:
        """What was learnt."""
        return ViewCorrections(self.alignment.shifts, self.weights)

    def state(self) -> dict[str, Tensor]:
        """What to go on with; complete right after an update."""
        return {
            **self.corrections.tensors(),
            "views.structure": self.alignment.structure,
            "views.difference": self.alignment.difference,
            "views.residual": self._residual,
            "views.rejections": self._rejections,
        }

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what `state` gave."""
        self.alignment.shifts = tensors["views.shifts"].to(self.weights)
        self.alignment.structure = tensors["views.structure"].to(self.weights)
        self.alignment.difference = tensors["views.difference"].to(self.weights)
        self._residual = tensors["views.residual"].to(self.weights)
        self.weights = tensors["views.weights"].to(self.weights)
        self._rejections = tensors["views.rejections"].to(self.weights)

    def targets(self, pixels: Int[Tensor, "*batch"]) -> dict[str, Tensor]:
        """What the views show at pixels of theirs, by name, with the `confidence` that they have.

        It is zero where a warp leaves the picture.
        """
        flat, alignment = pixels.reshape(-1), self.alignment
        size = alignment.height, alignment.width
        values, weight = view_warps.read_through(self.corrections, self._pictures, flat, *size)
        named = dict(zip(self._names, values.split(self._widths, 1), strict=True))
        if DOUBT in named:
            weight = weight * (named.pop(DOUBT) == 0.0)
        named["confidence"] = weight * named.get("confidence", 1.0)
        return {name: value.view(*pixels.shape, -1) for name, value in named.items()}

    def chosen_targets(
        self, view: int, rendered_basecolor: Float[Tensor, "H W 3"], patience: int
    ) -> tuple[dict[str, Float[Tensor, "H W _"]], bool]:
        """A whole view through its warp or, if its colours fit better so, as it is.

        A warp that is worse than none `patience` times in a row is forgotten.
        Source: SViM3D sec. 4, phase 2.

        Returns:
            the targets, and whether the warp was forgotten.
        """
        height, width = self.alignment.height, self.alignment.width
        first = view * height * width
        pixels = torch.arange(first, first + height * width, device=self.weights.device)
        warped = self.targets(pixels.view(height, width))
        if not bool(self.alignment.shifts[view].any()):
            return warped, False
        own = dict(zip(self._names, self._pictures[pixels].split(self._widths, 1), strict=True))
        own = {n: value.view(height, width, -1) for n, value in own.items() if n != DOUBT}
        own["confidence"] = self.weights[view] * own.get("confidence", torch.ones_like(own["mask"]))
        both = torch.minimum(warped["confidence"], own["confidence"])
        losses = [
            color_loss(rendered_basecolor, shown["basecolor"], both) for shown in (warped, own)
        ]
        if bool(losses[0] < losses[1]):
            self._rejections[view] = 0.0
            return warped, False
        self._rejections[view] += 1.0
        forget = bool(self._rejections[view] >= patience)
        if forget:
            self._rejections[view] = 0.0
            self.alignment.forget(view)
        return own, forget

    def observe(
        self,
        pixels: Int[Tensor, "*batch"],
        rendered: Mapping[str, Float[Tensor, "P _"]],
        targets: Mapping[str, Float[Tensor, "*batch _"]],
    ) -> None:
        """Learn from rendered pixels and the `targets` that they were compared with."""
        pixels = pixels.reshape(-1)
        targets = {name: target.flatten(0, -2) for name, target in targets.items()}
        with torch.no_grad():
            shown = features(rendered)
            self.alignment.observe(pixels, shown, targets["confidence"])
            if self._weigh:
                differences = (shown - features(targets)).square().sum(1).nan_to_num()
                either = torch.maximum(rendered["mask"], targets["mask"]) > 0.5
                seen = (either * targets["confidence"])[:, 0]
                view = pixels // (self.alignment.height * self.alignment.width)
                self._sum.index_add_(0, view, differences * seen)
                self._count.index_add_(0, view, seen)

    def observe_view(
        self,
        view: int,
        rendered: Mapping[str, Float[Tensor, "H W _"]],
        targets: Mapping[str, Float[Tensor, "H W _"]],
        *,
        every: int,
    ) -> None:
        """Learn from one in `every` pixels of a whole view; those on no object teach nothing."""
        either = torch.maximum(rendered["mask"].detach(), targets["mask"])
        places = torch.nonzero(either.reshape(-1) > 0.0)[:, 0][::every]
        first = view * self.alignment.height * self.alignment.width
        self.observe(
            first + places,
            {name: image.flatten(0, 1)[places] for name, image in rendered.items()},
            {name: image.flatten(0, 1)[places] for name, image in targets.items()},
        )

    def update(self, gain: float) -> None:
        """Let what was observed act on warps and weights."""
        self.alignment.update(gain)
        if not self._weigh:
            return
        fresh = self._sum / self._count.clamp_min(MIN_COUNT)
        mixed = RESIDUAL_MEMORY * self._residual + (1.0 - RESIDUAL_MEMORY) * fresh
        mixed = torch.where(self._residual >= 0.0, mixed, fresh)
        self._residual = torch.where(self._count > 0.0, mixed, self._residual)
        if bool((self._residual >= 0.0).all()):
            self.weights = view_weights(self._residual, self._reference)
        self._sum.zero_()
        self._count.zero_()


def _without_doubtful(
    planes: Mapping[str, Float[Tensor, "V H W _"]],
) -> dict[str, Float[Tensor, "V H W _"]]:
    """The planes, and that of the doubt, with nothing where no confidence is.

    Reading between pixels must not carry what is there to its neighbours.
    """
    if "confidence" not in planes:
        return dict(planes)
    known = (planes["confidence"] > 0.0).float()
    kept = {name: torch.where(known > 0.0, plane, 0.0) for name, plane in planes.items()}
    return kept | {DOUBT: 1.0 - known}
