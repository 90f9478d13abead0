"""Table scores: an asset, and the views it was made of, against the truth of a benchmark's object.

Reads the truth, the exported asset, the views of the pipeline and, for a photo, what the generator
draws at the test cameras; writes `scores.json`: a line of figures for each view and subject, and
those of the surface; and where there are networks for it, features of the pictures.
`svim3d.render.view_figures` tells what each figure is.

Subjects: `drawn` are the generator's views; `relit` the same (of true views: themselves) under a
light they never saw, in image space; `asset` is the finished file, rendered.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from stages.artifacts import ExportedAsset, MaterialViews
from stages.base import Context, Stage
from stages.errors import InputError
from stages.orb_scores import capture_figures, orb_figures
from stages.pair_distance import read_distance
from stages.picture_networks import read_encoders
from stages.picture_sets import PictureSets
from stages.prefilter_cache import cached_operator
from stages.scores_artifact import (
    ASSET,
    DRAWN,
    GIVEN,
    NOVEL,
    REFERENCE,
    RELIT,
    TRUE,
    TableScores,
    ViewScore,
)
from stages.settings.table_scores import TableScoresConfig
from stages.truth import SEEN, Truth, read_truth
from svim3d.cameras import Cameras
from svim3d.color import srgb_from_linear
from svim3d.io.exr import read_rgb
from svim3d.io.glb import read_mesh
from svim3d.mesh.source_mesh import SourceMesh
from svim3d.metrics import occupancy, volume_iou
from svim3d.metrics.surface_agreement import compare_surfaces
from svim3d.numerics import dot, normalize
from svim3d.render.asset_figures import HALF_EXTENT, Surface
from svim3d.render.deferred import environment_shader
from svim3d.render.framing import MIN_COVERAGE, Framing
from svim3d.render.pictures import render_pictures
from svim3d.render.view_consistency import mesh_depth, view_consistency
from svim3d.render.view_figures import BUFFERS, COVERED, relit, view_figures
from svim3d.shading.environment import octahedral_from_latlong
from svim3d.shading.prefilter import EnvironmentPyramid

GLB, LIGHT = "asset.glb", "environment.exr"
SAME_DIRECTION = 0.9998  # cosine of a degree

Images = dict[str, Tensor]


def run(
    truth: Path,
    export: ExportedAsset,
    generation: MaterialViews,
    novel: MaterialViews | None,
    *,
    config: TableScoresConfig,
    ctx: Context,
) -> TableScores:
    """Score an asset, and its views where they were drawn.

    Args:
        truth: folder of the true object.
        export: the asset.
        generation: the views it was made of.
        novel: what was drawn at the test cameras, the photo's camera last; None for true views.
        config: how finely.
        ctx: surroundings.

    Raises:
        InputError: the truth cannot be read, or lacks the photo's view.
    """
    try:
        known = read_truth(truth)
        scoring = _Scoring(known, export, generation, novel, config, ctx)
        return TableScores(
            list(scoring.views()),
            scoring.surface(),
            scoring.agreement(),
            scoring.framing.scale,
            scoring.capture,
            scoring.sets.features(),
        )
    except ValueError as error:
        raise InputError(f"{truth.name}: {error}") from error


class _Scoring:
    """One asset and its truth."""

    def __init__(
        self,
        truth: Truth,
        export: ExportedAsset,
        generation: MaterialViews,
        novel: MaterialViews | None,
        config: TableScoresConfig,
        ctx: Context,
    ) -> None:
        self._truth, self._config, self._ctx = truth, config, ctx
        self._generation, self._novel = generation, novel
        self._operator = cached_operator(ctx.shared, config.light_size)
        self.framing = self._frame()
        self._own_mesh = _mesh(export, ctx)
        self._mesh = self.framing.place(self._own_mesh)
        self._found = _found_light(export, ctx)
        # A photo's exposure is in the light that was found of it.
        self._own_gain = 1.0 if config.from_photo else truth.exposure
        self._perceptual = read_distance(config.lpips_weights)
        self.capture: dict[str, float] = {}
        weights = config.efficientnet_weights, config.inception_weights, config.clip_folder
        self.sets = PictureSets(read_encoders(*weights, ctx.device))

    def _frame(self) -> Framing:
        if not self._config.from_photo:
            return Framing.none()
        if self._truth.given is None:
            raise ValueError("wanted training views, of which the photo's tells the framing")
        cameras, images, reference = self._truth.given
        views = self._generation
        mine = views.cameras[views.reference], views.mask[views.reference]
        return Framing.fit(*mine, cameras[reference], images["mask"][reference])

    def views(self) -> Iterator[ViewScore]:
        """Scores of all parts."""
        if self._truth.given is not None:
            yield from self._given(*self._truth.given)
        if self._truth.novel is not None:
            yield from self._test(*self._truth.novel)
        for name, groups in self._truth.relit.items():
            for group in groups:
                light = self._pyramid(group.light)
                yield from self._relit(name, group.cameras, group.images, light)

    def surface(self) -> dict[str, float]:
        """Figures of geometry."""
        if self._truth.surface is None:
            return {}
        mesh = self._mesh.vertices, self._mesh.faces
        agreement = compare_surfaces(
            mesh,
            self._truth.surface,
            self._ctx.generator("surfaces"),
            samples=self._config.surface_samples,
        )
        volumes = [
            occupancy(v, f, resolution=self._config.volume_cells, half_extent=HALF_EXTENT)
            for v, f in (mesh, self._truth.surface)
        ]
        return {
            "chamfer": agreement.chamfer,
            **{f"f_{threshold:g}": score.f for threshold, score in agreement.f_scores.items()},
            "normal_consistency": agreement.normal_consistency,
            "volume_iou": volume_iou(*volumes),
        }

    def agreement(self) -> dict[str, dict[str, float]]:
        """How well drawn views agree with each other, and true ones, which are no generator's."""
        if not self._config.from_photo:
            return {}
        views, own = self._generation, self._own_mesh
        drawn = {name: getattr(views, name) for name in ("radiance", "mask", "basecolor")}
        found = {DRAWN: _agreement(drawn, views.cameras, (own.vertices, own.faces), self._own_gain)}
        if self._truth.given is not None and self._truth.surface is not None:
            cameras, images, _ = self._truth.given
            surface, gain = self._truth.surface, self._truth.exposure
            found[TRUE] = _agreement(images, cameras, surface, gain)
        return found

    def _pyramid(self, latlong: Tensor) -> EnvironmentPyramid:
        return self._operator(octahedral_from_latlong(latlong, self._config.light_size))

    def _rendered(self, cameras: Cameras, light: Tensor | EnvironmentPyramid) -> Images:
        """The asset under a light that was given, or under its own, as it was fitted."""
        if isinstance(light, EnvironmentPyramid):
            shader = environment_shader(light, multiple_scattering=False)
        else:
            shader = environment_shader(self._pyramid(light), multiple_scattering=True)
        return render_pictures(self._mesh, cameras, shader, supersample=self._config.supersample)

    def _given(self, cameras: Cameras, images: Images, reference: int) -> Iterator[ViewScore]:
        """The photo's view and the other training views."""
        shown = {ASSET: self._rendered(cameras, self._found)}
        if self._config.from_photo and _stand_alike(self._generation.cameras, cameras):
            shown[DRAWN] = self._framed(self._generation, cameras)
        elif self._config.from_photo:
            yield from self._drawn_reference(cameras, images, reference)
        for subject, pictures in shown.items():
            for view in range(len(cameras)):
                part = REFERENCE if view == reference else GIVEN
                yield self._score(part, subject, SEEN, cameras, pictures, images, view)
            others = [view for view in range(len(cameras)) if view != reference]
            self._collect(subject, pictures, images, others)

    def _drawn_reference(
        self, cameras: Cameras, images: Images, reference: int
    ) -> Iterator[ViewScore]:
        """The drawn view of the photo, where the others stand elsewhere than the truth's."""
        views = self._generation
        one = _subset(views, [views.reference])
        drawn = self.framing.resample(*one, cameras[reference])
        true = {name: image[[reference]] for name, image in images.items()}
        yield self._score(REFERENCE, DRAWN, SEEN, cameras[reference], drawn, true, 0)

    def _test(self, cameras: Cameras, images: Images) -> Iterator[ViewScore]:
        """Test views under the light of the given ones; the asset is lit by what was found."""
        shown = {ASSET: self._rendered(cameras, self._found)}
        if self._novel is not None and _stand_alike(self._novel.cameras, cameras):
            shown[DRAWN] = self._framed(self._novel, cameras)
        for subject, pictures in shown.items():
            for view in range(len(cameras)):
                yield self._score(NOVEL, subject, SEEN, cameras, pictures, images, view)
            self._collect(subject, pictures, images, range(len(cameras)))
        if self._config.stanford_orb:
            mesh = self._mesh.vertices, self._mesh.faces
            depths, generator = list(shown[ASSET]["depth"]), self._ctx.generator("orb shape")
            self.capture = capture_figures(depths, mesh, self._truth, generator)

    def _relit(
        self, name: str, cameras: Cameras, images: Images, light: EnvironmentPyramid
    ) -> Iterator[ViewScore]:
        """Test views under a light that nobody saw; the asset, and materials in image space."""
        shown = {ASSET: self._rendered(cameras, light)}
        materials = {TRUE: images} if set(BUFFERS) <= images.keys() else {}
        if self._novel is not None and _stand_alike(self._novel.cameras, cameras):
            materials[DRAWN] = self._framed(self._novel, cameras)
        for subject, given in materials.items():
            lit = [relit(cameras, given, view, light) for view in range(len(cameras))]
            shown[subject] = {"mask": given["mask"], "radiance": torch.stack(lit)}
        gain = self._truth.exposure
        for subject, pictures in shown.items():
            for view in range(len(cameras)):
                yield self._score(RELIT, subject, name, cameras, pictures, images, view, gain)

    def _collect(self, subject: str, shown: Images, truth: Images, views: Sequence[int]) -> None:
        """Keep features of views for the sets of all objects."""
        gains = self._own_gain, self._truth.exposure
        self.sets.add(subject, shown, truth, views, gains)

    def _framed(self, views: MaterialViews, cameras: Cameras) -> Images:
        """Drawn views as the truth's cameras have them; further ones are left out."""
        return self.framing.resample(*_subset(views, list(range(len(cameras)))), cameras)

    def _score(
        self,
        part: str,
        subject: str,
        light: str,
        cameras: Cameras,
        shown: Images,
        truth: Images,
        view: int,
        gain: float | None = None,
    ) -> ViewScore:
        mine, true = ({n: i[view] for n, i in images.items()} for images in (shown, truth))
        own_gain = self._own_gain if gain is None else gain
        figures = view_figures(
            mine,
            true,
            gain=own_gain,
            true_gain=self._truth.exposure,
            perceptual=self._perceptual,
        )
        if self._config.stanford_orb:
            own_gain /= self._truth.exposure
            figures |= orb_figures(part, mine, true, gain=own_gain, learned=self._perceptual)
        return ViewScore(part, subject, light, _azimuth_deg(cameras, view), figures)


def _agreement(images: Images, cameras: Cameras, surface: Surface, gain: float) -> dict[str, float]:
    """Differences of neighbours around the object where a surface shows them the same points."""
    azimuths = [_azimuth_deg(cameras, view) for view in range(len(cameras))]
    around = sorted(range(len(cameras)), key=azimuths.__getitem__)
    cameras = cameras[around]
    depth, covered = mesh_depth(*surface, cameras)
    mask = images["mask"][around]
    inside = covered & (mask > COVERED)
    straight = images["radiance"][around] / mask.clamp_min(MIN_COVERAGE) * gain
    compared = {"rgb_apart": straight}
    if "basecolor" in images:
        compared["apart"] = images["basecolor"][around]
    figures: dict[str, float] = {}
    for name, linear in compared.items():
        found = view_consistency(srgb_from_linear(linear.clamp(0.0, 1.0)), depth, inside, cameras)
        figures |= {name: found.error, "compared": found.share}
    return figures


def _subset(views: MaterialViews, chosen: list[int]) -> tuple[Cameras, Images]:
    names = ("radiance", "mask", *BUFFERS)
    return views.cameras[chosen], {name: getattr(views, name)[chosen] for name in names}


def _stand_alike(cameras: Cameras, others: Cameras) -> bool:
    """Whether the first of some cameras look from where others do, whatever their distance."""
    if len(cameras) < len(others):
        return False
    mine, wanted = (normalize(c.positions[: len(others)]) for c in (cameras, others))
    return bool((dot(mine, wanted) > SAME_DIRECTION).all())


def _azimuth_deg(cameras: Cameras, view: int) -> float:
    x, _, z = cameras.positions[view].tolist()
    return float(torch.rad2deg(torch.atan2(torch.tensor(x), torch.tensor(z)))) % 360.0


def _mesh(export: ExportedAsset, ctx: Context) -> SourceMesh:
    file = ctx.work / GLB
    file.write_bytes(export.files[GLB])
    return read_mesh(file)


def _found_light(export: ExportedAsset, ctx: Context) -> Tensor:
    """The light that came with the asset."""
    file = ctx.work / LIGHT
    file.write_bytes(export.files[LIGHT])
    return torch.from_numpy(read_rgb(file))


TABLE_SCORES = Stage(run)
