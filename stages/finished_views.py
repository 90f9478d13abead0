"""The finished asset as the given cameras see it: layers for compositing, and an orbit again.

What is shown went through the GLB, as in the preview. Light is the asset's own, without shadows or
interreflection.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from stages.artifacts import MaterialViews
from stages.base import Context
from stages.prefilter_cache import cached_operator
from svim3d.cameras import Cameras
from svim3d.io.glb import read_mesh
from svim3d.io.orbit import read_cameras, read_orbit
from svim3d.render.deferred import environment_shader
from svim3d.render.pictures import render_pictures

FOLDER = "aov"
SUPERSAMPLE = 3  # per pixel and axis, as the preview has it by default


@dataclass(frozen=True)
class ViewFolder:
    """Views that are left on disk until something of them is asked for."""

    folder: Path

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Nothing is read yet."""
        return cls(folder)

    def cameras(self) -> tuple[Cameras, int]:
        """Poses, and the index of the reference."""
        return read_cameras(self.folder)

    def confidence(self) -> Float[Tensor, "V H W 1"] | None:
        """How far each pixel was trusted, where that is known."""
        _, images, _ = read_orbit(self.folder, wanted=("mask",))
        return images.get("confidence")


def finished_views(
    glb: bytes, views: ViewFolder, light: Float[Tensor, "N N 3"], ctx: Context
) -> dict[str, bytes]:
    """`aov/`: an orbit folder of the asset, one multi-layer EXR per given view.

    Each holds premultiplied radiance with coverage, and straight basecolor, roughness, metallic,
    world normal and depth; the confidence of the given view where there is one.

    Args:
        glb: the finished file.
        views: what it was made from.
        light: octahedral radiance.
        ctx: where to work.
    """
    file = ctx.work / "asset.glb"
    file.write_bytes(glb)
    mesh = read_mesh(file)
    cameras, reference = views.cameras()
    shader = environment_shader(cached_operator(ctx.shared, light.shape[0])(light))
    shown = []
    for view in range(len(cameras)):
        shown.append(render_pictures(mesh, cameras[[view]], shader, supersample=SUPERSAMPLE))
        ctx.report(view + 1, len(cameras), {"coverage": float(shown[-1]["mask"].mean())})
    images = {name: torch.cat([view[name] for view in shown]) for name in shown[0]}
    seen = MaterialViews(
        cameras=cameras, reference=reference, confidence=views.confidence(), **images
    )
    folder = ctx.work / FOLDER
    folder.mkdir(exist_ok=True)
    seen.save(folder)
    return {f"{FOLDER}/{made.name}": made.read_bytes() for made in sorted(folder.iterdir())}
