"""The Mitsuba door: a mesh under an environment, path traced, with shadows and interreflection.

Mitsuba is an optional dependency (`pip install svim3d[path]`). Its `principled` material stands for
glTF's: the same GGX lobe and Schlick reflectance, but Disney's diffuse lobe, which darkens and
brightens at grazing angles where Lambert's does not.

Source: Jakob et al. 2022, "Mitsuba 3 renderer"; Burley 2012, "Physically-based shading at Disney".
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from svim3d.cameras import FAR, NEAR, Cameras
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh

# The compiled variants need a recent LLVM, and an old one (14, 15) ends the whole process.
VARIANT = "scalar_rgb"
DIELECTRIC_SPECULAR = 0.5  # of `principled`: reflectance 0.04 at normal incidence, as in glTF

Mitsuba = Any  # the module has no types of its own


def render_path_traced(
    mesh: SourceMesh,
    cameras: Cameras,
    latlong: Float[Tensor, "H W 3"],
    *,
    samples: int,
    seed: int,
    max_depth: int = 6,
) -> dict[str, Float[Tensor, "_ _ _ _"]]:
    """Render all views; both sides of a face are seen, the background stays empty.

    Args:
        mesh: in world space.
        cameras: V poses.
        latlong: linear radiance, in the convention of `svim3d.shading.environment`.
        samples: paths per pixel.
        seed: of the random numbers; equal seeds give equal pictures.
        max_depth: path vertices but the camera; 2 is direct light with shadows.

    Returns:
        `radiance` (linear, premultiplied) and `mask`.

    Raises:
        ValueError: Mitsuba is not installed, or the mesh has what cannot be handed over.
    """
    mi = load_mitsuba()
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": max_depth, "hide_emitters": True},
        "light": {"type": "envmap", "bitmap": _bitmap(mi, _turned_half(latlong))},
    }
    for index, material in enumerate(mesh.materials):
        for mirrored in (False, True):
            faces = _faces_of(mesh, index, mirrored)
            if len(faces):
                name = f"part_{index}_{int(mirrored)}"
                scene[name] = _shape(mi, name, mesh, faces, _bsdf(mi, material, mesh, mirrored))
    loaded = mi.load_dict(scene)
    pictures = []
    for view in range(len(cameras)):
        sensor = mi.load_dict(_sensor(mi, cameras, view))
        picture = mi.render(loaded, sensor=sensor, spp=samples, seed=seed + view)
        pictures.append(torch.from_numpy(np.array(picture, np.float32)))
    stacked = torch.stack(pictures).to(mesh.vertices.device)
    return {"radiance": stacked[..., :3], "mask": stacked[..., 3:].clamp(0.0, 1.0)}


def load_mitsuba() -> Mitsuba:
    """Mitsuba, ready for use.

    Raises:
        ValueError: it is not installed.
    """
    try:
        import mitsuba
    except ImportError as error:
        raise ValueError(
            "path tracing needs Mitsuba, which is not installed; run pip install 'svim3d[path]'"
        ) from error
    mitsuba.set_variant(VARIANT)
    return mitsuba


def _turned_half(latlong: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Mitsuba's picture starts at -z, ours has it in the middle."""
    return latlong.roll(latlong.shape[1] // 2, 1)


def _bitmap(mi: Mitsuba, values: Tensor) -> Any:
    """Raw linear values."""
    return mi.Bitmap(np.ascontiguousarray(values.detach().cpu().float().numpy()))


def _texture(mi: Mitsuba, values: Tensor) -> dict[str, Any]:
    """A repeating bilinear texture of linear values; row 0 is v = 0, as in glTF."""
    return {
        "type": "bitmap",
        "bitmap": _bitmap(mi, values),
        "raw": True,
        "wrap_mode": "repeat",
        "filter_type": "bilinear",
    }


def _faces_of(mesh: SourceMesh, material: int, mirrored: bool) -> Int[Tensor, "F 3"]:
    """Faces of a material whose texture is shown as it is, or as in a mirror."""
    handedness = mesh.tangents[mesh.faces[:, 0].long(), 3]
    chosen = (mesh.face_material == material) & ((handedness < 0.0) == mirrored)
    return mesh.faces[chosen].long()


def _shape(
    mi: Mitsuba, name: str, mesh: SourceMesh, faces: Int[Tensor, "F 3"], bsdf: dict[str, Any]
) -> Any:
    """Some faces of the mesh with their material."""
    used, index = torch.unique(faces, return_inverse=True)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    shape = mi.Mesh(
        name,
        vertex_count=len(used),
        face_count=len(faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    shape.add_attribute("vertex_color", 3, _flat(mesh.colors[used]))
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = _flat(mesh.vertices[used])
    parameters["vertex_normals"] = _flat(mesh.normals[used])
    parameters["vertex_texcoords"] = _flat(mesh.uv[used])
    parameters["faces"] = index.cpu().numpy().astype(np.uint32).ravel()
    parameters.update()
    return shape


def _flat(values: Tensor) -> NDArray[np.float32]:
    return values.detach().cpu().float().numpy().ravel()


def _bsdf(
    mi: Mitsuba, material: SourceMaterial, mesh: SourceMesh, mirrored: bool
) -> dict[str, Any]:
    """A glTF material in Mitsuba's terms."""
    roughness_metallic = material.roughness_metallic
    principled: dict[str, Any] = {
        "type": "principled",
        "base_color": _basecolor(mi, material, mesh),
        "specular": DIELECTRIC_SPECULAR,
        "roughness": material.roughness_factor,
        "metallic": material.metallic_factor,
    }
    if roughness_metallic is not None:
        for channel, name in enumerate(("roughness", "metallic")):
            factor = principled[name]
            plane = roughness_metallic[..., channel : channel + 1]
            principled[name] = _texture(mi, plane * factor)
    inner = principled
    if material.normal_tangent is not None:
        # A mirrored texture has its bitangent the other way; Mitsuba knows only one.
        green = -1.0 if mirrored else 1.0
        normal = material.normal_tangent * material.normal_tangent.new_tensor([1.0, green, 1.0])
        inner = {
            "type": "normalmap",
            "normalmap": _texture(mi, normal * 0.5 + 0.5),
            "bsdf": principled,
        }
    return {"type": "twosided", "bsdf": inner}


def _basecolor(mi: Mitsuba, material: SourceMaterial, mesh: SourceMesh) -> dict[str, Any]:
    """Texture or vertex colour times the factor."""
    factor = mesh.colors.new_tensor(material.basecolor_factor)
    is_coloured = bool((mesh.colors != 1.0).any())
    if material.basecolor is not None:
        if is_coloured:
            raise ValueError(
                "the path tracer takes textures or vertex colours, not their product; "
                "bake the colours into the texture, or use --engine raster"
            )
        return _texture(mi, (material.basecolor * factor).clamp(0.0, 1.0))
    if is_coloured:
        if bool((factor != 1.0).any()):
            raise ValueError(
                "the path tracer takes vertex colours without a factor; multiply them, "
                "or use --engine raster"
            )
        return {"type": "mesh_attribute", "name": "vertex_color"}
    return {"type": "rgb", "value": factor.tolist()}


def _sensor(mi: Mitsuba, cameras: Cameras, view: int) -> dict[str, Any]:
    """One camera, box filtered like our own pictures."""
    pose = cameras.c2w[view].double().cpu().numpy()
    centre, backward, up = pose[:3, 3], pose[:3, 2], pose[:3, 1]
    return {
        "type": "perspective",
        "fov": cameras.fov_y_deg,
        "fov_axis": "y",
        "near_clip": NEAR,
        "far_clip": FAR,
        "to_world": mi.ScalarTransform4f().look_at(
            origin=centre.tolist(), target=(centre - backward).tolist(), up=up.tolist()
        ),
        "sampler": {"type": "independent"},
        "film": {
            "type": "hdrfilm",
            "width": cameras.width,
            "height": cameras.height,
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
        },
    }
