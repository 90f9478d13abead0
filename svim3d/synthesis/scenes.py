"""Scenes: things to take pictures of, invented or read from a file, turned as they will be seen."""

from dataclasses import dataclass, replace

import torch

from svim3d.fields.material_field import Materials
from svim3d.mesh.micropolygons import Micropolygons, cut_long_edges
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh
from svim3d.numerics import normalize
from svim3d.render.deferred import Geometry, MaterialSource, SurfacePoints
from svim3d.render.pictures import MeshMaterials, mesh_geometry
from svim3d.synthesis.bodies import turned
from svim3d.synthesis.objects import Quality, SyntheticObject


@dataclass(frozen=True)
class Scene:
    """Something to take pictures of, turned as it will be seen.

    Attributes:
        name: tells what it is.
        geometry: world frame; centred, longest side 1.
        materials: of its surface.
        quality: "good" or "low"; low ones do not teach materials.
    """

    name: str
    geometry: Geometry
    materials: MaterialSource
    quality: Quality


def scene_of(thing: SyntheticObject, yaw_deg: float) -> Scene:
    """An invented object, turned about the upright axis."""
    yaw = turned(1, yaw_deg)

    def materials(points: SurfacePoints) -> Materials:
        # Materials live in the object's own frame.
        rows = thing.material_rows(points.position @ yaw, points.normal @ yaw, points.face)
        return Materials(rows[:, :3], rows[:, 3:4], rows[:, 4:5], torch.zeros_like(points.normal))

    assembly = thing.assembly
    geometry = Geometry(
        vertices=assembly.vertices @ yaw.T,
        faces=assembly.faces,
        normals=assembly.normals @ yaw.T,
        attributes=assembly.vertices.new_zeros(len(assembly.vertices), 0),
    )
    return Scene(thing.name, geometry, materials, thing.quality)


def scene_of_mesh(name: str, mesh: SourceMesh, yaw_deg: float) -> Scene:
    """A normalised mesh, turned about the upright axis."""
    yaw = turned(1, yaw_deg)
    tangents = torch.cat([mesh.tangents[:, :3] @ yaw.T, mesh.tangents[:, 3:]], 1)
    mesh = replace(
        mesh, vertices=mesh.vertices @ yaw.T, normals=mesh.normals @ yaw.T, tangents=tangents
    )
    return Scene(name, mesh_geometry(mesh), MeshMaterials.of(mesh), mesh_quality(mesh))


def micropolygons(scene: Scene, longest: float) -> Micropolygons:
    """The scene with its materials asked for at the corners of triangles of edges so short.

    Normal maps become shading normals of the corners.
    """
    geometry = scene.geometry
    values = torch.cat([geometry.vertices, geometry.normals, geometry.attributes], 1)
    corners, face = cut_long_edges(values[geometry.faces.long()], longest)
    flat = corners.flatten(0, 1)
    points = SurfacePoints(
        position=flat[:, :3],
        normal=normalize(flat[:, 3:6]),
        facing=torch.ones_like(flat[:, :1]),
        face=face.repeat_interleave(3),
        attributes=flat[:, 6:],
    )
    materials = scene.materials(points)
    at_corners = (
        points.position,
        normalize(points.normal + materials.bump),
        materials.basecolor,
        materials.roughness,
        materials.metallic,
    )
    return Micropolygons(*(values.unflatten(0, (-1, 3)) for values in at_corners))


def mesh_quality(mesh: SourceMesh) -> Quality:
    """Whether a file's materials are worth learning from.

    They are where the colour varies (a texture, vertex colours, several materials) and roughness
    or metallic does too.
    """
    used = [mesh.materials[i] for i in torch.unique(mesh.face_material).tolist()]
    colours = {material.basecolor_factor for material in used}
    rough = {(material.roughness_factor, material.metallic_factor) for material in used}
    has_colours = (
        len(colours) > 1
        or any(_varies(material, "basecolor") for material in used)
        or bool((mesh.colors != mesh.colors[:1]).any())
    )
    has_rough = len(rough) > 1 or any(_varies(m, "roughness_metallic") for m in used)
    return "good" if has_colours and has_rough else "low"


def _varies(material: SourceMaterial, texture: str) -> bool:
    """Whether a texture holds more than one value."""
    image = getattr(material, texture)
    return image is not None and bool((image != image[:1, :1]).any())
