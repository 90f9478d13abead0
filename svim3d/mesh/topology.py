"""What a closed or open surface is, counted: parts, handles, cavities, open edges."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from svim3d.mesh.mesh import face_adjacency


@dataclass(frozen=True)
class Topology:
    """Counts of a surface whose vertices have been welded.

    Attributes:
        euler: V - E + F; 2 for each part without handles.
        parts: sets of faces that hang together through vertices.
        cavities: closed parts that enclose a negative volume: shells that face inward.
        open_edges: edges of one face alone, or of more than two.
    """

    euler: int
    parts: int
    cavities: int
    open_edges: int

    @property
    def is_closed(self) -> bool:
        """Whether every edge joins two faces."""
        return self.open_edges == 0

    @classmethod
    def of(cls, vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]) -> Self:
        """Count; vertices of equal position are one, such as those that a texture seam splits."""
        if not len(faces):
            return cls(0, 0, 0, 0)
        used, index = torch.unique(vertices.detach().cpu(), dim=0, return_inverse=True)
        faces = index[faces.cpu().long()]
        differ = (faces != faces.roll(1, 1)).all(1)
        faces = faces[differ]
        corners = torch.unique(faces)
        edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
        _, counts = torch.unique(edges, dim=0, return_counts=True)
        part = _parts(faces)
        return cls(
            euler=len(corners) - len(counts) + len(faces),
            parts=int(part.max()) + 1,
            cavities=_cavities(used[faces].double(), part, faces),
            open_edges=int((counts != 2).sum()),
        )


def _parts(faces: Int[Tensor, "F 3"]) -> Int[Tensor, "F"]:
    """Number the sets of faces that share vertices."""
    count = int(faces.max()) + 1
    a, b, c = faces.numpy().T
    links = coo_array(
        (np.ones(2 * len(a), bool), (np.concatenate([a, b]), np.concatenate([b, c]))),
        shape=(count, count),
    )
    labels = connected_components(links, directed=False)[1][a]
    return torch.unique(torch.from_numpy(labels), return_inverse=True)[1]


def _cavities(
    corners: Float[Tensor, "F 3 3"], part: Int[Tensor, "F"], faces: Int[Tensor, "F 3"]
) -> int:
    """Closed parts whose faces look inward."""
    volume = torch.linalg.det(corners) / 6.0
    count = int(part.max()) + 1
    of_part = torch.zeros(count, dtype=torch.float64).index_add_(0, part, volume)
    is_open = (face_adjacency(faces.int()) < 0).any(1)
    opened = torch.zeros(count).index_add_(0, part, is_open.float())
    return int(((of_part < 0.0) & (opened == 0.0)).sum())
