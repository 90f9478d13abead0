"""Settings of the export stage."""

import importlib.util
from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from stages.settings.base import StageConfig


class ExportConfig(StageConfig):
    """The finished files."""

    formats: tuple[Literal["glb", "obj", "usdc", "usdz", "textures", "aov"], ...] = ("glb",)
    """What is written: `glb` always (glTF 2.0); `obj` with MTL, which has no occlusion; `usdc` with
    its pictures in `textures/` for pipelines; `usdz`, the same in one package for AR viewers (both
    need `svim3d[usd]`); `textures`, the maps alone; `aov`, the asset in the cameras of the views,
    one multi-layer EXR each. Source: OpenUSD UsdPreviewSurface 2.6; OpenEXR standard attributes."""

    compression: Literal["none", "quantised", "draco"] = "none"
    """Of a second, smaller `asset_small.glb`, with JPEG pictures: `quantised` (16-bit vertices,
    KHR_mesh_quantization, which nearly all loaders know) or `draco` (a ninth of the vertices'
    bytes, KHR_draco_mesh_compression, needs `svim3d[draco]` and a decoder beside the loader).
    Source: docs/exports.md, where bytes and losses are measured."""

    vertex_color_faces: int = Field(
        default=100_000,
        ge=100,
        le=2_000_000,
        description="decimate to this when phase 3 was skipped and vertices carry the colour",
    )

    lods: int = Field(
        default=0,
        ge=0,
        le=3,
        description="coarser levels of detail at most, written beside it as asset_lod1.glb, ...",
    )

    @field_validator("formats")
    @classmethod
    def _has_glb(cls, formats: tuple[str, ...]) -> tuple[str, ...]:
        """The GLB is what a run is for; without it nothing could be checked."""
        if "glb" not in formats:
            raise ValueError('formats must contain "glb"')
        return formats

    @model_validator(mode="after")
    def _has_libraries(self) -> Self:
        """Missing libraries are told before hours are spent on what they should write."""
        wants_usd = bool({"usdc", "usdz"} & set(self.formats))
        for extra, module, is_wanted in (
            ("usd", "pxr", wants_usd),
            ("draco", "DracoPy", self.compression == "draco"),
        ):
            if is_wanted and importlib.util.find_spec(module) is None:
                raise ValueError(
                    f"needs a library that is not installed; pip install 'svim3d[{extra}]'"
                )
        return self
