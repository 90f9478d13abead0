"""Pictures of a textured mesh: materials, normals and radiance of every view, supersampled.

These are the renders that others are measured against: every sample inside a pixel is textured and
shaded on its own, then averaged. Light is an environment without visibility or interreflection, so
that cavities are as bright as open surfaces.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.mesh.frames import bitangents, world_from_tangent
from svim3d.mesh.mesh import face_normals_scaled
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh
from svim3d.numerics import dot, normalize
from svim3d.raster.interpolation import interpolate
from svim3d.raster.texture import sample_texture
from svim3d.raster.zbuffer import rasterize

MIN_COVERAGE = 1e-6  # keeps the mean over the covered samples finite where there are none

# (normal, wo, basecolor, roughness, metallic) -> radiance, all [P, C]
Shader = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]
ATTRIBUTES = {"position": 3, "normal": 3, "tangent": 3, "bitangent": 3, "color": 3, "uv": 2}
AOVS = {"basecolor": 3, "roughness": 1, "metallic": 1, "normal_world": 3}


def render_pictures(
    mesh: SourceMesh, cameras: Cameras, shader: Shader, *, supersample: int
) -> dict[str, Float[Tensor, "V H W C"]]:
    """Render all views; both sides of a face are seen.

    Args:
        mesh: in world space.
        cameras: V poses.
        shader: gives the radiance that leaves a point towards the viewer.
        supersample: samples per pixel and axis.

    Returns:
        `radiance` (linear, premultiplied), `mask`, and straight `basecolor`, `roughness`,
        `metallic`, `normal_world`: the six images of `MaterialViews`.
    """
    views = [_render_view(mesh, cameras, v, shader, supersample) for v in range(len(cameras))]
    return {name: torch.stack([view[name] for view in views]) for name in views[0]}


def _render_view(
    mesh: SourceMesh, cameras: Cameras, view: int, shader: Shader, supersample: int
) -> dict[str, Float[Tensor, "H W C"]]:
    """One view: sample, shade, average."""
    fine = cameras[view].resized(cameras.height * supersample, cameras.width * supersample)
    pixels, samples = surface_samples(mesh, fine)
    wo = normalize(fine.positions[0] - samples["position"])
    radiance = shader(samples["normal_world"], wo, *(samples[k] for k in list(AOVS)[:3]))
    values = torch.cat([torch.ones_like(wo[:, :1]), radiance, *(samples[k] for k in AOVS)], 1)
    image = values.new_zeros(fine.height * fine.width, values.shape[1])
    image[pixels] = values
    image = image.view(cameras.height, supersample, cameras.width, supersample, -1).mean((1, 3))
    mask, radiance, aovs = torch.split(image, [1, 3, sum(AOVS.values())], -1)
    straight = torch.split(aovs / mask.clamp_min(MIN_COVERAGE), list(AOVS.values()), -1)
    result = {"radiance": radiance, "mask": mask, **dict(zip(AOVS, straight, strict=True))}
    result["normal_world"] = normalize(result["normal_world"])
    return result


def surface_samples(
    mesh: SourceMesh, camera: Cameras
) -> tuple[Int[Tensor, "P"], dict[str, Float[Tensor, "P C"]]]:
    """Position, materials and shading normal at the pixel centres of one camera.

    Returns:
        Flat indices of the covered pixels, and the values there by name: those of `AOVS`, and the
        world `position`.
    """
    clip = camera.project(mesh.vertices)[0]
    fragments = rasterize(clip, mesh.faces, camera.height, camera.width, cull_backfaces=False)
    tangent = mesh.tangents[:, :3]
    across = bitangents(mesh.normals, mesh.tangents)
    per_vertex = [mesh.vertices, mesh.normals, tangent, across, mesh.colors, mesh.uv]
    pixels, values = interpolate(clip, mesh.faces, fragments, torch.cat(per_vertex, 1))
    split = torch.split(values, list(ATTRIBUTES.values()), 1)
    attributes = dict(zip(ATTRIBUTES, split, strict=True))
    face = fragments.triangle.reshape(-1)[pixels].long()
    samples = _textured(mesh, face, attributes)
    samples["position"] = attributes["position"]
    # A face seen from behind shows its other side: the normal turns to the viewer with it.
    geometric = face_normals_scaled(mesh.vertices, mesh.faces)[face]
    behind = dot(geometric, camera.positions[0] - samples["position"]) < 0.0
    normal = samples["normal_world"]
    samples["normal_world"] = torch.where(behind, -normal, normal)
    return pixels, samples


def _textured(
    mesh: SourceMesh, face: Int[Tensor, "P"], attributes: dict[str, Float[Tensor, "P C"]]
) -> dict[str, Float[Tensor, "P C"]]:
    """Materials and shading normals, one material after another."""
    material_of = mesh.face_material.long()[face]
    count = len(face)
    result = {name: attributes["uv"].new_zeros(count, width) for name, width in AOVS.items()}
    for index, material in enumerate(mesh.materials):
        chosen = torch.nonzero(material_of == index)[:, 0]
        if not len(chosen):
            continue
        here = {name: value[chosen] for name, value in attributes.items()}
        for name, value in _evaluate(material, here).items():
            result[name][chosen] = value
    return result


def _evaluate(
    material: SourceMaterial, attributes: dict[str, Float[Tensor, "P C"]]
) -> dict[str, Float[Tensor, "P C"]]:
    """A glTF metallic-roughness material at P points."""
    uv, normal = attributes["uv"], normalize(attributes["normal"])
    basecolor = attributes["color"] * uv.new_tensor(material.basecolor_factor)
    if material.basecolor is not None:
        basecolor = basecolor * sample_texture(material.basecolor, uv)
    factors = uv.new_tensor([material.roughness_factor, material.metallic_factor])
    roughness_metallic = factors.expand(len(uv), 2)
    if material.roughness_metallic is not None:
        roughness_metallic = factors * sample_texture(material.roughness_metallic, uv)
    if material.normal_tangent is not None:
        local = sample_texture(material.normal_tangent, uv)
        normal = world_from_tangent(local, normal, attributes["tangent"], attributes["bitangent"])
    return {
        "basecolor": basecolor.clamp(0.0, 1.0),
        "roughness": roughness_metallic[:, :1],
        "metallic": roughness_metallic[:, 1:],
        "normal_world": normal,
    }
