"""Bare triangles in mesh files: the true surfaces of benchmark sets."""

from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor


def read_triangles(file: Path) -> tuple[Float[Tensor, "N 3"], Int[Tensor, "F 3"]]:
    """Vertices and faces of any mesh file, all parts together, as they are written.

    Raises:
        ValueError: there is no such file, or no triangle in it.
    """
    if not file.is_file():
        raise ValueError(f"wanted a mesh, but {file} does not exist; check the path")
    loaded = trimesh.load(file, process=False, force="mesh")
    if not len(getattr(loaded, "faces", ())):
        raise ValueError(f"wanted triangles in {file}, but it holds none")
    return (
        torch.from_numpy(np.array(loaded.vertices, np.float32)),
        torch.from_numpy(np.array(loaded.faces, np.int32)),
    )


def write_triangles(file: Path, vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]) -> None:
    """Write a mesh of bare triangles; the file's ending names the format, like .ply."""
    trimesh.Trimesh(vertices.cpu().numpy(), faces.cpu().numpy(), process=False).export(file)
