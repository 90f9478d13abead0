"""The asset in the formats that are wanted beside GLB, each read again and compared."""

from dataclasses import fields
from typing import Any

from stages.artifacts import TexturedMesh
from stages.base import Context
from stages.errors import InputError
from stages.export_checks import check_quantised, check_usdz
from stages.settings.export import ExportConfig
from svim3d.io.glb_small import small_glb_bytes
from svim3d.io.obj import obj_files
from svim3d.io.texture_files import texture_files
from svim3d.io.usd import usd_files, usdz_bytes

NAME = "asset"
SMALL = f"{NAME}_small.glb"
PER_VERTEX = 2  # dimensions of a material's values


def writers_parts(mesh: TexturedMesh) -> dict[str, Any]:
    """What the writers of GLB and OBJ ask for."""
    return {field.name: getattr(mesh, field.name) for field in fields(mesh)} | {"name": NAME}


def other_files(mesh: TexturedMesh, config: ExportConfig, ctx: Context) -> dict[str, bytes]:
    """Files by name.

    Raises:
        InputError: a library that a format needs is missing.
        RuntimeError: a file does not read back as what was written.
    """
    files: dict[str, bytes] = {}
    try:
        if "obj" in config.formats:
            parts = writers_parts(mesh)
            del parts["tangents"]
            files |= obj_files(**parts)
        if "textures" in config.formats:
            files |= texture_files(mesh)
            if mesh.basecolor.ndim == PER_VERTEX:
                ctx.event("no_textures", "vertices carry the colour: there is no texture to write")
        if "usdc" in config.formats:
            files |= usd_files(mesh, name=NAME)
        if "usdz" in config.formats:
            files[f"{NAME}.usdz"] = usdz_bytes(mesh, name=NAME)
            check_usdz(files[f"{NAME}.usdz"], mesh)
        if config.compression != "none":
            files[SMALL] = small_glb_bytes(mesh, config.compression, name=NAME)
    except ValueError as error:
        raise InputError(str(error)) from error
    if config.compression == "quantised":
        check_quantised(files[SMALL], mesh)
    return files
