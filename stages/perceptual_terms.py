"""What phases 1 and 2 hold renders to as pictures, as far as they do the same."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages import view_remedies
from stages.base import Context
from stages.errors import InputError
from stages.settings.dmtet import DmtetConfig
from stages.settings.nerf import NerfConfig
from svim3d.cameras import Cameras
from svim3d.io.weights import load_state
from svim3d.losses.lpips import Lpips
from svim3d.render import ray_losses
from svim3d.render.aligned_views import AlignedViews
from svim3d.render.deferred import RenderedView
from svim3d.render.hull import INSIDE_COVERAGE
from svim3d.render.march import Rays
from svim3d.render.perceptual import (
    Distance,
    crop_around,
    draw_triplets,
    perceptual_loss,
    structural_distance,
)
from svim3d.render.pixel_blocks import pixel_rays
from svim3d.render.volumetric import Rendered


@dataclass(frozen=True)
class PerceptualTerm:
    """The loss term and what it needs.

    Attributes:
        cameras: of the views.
        planes: what they show, premultiplied.
        object_pixels: flat indices of those that show the object.
        distance: of pictures.
    """

    cameras: Cameras
    planes: Mapping[str, Float[Tensor, "V H W _"]]
    object_pixels: Int[Tensor, "P"]
    distance: Distance
    config: NerfConfig | DmtetConfig
    ctx: Context

    @classmethod
    def of(
        cls,
        cameras: Cameras,
        planes: Mapping[str, Tensor],
        config: NerfConfig | DmtetConfig,
        ctx: Context,
    ) -> Self | None:
        """None if it is not asked for.

        Raises:
            InputError: the network that was asked for is not there.
        """
        distance = _distance(config, ctx)
        if distance is None or config.perceptual_weight == 0.0:
            return None
        covered = torch.nonzero(planes["mask"].reshape(-1) >= INSIDE_COVERAGE)[:, 0]
        return cls(cameras, planes, covered, distance, config, ctx)

    def of_rays(
        self, step: int, render: Callable[[Rays, str], Rendered], aligned: AlignedViews | None
    ) -> dict[str, Tensor]:
        """Phase 1's term, if it is due: a crop of a view is rendered, by rays and a name of theirs.

        Its weight rises with the steps that have passed.
        """
        if step % self.config.perceptual_every:
            return {}
        crop = self._crop(step, self.object_pixels)
        rendered = render(pixel_rays(self.cameras, crop.reshape(-1)), "crop")
        assert rendered.radiance is not None  # phase 1 always has a light
        images = rendered.surface_images() | {
            "radiance": rendered.radiance,
            "normal_world": rendered.normal_shading,
        }
        if aligned is None:
            targets = {name: plane.flatten(0, 2)[crop] for name, plane in self.planes.items()}
        else:
            targets = aligned.targets(crop)
        shown = {name: image.view(*crop.shape, -1) for name, image in images.items()}
        return self._term(step, step / self.config.steps, shown, targets)

    def of_view(
        self, step: int, view: int, rendered: RenderedView, targets: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Phase 2's term, if it is due, on a crop of a view that was rendered anyway."""
        per_view = self.cameras.height * self.cameras.width
        inside = self.object_pixels[self.object_pixels // per_view == view]
        if step % self.config.perceptual_every or not len(inside):
            return {}
        crop = self._crop(step, inside) - view * per_view
        images = rendered.surface_images() | {"radiance": rendered.radiance}
        shown, wanted = (
            {name: image.flatten(0, 1)[crop] for name, image in side.items()}
            for side in (images, targets)
        )
        return self._term(step, 1.0, shown, wanted)

    def _crop(self, step: int, among: Int[Tensor, "P"]) -> Int[Tensor, "H W"]:
        """A square around one of some pixels."""
        drawn = torch.randint(len(among), (), generator=self.ctx.generator(f"crop {step}"))
        return crop_around(int(among[int(drawn)]), self.cameras, self.config.perceptual_size)

    def _term(
        self, step: int, share: float, shown: Mapping[str, Tensor], targets: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """The weighted term, `share` of the weight."""
        trust = targets.get("confidence")
        loss = perceptual_loss(
            shown,
            targets,
            draw_triplets(self.ctx.generator(f"triplets {step}")),
            self.distance,
            trust=trust,
            normal_trust=ray_losses.combined_weight(trust, targets.get(view_remedies.FACING)),
        )
        weight = share * self.config.perceptual_weight * self.config.perceptual_every
        return {"perceptual": weight * loss}


def _distance(config: NerfConfig | DmtetConfig, ctx: Context) -> Distance | None:
    """The distance that settings ask for."""
    if config.perceptual == "none":
        return None
    file = config.perceptual_weights
    if file is None:
        if config.perceptual == "auto":
            ctx.event("no_lpips", "no weights for LPIPS: pictures are compared by their structure")
        return structural_distance
    try:
        network = Lpips.of(load_state(file))
    except ValueError as error:
        raise InputError(f"perceptual_weights: {error}") from error
    wanted = {"lpips": False, "st_lpips": True}.get(config.perceptual, network.is_shift_tolerant)
    if network.is_shift_tolerant != wanted:
        raise InputError(
            f"perceptual {config.perceptual} was asked for, but {file.name} holds the "
            f"{'plain' if wanted else 'shift-tolerant'} network; choose the other one, or auto"
        )
    return network.to(ctx.device)
