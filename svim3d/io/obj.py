"""Wavefront OBJ with MTL materials, including the PBR keys (Pr, Pm, map_Pr, map_Pm, norm)."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.io.image import decode_image, encode_png, encode_small_png
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh, complete, merge
from svim3d.numerics import normalize

DEFAULT_ROUGHNESS = 0.5  # of a material that gives neither Pr nor Ns
DEFAULT_COLOR = (0.8, 0.8, 0.8)  # of a material without Kd


def read_obj(file: Path) -> SourceMesh:
    """Read every face of an OBJ file and the MTL file it names.

    `Kd` is taken as linear and colour maps as sRGB, as Blender writes them.

    Raises:
        ValueError: the file is damaged or holds no triangles.
    """
    try:
        with file.open() as text:
            loaded = trimesh.exchange.obj.load_obj(
                text, resolver=trimesh.resolvers.FilePathResolver(file)
            )
    except Exception as error:
        raise ValueError(f"{file.name} cannot be read as OBJ: {error}") from error
    geometry = [part for part in loaded.get("geometry", {}).values() if len(part["faces"])]
    if not geometry:
        raise ValueError(f"{file.name} holds no triangles")
    libraries = _libraries(file)
    materials = tuple(
        _material(libraries.get(_material_name(part), {}), file.parent) for part in geometry
    )
    return merge([_part(part, index, materials) for index, part in enumerate(geometry)])


def _part(part: dict[str, Any], index: int, materials: tuple[SourceMaterial, ...]) -> SourceMesh:
    """The faces of one material."""
    uv = getattr(part.get("visual"), "uv", None)
    normals = part.get("vertex_normals")
    colors = part.get("vertex_colors")
    faces = np.asarray(part["faces"])
    if faces.min() < 0 or faces.max() >= len(part["vertices"]):
        raise ValueError("a face refers to a vertex that does not exist")
    return complete(
        _tensor(part["vertices"]),
        torch.from_numpy(faces.astype(np.int32)),
        material=index,
        materials=materials,
        normals=None if normals is None else normalize(_tensor(normals)),
        uv=None if uv is None else _tensor(uv) * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1]),
        colors=None if colors is None else linear_from_srgb(_tensor(colors)[:, :3] / 255.0),
    )


def _material_name(part: dict[str, Any]) -> str:
    """Name after `usemtl`; empty where there is none."""
    return str(getattr(getattr(part.get("visual"), "material", None), "name", "") or "")


def _libraries(file: Path) -> dict[str, dict[str, str]]:
    """Lower-case keys and raw values of every material in the MTL files that exist."""
    found: dict[str, dict[str, str]] = {}
    for line in file.read_text(errors="replace").splitlines():
        key, _, name = line.strip().partition(" ")
        library = file.parent / name.strip()
        if key != "mtllib" or not library.is_file():
            continue
        current: dict[str, str] = {}
        for entry in library.read_text(errors="replace").splitlines():
            key, _, value = entry.strip().partition(" ")
            if key.lower() == "newmtl":
                current = found.setdefault(value.strip(), {})
            elif key and not key.startswith("#"):
                current[key.lower()] = value.strip()
    return found


def _material(keys: dict[str, str], folder: Path) -> SourceMaterial:
    """A material from its MTL entries."""

    def texture(key: str, *, srgb: bool = False) -> Tensor | None:
        if key not in keys:
            return None
        # Options come before the name; separators may be those of another system.
        picture = folder / keys[key].split()[-1].replace("\\", "/")
        if not picture.is_file():
            raise ValueError(f"texture {picture.name} named by the MTL file is missing")
        image = decode_image(picture.read_bytes(), srgb=srgb)
        if image.shape[-1] < 3:  # grey, perhaps with opacity
            return image[..., :1].expand(*image.shape[:2], 3)
        return image[..., :3]

    basecolor = texture("map_kd", srgb=True)
    roughness, metallic = texture("map_pr"), texture("map_pm")
    # Blinn-Phong exponent to GGX: alpha^2 = 2 / (exponent + 2). Source: Walter et al. 2007.
    shiny = "ns" in keys
    fallback = (2.0 / (float(keys["ns"]) + 2.0)) ** 0.25 if shiny else DEFAULT_ROUGHNESS
    color = [float(c) for c in keys["kd"].split()] if "kd" in keys else DEFAULT_COLOR
    normal = texture("norm")
    return SourceMaterial(
        basecolor_factor=(1.0, 1.0, 1.0)
        if basecolor is not None
        else (color[0], color[1], color[2]),
        roughness_factor=1.0 if roughness is not None else float(keys.get("pr", fallback)),
        metallic_factor=1.0 if metallic is not None else float(keys.get("pm", 0.0)),
        basecolor=basecolor,
        roughness_metallic=_paired(roughness, metallic),
        normal_tangent=None if normal is None else normalize(normal * 2.0 - 1.0),
    )


def _paired(roughness: Tensor | None, metallic: Tensor | None) -> Float[Tensor, "H W 2"] | None:
    """Roughness and metallic maps as one texture, of the size of the first; a missing one is 1."""
    given = [m[..., 0] for m in (roughness, metallic) if m is not None]
    if not given:
        return None
    planes = [torch.ones_like(given[0]) if m is None else m[..., 0] for m in (roughness, metallic)]
    if planes[0].shape != planes[1].shape:
        raise ValueError(
            f"map_Pr is {list(planes[0].shape)} and map_Pm {list(planes[1].shape)} pixels; "
            "make them equal in size"
        )
    return torch.stack(planes, -1)


def obj_files(
    *,
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    normals: Float[Tensor, "N 3"],
    basecolor: Float[Tensor, "*texels 3"],
    orm: Float[Tensor, "*orm_texels 3"],
    uv: Float[Tensor, "N 2"] | None = None,
    normal_tangent: Float[Tensor, "M M 3"] | None = None,
    orm_factor: Float[Tensor, "3"] | None = None,
    name: str = "asset",
) -> dict[str, bytes]:
    """OBJ, MTL and PNG files by name; equal input gives equal bytes.

    Arguments as for `svim3d.io.glb.glb_bytes`; colours per vertex go behind the positions (sRGB, as
    MeshLab reads them) and the material takes the mean roughness and metallic. A map's channel that
    is one throughout is left to its factor. MTL has no occlusion.
    """
    numbers = vertices.detach().cpu().double()
    if basecolor.ndim == 2:
        numbers = torch.cat([numbers, srgb_from_linear(basecolor).cpu().double()], 1)
    lines = [f"mtllib {name}.mtl", f"o {name}"]
    lines += _rows("v", numbers)
    if uv is not None:
        lines += _rows("vt", uv.cpu().double() * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1]))
    lines += _rows("vn", normals.cpu().double())
    lines.append(f"usemtl {name}")
    pattern = "{0}/{0}/{0}" if uv is not None else "{0}//{0}"
    for face in (faces.cpu().long() + 1).tolist():
        lines.append("f " + " ".join(pattern.format(index) for index in face))

    material = [f"newmtl {name}", "illum 2", "Ks 0 0 0"]
    files: dict[str, bytes] = {}
    encode = encode_png if orm_factor is None else encode_small_png
    factor = torch.ones(3) if orm_factor is None else orm_factor
    colour = basecolor if basecolor.ndim == 1 else torch.ones(3)
    material.append("Kd " + " ".join(f"{value:.6g}" for value in colour.tolist()))
    if basecolor.ndim == 3:
        files[f"{name}_basecolor.png"] = encode(basecolor, srgb=True)
        material.append(f"map_Kd {name}_basecolor.png")
    for place, key, channel in ((1, "Pr", "roughness"), (2, "Pm", "metallic")):
        plane = orm[..., place : place + 1]
        if orm.ndim == 3 and (orm_factor is None or bool((plane < 1.0).any())):
            files[f"{name}_{channel}.png"] = encode(plane)
            material.append(f"map_{key} {name}_{channel}.png")
        else:
            value = float(factor[place] * plane.mean())
            material.append(f"{key} {min(max(value, 0.0), 1.0):.6f}")
    if normal_tangent is not None:
        files[f"{name}_normal.png"] = encode(normal_tangent * 0.5 + 0.5)
        material.append(f"norm {name}_normal.png")
    text = {f"{name}.obj": lines, f"{name}.mtl": material}
    return {file: ("\n".join(rows) + "\n").encode() for file, rows in text.items()} | files


def _rows(key: str, values: Tensor) -> list[str]:
    """One line per row."""
    return [key + "".join(f" {value:.7g}" for value in row) for row in values.tolist()]


def _tensor(values: Any) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
