"""Relight: views of materials and normals, or a finished asset, under any light.

Reads an orbit folder, one frame of it, or a mesh; writes per view a multi-layer EXR and a picture,
a turntable of the turning light and a contact sheet. Views are shaded where they are, in image
space, without any geometry but the depth that they may carry: the 2.5D relighting of the paper.
A mesh is first rendered to the same buffers of materials and normals, or handed to a path tracer.

Source: SViM3D, section 3 ("relighting"). Differs from the paper: where there is depth, the object
shadows and lights itself.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from stages.artifacts import RelitViews
from stages.base import Context, Stage
from stages.errors import InputError
from stages.prefilter_cache import cached_operator
from stages.settings.relight import RelightConfig
from stages.subject import MeshSubject, Subject, Viewpoint, read_subject
from svim3d.io.animation import write_animation
from svim3d.io.edit_record import EditRecord, read_region
from svim3d.io.exr import write_layers
from svim3d.io.image import contact_sheet, encode_png
from svim3d.io.light import read_light
from svim3d.numerics import dot, normalize
from svim3d.render.gbuffer import GBuffer
from svim3d.render.image_shading import PointShader, ViewPoints
from svim3d.render.regions import region_of_points, resized_region
from svim3d.shading.directional_albedo import MIN_N_DOT_V
from svim3d.shading.environment import latlong_from_octahedral, rotate_about_y
from svim3d.shading.material_edits import Edit, apply_edits
from svim3d.shading.monte_carlo import shade_by_sampling
from svim3d.shading.octahedral import texel_directions
from svim3d.shading.prefilter import EnvironmentPyramid
from svim3d.shading.sampled_light import SampledLight
from svim3d.shading.split_sum import Shading, shade
from svim3d.shading.studio import studio_radiance
from svim3d.shading.tonemap import agx, expose

STUDIO_SIZE = 256  # texels per side of the built-in light, whose edges are soft
SHEET_COLUMNS, SHEET_VIEWS, SHEET_TURNS = 6, 24, 6  # what fits on a contact sheet
PANORAMA_ROWS = 128  # of the light's picture on the sheet
PAPER = 0.11  # display-encoded grey behind the object
MIN_COVERAGE = 1e-3  # below it a straight colour is undefined


@dataclass(frozen=True)
class _Picture:
    """One view as lit, all premultiplied by coverage and scene-linear.

    Attributes:
        layers: `beauty`, and where they are told apart `diffuse` and `specular`.
        mask: coverage.
    """

    layers: dict[str, Float[Tensor, "H W 3"]]
    mask: Float[Tensor, "H W 1"]

    def displayed(self, exposure: float) -> Float[Tensor, "H W 3"]:
        """Display-encoded, straight."""
        straight = self.layers["beauty"] / self.mask.clamp_min(MIN_COVERAGE)
        return agx(expose(straight, exposure))

    def on_paper(self, exposure: float) -> Float[Tensor, "H W 3"]:
        """Display-encoded, before a dark grey."""
        return PAPER + self.mask * (self.displayed(exposure) - PAPER)


Render = Callable[[float], _Picture]  # from the light's azimuth in degrees


def run(source: Path, *, config: RelightConfig, ctx: Context) -> RelitViews:
    """Views of `source` under the light of the settings.

    Raises:
        InputError: the source, the light, an edit or the mask cannot be used.
    """
    try:
        return _relight(source, config, ctx)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(str(error)) from error


def _relight(source: Path, config: RelightConfig, ctx: Context) -> RelitViews:
    viewpoint = Viewpoint(
        config.orbit_views,
        config.size,
        config.supersample,
        config.fov_y_deg,
        config.elevation_deg,
    )
    subject = read_subject(source, viewpoint, ctx.event)
    chosen = _chosen(config.views, subject)
    spun = subject.reference if subject.reference in chosen else chosen[0]
    turns = () if config.turntable == "none" else config.azimuths_deg
    light = _light(config, ctx)
    paint = _Paint.of(subject, config, ctx)
    lit = _lighting(subject, paint, light, config, ctx)
    files = paint.record()
    shown: dict[str, Tensor] = {}
    for done, index in enumerate(chosen):
        picture = lit(index)(config.azimuths_deg[0])
        files |= _view_files(f"views/{index:03d}", picture, config.exposure, ctx)
        if len(shown) < SHEET_VIEWS:
            shown[f"view {index}"] = picture.on_paper(config.exposure)
        ctx.report(done + 1, len(chosen) + len(turns), {"coverage": float(picture.mask.mean())})
    if len(turns) > 1:
        render = lit(spun)
        stride = -(-len(turns) // SHEET_TURNS)

        def frames() -> Iterator[Tensor]:
            for turn, azimuth in enumerate(turns):
                frame = render(azimuth).on_paper(config.exposure)
                if turn % stride == 0:
                    shown[f"light at {azimuth:g} deg"] = frame
                ctx.report(len(chosen) + turn + 1, len(chosen) + len(turns), {"turn": azimuth})
                yield frame

        files |= _turntable(frames(), config, ctx)
    turned = rotate_about_y(light, config.azimuths_deg[0])
    panorama = latlong_from_octahedral(turned, height=PANORAMA_ROWS)
    shown["light"] = agx(expose(panorama, config.exposure))
    sheet = contact_sheet(list(shown.values()), list(shown), columns=SHEET_COLUMNS)
    files["contact_sheet.png"] = encode_png(sheet)
    return RelitViews(
        files,
        {
            "views": len(chosen),
            "frames": len(config.azimuths_deg),
            "width": subject.cameras.width,
            "height": subject.cameras.height,
            "mean_radiance": float(light.mean()),
        },
    )


def _chosen(views: tuple[int, ...] | str, subject: Subject) -> list[int]:
    """Indices of the views to relight."""
    count = len(subject.cameras)
    if views == "all":
        return list(range(count))
    if views == "reference":
        return [subject.reference]
    absent = [index for index in views if int(index) >= count]
    if absent:
        raise InputError(f"wanted views {absent}, but there are {count}, numbered from 0")
    return [int(index) for index in views]


def _light(config: RelightConfig, ctx: Context) -> Float[Tensor, "N N 3"]:
    """The light as an octahedral map."""
    if config.environment is None:
        return studio_radiance(texel_directions(STUDIO_SIZE))
    return read_light(config.environment, ctx.event, layout=config.layout).octahedral()


@dataclass(frozen=True)
class _Region:
    """A region drawn on one view.

    Attributes:
        home: that view.
        share: of the edits that each of its pixels takes.
    """

    home: GBuffer
    share: Float[Tensor, "H W 1"]

    @classmethod
    def drawn_on(cls, home: GBuffer, file: Path) -> Self:
        """Read a region from a picture of the view."""
        share = resized_region(read_region(file), *home.mask.shape[1:3])
        if not bool(((share > 0.0) & (home.mask[0] > 0.0)).any()):
            raise InputError(f"the region in {file.name} is empty: it misses the object")
        return cls(home, share)

    def seen_in(self, gbuffer: GBuffer) -> Float[Tensor, "1 H W 1"]:
        """The region as another view, or the same, sees it."""
        if torch.equal(gbuffer.cameras.c2w, self.home.cameras.c2w):
            return self.share[None]
        points = gbuffer.positions(0).view(-1, 3)
        return region_of_points(points, self.share, self.home).view_as(gbuffer.mask)


@dataclass(frozen=True)
class _Paint:
    """What is changed about the materials, and where.

    Attributes:
        edits: in order.
        region: None edits everything.
        tell: told of clamped and implausible values.
    """

    edits: tuple[Edit, ...]
    region: _Region | None
    tell: Callable[[str, str], None]

    @classmethod
    def of(cls, subject: Subject, config: RelightConfig, ctx: Context) -> Self:
        """Read the edits; a region is taken to be drawn on the reference view."""
        edits = tuple(Edit.parse(text) for text in config.edits)
        if config.mask is None:
            return cls(edits, None, ctx.event)
        home = subject.view(subject.reference)
        return cls(edits, _Region.drawn_on(home, config.mask), ctx.event)

    def __call__(self, gbuffer: GBuffer, index: int) -> GBuffer:
        """The same view in other paint."""
        if not self.edits:
            return gbuffer
        share = (gbuffer.mask > 0.0).float()
        if self.region is not None:
            share = share * self.region.seen_in(gbuffer)
        if not bool((share > 0.0).any()):  # the region lies on a side that this view does not see
            return gbuffer
        images, notices = apply_edits(gbuffer.images(), self.edits, share)
        for notice in notices:
            self.tell("edit", f"view {index}: {notice}")
        return GBuffer.of(gbuffer.cameras, images)

    def record(self) -> dict[str, bytes]:
        """Files from which the edits can be replayed on the asset's textures."""
        if not self.edits:
            return {}
        if self.region is None:
            return EditRecord(self.edits).files()
        return EditRecord(self.edits, self.region.share, self.region.home.cameras).files()


def _lighting(
    subject: Subject,
    paint: _Paint,
    light: Float[Tensor, "N N 3"],
    config: RelightConfig,
    ctx: Context,
) -> Callable[[int], Render]:
    """What makes a view ready to be lit from any side."""
    if config.engine == "path":
        return _path_tracing(subject, light, config, ctx)
    pyramid = cached_operator(ctx.shared, len(light), "hybrid", "relighting")(light)
    shader = _sampling(light, pyramid, config, ctx) if config.quality == "exact" else None

    def ready(index: int) -> Render:
        gbuffer = paint(subject.view(index), index)
        if config.occlusion and gbuffer.depth is None:
            ctx.event("no_depth", "the views carry no depth: nothing is occluded")
        is_occluded = config.occlusion and gbuffer.depth is not None
        points = (ViewPoints.occluded if is_occluded else ViewPoints.of)(gbuffer, 0)

        def render(azimuth_deg: float) -> _Picture:
            shading = points.lit(
                pyramid,
                azimuth_deg=azimuth_deg,
                multiple_scattering=config.multiple_scattering,
                shader=shader,
            )
            lobes = {"diffuse": shading.diffuse, "specular": shading.specular}
            images = {name: points.image(lobe) for name, lobe in lobes.items()}
            return _averaged(images, gbuffer.mask[0], subject.cameras.height)

        return render

    return ready


def _sampling(
    light: Float[Tensor, "N N 3"], pyramid: EnvironmentPyramid, config: RelightConfig, ctx: Context
) -> PointShader:
    """Shading by samples; what bounces between microfacets is added as the split sum has it."""
    sampled = SampledLight.build(light)

    def shader(
        normal: Tensor, wo: Tensor, basecolor: Tensor, roughness: Tensor, metallic: Tensor
    ) -> Shading:
        points = _turned_to(wo, normal), wo, basecolor, roughness, metallic
        # The same random numbers for every picture: the light's turn is all that changes.
        generator = ctx.generator("samples")
        shading = shade_by_sampling(*points, sampled, samples=config.samples, generator=generator)
        if not config.multiple_scattering:
            return shading
        once, more = (
            shade(*points, pyramid, multiple_scattering=multiple) for multiple in (False, True)
        )
        return Shading(
            shading.diffuse + more.diffuse - once.diffuse,
            shading.specular + more.specular - once.specular,
        )

    return shader


def _turned_to(wo: Float[Tensor, "P 3"], normal: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """Normals that face away, as they may at silhouettes, bent until they are seen edge-on."""
    behind = (MIN_N_DOT_V - dot(normal, wo)).clamp_min(0.0)
    return normalize(normal + behind * wo)


def _averaged(
    lobes: dict[str, Float[Tensor, "h w 3"]], mask: Float[Tensor, "h w 1"], height: int
) -> _Picture:
    """Premultiply, and average samples down to `height` rows."""
    factor = mask.shape[0] // height
    stacked = torch.cat([*(lobe * mask for lobe in lobes.values()), mask], -1)
    blocks = stacked.view(height, factor, -1, factor, stacked.shape[-1])
    *means, coverage = torch.split(blocks.mean((1, 3)), [*(3 for _ in lobes), 1], -1)
    layers = dict(zip(lobes, means, strict=True))
    return _Picture({"beauty": torch.stack(means).sum(0), **layers}, coverage)


def _path_tracing(
    subject: Subject, light: Float[Tensor, "N N 3"], config: RelightConfig, ctx: Context
) -> Callable[[int], Render]:
    """Views of a mesh with global illumination; only their sum is known."""
    from svim3d.render.path_tracing import render_path_traced

    if not isinstance(subject, MeshSubject):
        raise InputError("--engine path needs an asset (.glb, .gltf, .obj), these are views")
    if config.edits:
        raise InputError("--engine path takes assets as they are; make one by svim3d edit first")

    def ready(index: int) -> Render:
        def render(azimuth_deg: float) -> _Picture:
            turned = rotate_about_y(light, azimuth_deg)
            traced = render_path_traced(
                subject.mesh,
                subject.cameras[[index]],
                latlong_from_octahedral(turned, height=len(light)),
                samples=config.samples,
                seed=ctx.seed,
            )
            return _Picture({"beauty": traced["radiance"][0]}, traced["mask"][0])

        return render

    return ready


def _view_files(name: str, picture: _Picture, exposure: float, ctx: Context) -> dict[str, bytes]:
    """One view as a multi-layer EXR and as a picture with transparency."""
    beauty = torch.cat([picture.layers["beauty"], picture.mask], -1)
    layers = {**picture.layers, "beauty": beauty}
    file = ctx.work / "view.exr"  # OpenEXR writes files only
    planes = {layer: values.numpy() for layer, values in layers.items()}
    write_layers(file, planes, notify=ctx.event)
    shown = torch.cat([picture.displayed(exposure) * (picture.mask > 0), picture.mask], -1)
    files = {f"{name}.exr": file.read_bytes(), f"{name}.png": encode_png(shown)}
    file.unlink()
    return files


def _turntable(frames: Iterator[Tensor], config: RelightConfig, ctx: Context) -> dict[str, bytes]:
    """The turning light as one moving picture, or as numbered ones."""
    name = "turntable" if config.turntable == "png" else f"turntable.{config.turntable}"
    made = ctx.work / name
    write_animation(made, frames, fps=float(config.frames_per_s))
    if made.is_dir():
        return {f"{name}/{file.name}": file.read_bytes() for file in sorted(made.iterdir())}
    return {name: made.read_bytes()}


RELIGHT = Stage(run)
