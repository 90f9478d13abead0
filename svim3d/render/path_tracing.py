"""The Mitsuba door: a mesh under an environment, path traced, with shadows and interreflection.

Mitsuba is an optional dependency (`pip install svim3d[path]`). Its `principled` material stands for
glTF's: the same GGX lobe, but Disney's diffuse base, which receives what the lobe reflects too and
darkens or brightens at grazing angles where Lambert's does not. The basecolor is scaled so that
both bases reflect the same share of even light; how it spreads over angles still differs.

Source: Jakob et al. 2022, "Mitsuba 3 renderer"; Burley 2012, "Physically-based shading at Disney".
"""

import functools
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from svim3d.cameras import FAR, NEAR, Cameras
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh
from svim3d.raster.texture import sample_texture
from svim3d.shading.directional_albedo import integrate_split_sum
from svim3d.shading.metallic_roughness import DIELECTRIC_F0

# The compiled variants need a recent LLVM, and an old one (14, 15) ends the whole process.
VARIANT = "scalar_rgb"
DIELECTRIC_SPECULAR = 0.5  # of `principled`: reflectance 0.04 at normal incidence, as in glTF
# Share of even light that the white diffuse base of `principled` reflects, by powers of roughness:
# Burley's lobe integrated over both directions; the first is (1 - 1/42)^2.
DISNEY_ALBEDO = (0.95295, 0.10870, 0.00352)
TABLE_SIZE = 17  # roughnesses; the factor is smooth
ANGLES = 24  # midpoints of the cosine in its mean; with the steps above, errors below 2e-4

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
                scene[name] = _shape(mi, name, mesh, faces, material, mirrored=mirrored)
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


def _texture(mi: Mitsuba, values: Float[Tensor, "H W c"]) -> dict[str, Any] | float:
    """A repeating bilinear texture of linear values, row 0 at v = 0 as in glTF; or one value."""
    if values.shape[:2].numel() == 1:
        value = values.flatten().tolist()
        return {"type": "rgb", "value": value} if len(value) == 3 else float(value[0])
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
    mi: Mitsuba,
    name: str,
    mesh: SourceMesh,
    faces: Int[Tensor, "F 3"],
    material: SourceMaterial,
    *,
    mirrored: bool,
) -> Any:
    """Some faces of the mesh with their material."""
    used, index = torch.unique(faces, return_inverse=True)
    is_coloured = bool((mesh.colors[used] != 1.0).any())
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_bsdf(mi, material, is_coloured, mirrored))
    shape = mi.Mesh(
        name,
        vertex_count=len(used),
        face_count=len(faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    if is_coloured:
        colors = _vertex_basecolor(material, mesh.colors[used], mesh.uv[used])
        shape.add_attribute("vertex_color", 3, _flat(colors))
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
    mi: Mitsuba, material: SourceMaterial, is_coloured: bool, mirrored: bool
) -> dict[str, Any]:
    """A glTF material in Mitsuba's terms."""
    surface = _roughness_metallic(material)
    if is_coloured and material.basecolor is not None:
        raise ValueError(
            "the path tracer takes textures or vertex colours, not their product; "
            "bake the colours into the texture, or use --engine raster"
        )
    principled: dict[str, Any] = {
        "type": "principled",
        "base_color": {"type": "mesh_attribute", "name": "vertex_color"}
        if is_coloured
        else _texture(mi, _basecolor(material, surface)),
        "specular": DIELECTRIC_SPECULAR,
        "roughness": _texture(mi, surface[..., :1]),
        "metallic": _texture(mi, surface[..., 1:]),
    }
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


def _roughness_metallic(material: SourceMaterial) -> Float[Tensor, "H W 2"]:
    """Texture times factors; one texel where there is no texture."""
    factors = torch.tensor([[[material.roughness_factor, material.metallic_factor]]])
    if material.roughness_metallic is None:
        return factors
    return material.roughness_metallic * factors.to(material.roughness_metallic)


def _basecolor(
    material: SourceMaterial, surface: Float[Tensor, "H W 2"]
) -> Float[Tensor, "H2 W2 3"]:
    """Texture times factor, scaled for Mitsuba's base; one texel where nothing varies."""
    basecolor = surface.new_tensor(material.basecolor_factor).view(1, 1, 3)
    if material.basecolor is not None:
        basecolor = material.basecolor * basecolor
    scale = _base_scale(surface)
    one = scale.shape[:2].numel() == 1 or basecolor.shape[:2].numel() == 1
    if not one and scale.shape[:2] != basecolor.shape[:2]:
        scale = _resized(scale, basecolor.shape[0], basecolor.shape[1])
    return basecolor.clamp(0.0, 1.0) * scale


def _resized(
    texture: Float[Tensor, "H W c"], height: int, width: int
) -> Float[Tensor, "height width c"]:
    """Bilinear values at the texel centres of another size."""
    v = (torch.arange(height).to(texture) + 0.5) / height
    u = (torch.arange(width).to(texture) + 0.5) / width
    centres = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).view(-1, 2)
    return sample_texture(texture, centres).view(height, width, -1)


def _vertex_basecolor(
    material: SourceMaterial, colors: Float[Tensor, "N 3"], uv: Float[Tensor, "N 2"]
) -> Float[Tensor, "N 3"]:
    """Colours times factor, scaled for Mitsuba's base."""
    basecolor = (colors * colors.new_tensor(material.basecolor_factor)).clamp(0.0, 1.0)
    return basecolor * sample_texture(_base_scale(_roughness_metallic(material)), uv)


def _base_scale(surface: Float[Tensor, "H W 2"]) -> Float[Tensor, "H W 1"]:
    """Factor of the basecolor that gives Mitsuba's diffuse base the albedo of glTF's.

    One for metals, whose basecolor is their reflectance; in between by the share of the base.
    """
    roughness, metallic = torch.split(surface, 1, -1)
    position = roughness.clamp(0.0, 1.0) * (TABLE_SIZE - 1)
    below = position.floor().clamp_max(TABLE_SIZE - 2)
    table = _base_scale_table().to(surface)
    low, high = table[below.long()], table[below.long() + 1]
    scale = low + (position - below) * (high - low)
    return scale + metallic * (1.0 - scale)


@functools.cache
def _base_scale_table() -> Float[Tensor, "r"]:
    """What the lobe leaves of even light to glTF's base, over what Mitsuba's base reflects."""
    roughness = torch.linspace(0.0, 1.0, TABLE_SIZE)
    cosine = (torch.arange(ANGLES) + 0.5) / ANGLES
    grid = torch.cartesian_prod(roughness, cosine)
    scale, bias = integrate_split_sum(grid[:, 1:], grid[:, :1])
    reflected = 2.0 * grid[:, 1:] * (DIELECTRIC_F0 * scale + bias)
    left = 1.0 - reflected.view(TABLE_SIZE, ANGLES).mean(1)
    constant, linear, square = DISNEY_ALBEDO
    return left / (constant + roughness * (linear + roughness * square))


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
