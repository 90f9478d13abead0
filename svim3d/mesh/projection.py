"""From a decimated mesh back to the surface it stands for."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import prange
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from svim3d.compiled import kernel
from svim3d.mesh.mesh import face_normals_scaled
from svim3d.numerics import normalize

CANDIDATES = 4  # faces compared per point, by nearest centroid; see `project_onto`
WRONG_SIDE_COSINE = 0.0  # faces turned away from the query's normal belong to another sheet


@dataclass(frozen=True)
class SurfaceHits:
    """Points on a mesh: face, barycentric coordinates, distance to the point that asked."""

    face: Int[Tensor, "P"]
    barycentric: Float[Tensor, "P 3"]
    distance: Float[Tensor, "P"]

    def interpolate(
        self, faces: Int[Tensor, "F 3"], attribute: Float[Tensor, "N C"]
    ) -> Float[Tensor, "P C"]:
        """A vertex attribute at the points."""
        corners = attribute[faces[self.face].long()]
        return (corners * self.barycentric[..., None]).sum(1)


def project_onto(
    points: Float[Tensor, "P 3"],
    normals: Float[Tensor, "P 3"],
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
) -> SurfaceHits:
    """Nearest point of a finely and evenly triangulated surface that faces the same way.

    Looks at the `CANDIDATES` faces with the nearest centroids, which for the meshes of a marching
    extraction hold the nearest point but for slivers.

    Args:
        points: near the surface.
        normals: of the mesh that the points lie on; a face turned the other way is taken only if
            all candidates are, so that a thin plate's sides keep apart.
        vertices: of the surface.
        faces: of the surface.
    """
    corners = vertices.detach().cpu().float()[faces.cpu().long()]
    tree = cKDTree(corners.mean(1).numpy())
    count = min(CANDIDATES, len(faces))
    query = points.detach().cpu().float().contiguous().numpy()
    candidates = tree.query(query, k=list(range(1, count + 1)))[1].astype(np.int32)
    face = np.empty(len(query), np.int32)
    weights = np.empty((len(query), 3), np.float32)
    distance = np.empty(len(query), np.float32)
    _nearest(
        query,
        normals.detach().cpu().float().contiguous().numpy(),
        corners.contiguous().numpy(),
        normalize(face_normals_scaled(vertices, faces)).detach().cpu().float().numpy(),
        candidates,
        face,
        weights,
        distance,
    )
    return SurfaceHits(
        face=torch.from_numpy(face.astype(np.int64)).to(points.device),
        barycentric=torch.from_numpy(weights).to(points.device),
        distance=torch.from_numpy(distance).to(points.device),
    )


@kernel()
def _closest_weights(p: NDArray[np.float32], corner: NDArray[np.float32]) -> tuple[float, float]:
    """Weights of the second and third corner at the triangle's point nearest to p.

    Source: Ericson 2005, "Real-time collision detection", section 5.1.5.
    """
    ab, ac, ap = corner[1] - corner[0], corner[2] - corner[0], p - corner[0]
    d1, d2 = (ab * ap).sum(), (ac * ap).sum()
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0
    bp = p - corner[1]
    d3, d4 = (ab * bp).sum(), (ac * bp).sum()
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return d1 / (d1 - d3), 0.0
    cp = p - corner[2]
    d5, d6 = (ab * cp).sum(), (ac * cp).sum()
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, d2 / (d2 - d6)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        along = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - along, along
    total = va + vb + vc
    return vb / total, vc / total


@kernel(parallel=True, fastmath=False)
def _nearest(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    corners: NDArray[np.float32],
    face_normals: NDArray[np.float32],
    candidates: NDArray[np.int32],
    face: NDArray[np.int32],
    weights: NDArray[np.float32],
    distance: NDArray[np.float32],
) -> None:
    """Choose among each point's candidates, first of those that face its way."""
    for i in prange(points.shape[0]):
        best, best_same = np.inf, False
        for k in range(candidates.shape[1]):
            f = candidates[i, k]
            same = (face_normals[f] * normals[i]).sum() > WRONG_SIDE_COSINE
            wb, wc = _closest_weights(points[i], corners[f])
            off = corners[f, 0] * (1.0 - wb - wc) + corners[f, 1] * wb + corners[f, 2] * wc
            off = off - points[i]
            squared = (off * off).sum()
            if (same and not best_same) or (same == best_same and squared < best):
                best, best_same = squared, same
                face[i] = f
                weights[i, 0], weights[i, 1], weights[i, 2] = 1.0 - wb - wc, wb, wc
        distance[i] = np.sqrt(best)
