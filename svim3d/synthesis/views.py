"""All views of an object at once: what every sample sees, lit by any number of lights.

Geometry and materials are found once per sample; each light then costs one lookup per sample.
Samples are averaged inside a pixel while they are linear.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.color import linear_from_srgb, luminance, srgb_from_linear
from svim3d.numerics import normalize
from svim3d.raster.interpolation import interpolate
from svim3d.raster.zbuffer import rasterize
from svim3d.render.deferred import Geometry, MaterialSource, SurfacePoints, surface_points
from svim3d.shading.prefilter import EnvironmentPyramid
from svim3d.shading.split_sum import Shading, shade

SUPERSAMPLE = 2  # samples per pixel and axis
EXPOSED_QUANTILE = 0.9  # of the luminance on the object that exposure brings to a chosen value
MIN_COVERAGE = 1e-4
DARKEST = 1e-6  # luminance; below it an object is black in any exposure


@dataclass(frozen=True)
class ViewSamples:
    """Surface samples of V views.

    Attributes:
        pixel: flat index into V x H x W.
        position: world frame.
        normal: unit shading normals, world frame.
        wo: unit directions to the viewer.
        basecolor: linear.
        roughness: perceptual.
        metallic: in [0, 1].
        shape: V, H, W.
        per_pixel: samples that fill a pixel.
    """

    pixel: Int[Tensor, "P"]
    position: Float[Tensor, "P 3"]
    normal: Float[Tensor, "P 3"]
    wo: Float[Tensor, "P 3"]
    basecolor: Float[Tensor, "P 3"]
    roughness: Float[Tensor, "P 1"]
    metallic: Float[Tensor, "P 1"]
    shape: tuple[int, int, int]
    per_pixel: int

    def image(self, values: Float[Tensor, "P C"]) -> Float[Tensor, "V H W C"]:
        """Box-filtered images of sample values, premultiplied by coverage."""
        views, height, width = self.shape
        blank = values.new_zeros(views * height * width, values.shape[1])
        summed = blank.index_add_(0, self.pixel, values / self.per_pixel)
        return summed.view(views, height, width, -1)

    @property
    def mask(self) -> Float[Tensor, "V H W 1"]:
        """Coverage."""
        return self.image(torch.ones_like(self.roughness))

    def shading(self, light: EnvironmentPyramid) -> Shading:
        """Linear radiance of all samples by lobe, as if nothing were in the way of the light."""
        return shade(self.normal, self.wo, self.basecolor, self.roughness, self.metallic, light)


def sample_views(
    geometry: Geometry,
    materials: MaterialSource,
    cameras: Cameras,
    *,
    supersample: int = SUPERSAMPLE,
) -> ViewSamples:
    """What all cameras see of a mesh; materials are asked once, about all samples of all views."""
    height, width = cameras.height * supersample, cameras.width * supersample
    clip = cameras.project(geometry.vertices)
    seen: list[SurfacePoints] = []
    pixel, directions = [], []
    for view in range(len(cameras)):
        fragments = rasterize(
            clip[view], geometry.faces, height, width, cull_backfaces=not geometry.two_sided
        )
        stacked = torch.cat(
            [geometry.vertices, geometry.normals, clip[view][:, 3:], geometry.attributes], 1
        )
        flat, values = interpolate(clip[view], geometry.faces, fragments, stacked)
        wo = normalize(cameras.positions[view] - values[:, :3])
        faces = fragments.triangle.reshape(-1)[flat].long()
        seen.append(surface_points(geometry, values, faces, wo))
        row, column = flat // width // supersample, flat % width // supersample
        pixel.append((view * cameras.height + row) * cameras.width + column)
        directions.append(wo)
    names = ("position", "normal", "facing", "face", "attributes")
    points = SurfacePoints(*(torch.cat([getattr(p, name) for p in seen]) for name in names))
    material = materials(points)
    return ViewSamples(
        pixel=torch.cat(pixel),
        position=points.position,
        normal=normalize(points.normal + material.bump),
        wo=torch.cat(directions),
        basecolor=material.basecolor,
        roughness=material.roughness,
        metallic=material.metallic,
        shape=(len(cameras), cameras.height, cameras.width),
        per_pixel=supersample**2,
    )


def exposure_for(
    radiance: Float[Tensor, "V H W 3"], mask: Float[Tensor, "V H W 1"], display: float
) -> float:
    """Factor that brings the bright part of the object to a display value.

    Args:
        radiance: linear, premultiplied.
        mask: coverage of the same pixels.
        display: sRGB-encoded value of the luminance that a tenth of the covered pixels exceed.
    """
    covered = mask[..., 0] > 0.5
    values = luminance(radiance[covered] / mask[covered])
    if not len(values):
        return 1.0
    bright = float(torch.quantile(values[:, 0], EXPOSED_QUANTILE))
    return float(linear_from_srgb(torch.tensor(display))) / max(bright, DARKEST)


def on_background(
    premultiplied: Float[Tensor, "V H W C"],
    mask: Float[Tensor, "V H W 1"],
    *,
    background: float,
    srgb: bool = False,
) -> UInt8[Tensor, "V H W C"]:
    """Bytes of an image over an even background; colours are encoded first, then blended."""
    straight = premultiplied / mask.clamp_min(MIN_COVERAGE)
    encoded = srgb_from_linear(straight) if srgb else straight
    blended = encoded * mask + background * (1.0 - mask)
    return (blended.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def with_coverage(
    rendered: Float[Tensor, "V H W 4"], mask: Float[Tensor, "V H W 1"]
) -> Float[Tensor, "V H W 3"]:
    """The colours of another renderer, premultiplied by our coverage instead of its own.

    Both sample a pixel at other points, so that their coverages differ a little on silhouettes.
    """
    coverage = rendered[..., 3:]
    return rendered[..., :3] / coverage.clamp_min(MIN_COVERAGE) * mask


def camera_normals(samples: ViewSamples, cameras: Cameras) -> UInt8[Tensor, "V H W 3"]:
    """Unit camera-space normals, encoded (n + 1) / 2, black where nothing is."""
    mean = normalize(samples.image(samples.normal))
    local = torch.einsum("vhwi,vij->vhwj", mean, cameras.c2w[:, :3, :3])
    mask = samples.mask
    return on_background((0.5 * local + 0.5) * mask, mask, background=0.0)
