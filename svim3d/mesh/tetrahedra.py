"""Body-centred cubic lattices of tetrahedra, restricted to where a surface runs.

The nodes are the corners and the centres of cubic cells. Two face-sharing cells span an octahedron
over their common face, cut into four congruent tetrahedra along the line between the two centres:
nearly regular, and with a third of the triangles of a cubic split at equal edge length.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

TETRAHEDRA_PER_NODE = 24  # around a node that is not at the border of the lattice
EDGE_ENDS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # corner pairs of a tetrahedron


@dataclass(frozen=True)
class TetrahedralLattice:
    """Tetrahedra with their edge table: what marching needs, computed once.

    Attributes:
        nodes: positions.
        tetrahedra: four nodes each, positively oriented.
        edges: two nodes each, the lower index first; every edge once.
        tetrahedron_edges: the edges of each tetrahedron in the order of `EDGE_ENDS`.
        source: place of each node's value in the flat arrays of corners and centres, joined.
        fixed: nodes at the lattice's border. While they keep their sign, the surface is closed.
        spacing: side of a cell.
    """

    nodes: Float[Tensor, "N 3"]
    tetrahedra: Int[Tensor, "T 4"]
    edges: Int[Tensor, "E 2"]
    tetrahedron_edges: Int[Tensor, "T 6"]
    source: Int[Tensor, "N"]
    fixed: Bool[Tensor, "N"]
    spacing: float


def cell_centres(corners: Float[Tensor, "m m m"]) -> Float[Tensor, "n n n"]:
    """Trilinear value at the centre of each cell: the mean of its eight corners."""
    mean = corners
    for axis in range(3):
        first, second = _shifted(mean, axis)
        mean = 0.5 * (first + second)
    return mean


def close_border(
    corners: Float[Tensor, "m m m"], centres: Float[Tensor, "n n n"], spacing: float
) -> tuple[Float[Tensor, "m m m"], Float[Tensor, "n n n"]]:
    """The same SDF with the outermost layer of corners and of centres outside the object."""
    closed = []
    for values in (corners, centres):
        outside = values.clamp_max(-0.5 * spacing)
        inner = (slice(1, -1),) * 3
        outside[inner] = values[inner]
        closed.append(outside)
    return closed[0], closed[1]


def lattice_around_surface(
    corners: Float[Tensor, "m m m"],
    centres: Float[Tensor, "n n n"],
    half_extent: float,
    *,
    reach: float = 0.0,
) -> TetrahedralLattice:
    """Tetrahedra of all octahedra that the zero set crosses or comes near to.

    Args:
        corners: SDF at the (n + 1)^3 cell corners of the cube, index order x, y, z; the outermost
            layer must be outside (see `close_border`), as must that of `centres`.
        centres: SDF at the n^3 cell centres.
        half_extent: half the side of the cube, world units.
        reach: how near to zero, in world units, the SDF of a node must be for its octahedra to be
            taken in too: room for the surface to move.
    """
    count = centres.shape[0]
    tetrahedra = torch.cat(
        [_octahedra(_near_surface(corners, centres, reach, axis), count, axis) for axis in range(3)]
    )
    source, tetrahedra = _compact(tetrahedra, corners.numel() + centres.numel())
    edges, tetrahedron_edges = _edge_table(tetrahedra, len(source))
    incident = torch.bincount(tetrahedra.reshape(-1), minlength=len(source))
    return TetrahedralLattice(
        nodes=_node_positions(source, count, half_extent).to(corners.dtype),
        tetrahedra=tetrahedra.int(),
        edges=edges.int(),
        tetrahedron_edges=tetrahedron_edges.int(),
        source=source,
        fixed=incident < TETRAHEDRA_PER_NODE,
        spacing=2.0 * half_extent / count,
    )


def node_values(
    lattice: TetrahedralLattice, corners: Float[Tensor, "m m m"], centres: Float[Tensor, "n n n"]
) -> Float[Tensor, "N"]:
    """Values at the lattice's nodes, taken from the dense arrays that it was built over."""
    return torch.cat([corners.reshape(-1), centres.reshape(-1)])[lattice.source]


def _near_surface(
    corners: Float[Tensor, "m m m"], centres: Float[Tensor, "n n n"], reach: float, axis: int
) -> Bool[Tensor, "..."]:
    """Octahedra along an axis whose six nodes differ in sign, or come within `reach` of zero."""
    ring = corners.narrow(axis, 1, centres.shape[0] - 1)
    low, high, small = ring, ring, ring.abs()
    for other in ((axis + 1) % 3, (axis + 2) % 3):
        low, high = torch.minimum(*_shifted(low, other)), torch.maximum(*_shifted(high, other))
        small = torch.minimum(*_shifted(small, other))
    first, second = _shifted(centres, axis)
    low = torch.minimum(low, torch.minimum(first, second))
    high = torch.maximum(high, torch.maximum(first, second))
    small = torch.minimum(small, torch.minimum(first.abs(), second.abs()))
    return ((low <= 0.0) & (high > 0.0)) | (small < reach)


def _shifted(values: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """All but the last and all but the first slice along an axis."""
    size = values.shape[axis]
    return values.narrow(axis, 0, size - 1), values.narrow(axis, 1, size - 1)


def _octahedra(near: Bool[Tensor, "..."], count: int, axis: int) -> Int[Tensor, "T 4"]:
    """Tetrahedra of the chosen octahedra over the cell faces normal to an axis; dense node ids."""
    cell = torch.nonzero(near)
    unit = torch.eye(3, dtype=torch.int64, device=near.device)
    u, w = unit[(axis + 1) % 3], unit[(axis + 2) % 3]
    beyond = cell + unit[axis]
    centre = (count + 1) ** 3
    low, high = centre + _flat(cell, count), centre + _flat(beyond, count)
    # Counter-clockwise around the axis, so that (low, ring k, ring k + 1, high) is positive.
    ring = [_flat(beyond + s, count + 1) for s in (0 * u, u, u + w, w)]
    tetrahedra = [torch.stack([low, ring[k], ring[(k + 1) % 4], high], 1) for k in range(4)]
    return torch.stack(tetrahedra, 1).reshape(-1, 4)


def _flat(index: Int[Tensor, "K 3"], size: int) -> Int[Tensor, "K"]:
    """Flat index into a cube of `size`^3."""
    return (index[:, 0] * size + index[:, 1]) * size + index[:, 2]


def _compact(
    tetrahedra: Int[Tensor, "T 4"], total: int
) -> tuple[Int[Tensor, "N"], Int[Tensor, "T 4"]]:
    """Used dense ids, ascending, and the tetrahedra in terms of their ranks."""
    used = torch.zeros(total, dtype=torch.bool, device=tetrahedra.device)
    used[tetrahedra.reshape(-1)] = True
    rank = torch.cumsum(used, 0) - 1
    return torch.nonzero(used)[:, 0], rank[tetrahedra]


def _edge_table(
    tetrahedra: Int[Tensor, "T 4"], nodes: int
) -> tuple[Int[Tensor, "E 2"], Int[Tensor, "T 6"]]:
    """Every edge once, ascending, and the six edges of each tetrahedron."""
    first, second = tetrahedra[:, torch.tensor(EDGE_ENDS, device=tetrahedra.device)].unbind(-1)
    key = torch.minimum(first, second) * nodes + torch.maximum(first, second)
    unique, inverse = torch.unique(key, return_inverse=True)
    return torch.stack([unique // max(nodes, 1), unique % max(nodes, 1)], 1), inverse


def _node_positions(
    source: Int[Tensor, "N"], count: int, half_extent: float
) -> Float[Tensor, "N 3"]:
    """World positions of dense node ids."""
    corner_count = (count + 1) ** 3
    is_centre = source >= corner_count
    flat = torch.where(is_centre, source - corner_count, source)
    size = torch.where(is_centre, count, count + 1)
    index = torch.stack([flat // (size * size), flat // size % size, flat % size], 1)
    offset = torch.where(is_centre, 0.5, 0.0)[:, None]
    return (index + offset) * (2.0 * half_extent / count) - half_extent
