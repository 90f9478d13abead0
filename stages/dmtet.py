"""Phase 2: refine an explicit surface, its materials and its light on whole images.

Reads MaterialViews and a FittedField, writes a RefinedSurface. Method: a lattice of tetrahedra
around the zero set of phase 1 carries a signed distance and an offset per node; marching gives a
closed mesh at every step, the rasteriser its pixels, the material field of phase 1, carried over,
their materials, and the prefiltered environment their radiance. All of them are compared with the
views; silhouettes are differentiable. Source: Munkberg et al. 2022; SViM3D sec. 4, phase 2.
Differs from the paper: the lattice is body-centred cubic and kept only around the surface.
"""

import logging
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from stages import view_remedies
from stages.artifacts import FittedField, MaterialViews, RefinedSurface
from stages.base import Context, Stage
from stages.capacity_plan import CapacityPlan, bounded
from stages.errors import DivergenceError, InputError
from stages.perceptual_terms import PerceptualTerm
from stages.plateau import Plateau
from stages.prefilter_cache import cached_operator
from stages.settings.dmtet import DmtetConfig
from svim3d.cameras import Cameras
from svim3d.fields.material_field import MaterialField
from svim3d.fields.sdf_grid import node_positions, sample_sdf
from svim3d.mesh.marching import crossing_points, find_crossings
from svim3d.mesh.regularizers import laplacian_loss, sign_change_loss
from svim3d.mesh.tetrahedra import (
    TetrahedralLattice,
    close_border,
    lattice_around_surface,
    node_values,
)
from svim3d.optim import NamedAdam, Rate
from svim3d.render import ray_losses
from svim3d.render.aligned_views import AlignedViews
from svim3d.render.deferred import Geometry, RenderedView, environment_shader, render_mesh
from svim3d.shading.prefilter import PyramidOperator

log = logging.getLogger(__name__)

SDF, OFFSET, ENVIRONMENT = "sdf", "offset", "log_environment"  # names of parameters
MAX_OFFSET = 0.3  # cells; below half the height of a tetrahedron (0.35) none can turn inside out
MIN_RADIANCE = 1e-4  # keeps the logarithm of black texels finite
MIN_COVERAGE = 1e-3  # guards the division that turns premultiplied into straight
WARM_UP = 10  # steps over which the rates rise, while Adam's moments fill
SIGN_CHANGE_SHARE = 0.25  # share of the steps over which its weight falls; Source: nvdiffrec
SDF_EPS = 1e-8  # nodes that no view sees get gradients near zero and must stay where they are
SPARSE = 3  # one in so many pixels of a view aligns it: enough, and a third of the time
SHOWN = ("mask", "basecolor", "orm", "normal")  # terms that say how well a view is shown
ENVIRONMENT_EPS = 1e-8  # texels that nothing reflects keep the light they started with


@dataclass(frozen=True)
class _Fit:
    """The lattice and everything that the optimisation changes."""

    lattice: TetrahedralLattice
    start: Tensor
    materials: MaterialField
    adam: NamedAdam

    @classmethod
    def assemble(
        cls, lattice: TetrahedralLattice, start: Tensor, field: FittedField, config: DmtetConfig
    ) -> "_Fit":
        """Parameters as phase 1 left them, each with its rate."""
        device = start.device
        materials = MaterialField(field.material_spec)
        materials.load_state_dict(field.material_state)
        materials = materials.to(device)
        named = {
            SDF: nn.Parameter(start.clone()),
            OFFSET: nn.Parameter(torch.zeros_like(lattice.nodes)),
            ENVIRONMENT: nn.Parameter(field.environment.clamp_min(MIN_RADIANCE).log().to(device)),
        }
        rates = {
            SDF: Rate(config.sdf_rate * lattice.spacing, eps=SDF_EPS),
            OFFSET: Rate(config.offset_rate, eps=SDF_EPS),
            ENVIRONMENT: Rate(config.environment_rate, eps=ENVIRONMENT_EPS),
        }
        for name, parameter in materials.named_parameters():
            named[f"materials.{name}"] = parameter
            in_network = name.startswith("network.")
            rates[f"materials.{name}"] = Rate(
                config.network_rate if in_network else config.field_rate
            )
        return cls(lattice, start, materials, NamedAdam(named, rates))

    @property
    def environment(self) -> Tensor:
        """Octahedral radiance."""
        return self.adam.parameters[ENVIRONMENT].exp()

    def surface(self) -> tuple[Tensor, Tensor, Tensor]:
        """Vertices, faces, and the SDF's sign-change term, in cells."""
        spacing = self.lattice.spacing
        # Nodes at the lattice's border keep their sign, so that the surface stays closed.
        sdf = torch.where(self.lattice.fixed, self.start, self.adam.parameters[SDF])
        offset = MAX_OFFSET * spacing * torch.tanh(self.adam.parameters[OFFSET])
        edges, faces = find_crossings(sdf.detach() > 0.0, self.lattice)
        vertices = crossing_points(self.lattice.nodes + offset, sdf, edges)
        return vertices, faces, sign_change_loss(sdf / spacing, edges)


def _build_lattice(
    field: FittedField, config: DmtetConfig, device: torch.device
) -> tuple[TetrahedralLattice, Tensor]:
    """The lattice around phase 1's surface, a cell wider than its cube, and its node values."""
    spacing = 2.0 * field.half_extent / config.cells
    half_extent = field.half_extent + spacing
    sdf = field.sdf.to(device)
    dense = []
    for nodes, reach in (
        (config.cells + 3, half_extent),
        (config.cells + 2, field.half_extent + 0.5 * spacing),
    ):
        positions = node_positions(nodes, reach, like=sdf)
        values, _ = sample_sdf(sdf, positions.view(-1, 3), field.half_extent)
        dense.append(values.view(nodes, nodes, nodes))
    corners, centres = close_border(dense[0], dense[1], spacing)
    lattice = lattice_around_surface(corners, centres, half_extent, reach=config.reach * spacing)
    values = node_values(lattice, corners, centres)
    if not len(values) or bool((values > 0.0).all()) or bool((values <= 0.0).all()):
        raise InputError(
            f"phase 1's field has no surface: its signed distance runs from "
            f"{float(field.sdf.min()):.3g} to {float(field.sdf.max()):.3g} and never changes sign "
            f"on {config.cells} cells; give nerf more steps, or lower nerf.density_threshold"
        )
    return lattice, values


def _blocks(image: Tensor) -> Tensor:
    """An image cut into blocks of 2 x 2 pixels, as the ray losses take them."""
    height, width, channels = image.shape
    even = image[: height // 2 * 2, : width // 2 * 2]
    tiles = even.reshape(height // 2, 2, width // 2, 2, channels).transpose(1, 2)
    return tiles.reshape(-1, 4, channels)


def _image_losses(
    rendered: RenderedView, target: dict[str, Tensor], config: DmtetConfig
) -> dict[str, Tensor]:
    """Weighted differences between one rendered view and its target, both premultiplied."""
    straight = rendered.normal_world / rendered.mask.detach().clamp_min(MIN_COVERAGE)
    both = torch.minimum(rendered.mask.detach(), target["mask"])
    trust = target.get("confidence")
    geometry_trust = ray_losses.combined_weight(trust, target.get(view_remedies.FACING))
    guide = ray_losses.smoothing_guide(target["radiance"], trust)
    return {
        "mask": config.mask_weight * ray_losses.squared_loss(rendered.mask, target["mask"], trust),
        "basecolor": config.basecolor_weight
        * ray_losses.color_loss(rendered.basecolor, target["basecolor"], trust),
        "orm": config.orm_weight
        * ray_losses.absolute_loss(
            torch.cat([rendered.roughness, rendered.metallic], -1),
            torch.cat([target["roughness"], target["metallic"]], -1),
            trust,
        ),
        "normal": config.normal_weight
        * ray_losses.absolute_loss(rendered.normal_world, target["normal_world"], geometry_trust),
        "radiance": config.radiance_weight
        * ray_losses.radiance_loss(rendered.radiance, target["radiance"], trust),
        "normal_smoothness": config.normal_smoothness_weight
        * ray_losses.bilateral_loss(_blocks(straight), _blocks(guide), _blocks(both)),
    }


def _priors(
    fit: _Fit,
    vertices: Tensor,
    faces: Tensor,
    sign_change: Tensor,
    done: float,
    config: DmtetConfig,
) -> dict[str, Tensor]:
    """Weighted regularisers of surface and light."""
    fallen = min(1.0, done / SIGN_CHANGE_SHARE)
    weight = config.sign_change_weight + fallen * (
        config.sign_change_weight_end - config.sign_change_weight
    )
    light = fit.environment
    return {
        "sign_change": weight * sign_change,
        "laplacian": config.laplacian_weight
        * laplacian_loss(vertices / fit.lattice.spacing, faces),
        "light_balance": config.light_balance_weight
        * (light - light.mean(-1, keepdim=True)).abs().mean(),
    }


def _draw_views(step: int, count: int, config: DmtetConfig, ctx: Context) -> list[int]:
    """The views of a step: epochs of random order, each a function of the seed alone."""
    chosen = []
    for place in range(step * config.views_per_step, (step + 1) * config.views_per_step):
        epoch, position = divmod(place, count)
        order = torch.randperm(count, generator=ctx.generator(f"epoch {epoch}"))
        chosen.append(int(order[position]))
    return chosen


def _step_losses(
    fit: _Fit,
    operator: PyramidOperator,
    cameras: Cameras,
    planes: dict[str, Tensor],
    aligned: AlignedViews | None,
    perceptual: PerceptualTerm | None,
    *,
    step: int,
    config: DmtetConfig,
    ctx: Context,
) -> dict[str, Tensor]:
    """All weighted terms of one step, image terms averaged over its views."""
    vertices, faces, sign_change = fit.surface()
    if not len(faces):
        raise DivergenceError(
            "dmtet: the surface has vanished; lower dmtet.sdf_rate or dmtet.mask_weight"
        )
    geometry = Geometry.smooth(vertices, faces, silhouettes=True)
    shader = environment_shader(
        operator(fit.environment), multiple_scattering=config.multiple_scattering
    )
    terms = _priors(fit, vertices, faces, sign_change, step / config.steps, config)
    for view in _draw_views(step, len(cameras), config, ctx):
        rendered = render_mesh(
            geometry,
            lambda points: fit.materials(points.position),
            cameras,
            view=view,
            shader=shader,
        )
        if aligned is None:
            target = {name: plane[view] for name, plane in planes.items()}
        else:
            target = _visit(aligned, view, rendered, step, config, ctx)
        losses = _image_losses(rendered, target, config)
        if perceptual is not None:
            losses |= perceptual.of_view(step, view, rendered, target)
        for name, value in losses.items():
            terms[name] = terms.get(name, 0.0) + value / config.views_per_step
    return terms


def _visit(
    aligned: AlignedViews,
    view: int,
    rendered: RenderedView,
    step: int,
    config: DmtetConfig,
    ctx: Context,
) -> dict[str, Tensor]:
    """Targets of a view, read as fits it best so far; then its warp goes on."""
    target, forgotten = aligned.chosen_targets(
        view, rendered.basecolor.detach(), config.warp_patience
    )
    if forgotten:
        ctx.event(
            "warp_reset",
            f"view {view} fits better without its homography, which begins anew at step {step}",
        )
    if step >= config.warp_start * config.steps:
        aligned.observe_view(view, rendered.surface_images(), target, every=SPARSE)
        aligned.update(config.warp_gain * config.final_rate ** (0.5 * step / config.steps))
    return target


def _optimise(
    fit: _Fit,
    cameras: Cameras,
    planes: dict[str, Tensor],
    aligned: AlignedViews | None,
    perceptual: PerceptualTerm | None,
    config: DmtetConfig,
    ctx: Context,
) -> None:
    """The loop."""
    operator = cached_operator(ctx.shared, fit.environment.shape[0])
    # A window holds every view at least once, so that windows compare the same pictures.
    epoch = -(-len(cameras) // config.views_per_step)
    plateau = Plateau.of(config, window=epoch)
    saved = ctx.checkpoints.load()
    step = 0
    if saved is not None:
        step, tensors = saved
        fit.adam.load_state(tensors)
        plateau.load_state(tensors)
        if aligned is not None:
            aligned.load_state(tensors)
        log.info("dmtet: resumed at step %d", step)
    while step < config.steps:
        if ctx.checkpoints.due():
            learnt = {} if aligned is None else aligned.state()
            ctx.checkpoints.save(step, fit.adam.state() | plateau.state() | learnt)
        terms = _step_losses(
            fit, operator, cameras, planes, aligned, perceptual, step=step, config=config, ctx=ctx
        )
        if ctx.is_finite(step, terms):
            fit.adam.zero_grad()
            torch.stack(list(terms.values())).sum().backward()
            if ctx.is_finite(step, fit.adam.gradients()):
                warm = min(1.0, (step + 1) / WARM_UP)
                fit.adam.step(config.final_rate ** (step / config.steps) * warm)
            plateau.observe(step, sum(float(terms[name].detach()) for name in SHOWN))
        told = {name: float(t.detach()) for name, t in terms.items()}
        if aligned is not None:
            told |= view_remedies.view_terms(aligned)
        ctx.report(step + 1, config.steps, told)
        step = plateau.after(step, ctx)
    plateau.tell(ctx)


def run(
    views: MaterialViews,
    field: FittedField,
    plan: CapacityPlan | None = None,
    *,
    config: DmtetConfig,
    ctx: Context,
) -> RefinedSurface:
    """Refine phase 1's surface on the views; with a plan sizes are upper bounds.

    Raises:
        InputError: the field has no surface.
        DivergenceError: the surface vanished, or too many steps were not finite.
    """
    config = bounded(config, plan, ctx)
    cameras, planes = views.premultiplied(config.image_size)
    cameras = cameras.to(ctx.device)
    planes = {name: plane.to(ctx.device) for name, plane in planes.items()}
    planes = view_remedies.with_facing_trust(cameras, planes, config)
    aligned = view_remedies.align_views(cameras, planes, views.reference, config, field.corrections)
    lattice, start = _build_lattice(field, config, ctx.device)
    fit = _Fit.assemble(lattice, start, field, config)
    log.info("dmtet: %d nodes, %d tetrahedra", len(lattice.nodes), len(lattice.tetrahedra))
    perceptual = PerceptualTerm.of(cameras, planes, config, ctx)
    _optimise(fit, cameras, planes, aligned, perceptual, config, ctx)
    if aligned is not None:
        view_remedies.tell_of_views(aligned, ctx)
    with torch.no_grad():
        vertices, faces, _ = fit.surface()
    return RefinedSurface(
        vertices=vertices.cpu(),
        faces=faces.cpu(),
        material_spec=fit.materials.spec,
        material_state={n: t.detach().cpu() for n, t in fit.materials.state_dict().items()},
        environment=fit.environment.detach().cpu(),
        corrections=field.corrections if aligned is None else aligned.corrections.to("cpu"),
    )


DMTET = Stage(run)
