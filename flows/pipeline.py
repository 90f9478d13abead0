"""The pipeline, declared once: its stages in order, what feeds what, what may be left out.

The plan, the flow and the command line all read this page. Nothing here imports a stage.
"""

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stages.base import Stage

SOURCE = "source"  # the input from outside: an orbit folder, a mesh or a scene file


@dataclass(frozen=True)
class Node:
    """One stage in the pipeline.

    Attributes:
        name: of the stage, its module, its settings and, in upper case, its `Stage`.
        inputs: names of upstream stages or `SOURCE`, in the order of the stage's signature.
        is_skippable: whether later stages can do without it.
        package: where the module lies.
    """

    name: str
    inputs: tuple[str, ...]
    is_skippable: bool = False
    package: str = "stages"

    @property
    def module(self) -> str:
        """Full name of the stage's module."""
        return f"{self.package}.{self.name}"

    def load(self) -> "Stage":
        """Import the stage, and with it whatever it computes with."""
        stage: Stage = getattr(importlib.import_module(self.module), self.name.upper())
        return stage


@dataclass(frozen=True)
class Product:
    """A file, or a folder of files, that the user came for.

    Attributes:
        name: in the run folder.
        origins: stage and file name in its payload, the best first.
    """

    name: str
    origins: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Pipeline:
    """Stages in an order in which every input comes before its user, and the products."""

    name: str
    nodes: tuple[Node, ...]
    products: tuple[Product, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Stage names in order."""
        return tuple(node.name for node in self.nodes)

    @property
    def skippable(self) -> tuple[str, ...]:
        """Names of the stages that may be left out."""
        return tuple(node.name for node in self.nodes if node.is_skippable)


IMAGE_TO_ASSET = Pipeline(
    name="image-to-asset",
    nodes=(
        Node("generation", (SOURCE,)),
        Node("env_preopt", ("generation",), is_skippable=True),
        Node("nerf", ("generation", "env_preopt")),
        Node("dmtet", ("generation", "nerf"), is_skippable=True),
        Node("uv_bake", ("generation", "nerf", "dmtet"), is_skippable=True),
        Node("export", ("nerf", "dmtet", "uv_bake")),
        Node("preview", ("generation", "nerf", "export"), is_skippable=True),
    ),
    products=(
        Product("asset.glb", (("export", "asset.glb"),)),
        Product(
            "environment.exr", (("export", "environment.exr"), ("env_preopt", "environment.exr"))
        ),
        Product("preview.png", (("preview", "preview.png"),)),
    ),
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
