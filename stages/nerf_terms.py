"""What phase 1 holds a batch of rays to: its loss terms and their weights along the schedule."""

import torch
from torch import Tensor

from stages import view_remedies
from stages.settings.nerf import NerfConfig
from svim3d.render import ray_losses
from svim3d.render.pixel_blocks import PIXELS, PixelBlocks
from svim3d.render.volumetric import Rendered

MIN_COVERAGE = 1e-3  # guards the division that turns premultiplied into straight


JUDGED = ("basecolor", "orm", "normal")  # terms that say how well views are shown


def shown_loss(
    rendered: Rendered, batch: PixelBlocks, log_environment: Tensor, config: NerfConfig
) -> float:
    """How well a batch is shown, by the same weights wherever the schedule is."""
    terms = ray_terms(rendered, batch, log_environment=log_environment, done=0.0, config=config)
    return sum(float(terms[name]) for name in JUDGED)


def ray_terms(
    rendered: Rendered,
    batch: PixelBlocks,
    *,
    log_environment: Tensor,
    done: float,
    config: NerfConfig,
) -> dict[str, Tensor]:
    """Weighted loss terms of one batch, `done` being the share of the steps that has passed."""
    target = batch.targets

    def blocks(values: Tensor) -> Tensor:
        return values.view(-1, PIXELS, values.shape[-1])

    normal = blocks(rendered.normal_geometric)
    straight = normal / blocks(rendered.mask).clamp_min(MIN_COVERAGE)
    depth = blocks(rendered.depth) / blocks(rendered.mask).clamp_min(MIN_COVERAGE)
    both = torch.minimum(blocks(rendered.mask).detach(), target["mask"])
    normal_weight = config.normal_weight + done * (config.normal_weight_end - config.normal_weight)
    trust = target.get("confidence")
    geometry_trust = ray_losses.combined_weight(trust, target.get(view_remedies.FACING))
    terms = {
        "mask": config.mask_weight
        * ray_losses.mask_loss(blocks(rendered.mask), target["mask"], trust),
        "basecolor": config.basecolor_weight
        * ray_losses.color_loss(blocks(rendered.basecolor), target["basecolor"], trust),
        "orm": config.orm_weight
        * ray_losses.squared_loss(
            torch.cat([blocks(rendered.roughness), blocks(rendered.metallic)], -1),
            torch.cat([target["roughness"], target["metallic"]], -1),
            trust,
        ),
        "normal": normal_weight
        * ray_losses.absolute_loss(normal, target["normal_world"], geometry_trust),
        "normal_smoothness": config.normal_smoothness_weight
        * ray_losses.bilateral_loss(straight, target["guide"], both),
        "depth_smoothness": config.depth_smoothness_weight
        * ray_losses.depth_smoothness_loss(depth, both, batch.footprint),
    }
    if config.density_model == "sdf":
        terms["eikonal"] = config.eikonal_weight * ray_losses.unit_gradient_loss(
            rendered.surface.gradient
        )
    if rendered.radiance is not None:
        terms["radiance"] = config.radiance_weight * ray_losses.radiance_loss(
            blocks(rendered.radiance), target["radiance"], trust
        )
        light = log_environment.exp()
        terms["light_balance"] = (
            config.light_balance_weight * (light - light.mean(-1, keepdim=True)).abs().mean()
        )
    if done >= config.bump_start:
        terms["bump_normal"] = config.bump_normal_weight * ray_losses.absolute_loss(
            blocks(rendered.normal_shading), target["normal_world"], geometry_trust
        )
        terms["bump_size"] = config.bump_size_weight * ray_losses.size_loss(rendered.bump)
    return terms
