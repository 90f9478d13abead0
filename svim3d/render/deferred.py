"""Mesh, material, light and camera to images: rasterise, evaluate materials once per pixel, shade.

Images are premultiplied by coverage, so that filtering and blending need no special cases.
Silhouettes are smoothed in one of two ways: by the differentiable edge walk, for optimisation, or
by supersampling with a box filter, for pictures that serve as ground truth.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.fields.material_field import Materials
from svim3d.mesh.mesh import face_adjacency, vertex_normals
from svim3d.numerics import dot, normalize
from svim3d.raster.interpolation import interpolate
from svim3d.raster.silhouettes import antialias
from svim3d.raster.texture import sample_texture
from svim3d.raster.zbuffer import rasterize
from svim3d.shading.prefilter import EnvironmentPyramid
from svim3d.shading.split_sum import shade

MIN_COVERAGE = 1e-4  # below it a straight colour is undefined and stays zero


@dataclass(frozen=True)
class SurfacePoints:
    """The visible surface points of one view, what a material is asked about.

    Attributes:
        position: world space.
        normal: unit, interpolated from the vertices, on the viewer's side of a two-sided face.
        facing: +1 where the face shows its front, -1 where its back is seen.
        face: index of the face.
        attributes: interpolated vertex attributes (texture coordinates, tangents, colours).
    """

    position: Float[Tensor, "P 3"]
    normal: Float[Tensor, "P 3"]
    facing: Float[Tensor, "P 1"]
    face: Int[Tensor, "P"]
    attributes: Float[Tensor, "P C"]


MaterialSource = Callable[[SurfacePoints], Materials]
# Unit shading normal, unit direction to the viewer, materials -> linear radiance [P, 3].
Shader = Callable[[Tensor, Tensor, Materials], Tensor]


@dataclass(frozen=True)
class Geometry:
    """A mesh to render.

    Attributes:
        vertices: world positions.
        faces: counter-clockwise seen from outside.
        normals: unit, per vertex.
        attributes: further vertex attributes for the material source; may have no channels.
        adjacency: face across the edge opposite each corner, for differentiable silhouettes; None
            leaves each pixel to its centre.
        two_sided: show faces from behind too.
    """

    vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    normals: Float[Tensor, "N 3"]
    attributes: Float[Tensor, "N C"]
    adjacency: Int[Tensor, "F 3"] | None = None
    two_sided: bool = False

    @classmethod
    def smooth(
        cls,
        vertices: Float[Tensor, "N 3"],
        faces: Int[Tensor, "F 3"],
        *,
        silhouettes: bool = False,
    ) -> "Geometry":
        """A mesh with area-weighted vertex normals; differentiable in `vertices`."""
        return cls(
            vertices=vertices,
            faces=faces,
            normals=vertex_normals(vertices, faces),
            attributes=vertices.new_zeros(len(vertices), 0),
            adjacency=face_adjacency(faces) if silhouettes else None,
        )


@dataclass(frozen=True)
class RenderedView:
    """One view, all images premultiplied by `mask`.

    Attributes:
        mask: coverage.
        basecolor: linear.
        roughness: perceptual.
        metallic: in [0, 1].
        normal_world: shading normals; shorter than one where a pixel mixes directions.
        depth: distance along the camera's -z axis.
        radiance: linear; zero without a shader.
    """

    mask: Float[Tensor, "H W 1"]
    basecolor: Float[Tensor, "H W 3"]
    roughness: Float[Tensor, "H W 1"]
    metallic: Float[Tensor, "H W 1"]
    normal_world: Float[Tensor, "H W 3"]
    depth: Float[Tensor, "H W 1"]
    radiance: Float[Tensor, "H W 3"]

    def surface_images(self) -> dict[str, Float[Tensor, "H W _"]]:
        """Coverage, materials and shading normals by the names that they have in views."""
        names = ("mask", "basecolor", "roughness", "metallic", "normal_world")
        return {name: getattr(self, name) for name in names}

    def straight(self) -> "RenderedView":
        """The same images divided by coverage, normals of unit length; radiance as it is."""
        scale = torch.where(self.mask > MIN_COVERAGE, 1.0 / self.mask.clamp_min(MIN_COVERAGE), 0.0)
        return RenderedView(
            mask=self.mask,
            basecolor=self.basecolor * scale,
            roughness=self.roughness * scale,
            metallic=self.metallic * scale,
            normal_world=normalize(self.normal_world * scale),
            depth=self.depth * scale,
            radiance=self.radiance,
        )


def environment_shader(pyramid: EnvironmentPyramid, *, multiple_scattering: bool = True) -> Shader:
    """Split-sum shading by a prefiltered environment; differentiable in it."""

    def radiance(normal: Tensor, wo: Tensor, material: Materials) -> Tensor:
        return shade(
            normal,
            wo,
            material.basecolor,
            material.roughness,
            material.metallic,
            pyramid,
            multiple_scattering=multiple_scattering,
        ).radiance

    return radiance


CHANNELS = [1, 3, 1, 1, 3, 1, 3]  # of the images of a RenderedView, in their order


def render_mesh(
    geometry: Geometry,
    materials: MaterialSource,
    cameras: Cameras,
    *,
    view: int,
    shader: Shader | None = None,
    supersample: int = 1,
) -> RenderedView:
    """One view of a mesh. Differentiable in geometry, materials and whatever the shader reads.

    Args:
        geometry: the mesh; with `adjacency` its silhouettes are smooth and differentiable.
        materials: evaluated once per visible point.
        cameras: poses; the image size is theirs.
        view: which pose.
        shader: radiance from shading normal, direction to the viewer and materials.
        supersample: samples per pixel and axis, box filtered; only without `adjacency`.
    """
    if supersample > 1 and geometry.adjacency is not None:
        raise ValueError(
            "silhouettes are smoothed either by supersampling or by the edge walk; "
            "leave out the adjacency, or set supersample to 1"
        )
    height, width = cameras.height, cameras.width
    clip = cameras[view].project(geometry.vertices)[0]
    fragments = rasterize(
        clip,
        geometry.faces,
        height * supersample,
        width * supersample,
        cull_backfaces=not geometry.two_sided,
    )
    # The clip-space w is the distance along the camera's -z axis.
    stacked = torch.cat([geometry.vertices, geometry.normals, clip[:, 3:], geometry.attributes], 1)
    pixels, values = interpolate(clip, geometry.faces, fragments, stacked)
    wo = normalize(cameras.positions[view] - values[:, :3])
    points = surface_points(geometry, values, fragments.triangle.reshape(-1)[pixels].long(), wo)
    channels = torch.cat(
        [torch.ones_like(wo[:, :1]), *_material_channels(points, materials, values, wo, shader)], 1
    )
    row = pixels // (width * supersample) // supersample
    column = pixels % (width * supersample) // supersample
    empty = channels.new_zeros(height * width, channels.shape[1])
    image = empty.index_add(0, row * width + column, channels / supersample**2)
    image = image.view(height, width, -1)
    if geometry.adjacency is not None:
        image = antialias(image, clip, geometry.faces, fragments, geometry.adjacency)
    return RenderedView(*torch.split(image, CHANNELS, -1))


def surface_points(
    geometry: Geometry,
    values: Float[Tensor, "P C"],
    face: Int[Tensor, "P"],
    wo: Float[Tensor, "P 3"],
) -> SurfacePoints:
    """Unpack interpolated values; turn normals of faces seen from behind to the viewer."""
    facing = torch.ones_like(wo[:, :1])
    if geometry.two_sided:
        a, b, c = geometry.vertices[geometry.faces[face].long()].unbind(1)
        facing = torch.where(dot(torch.linalg.cross(b - a, c - a), wo) < 0.0, -1.0, 1.0).to(wo)
    return SurfacePoints(
        position=values[:, :3],
        normal=normalize(values[:, 3:6]) * facing,
        facing=facing,
        face=face,
        attributes=values[:, 7:],
    )


def _material_channels(
    points: SurfacePoints,
    materials: MaterialSource,
    values: Float[Tensor, "P C"],
    wo: Float[Tensor, "P 3"],
    shader: Shader | None,
) -> list[Tensor]:
    """The images of a RenderedView after the mask, at the visible points."""
    material = materials(points)
    normal = normalize(points.normal + material.bump)
    radiance = torch.zeros_like(wo) if shader is None else shader(normal, wo, material)
    return [
        material.basecolor,
        material.roughness,
        material.metallic,
        normal,
        values[:, 6:7],
        radiance,
    ]


@dataclass(frozen=True)
class TextureMaterials:
    """Materials from textures; vertex attributes are uv (2) and, for a normal map, tangent (4).

    Attributes:
        basecolor: linear.
        orm: occlusion, roughness, metallic.
        normal_tangent: unit tangent-space normals, green up, or None.
    """

    basecolor: Float[Tensor, "H W 3"]
    orm: Float[Tensor, "H W 3"]
    normal_tangent: Float[Tensor, "H W 3"] | None = None

    def __call__(self, points: SurfacePoints) -> Materials:
        """Materials at the points' texture coordinates."""
        uv = points.attributes[:, :2]
        orm = sample_texture(self.orm, uv)
        bump = torch.zeros_like(points.normal)
        if self.normal_tangent is not None:
            mapped = sample_texture(self.normal_tangent, uv)
            bump = normal_from_tangent(mapped, points, points.attributes[:, 2:6]) - points.normal
        return Materials(
            basecolor=sample_texture(self.basecolor, uv),
            roughness=orm[:, 1:2],
            metallic=orm[:, 2:3],
            bump=bump,
        )


def normal_from_tangent(
    normal_tangent: Float[Tensor, "P 3"], points: SurfacePoints, tangent: Float[Tensor, "P 4"]
) -> Float[Tensor, "P 3"]:
    """World-space shading normal; the bitangent is cross(normal, tangent) times the handedness.

    Source: glTF 2.0, section 3.7.2.1. Seen from behind, the whole frame turns around.
    """
    front_normal = points.normal * points.facing
    bitangent = torch.linalg.cross(front_normal, tangent[:, :3]) * torch.sign(tangent[:, 3:])
    x, y, z = torch.split(normal_tangent, 1, -1)
    return normalize((x * tangent[:, :3] + y * bitangent + z * front_normal) * points.facing)


def vertex_materials(points: SurfacePoints) -> Materials:
    """Materials carried by the vertices: attributes are basecolor (3) and ORM (3)."""
    return Materials(
        basecolor=points.attributes[:, :3],
        roughness=points.attributes[:, 4:5],
        metallic=points.attributes[:, 5:6],
        bump=torch.zeros_like(points.normal),
    )
