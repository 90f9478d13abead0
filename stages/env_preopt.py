"""Phase 0: the environment that lights the views, before there is any geometry.

Reads views with materials and normals; writes an octahedral environment map. Every pixel is shaded
where it is, with its own normal and material and without occlusion. That is linear in the
environment, so the lookup of all pixels and the prefilter are stored operators, and each step fits
all pixels at once. Log radiance is optimised, which keeps light positive.

Source: SViM3D, section 4 ("illumination optimisation"). Differs from the paper: the pyramid holds
the lobes' exact integrals, and the loss compares square roots of radiance by absolute difference:
that gives each decade of brightness its say and leaves shadowed and doubly reflected pixels, which
the model cannot explain, as outliers.

`light=spherical_gaussians` fits 24 white lobes instead of a map's texels and writes their map: the
paper's ablation "without environment lighting" (its light is SV3D's).
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from stages.artifacts import EnvironmentLight, MaterialViews
from stages.base import Context, Stage
from stages.capacity_plan import CapacityPlan, bounded
from stages.errors import InputError
from stages.prefilter_cache import cached_operator
from stages.settings.env_preopt import EnvPreoptConfig
from svim3d.numerics import dot, normalize
from svim3d.optim import NamedAdam, Rate, cosine
from svim3d.shading.octahedral import total_variation
from svim3d.shading.spherical_gaussians import LOBES, lobes_over_sphere, log_octahedral
from svim3d.shading.stored_shading import StoredShading

BLACK_LEVEL = 0.02  # of the mean radiance: below it the square root no longer magnifies noise
CLIPPED_SHARE = 1e-3  # of all values; if so many equal the largest, they are clipped highlights
MIN_RADIANCE = 1e-6  # keeps the logarithm of the starting light finite for black pictures
LIGHT = "light"  # name of the parameter
ADAM_EPS = 1e-8  # far below the gradients of texels that anything reflects
ADAM_BETAS = (0.9, 0.95)  # the second moment forgets in 20 of 200 steps, as log radiance settles


def run(
    views: MaterialViews,
    plan: CapacityPlan | None = None,
    *,
    config: EnvPreoptConfig,
    ctx: Context,
) -> EnvironmentLight:
    """Fit the environment to all views; with a plan its size is an upper bound.

    Raises:
        InputError: no pixel is covered and seen from the front.
    """
    config = bounded(config, plan, ctx)
    pixels = _usable_pixels(views, config, ctx)
    radiance = pixels.pop("radiance").to(ctx.device)
    trust = pixels.pop("confidence").to(ctx.device) if "confidence" in pixels else None
    operator = cached_operator(ctx.shared, config.size, config.prefilter)
    shading = StoredShading.build(
        **{name: value.to(ctx.device) for name, value in pixels.items()},
        layout=operator.layout,
        multiple_scattering=config.multiple_scattering,
    )
    # A white environment tells how bright the materials are; their ratio starts the fit.
    white = torch.ones(config.size, config.size, 3, device=ctx.device)
    start = radiance.sum(0) / shading(operator(white)).sum(0).clamp_min(MIN_RADIANCE)
    light = _start_light(start.clamp_min(MIN_RADIANCE), config)
    objective = _Objective(radiance, trust)
    rates = {LIGHT: Rate(config.learning_rate, eps=ADAM_EPS)}
    adam = NamedAdam({LIGHT: light}, rates, betas=ADAM_BETAS)
    for step in range(_resume(ctx, adam), config.steps):
        if ctx.checkpoints.due():
            ctx.checkpoints.save(step, adam.state())
        log_radiance = _log_radiance(light, config)
        terms = {
            "photometric": objective(shading(operator(log_radiance.exp()))),
            "smooth": config.smooth_weight * total_variation(log_radiance),
            "white": config.white_weight * _departure_from_grey(log_radiance),
        }
        adam.zero_grad()
        ctx.report(step + 1, config.steps, {name: t.item() for name, t in terms.items()})
        if not ctx.is_finite(step, terms):
            continue
        torch.stack(list(terms.values())).sum().backward()
        adam.step(cosine(step, config.steps, warm_up=0, final=0.0))
    return EnvironmentLight(_log_radiance(light, config).detach().exp().cpu())


def _start_light(radiance: Float[Tensor, "3"], config: EnvPreoptConfig) -> nn.Parameter:
    """What is optimised, for an even light: log radiance of all texels, or a row for each lobe."""
    if config.light == "spherical_gaussians":
        return nn.Parameter(lobes_over_sphere(LOBES, radiance.mean()))
    return nn.Parameter(radiance.log().repeat(config.size, config.size, 1))


def _log_radiance(light: Float[Tensor, "..."], config: EnvPreoptConfig) -> Float[Tensor, "n n 3"]:
    """The map that the light is."""
    return log_octahedral(light, config.size) if light.ndim == 2 else light


class _Objective:
    """Mean absolute difference of square roots, relative to the pictures' own brightness.

    With a confidence each pixel's difference counts by it.
    """

    def __init__(self, radiance: Float[Tensor, "P 3"], trust: Float[Tensor, "P 1"] | None) -> None:
        self._trust = trust
        self._floor = BLACK_LEVEL * radiance.mean().clamp_min(MIN_RADIANCE)
        self._target = (radiance + self._floor).sqrt()
        self._clipped = _clipped(radiance)

    def __call__(self, shaded: Float[Tensor, "P 3"]) -> Float[Tensor, ""]:
        residual = (shaded + self._floor).sqrt() - self._target
        # A clipped highlight says only that the light is at least so bright.
        residual = torch.where(self._clipped, residual.clamp_max(0.0), residual)
        difference = residual.abs() if self._trust is None else residual.abs() * self._trust
        return difference.mean() / self._target.mean()


def _clipped(radiance: Float[Tensor, "P 3"]) -> Bool[Tensor, "P 3"]:
    """Values at the top of their range, if suspiciously many share it; else none."""
    at_top = radiance >= radiance.max()
    return at_top if bool(at_top.float().mean() > CLIPPED_SHARE) else torch.zeros_like(at_top)


def _departure_from_grey(log_radiance: Float[Tensor, "n n 3"]) -> Float[Tensor, ""]:
    """Mean absolute log ratio of each channel to the texel's mean."""
    return (log_radiance - log_radiance.mean(-1, keepdim=True)).abs().mean()


def _usable_pixels(
    views: MaterialViews, config: EnvPreoptConfig, ctx: Context
) -> dict[str, Tensor]:
    """Normals, view directions, materials and radiance of at most `max_pixels` good pixels."""
    directions, chosen = [], []
    for view in range(len(views.cameras)):
        _, rays = views.cameras.rays(view)
        normal = normalize(views.normal_world[view].reshape(-1, 3))
        facing = dot(normal, -rays)[:, 0] > config.min_n_dot_v
        covered = views.mask[view].reshape(-1) > config.min_mask
        if views.confidence is not None:
            covered &= views.confidence[view].reshape(-1) > 0.0
        finite = torch.isfinite(views.radiance[view].reshape(-1, 3)).all(-1)
        pixels = torch.nonzero(facing & covered & finite)[:, 0]
        directions.append(-rays[pixels])
        chosen.append(pixels + view * len(rays))
    index = torch.cat(chosen)
    if len(index) == 0:
        raise InputError(
            f"wanted pixels with a mask above {config.min_mask} that face the camera (normal.view "
            f"above {config.min_n_dot_v}), found none in {len(views.cameras)} views; check the "
            "masks, and that normals are in world space"
        )
    wo = torch.cat(directions)
    if len(index) > config.max_pixels:
        order = torch.randperm(len(index), generator=ctx.generator("pixels"))
        kept = order[: config.max_pixels].sort().values
        index, wo = index[kept], wo[kept]
    planes = {
        "basecolor": views.basecolor,
        "roughness": views.roughness,
        "metallic": views.metallic,
        "radiance": views.radiance,
        "normal": views.normal_world,
        **({} if views.confidence is None else {"confidence": views.confidence}),
    }
    pixels_of = {name: t.reshape(-1, t.shape[-1])[index] for name, t in planes.items()}
    return pixels_of | {"normal": normalize(pixels_of["normal"]), "wo": wo}


def _resume(ctx: Context, adam: NamedAdam) -> int:
    """Restore the last checkpoint, if there is one; the step to go on with."""
    saved = ctx.checkpoints.load()
    if saved is None:
        return 0
    step, state = saved
    adam.load_state(state)
    return step


ENV_PREOPT = Stage(run)
