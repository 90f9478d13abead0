"""The USD door: the asset as USDC with its pictures beside it, or as one USDZ.

The material is a UsdPreviewSurface, which every USD renderer and AR viewer knows. The package is
zipped here and not by USD, whose archive carries the clock: only so do equal assets give equal
bytes.

Source: OpenUSD, "UsdPreviewSurface Specification" 2.6 and "Usdz File Format Specification" 1.3.
"""

import io
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.color import linear_from_srgb
from svim3d.io.image import decode_image
from svim3d.io.texture_files import FOLDER, full_orm, texture_files
from svim3d.mesh.painted_mesh import PaintedMesh

MISSING = "USD files need usd-core, which is not installed; pip install 'svim3d[usd]'"
METERS_PER_UNIT = 1.0  # as glTF has it: the longest side of an asset is one metre
ORM_CHANNELS = (("occlusion", "r"), ("roughness", "g"), ("metallic", "b"))
ZIP_ALIGNMENT = 64  # bytes: the files of a package are mapped into memory as they lie
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date that a zip can tell
LOCAL_HEADER = 30  # bytes of a zip entry before its name
EXTRA_HEADER, EXTRA_ID = 4, 0x1986  # of the field that pads, as USD's own writer has it
PER_VERTEX, TEXTURE = 2, 3  # dimensions of a material's values


def usd_files(mesh: PaintedMesh, *, name: str = "asset") -> dict[str, bytes]:
    """`NAME.usdc` and the pictures it refers to in `textures/`; equal input gives equal bytes.

    Maps of one value become inputs of the surface. What is coloured per vertex carries displayColor
    and, since many viewers read no other values per vertex, the mean roughness and metallic.

    Args:
        mesh: v is turned upwards, as USD has it.
        name: of the root prim and the file.

    Raises:
        ValueError: usd-core is not installed.
    """
    with tempfile.TemporaryDirectory(prefix="svim3d_usd_") as folder:  # USD writes files only
        file = Path(folder) / f"{name}.usdc"
        _write_stage(file, mesh, name)
        return {file.name: file.read_bytes()} | _pictures(mesh)


def usdz_bytes(mesh: PaintedMesh, *, name: str = "asset") -> bytes:
    """All of `usd_files` as one package; equal input gives equal bytes.

    Raises:
        ValueError: usd-core is not installed.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as package:
        for file, content in usd_files(mesh, name=name).items():  # the stage comes first
            entry = zipfile.ZipInfo(file, ZIP_EPOCH)
            start = buffer.tell() + LOCAL_HEADER + len(file.encode()) + EXTRA_HEADER
            padding = -start % ZIP_ALIGNMENT
            header = EXTRA_ID.to_bytes(2, "little") + padding.to_bytes(2, "little")
            entry.extra = header + bytes(padding)
            package.writestr(entry, content)
    return buffer.getvalue()


def _pictures(mesh: PaintedMesh) -> dict[str, bytes]:
    """Those of the asset's pictures that the material reads."""
    read = {"basecolor": mesh.basecolor.ndim == TEXTURE, "normal": True}
    read["orm"] = any(plane.ndim for plane in _orm(mesh).values())
    return {
        file: content
        for file, content in texture_files(mesh).items()
        if read.get(Path(file).stem, False)
    }


def _orm(mesh: PaintedMesh) -> dict[str, Tensor]:
    """Occlusion, roughness and metallic: a texture where it varies, else its one value."""
    return {
        name: plane if plane.ndim == 2 and bool((plane != plane[0, 0]).any()) else plane.mean()
        for (name, _), plane in zip(ORM_CHANNELS, full_orm(mesh).unbind(-1), strict=True)
    }


def _write_stage(file: Path, mesh: PaintedMesh, name: str) -> None:
    """The stage: a component with one mesh and one material."""
    try:
        from pxr import Kind, Sdf, Usd, UsdGeom, UsdShade
    except ImportError as error:
        raise ValueError(MISSING) from error
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, METERS_PER_UNIT)
    root = UsdGeom.Xform.Define(stage, f"/{name}")
    Usd.ModelAPI(root.GetPrim()).SetKind(Kind.Tokens.component)
    stage.SetDefaultPrim(root.GetPrim())
    shape = UsdGeom.Mesh.Define(stage, f"/{name}/mesh")
    _fill_mesh(shape, mesh)
    UsdGeom.Scope.Define(stage, f"/{name}/materials")
    material = UsdShade.Material.Define(stage, f"/{name}/materials/surface")
    _Surface(stage, material, Sdf, UsdShade).connect(mesh)
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()


def _fill_mesh(shape: Any, mesh: PaintedMesh) -> None:
    """Triangles, normals, texture coordinates, colours; no subdivision."""
    from pxr import Sdf, UsdGeom, Vt

    points = _array(mesh.vertices)
    faces = np.ascontiguousarray(mesh.faces.detach().cpu().numpy().reshape(-1), np.int32)
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces))
    counts = np.full(len(faces) // 3, 3, np.int32)
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(_array(mesh.normals)))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    variables = UsdGeom.PrimvarsAPI(shape)
    if mesh.uv is not None:
        upright = _array(_turned(mesh.uv))
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        st = variables.CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
        st.Set(Vt.Vec2fArray.FromNumpy(upright))
    if mesh.basecolor.ndim != TEXTURE:  # also what viewers show that know no materials
        is_painted = mesh.basecolor.ndim == PER_VERTEX
        shape.CreateDisplayColorPrimvar(
            UsdGeom.Tokens.vertex if is_painted else UsdGeom.Tokens.constant
        ).Set(Vt.Vec3fArray.FromNumpy(_array(mesh.basecolor.clamp(0.0, 1.0).view(-1, 3))))


@dataclass
class _Surface:
    """Builds the network of one material."""

    stage: Any
    material: Any
    sdf: Any
    shade: Any

    def connect(self, mesh: PaintedMesh) -> None:
        """A UsdPreviewSurface with its inputs set or connected to pictures."""
        types = self.sdf.ValueTypeNames
        surface = self._shader("preview", "UsdPreviewSurface")
        output = surface.CreateOutput("surface", types.Token)
        self.material.CreateSurfaceOutput().ConnectToSource(output)
        surface.CreateInput("useSpecularWorkflow", types.Int).Set(0)
        colour = surface.CreateInput("diffuseColor", types.Color3f)
        if mesh.basecolor.ndim == TEXTURE:
            colour.ConnectToSource(self._texture("basecolor", "sRGB", "rgb"))
        elif mesh.basecolor.ndim == PER_VERTEX:
            reader = self._shader("vertex_colour", "UsdPrimvarReader_float3")
            reader.CreateInput("varname", types.String).Set("displayColor")
            colour.ConnectToSource(reader.CreateOutput("result", types.Float3))
        else:
            colour.Set(tuple(mesh.basecolor.clamp(0.0, 1.0).tolist()))
        orm = _orm(mesh)
        for name, channel in ORM_CHANNELS:
            given = surface.CreateInput(name, types.Float)
            if orm[name].ndim:
                given.ConnectToSource(self._texture("orm", "raw", channel))
            else:
                given.Set(float(orm[name].clamp(0.0, 1.0)))
        if mesh.normal_tangent is not None:
            normal = surface.CreateInput("normal", types.Normal3f)
            normal.ConnectToSource(self._texture("normal", "raw", "rgb"))

    def _shader(self, name: str, kind: str) -> Any:
        """A node, made where it is not there yet."""
        path = f"{self.material.GetPath()}/{name}"
        shader = self.shade.Shader.Define(self.stage, path)
        shader.CreateIdAttr(kind)
        return shader

    def _texture(self, name: str, space: str, channel: str) -> Any:
        """An output of a picture: all three channels or one of them."""
        types = self.sdf.ValueTypeNames
        reader = self._shader("st", "UsdPrimvarReader_float2")
        reader.CreateInput("varname", types.String).Set("st")
        texture = self._shader(name, "UsdUVTexture")
        texture.CreateInput("file", types.Asset).Set(f"{FOLDER}/{name}.png")
        texture.CreateInput("sourceColorSpace", types.Token).Set(space)
        texture.CreateInput("st", types.Float2).ConnectToSource(
            reader.CreateOutput("result", types.Float2)
        )
        for wrap in ("wrapS", "wrapT"):
            texture.CreateInput(wrap, types.Token).Set("clamp")
        if name == "normal":  # 8 bits hold [0, 1], normals lie in [-1, 1]
            texture.CreateInput("scale", types.Float4).Set((2.0, 2.0, 2.0, 1.0))
            texture.CreateInput("bias", types.Float4).Set((-1.0, -1.0, -1.0, 0.0))
        kind = types.Float3 if channel == "rgb" else types.Float
        return texture.CreateOutput(channel, kind)


@dataclass(frozen=True)
class ReopenedUsd:
    """What USD's own reader makes of a package, in the terms of `PaintedMesh`.

    Attributes:
        vertices: positions, transforms applied.
        faces: vertex indices.
        normals: per vertex.
        uv: glTF texture coordinates, or None.
        basecolor: linear; texture, per vertex or one colour.
        occlusion: a texture [H, W, 1] or one value [], as roughness and metallic.
        roughness: perceptual.
        metallic: in [0, 1].
        normal_tangent: texture, or None.
    """

    vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    normals: Float[Tensor, "N 3"]
    uv: Float[Tensor, "N 2"] | None
    basecolor: Float[Tensor, "*texels 3"]
    occlusion: Float[Tensor, "*o"]
    roughness: Float[Tensor, "*r"]
    metallic: Float[Tensor, "*m"]
    normal_tangent: Float[Tensor, "M M 3"] | None


def reopen_usdz(content: bytes) -> ReopenedUsd:
    """Read a package of one mesh as a renderer would, to check what was written."""
    from pxr import Usd, UsdGeom, UsdShade

    with tempfile.TemporaryDirectory(prefix="svim3d_usd_") as folder:
        file = Path(folder) / "asset.usdz"
        file.write_bytes(content)
        stage = Usd.Stage.Open(str(file))
        (prim,) = (p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
        shape = UsdGeom.Mesh(prim)
        world = np.asarray(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0.0))
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        surface = material.ComputeSurfaceSource("")[0]
        planes = {
            name: _value(surface.GetInput(name), content)
            for name in ("diffuseColor", "occlusion", "roughness", "metallic", "normal")
        }
        colours = shape.GetDisplayColorAttr().Get()
        variables = UsdGeom.PrimvarsAPI(prim)
        st = variables.GetPrimvar("st").Get() if variables.HasPrimvar("st") else None
        points = np.asarray(shape.GetPointsAttr().Get(), np.float64) @ world[:3, :3] + world[3, :3]
        basecolor = planes["diffuseColor"]
        normal = planes["normal"]
        return ReopenedUsd(
            vertices=torch.from_numpy(points.astype(np.float32)),
            faces=torch.from_numpy(np.array(shape.GetFaceVertexIndicesAttr().Get())).view(-1, 3),
            normals=torch.from_numpy(np.array(shape.GetNormalsAttr().Get())),
            uv=None if st is None else _turned(torch.from_numpy(np.array(st, np.float32))),
            basecolor=torch.from_numpy(np.array(colours)) if basecolor is None else basecolor,
            occlusion=_known(planes["occlusion"]),
            roughness=_known(planes["roughness"]),
            metallic=_known(planes["metallic"]),
            normal_tangent=normal if normal is not None and normal.ndim == TEXTURE else None,
        )


def _known(plane: Tensor | None) -> Tensor:
    """A value that a well-formed surface has."""
    if plane is None:
        raise ValueError("an input of the surface is connected to no picture")
    return plane


def _value(given: Any, content: bytes) -> Tensor | None:
    """Constant or picture of an input; None where it reads a value per vertex, or nothing."""
    if not given:
        return None
    sources = given.GetConnectedSources()[0]
    if not sources:
        return torch.tensor(given.Get(), dtype=torch.float32)
    node = sources[0].source.GetPrim()
    inputs = {
        a.GetName().removeprefix("inputs:"): a.Get()
        for a in node.GetAttributes()
        if a.GetName().startswith("inputs:")
    }
    if "file" not in inputs:
        return None
    inside = inputs["file"].resolvedPath.partition("[")[2].rstrip("]")
    with zipfile.ZipFile(io.BytesIO(content)) as package:
        picture = decode_image(package.read(inside))
    if inputs["sourceColorSpace"] == "sRGB":
        picture = linear_from_srgb(picture)
    scale, bias = (inputs.get(n, d) for n, d in (("scale", [1.0] * 4), ("bias", [0.0] * 4)))
    width = picture.shape[-1]
    picture = picture * torch.tensor(scale)[:width] + torch.tensor(bias)[:width]
    channel = sources[0].sourceName
    return picture if channel == "rgb" else picture[..., "rgba".index(channel), None]


def _turned(uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 2"]:
    """Texture coordinates with their origin at the other end of v."""
    return torch.stack([uv[:, 0], 1.0 - uv[:, 1]], 1)


def _array(values: Tensor) -> Any:
    return np.ascontiguousarray(values.detach().cpu().numpy(), np.float32)
