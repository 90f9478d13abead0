"""The pipeline, declared once: its stages in order, what feeds what, what may be left out.

The plan, the flow and the command line all read this page. Nothing here imports a stage.
"""

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stages.errors import InputError

if TYPE_CHECKING:
    from stages.base import Stage

SOURCE = "source"  # the input from outside: a photo, an orbit folder, a mesh or a scene file
PHOTOS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".gif")
REPORT = "report.html"  # the product that tells of the run
MESHES = (".glb", ".gltf", ".obj", ".json")  # scenes among them


@dataclass(frozen=True)
class Node:
    """One stage in the pipeline.

    Attributes:
        name: of the stage, its module, its settings and, in upper case, its `Stage`.
        inputs: names of upstream stages or `SOURCE`, in the order of the stage's signature.
        is_skippable: whether later stages can do without it.
        only_for: suffixes of the input files that the stage has work for; empty means any input.
        package: where the module lies.
    """

    name: str
    inputs: tuple[str, ...]
    is_skippable: bool = False
    only_for: tuple[str, ...] = ()
    package: str = "stages"

    @property
    def module(self) -> str:
        """Full name of the stage's module."""
        return f"{self.package}.{self.name}"

    def has_work_for(self, source: Path) -> bool:
        """Whether the stage does anything for this input."""
        return not self.only_for or (_suffix(source) in self.only_for and not source.is_dir())

    def load(self) -> "Stage":
        """Import the stage, and with it whatever it computes with."""
        stage: Stage = getattr(importlib.import_module(self.module), self.name.upper())
        return stage


def _suffix(source: Path) -> str:
    return source.suffix.lower()


@dataclass(frozen=True)
class Product:
    """A file, or a folder of files, that the user came for.

    Attributes:
        name: in the run folder.
        origins: stage and file name in its payload, the best first; none for the report, which
            is written of the run as a whole.
    """

    name: str
    origins: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Pipeline:
    """Stages in an order in which every input comes before its user, and the products.

    Attributes:
        name: of the flow.
        nodes: the stages.
        products: what the run folder is for.
        takes: suffixes of the input files that can be used; empty leaves it to the stages.
    """

    name: str
    nodes: tuple[Node, ...]
    products: tuple[Product, ...]
    takes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Stage names in order."""
        return tuple(node.name for node in self.nodes)

    @property
    def results(self) -> tuple[Product, ...]:
        """Products that stages make, the best first."""
        return tuple(product for product in self.products if product.origins)

    @property
    def has_report(self) -> bool:
        """Whether a page tells of each run."""
        return any(product.name == REPORT for product in self.products)

    @property
    def skippable(self) -> tuple[str, ...]:
        """Names of the stages that may be left out."""
        return tuple(node.name for node in self.nodes if node.is_skippable)

    def check(self, source: Path) -> None:
        """Refuse a file of a kind that no stage can use.

        Raises:
            InputError: naming the kinds that can be.
        """
        if self.takes and source.is_file() and _suffix(source) not in self.takes:
            raise InputError(
                f"wanted a photo, a mesh or a scene ({', '.join(self.takes)}) or an orbit folder, "
                f"got {source.name}; convert it, or correct its ending"
            )


# What the export stage writes on request.
EXPORTED = (
    *("asset_lod1.glb", "asset_lod2.glb", "asset_lod3.glb", "asset_small.glb"),
    *("asset.usdz", "asset.usdc", "textures", "aov", "asset.obj", "asset.mtl"),
    *(f"asset_{channel}.png" for channel in ("basecolor", "roughness", "metallic", "normal")),
)

IMAGE_TO_ASSET = Pipeline(
    name="image-to-asset",
    nodes=(
        Node("prepare", (SOURCE,), only_for=PHOTOS),
        Node("generation", (SOURCE, "prepare")),
        Node("capacity", ("generation",), is_skippable=True),
        Node("env_preopt", ("generation", "capacity"), is_skippable=True),
        Node("nerf", ("generation", "env_preopt", "capacity")),
        Node("dmtet", ("generation", "nerf", "capacity"), is_skippable=True),
        Node("uv_bake", ("generation", "nerf", "dmtet", "capacity"), is_skippable=True),
        Node("export", ("nerf", "dmtet", "uv_bake", "generation")),
        Node("preview", ("generation", "nerf", "export"), is_skippable=True),
    ),
    products=(
        Product("asset.glb", (("export", "asset.glb"),)),
        Product(
            "environment.exr", (("export", "environment.exr"), ("env_preopt", "environment.exr"))
        ),
        Product("preview.png", (("preview", "preview.png"),)),
        Product("views.png", (("generation", "views.png"),)),
        *(Product(name, (("export", name),)) for name in EXPORTED),
        Product(REPORT, ()),
    ),
    takes=(*PHOTOS, *MESHES),
)

RELIGHT = Pipeline(
    name="relight",
    nodes=(Node("relight", (SOURCE,)),),
    products=tuple(
        Product(name, (("relight", name),))
        for name in (
            "views",
            "contact_sheet.png",
            "turntable.gif",
            "turntable.mp4",
            "turntable",
            "edits.json",
            "mask.png",
        )
    ),
)
