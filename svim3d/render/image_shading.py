"""Relighting of pictures: one view of a geometry buffer under a turned environment.

The split sum gives every pixel the light of an empty world. With a traced view, each lobe is then
scaled by what its rays receive with the object in place over what they would receive without it: a
pixel that nothing shadows keeps its value exactly, one whose rays are all blocked loses all of it,
and blocked rays bring what the pixels they meet send out.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.render.gbuffer import GBuffer
from svim3d.render.ray_light import gather_hits, lobe_light, turn_about_y
from svim3d.render.screen_visibility import ScreenVisibility
from svim3d.shading.directional_albedo import MultipleScattering
from svim3d.shading.prefilter import EnvironmentPyramid
from svim3d.shading.split_sum import Shading, shade

BOUNCES = 3  # mean PSNR against path-traced pictures: 25.0 dB with none, 26.7 with one, 26.8 with 2
DARKEST = 1e-6  # radiance; below it a lobe counts as unlit, and how it is scaled does not matter
TRACED_SIDE = 384  # pixels; 96 rays of each take 0.3 GB there, and about a second of two cores
NOWHERE = -1  # a point that no traced one stands for


# Unit normal and direction to the viewer, basecolor, roughness, metallic -> radiance by lobe, all
# in the frame of the unturned light.
PointShader = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Shading]


@dataclass(frozen=True)
class ViewPoints:
    """The visible points of one view, ready to be lit from any side.

    Attributes:
        pixels: flat indices of all pixels that show any surface.
        normal: unit, world frame.
        wo: unit directions to the viewer, world frame.
        basecolor: linear.
        roughness: perceptual.
        metallic: in [0, 1].
        occluders: what the points see of each other; None for open air.
        height: image rows.
        width: image columns.
    """

    pixels: Int[Tensor, "P"]
    normal: Float[Tensor, "P 3"]
    wo: Float[Tensor, "P 3"]
    basecolor: Float[Tensor, "P 3"]
    roughness: Float[Tensor, "P 1"]
    metallic: Float[Tensor, "P 1"]
    occluders: "Occluders | None"
    height: int
    width: int

    @classmethod
    def of(cls, gbuffer: GBuffer, view: int, visibility: ScreenVisibility | None = None) -> Self:
        """Collect the points of a view; `visibility` is of this very view."""
        pixels = torch.nonzero(gbuffer.mask[view].reshape(-1) > 0.0)[:, 0]
        points = cls._at(gbuffer, view, pixels)
        if visibility is None:
            return points
        nearest = torch.full_like(pixels, NOWHERE)
        nearest[torch.searchsorted(pixels, visibility.pixels)] = torch.arange(
            len(visibility.pixels), device=pixels.device
        )
        themselves = cls._at(gbuffer, view, visibility.pixels)
        return replace(points, occluders=Occluders(themselves, visibility, nearest))

    @classmethod
    def occluded(cls, gbuffer: GBuffer, view: int) -> Self:
        """Collect the points of a view and trace what they see of each other.

        Views of more than `TRACED_SIDE` pixels are traced at that size: shadows and bounced light
        are the coarser for it, not the shading.

        Raises:
            ValueError: the views have no depth.
        """
        height, width = gbuffer.cameras.height, gbuffer.cameras.width
        shrink = max(1.0, max(height, width) / TRACED_SIDE)
        rows, columns = round(height / shrink), round(width / shrink)
        if (rows, columns) == (height, width):
            return cls.of(gbuffer, view, ScreenVisibility.trace(gbuffer, view))
        coarse = _subsampled(gbuffer.take([view]), rows, columns)
        visibility = ScreenVisibility.trace(coarse, 0)
        points = cls.of(gbuffer, view)
        index = torch.full((rows * columns,), NOWHERE, device=points.pixels.device)
        index[visibility.pixels] = torch.arange(len(visibility.pixels), device=index.device)
        row = _scaled(points.pixels // width, height, rows)
        column = _scaled(points.pixels % width, width, columns)
        nearest = index[row * columns + column]
        sources = cls._at(coarse, 0, visibility.pixels)
        return replace(points, occluders=Occluders(sources, visibility, nearest))

    @classmethod
    def _at(cls, gbuffer: GBuffer, view: int, pixels: Int[Tensor, "P"]) -> Self:
        """The points of some pixels, in open air."""

        def chosen(image: Tensor) -> Tensor:
            return image.reshape(-1, image.shape[-1])[pixels]

        return cls(
            pixels=pixels,
            normal=chosen(gbuffer.normal_world[view]),
            wo=chosen(gbuffer.view_directions(view)),
            basecolor=chosen(gbuffer.basecolor[view]),
            roughness=chosen(gbuffer.roughness[view]),
            metallic=chosen(gbuffer.metallic[view]),
            occluders=None,
            height=gbuffer.cameras.height,
            width=gbuffer.cameras.width,
        )

    def lit(
        self,
        light: EnvironmentPyramid,
        *,
        azimuth_deg: float = 0.0,
        bounces: int = BOUNCES,
        multiple_scattering: MultipleScattering = True,
        shader: PointShader | None = None,
    ) -> Shading:
        """Radiance of all points; on the CPU where there are occluders.

        Args:
            light: the prefiltered environment.
            azimuth_deg: turns the light counter-clockwise seen from above, as `rotate_about_y`
                does, but exactly: normals and views are turned the other way instead of the map.
            bounces: how often light that blocked rays bring is passed on; 0 leaves shadows black.
            multiple_scattering: as in `split_sum.shade`.
            shader: shades points in the split sum's place; shadows are looked up in `light` still.
        """
        if shader is None:
            shader = partial(shade, pyramid=light, multiple_scattering=multiple_scattering)
        shading = shader(
            turn_about_y(self.normal, -azimuth_deg),
            turn_about_y(self.wo, -azimuth_deg),
            self.basecolor,
            self.roughness,
            self.metallic,
        )
        if self.occluders is None:
            return shading
        found = self.occluders.lit(light, azimuth_deg, bounces, shader)
        return Shading(
            found.diffuse.apply(shading.diffuse, self.occluders.nearest),
            found.specular.apply(shading.specular, self.occluders.nearest),
        )

    def image(self, values: Float[Tensor, "P C"]) -> Float[Tensor, "H W C"]:
        """Values of the points as an image, zero where nothing is."""
        blank = values.new_zeros(self.height * self.width, values.shape[1])
        return blank.index_copy(0, self.pixels, values).view(self.height, self.width, -1)


@dataclass(frozen=True)
class ImageShading:
    """Outgoing radiance of one view by lobe, linear Rec.709, straight; zero off the surface.

    Attributes:
        diffuse: from the diffuse base.
        specular: from the specular lobe.
    """

    diffuse: Float[Tensor, "H W 3"]
    specular: Float[Tensor, "H W 3"]

    @property
    def radiance(self) -> Float[Tensor, "H W 3"]:
        """The sum of both lobes."""
        return self.diffuse + self.specular


def shade_view(
    gbuffer: GBuffer,
    view: int,
    light: EnvironmentPyramid,
    *,
    azimuth_deg: float = 0.0,
    visibility: ScreenVisibility | None = None,
    bounces: int = BOUNCES,
    multiple_scattering: MultipleScattering = True,
) -> ImageShading:
    """Light one view once; arguments as in `ViewPoints`."""
    points = ViewPoints.of(gbuffer, view, visibility)
    shading = points.lit(
        light,
        azimuth_deg=azimuth_deg,
        bounces=bounces,
        multiple_scattering=multiple_scattering,
    )
    return ImageShading(points.image(shading.diffuse), points.image(shading.specular))


@dataclass(frozen=True)
class LobeOcclusion:
    """What becomes of one lobe at traced points.

    Attributes:
        share: of the unshadowed radiance that is left.
        bounced: radiance that comes from the pixels in the way.
    """

    share: Float[Tensor, "Q 3"]
    bounced: Float[Tensor, "Q 3"]

    def apply(
        self, unshadowed: Float[Tensor, "P 3"], nearest: Int[Tensor, "P"]
    ) -> Float[Tensor, "P 3"]:
        """Radiance of points, each occluded like the traced one that it names."""
        if not len(self.share):
            return unshadowed
        occluded = unshadowed * self.share[nearest] + self.bounced[nearest]
        return torch.where(nearest[:, None] == NOWHERE, unshadowed, occluded)


@dataclass(frozen=True)
class Occlusion:
    """What becomes of both lobes under one light."""

    diffuse: LobeOcclusion
    specular: LobeOcclusion


@dataclass(frozen=True)
class Occluders:
    """Traced points of a view, and which of them stands for each of the view's points.

    Attributes:
        points: that were traced.
        visibility: what they see of each other.
        nearest: index into `points` for each point of the view, or NOWHERE.
    """

    points: ViewPoints
    visibility: ScreenVisibility
    nearest: Int[Tensor, "P"]

    def lit(
        self, light: EnvironmentPyramid, azimuth_deg: float, bounces: int, shader: PointShader
    ) -> Occlusion:
        """Shadows, and the light that the points pass on to each other."""
        unshadowed = self.points.lit(light, azimuth_deg=azimuth_deg, shader=shader)
        lobes = unshadowed.diffuse, unshadowed.specular
        every_ray = self.visibility.diffuse, self.visibility.specular
        shares, gains = [], []
        for rays, lobe in zip(every_ray, lobes, strict=True):
            every, free = lobe_light(rays, light, azimuth_deg=azimuth_deg)
            shares.append(torch.where(every > DARKEST, free / every.clamp_min(DARKEST), 1.0))
            # A lobe returns no more than it gets; rays that miss a lamp which the lookup saw do not
            # tell what it got.
            gains.append((lobe / every.clamp_min(DARKEST)).clamp_max(1.0))
        shadowed = lobes[0] * shares[0] + lobes[1] * shares[1]
        bounced = [torch.zeros_like(lobe) for lobe in lobes]
        for _ in range(bounces):
            radiance = shadowed + bounced[0] + bounced[1]
            bounced = [
                gain * gather_hits(rays, radiance)
                for gain, rays in zip(gains, every_ray, strict=True)
            ]
        return Occlusion(*map(LobeOcclusion, shares, bounced))


def _subsampled(gbuffer: GBuffer, rows: int, columns: int) -> GBuffer:
    """A smaller buffer of the pixels nearest to its own pixels' centres: nothing is mixed."""
    height, width = gbuffer.cameras.height, gbuffer.cameras.width
    row = _scaled(torch.arange(rows, device=gbuffer.mask.device), rows, height)
    column = _scaled(torch.arange(columns, device=gbuffer.mask.device), columns, width)
    images = {name: image[:, row][:, :, column] for name, image in gbuffer.images().items()}
    return GBuffer.of(gbuffer.cameras.resized(rows, columns), images)


def _scaled(index: Int[Tensor, "P"], count: int, wanted: int) -> Int[Tensor, "P"]:
    """Where pixel centres of `count` pixels lie among `wanted` pixels."""
    return (2 * index + 1) * wanted // (2 * count)
