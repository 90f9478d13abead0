"""Supersampled pictures of meshes that carry their own materials, as others are measured against.

Every sample inside a pixel is textured and shaded on its own, then averaged. Light is an
environment without visibility or interreflection, so that cavities are as bright as open surfaces.
"""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.fields.material_field import Materials
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh
from svim3d.raster.texture import sample_texture
from svim3d.render.deferred import (
    Geometry,
    Shader,
    SurfacePoints,
    normal_from_tangent,
    render_mesh,
)
from svim3d.render.gbuffer import GBuffer

BUFFERS = ("basecolor", "roughness", "metallic", "normal_world", "depth")
ATTRIBUTES = {"uv": 2, "tangent": 4, "color": 3}


def render_pictures(
    mesh: SourceMesh, cameras: Cameras, shader: Shader, *, supersample: int
) -> dict[str, Float[Tensor, "_ _ _ _"]]:
    """Render all views; both sides of a face are seen.

    Args:
        mesh: in world space.
        cameras: V poses.
        shader: radiance from shading normal, direction to the viewer and materials.
        supersample: samples per pixel and axis.

    Returns:
        `radiance` (linear, premultiplied), `mask`, and straight `basecolor`, `roughness`,
        `metallic`, `normal_world` and `depth`: the images of an orbit.
    """
    return _images(mesh, cameras, shader, supersample, ("radiance", "mask", *BUFFERS))


def render_gbuffer(mesh: SourceMesh, cameras: Cameras) -> GBuffer:
    """Materials, normals and depth at the centre of every pixel; both sides of a face are seen.

    For smooth pictures, ask for larger ones and average what is shaded from them.
    """
    return GBuffer.of(cameras, _images(mesh, cameras, None, 1, ("mask", *BUFFERS)))


def _images(
    mesh: SourceMesh,
    cameras: Cameras,
    shader: Shader | None,
    supersample: int,
    names: tuple[str, ...],
) -> dict[str, Float[Tensor, "_ _ _ _"]]:
    """The named images of all views."""
    geometry, materials = mesh_geometry(mesh), MeshMaterials.of(mesh)
    views = [
        render_mesh(
            geometry, materials, cameras, view=view, shader=shader, supersample=supersample
        ).straight()
        for view in range(len(cameras))
    ]
    return {name: torch.stack([getattr(view, name) for view in views]) for name in names}


def mesh_geometry(mesh: SourceMesh) -> Geometry:
    """The mesh with what `MeshMaterials` reads at its vertices; both sides of a face are seen."""
    return Geometry(
        vertices=mesh.vertices,
        faces=mesh.faces,
        normals=mesh.normals,
        attributes=torch.cat([mesh.uv, mesh.tangents, mesh.colors], 1),
        two_sided=True,
    )


@dataclass(frozen=True)
class MeshMaterials:
    """The materials of a `SourceMesh` at its visible points."""

    face_material: Int[Tensor, "F"]
    materials: tuple[SourceMaterial, ...]

    @classmethod
    def of(cls, mesh: SourceMesh) -> Self:
        """The materials of a mesh that is rendered as `mesh_geometry` has it."""
        return cls(mesh.face_material.long(), mesh.materials)

    def __call__(self, points: SurfacePoints) -> Materials:
        """Evaluate one material after another, each at the points that show it."""
        material_of = self.face_material[points.face]
        result = points.position.new_zeros(len(points.position), 8)
        for index, material in enumerate(self.materials):
            chosen = torch.nonzero(material_of == index)[:, 0]
            if len(chosen):
                here = SurfacePoints(
                    position=points.position[chosen],
                    normal=points.normal[chosen],
                    facing=points.facing[chosen],
                    face=points.face[chosen],
                    attributes=points.attributes[chosen],
                )
                result[chosen] = _evaluate(material, here)
        return Materials(*torch.split(result, [3, 1, 1, 3], 1))


def _evaluate(material: SourceMaterial, points: SurfacePoints) -> Float[Tensor, "P 8"]:
    """Basecolor, roughness, metallic and normal offset of one glTF material."""
    uv, tangent, color = torch.split(points.attributes, list(ATTRIBUTES.values()), 1)
    basecolor = color * uv.new_tensor(material.basecolor_factor)
    if material.basecolor is not None:
        basecolor = basecolor * sample_texture(material.basecolor, uv)
    factors = uv.new_tensor([material.roughness_factor, material.metallic_factor])
    roughness_metallic = factors.expand(len(uv), 2)
    if material.roughness_metallic is not None:
        roughness_metallic = factors * sample_texture(material.roughness_metallic, uv)
    bump = torch.zeros_like(points.normal)
    if material.normal_tangent is not None:
        mapped = sample_texture(material.normal_tangent, uv)
        bump = normal_from_tangent(mapped, points, tangent) - points.normal
    return torch.cat([basecolor.clamp(0.0, 1.0), roughness_metallic, bump], 1)
