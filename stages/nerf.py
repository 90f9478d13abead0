"""Phase 1: fit a surface, its materials and its light to the views.

Reads MaterialViews and, unless phase 0 was skipped, an EnvironmentLight; writes a FittedField.
Method: the visual hull of the masks starts a volume (signed distance or density); a hash-grid
field holds the materials; rays are composited and shaded once each by the prefiltered environment
and compared with the views' radiance, materials, normals and masks. Depth is never used.
Source: SViM3D sec. 4 (phase 1 of the reconstruction), on top of Instant-NGP and NeuS.
"""

import logging
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn

from stages import view_remedies
from stages.artifacts import EnvironmentLight, FittedField, MaterialViews
from stages.base import Context, Stage
from stages.capacity_plan import CapacityPlan, bounded
from stages.errors import InputError
from stages.nerf_hull import start_hull
from stages.nerf_terms import ray_terms, shown_loss
from stages.perceptual_terms import PerceptualTerm
from stages.plateau import Plateau
from stages.prefilter_cache import cached_operator
from stages.settings.nerf import NerfConfig
from svim3d.cameras import Cameras
from svim3d.fields.distance import without_hidden_parts
from svim3d.fields.hash_grid import HashGridSpec
from svim3d.fields.material_field import MaterialField, MaterialFieldSpec
from svim3d.fields.sdf_grid import resample_grid
from svim3d.optim import NamedAdam, Rate
from svim3d.render import ray_losses
from svim3d.render.aligned_views import AlignedViews
from svim3d.render.hull import INSIDE_COVERAGE
from svim3d.render.march import Rays, hits_surface
from svim3d.render.pixel_blocks import PIXELS, PixelBlocks
from svim3d.render.volumes import DensityVolume, SdfVolume
from svim3d.render.volumetric import Rendered, render_rays
from svim3d.shading.prefilter import EnvironmentPyramid

log = logging.getLogger(__name__)

VOLUME, SDF_GRID, ENVIRONMENT = "volume.", "volume.grid", "log_environment"  # parameter names

MIN_VIEWS = 3  # fewer silhouettes leave the hull open along whole directions
ENVIRONMENT_EPS = 1e-8  # texels that nothing reflects keep the light they started with
MIN_RADIANCE = 1e-4  # keeps the logarithm of black texels finite
SMALLEST_PART = 1e-4  # of the largest part's volume: smaller ones are specks
MOMENT_POWER = {"exp_avg": 1, "exp_avg_sq": 2}  # how Adam's moments scale with the gradient
REFRESH_EVERY = 8  # steps between updates of the empty-space grid
WARM_UP = 10  # steps over which the rates rise, while Adam's moments fill
CULL_RAYS = 65536  # rays tested at once for meeting the hull


@dataclass(frozen=True)
class _Fit:
    """Everything that the optimisation changes."""

    volume: SdfVolume | DensityVolume
    materials: MaterialField
    log_environment: nn.Parameter
    adam: NamedAdam

    @classmethod
    def assemble(
        cls,
        volume: SdfVolume | DensityVolume,
        materials: MaterialField,
        log_environment: nn.Parameter,
        config: NerfConfig,
    ) -> "_Fit":
        """Give every parameter its rate."""
        named = {f"{VOLUME}{n}": p for n, p in volume.named_parameters()}
        named |= {f"materials.{n}": p for n, p in materials.named_parameters()}
        named[ENVIRONMENT] = log_environment
        rates = {name: _rate(name, config) for name in named}
        if isinstance(volume, SdfVolume):
            distance = Rate(config.sdf_rate * volume.cell)
            rates |= {name: distance for name in named if name.startswith(VOLUME)}
        return cls(volume, materials, log_environment, NamedAdam(named, rates))

    def grow(self, nodes: int, config: NerfConfig) -> None:
        """Refine the signed-distance grid and carry Adam's moments along.

        A node of a finer grid sees fewer samples: its gradients shrink with the cell's volume.
        """
        assert isinstance(self.volume, SdfVolume)
        ratio = (len(self.volume.grid) / nodes) ** 3
        self.volume.resample(nodes, _coarse_below(nodes, config))
        rate = Rate(config.sdf_rate * self.volume.cell)
        fresh = {f"{VOLUME}{n}": p for n, p in self.volume.named_parameters()}
        for name in [n for n in self.adam.parameters if n.startswith(VOLUME) and n not in fresh]:
            self.adam.remove(name)
        for name in fresh.keys() - {SDF_GRID}:
            self.adam.replace(name, fresh[name], rate)
        self.adam.replace(
            SDF_GRID,
            self.volume.grid,
            rate,
            lambda moment, old: resample_grid(old, nodes) * ratio ** MOMENT_POWER[moment],
        )


# What is computed from settings stays here: their own modules are no part of an artifact's key.
def _sharpness_at(done: float, config: NerfConfig) -> float:
    """Sharpness when a share `done` of the steps has passed."""
    return float(config.sharpness_start * (config.sharpness_end / config.sharpness_start) ** done)


def _coarse_below(nodes: int, config: NerfConfig) -> tuple[int, ...]:
    """The coarser grids that are added to a grid of `nodes`."""
    return config.coarse_nodes if nodes <= config.coarse_largest else ()


def _rate(name: str, config: NerfConfig) -> Rate:
    """Adam's step by kind of parameter."""
    if name == ENVIRONMENT:
        return Rate(config.environment_rate, eps=ENVIRONMENT_EPS)
    return Rate(config.network_rate if ".network." in name else config.field_rate)


def _check(views: MaterialViews) -> None:
    """Refuse what can never work, with advice."""
    if len(views.cameras) < MIN_VIEWS:
        raise InputError(
            f"nerf needs at least {MIN_VIEWS} views around the object, got {len(views.cameras)}; "
            "give an orbit of views (21 are usual), or a mesh to render one from"
        )
    empty = [i for i, mask in enumerate(views.mask) if float(mask.max()) < INSIDE_COVERAGE]
    if empty:
        raise InputError(
            f"the mask of view {empty[0]} is empty (as are {len(empty) - 1} others); every view "
            "must show the object: check channel A of these views or leave them out"
        )


def _pixel_blocks(
    cameras: Cameras, planes: dict[str, Tensor], hull: Tensor, config: NerfConfig
) -> PixelBlocks:
    """Blocks of which some ray comes near the hull; all others show nothing and teach nothing."""
    blocks = PixelBlocks.cut(cameras, planes)
    volume = SdfVolume(hull, config.half_extent)
    volume.refresh()
    keep = []
    for start in range(0, len(blocks), CULL_RAYS // PIXELS):
        part = blocks.take(torch.arange(start, min(start + CULL_RAYS // PIXELS, len(blocks))))
        hits = hits_surface(
            part.rays(), volume.cells, half_extent=config.half_extent, step=volume.step
        )
        keep.append(hits.view(-1, PIXELS).any(1))
    return blocks.take(torch.cat(keep))


def _start_volume(hull: Tensor, config: NerfConfig, ctx: Context) -> SdfVolume | DensityVolume:
    """The density model that was asked for, filling the hull."""
    if config.density_model == "sdf":
        surface = SdfVolume(hull, config.half_extent)
        surface.resample(config.grid_nodes[0], _coarse_below(config.grid_nodes[0], config))
        return surface
    spec = HashGridSpec(
        config.hash_levels, config.hash_log2_entries, config.hash_coarsest, config.hash_finest
    )
    fog = DensityVolume(spec, hull, config.half_extent, config.density_threshold)
    fog.reset(ctx.generator("density"))
    return fog.to(ctx.device)


def _start(
    hull: Tensor, environment: EnvironmentLight | None, config: NerfConfig, ctx: Context
) -> _Fit:
    """Parameters and optimiser before the first step."""
    spec = MaterialFieldSpec(
        levels=config.hash_levels,
        log2_entries=config.hash_log2_entries,
        coarsest=config.hash_coarsest,
        finest=config.hash_finest,
        hidden=config.hidden,
        half_extent=config.half_extent,
    )
    materials = MaterialField(spec)
    materials.reset(ctx.generator("materials"))
    if environment is None:
        size = config.environment_size
        radiance = torch.full((size, size, 3), config.environment_start)
    else:
        radiance = environment.radiance
    log_environment = nn.Parameter(radiance.clamp_min(MIN_RADIANCE).log().to(ctx.device))
    volume = _start_volume(hull, config, ctx)
    return _Fit.assemble(volume, materials.to(ctx.device), log_environment, config)


def _draw(blocks: PixelBlocks, step: int, config: NerfConfig, ctx: Context) -> PixelBlocks:
    """The blocks of a step: epochs of random order, each a function of the seed alone."""
    count = min(config.rays_per_step // PIXELS, len(blocks))
    per_epoch = len(blocks) // count
    epoch, place = divmod(step, per_epoch)
    order = torch.randperm(len(blocks), generator=ctx.generator(f"epoch {epoch}"))
    return blocks.take(order[place * count : (place + 1) * count].to(ctx.device))


def _render(
    fit: _Fit,
    pyramid: EnvironmentPyramid,
    rays: Rays,
    name: str,
    *,
    step: int,
    config: NerfConfig,
    ctx: Context,
) -> Rendered:
    """What rays see at a step; `name` tells those of one step apart."""
    jitter = torch.rand(len(rays.origins), generator=ctx.generator(f"{name} {step}"))
    return render_rays(
        fit.volume,
        fit.materials,
        rays,
        jitter=jitter.to(ctx.device),
        pyramid=pyramid,
        min_weight=config.min_weight,
        use_bump=step >= config.bump_start * config.steps,
        multiple_scattering=config.multiple_scattering,
    )


def _optimise(
    fit: _Fit,
    blocks: PixelBlocks,
    aligned: AlignedViews | None,
    perceptual: PerceptualTerm | None,
    config: NerfConfig,
    ctx: Context,
) -> None:
    """The loop. State is saved where the empty-space grid is a function of the parameters."""
    operator = cached_operator(ctx.shared, len(fit.log_environment))
    plateau = Plateau.of(config, config.grid_shares, window=REFRESH_EVERY)
    held_out, blocks = plateau.held_out(blocks, ctx)
    step = _resume(fit, aligned, plateau, config, ctx)
    while step < config.steps:
        warped = aligned if step >= config.warp_start * config.steps else None
        if step % REFRESH_EVERY == 0:
            _grow_if_due(fit, step, config)
            if warped is not None:
                view_remedies.realign(warped, step / config.steps, config)
            if ctx.checkpoints.due():
                learnt = {} if aligned is None else aligned.state()
                learnt |= plateau.state() | dict(fit.volume.named_buffers())
                ctx.checkpoints.save(step, fit.adam.state() | learnt)
            if isinstance(fit.volume, SdfVolume):
                fit.volume.sharpness = _sharpness_at(step / config.steps, config)
            fit.volume.refresh(generator=ctx.generator(f"refresh {step}"))
        pyramid = operator(fit.log_environment.exp())
        render = partial(_render, fit, pyramid, step=step, config=config, ctx=ctx)
        if plateau.is_watched and step % REFRESH_EVERY == 0:
            shown = _read_through(warped, held_out)
            with torch.no_grad():
                seen = render(shown.rays(), "held out")
            plateau.observe(step, shown_loss(seen, shown, fit.log_environment, config))
        batch = _read_through(warped, _draw(blocks, step, config, ctx))
        rendered = render(batch.rays(), "jitter")
        if warped is not None:
            warped.observe(batch.pixels, rendered.surface_images(), batch.targets)
        terms = ray_terms(
            rendered,
            batch,
            log_environment=fit.log_environment,
            done=step / config.steps,
            config=config,
        )
        if perceptual is not None:
            terms |= perceptual.of_rays(step, render, warped)
        if ctx.is_finite(step, terms):
            fit.adam.zero_grad()
            torch.stack(list(terms.values())).sum().backward()
            if ctx.is_finite(step, fit.adam.gradients()):
                warm = min(1.0, (step + 1) / WARM_UP)
                fit.adam.step(config.final_rate ** (step / config.steps) * warm)
        told = {name: float(t.detach()) for name, t in terms.items()}
        if warped is not None and step % REFRESH_EVERY == 0:
            told |= view_remedies.view_terms(warped)
        ctx.report(step + 1, config.steps, told)
        step = plateau.after(step, ctx)
    plateau.tell(ctx)


def _read_through(aligned: AlignedViews | None, batch: PixelBlocks) -> PixelBlocks:
    """A batch with what its views show where they are read through their warps, if any."""
    return batch if aligned is None else batch.showing(aligned.targets(batch.pixels))


def _grow_if_due(fit: _Fit, step: int, config: NerfConfig) -> None:
    """Go to the next grid of the schedule at the first refresh at or after its share of steps."""
    if not isinstance(fit.volume, SdfVolume):
        return
    begun = [share * config.steps <= step for share in config.grid_shares]
    nodes = config.grid_nodes[sum(begun) - 1]
    if nodes != len(fit.volume.grid):
        fit.grow(nodes, config)


def _resume(
    fit: _Fit,
    aligned: AlignedViews | None,
    plateau: Plateau,
    config: NerfConfig,
    ctx: Context,
) -> int:
    """Take up a checkpoint; returns the step to go on with."""
    saved = ctx.checkpoints.load()
    if saved is None:
        return 0
    step, tensors = saved
    nodes = tensors.get(f"value.{SDF_GRID}")
    if nodes is not None and isinstance(fit.volume, SdfVolume):
        fit.grow(len(nodes), config)
    fit.adam.load_state(tensors)
    for name, buffer in fit.volume.named_buffers():
        buffer.copy_(tensors[name])
    if aligned is not None:
        aligned.load_state(tensors)
    plateau.load_state(tensors)
    log.info("nerf: resumed at step %d", step)
    return step


def run(
    views: MaterialViews,
    environment: EnvironmentLight | None,
    plan: CapacityPlan | None = None,
    *,
    config: NerfConfig,
    ctx: Context,
) -> FittedField:
    """Fit a field to the views; with a plan sizes are upper bounds.

    Raises:
        InputError: fewer than three views, an empty mask, or masks that share no point.
    """
    _check(views)
    config = bounded(config, plan, ctx)
    cameras, planes = views.premultiplied(config.image_size)
    cameras = cameras.to(ctx.device)
    planes = {name: plane.to(ctx.device) for name, plane in planes.items()}
    hull = start_hull(planes, cameras, views.reference, config, ctx)
    planes["guide"] = ray_losses.smoothing_guide(planes["radiance"], planes.get("confidence"))
    planes = view_remedies.with_facing_trust(cameras, planes, config)
    blocks = _pixel_blocks(cameras, planes, hull, config)
    fit = _start(hull, environment, config, ctx)
    aligned = view_remedies.align_views(cameras, planes, views.reference, config)
    perceptual = PerceptualTerm.of(cameras, planes, config, ctx)
    _optimise(fit, blocks, aligned, perceptual, config, ctx)
    if aligned is not None:
        view_remedies.tell_of_views(aligned, ctx)
    sdf = fit.volume.signed_distance(config.grid_nodes[-1])
    return FittedField(
        sdf=without_hidden_parts(sdf, smallest_share=SMALLEST_PART).cpu(),
        half_extent=config.half_extent,
        material_spec=fit.materials.spec,
        material_state={n: t.detach().cpu() for n, t in fit.materials.state_dict().items()},
        environment=fit.log_environment.detach().exp().cpu(),
        corrections=None if aligned is None else aligned.corrections.to("cpu"),
    )


NERF = Stage(run)
