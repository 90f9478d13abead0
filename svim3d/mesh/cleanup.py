"""From a fitted surface to a sound mesh: repair, removal of floaters, decimation.

No step fails: one that would return an empty, non-finite or opened mesh is not taken, and says so.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import fast_simplification
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from svim3d.mesh.mesh import face_adjacency, face_normals_scaled, signed_volume

MAX_HOLE_EDGES = 30  # larger openings are taken for the object's own
# Aggressiveness of the quadric decimation, tried in turn. Measured on a 194k-face test surface to
# 20k, 10k, 5k faces: 7, the library's default, tears 2, 5, 14 edges; 5 and 3 none; 1 stops at 49k.
# To 2k faces 5 tears 2 edges, and 3 stops at 3.2k.
AGGRESSIVENESS = (5.0, 3.0)
MAX_VOLUME_CHANGE = 0.1  # a decimated mesh off by more than this share has lost parts
ENOUGH = 1.05  # a mesh with at most this many times the faces asked for is not decimated again


@dataclass(frozen=True)
class CleanMesh:
    """A mesh and what was done to it.

    Attributes:
        vertices: world positions.
        faces: counter-clockwise seen from outside.
        notes: sentences about repairs, removals and steps not taken.
    """

    vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    notes: tuple[str, ...] = ()


def is_closed(faces: Int[Tensor, "F 3"]) -> bool:
    """Whether every edge joins exactly two faces that wind alike: a closed oriented manifold."""
    if not len(faces):
        return False
    directed = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).long()
    base = int(faces.max()) + 1
    forth = torch.sort(directed[:, 0] * base + directed[:, 1]).values
    back = torch.sort(directed[:, 1] * base + directed[:, 0]).values
    return bool((forth[1:] != forth[:-1]).all()) and torch.equal(forth, back)


def clean_surface(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    *,
    min_area_share: float,
    min_extent_share: float,
) -> CleanMesh:
    """Weld, drop broken faces, repair topology where needed, and remove what no one should see.

    Removed are hidden cavities and floaters: parts small in area and in extent at once. A thin rod
    beside the object has little area but reaches far, so it stays.

    Args:
        vertices: world positions.
        faces: counter-clockwise seen from outside.
        min_area_share: of the whole surface.
        min_extent_share: a part's longest bounding-box side, of the whole's.
    """
    notes: list[str] = []
    mesh = _without_broken(vertices.detach().cpu().float(), faces.cpu().long())
    if len(mesh.faces) < len(faces):
        notes.append(f"dropped {len(faces) - len(mesh.faces)} degenerate or duplicate faces")
    if len(mesh.faces) and not is_closed(mesh.faces):
        mesh, note = _attempt(mesh, _repair, "repair")
        notes.append(note)
    mesh, removed = _without_floaters(mesh, min_area_share, min_extent_share)
    if signed_volume(mesh.vertices, mesh.faces) < 0:
        mesh = CleanMesh(mesh.vertices, mesh.faces[:, [0, 2, 1]])
        notes.append("turned the faces outward")
    return CleanMesh(mesh.vertices, mesh.faces.to(faces.dtype), (*notes, *removed))


def decimate(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"], *, max_faces: int
) -> CleanMesh:
    """Reduce to about `max_faces` by quadric edge collapse, keeping a closed mesh closed.

    fast_simplification takes a thirteenth of pymeshlab's time at equal error, so pymeshlab only
    steps in when it opens the mesh or loses volume. Source: Garland and Heckbert 1997.
    """
    mesh = CleanMesh(vertices, faces)
    if len(faces) <= max_faces:
        return mesh
    closed = is_closed(faces)
    volume = float(signed_volume(vertices, faces).abs())
    steps: list[Callable[[CleanMesh], CleanMesh]] = [
        lambda m, strength=strength: _collapse(m, max_faces, strength)  # type: ignore[misc]
        for strength in AGGRESSIVENESS
    ]
    steps.append(lambda m: _collapse_carefully(m, max_faces))
    smallest = mesh
    for step in steps:
        result, _ = _attempt(mesh, step, "decimation")
        kept = abs(float(signed_volume(result.vertices, result.faces).abs()) - volume)
        if (closed and not is_closed(result.faces)) or kept > MAX_VOLUME_CHANGE * volume:
            continue
        if len(result.faces) <= ENOUGH * max_faces:
            return CleanMesh(result.vertices, result.faces.to(faces.dtype))
        smallest = min(smallest, result, key=lambda m: len(m.faces))
    note = f"decimation ended at {len(smallest.faces)} faces instead of {max_faces}"
    return CleanMesh(smallest.vertices, smallest.faces.to(faces.dtype), (note,))


def _attempt(
    mesh: CleanMesh, step: Callable[[CleanMesh], CleanMesh], name: str
) -> tuple[CleanMesh, str]:
    """The step's result where it is a mesh, else the mesh as it was; and what happened."""
    try:
        result = step(mesh)
    except Exception as error:  # the libraries raise many kinds; the mesh at hand is good enough
        return mesh, f"{name} failed and was left out: {error}"
    if not len(result.faces) or not bool(torch.isfinite(result.vertices).all()):
        return mesh, f"{name} returned no usable mesh and was left out"
    changed = len(result.faces) - len(mesh.faces)
    return result, f"{name} changed the number of faces by {changed:+d}"


def _without_broken(vertices: Tensor, faces: Tensor) -> CleanMesh:
    """Weld equal vertices; drop faces with a non-finite or repeated corner, or seen before."""
    finite = torch.isfinite(vertices).all(1)
    inside = ((faces >= 0) & (faces < len(vertices))).all(1)
    faces = faces[inside]
    faces = faces[finite[faces].all(1)]
    unique, index = torch.unique(torch.nan_to_num(vertices), dim=0, return_inverse=True)
    if len(unique) < len(vertices):
        vertices, faces = unique, index[faces]
    differ = (faces != faces.roll(1, 1)).all(1)
    faces = faces[differ]
    if len(faces):
        keys = faces.sort(1).values.numpy()
        first = np.unique(keys, axis=0, return_index=True)[1]
        faces = faces[torch.from_numpy(np.sort(first))]
    return _compact(vertices, faces)


def _compact(vertices: Tensor, faces: Tensor) -> CleanMesh:
    """Drop vertices that no face uses."""
    used, index = torch.unique(faces, return_inverse=True)
    return CleanMesh(vertices[used], index.view(-1, 3))


def _without_floaters(
    mesh: CleanMesh, min_area_share: float, min_extent_share: float
) -> tuple[CleanMesh, tuple[str, ...]]:
    """Remove small parts and cavities; the largest part always stays."""
    if not len(mesh.faces):
        return mesh, ()
    part = _parts(mesh.faces)
    count = int(part.max()) + 1
    corners = mesh.vertices[mesh.faces].double()
    area = face_normals_scaled(mesh.vertices, mesh.faces).double().norm(dim=1) / 2
    volume = (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum(1) / 6
    part_area = np.bincount(part, area.numpy(), count)
    part_volume = np.bincount(part, volume.numpy(), count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, corners.amin(1).numpy())
    np.maximum.at(high, part, corners.amax(1).numpy())
    extent = (high - low).max(1)
    whole = (high.max(0) - low.min(0)).max()
    largest = part_area == part_area.max()
    small = (part_area < min_area_share * part_area.sum()) & (extent < min_extent_share * whole)
    # A closed part that winds the other way than the object bounds a cavity inside it.
    facing = np.sign(part_volume[part_area.argmax()])
    cavity = (part_volume * facing < 0) & is_closed(mesh.faces)
    keep = (~small & ~cavity) | largest
    if keep.all():
        return mesh, ()
    notes = []
    if (small & ~cavity & ~largest).any():
        lost = part_area[small & ~cavity & ~largest]
        notes.append(
            f"removed {len(lost)} floaters, {lost.sum() / part_area.sum():.2%} of the area"
        )
    if (cavity & ~largest).any():
        notes.append(f"removed {int((cavity & ~largest).sum())} hidden cavities")
    kept = torch.from_numpy(keep[part])
    return _compact(mesh.vertices, mesh.faces[kept]), tuple(notes)


def _parts(faces: Tensor) -> NDArray[np.int64]:
    """Number of the edge-connected part that each face belongs to."""
    neighbour = face_adjacency(faces).numpy()
    face, side = np.nonzero(neighbour >= 0)
    links = coo_array(
        (np.ones(len(face), bool), (face, neighbour[face, side])), shape=(len(faces), len(faces))
    )
    parts: NDArray[np.int64] = connected_components(links, directed=False)[1].astype(np.int64)
    return parts


def _repair(mesh: CleanMesh) -> CleanMesh:
    """Make edges and vertices manifold, winding coherent, and close small holes."""
    session = _session(mesh)
    session.meshing_repair_non_manifold_edges()
    session.meshing_repair_non_manifold_vertices()
    session.meshing_re_orient_faces_coherently()
    session.meshing_close_holes(maxholesize=MAX_HOLE_EDGES)
    return _from_session(session)


def _collapse(mesh: CleanMesh, max_faces: int, aggressiveness: float) -> CleanMesh:
    """Decimate with fast_simplification."""
    vertices, faces = fast_simplification.simplify(
        mesh.vertices.detach().cpu().float().numpy(),
        mesh.faces.cpu().numpy().astype(np.int32),
        target_count=max_faces,
        agg=aggressiveness,
    )
    return _mesh(vertices, faces)


def _collapse_carefully(mesh: CleanMesh, max_faces: int) -> CleanMesh:
    """Decimate with pymeshlab, which can be told to keep the topology."""
    session = _session(mesh)
    session.meshing_decimation_quadric_edge_collapse(
        targetfacenum=max_faces, preservetopology=True, preservenormal=True
    )
    return _from_session(session)


def _session(mesh: CleanMesh) -> Any:
    """A pymeshlab session that holds the mesh.

    Imported here: it takes half a second and brings a TBB library that numba warns about, and a
    closed surface never needs it.
    """
    import pymeshlab

    session = pymeshlab.MeshSet()
    session.add_mesh(
        pymeshlab.Mesh(
            mesh.vertices.detach().cpu().double().numpy(), mesh.faces.cpu().numpy().astype(np.int32)
        )
    )
    return session


def _from_session(session: Any) -> CleanMesh:
    current = session.current_mesh()
    return _mesh(current.vertex_matrix(), current.face_matrix())


def _mesh(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> CleanMesh:
    return CleanMesh(
        torch.from_numpy(np.asarray(vertices, np.float32)),
        torch.from_numpy(np.asarray(faces, np.int64)),
    )
