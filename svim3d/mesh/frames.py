"""Tangent frames of textured meshes, compatible with MikkTSpace, as glTF asks for.

Source: Mikkelsen 2008, "Simulation of wrinkled surfaces revisited"; glTF 2.0 specification, section
3.7.2.1: bitangent = cross(normal, tangent) * handedness. MikkTSpace's v axis points up in the
texture, so that a positive green channel tilts a normal towards the top of the picture.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from svim3d.mesh.mesh import face_adjacency
from svim3d.numerics import dot, normalize

FRAME_MIN_DETERMINANT = 1e-3  # keeps the inverse finite where interpolated axes nearly coincide
NORMAL_MIN_Z = 0.05  # an encoded normal must leave the surface; glTF maps blue to z > 0
ANGLE_COSINE_LIMIT = 1.0 - 1e-12  # keeps acos real where rounding pushes a cosine past 1


@dataclass(frozen=True)
class TangentFrames:
    """Tangents of a mesh whose vertices were split where one vertex needs two of them.

    Attributes:
        vertex_source: index into the given vertices, for each resulting vertex; the given vertices
            come first and in their order.
        faces: the given faces over the resulting vertices.
        tangents: unit tangent and handedness (+1 or -1) per resulting vertex.
    """

    vertex_source: Int[Tensor, "M"]
    faces: Int[Tensor, "F 3"]
    tangents: Float[Tensor, "M 4"]


def tangent_frames(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    normals: Float[Tensor, "N 3"],
    uv: Float[Tensor, "N 2"],
) -> TangentFrames:
    """Tangents as MikkTSpace computes them.

    Vertices equal in position, normal and uv are one. Around each, the faces that hang together
    through shared edges and have the same orientation in texture space form a group; a group's
    tangent is the mean of its faces' tangents, projected onto the normal's plane and weighted by
    the corner's angle.

    Args:
        vertices: world positions.
        faces: counter-clockwise seen from outside.
        normals: unit.
        uv: glTF texture coordinates, origin at the top left.
    """
    corner = faces.reshape(-1).long()
    attributes = torch.cat([vertices, normals, uv], 1).numpy(force=True)
    welded = np.unique(attributes, axis=0, return_inverse=True)[1].reshape(-1)
    tangent, mirrored, valid = _face_tangents(vertices, faces, uv)
    group = _corner_groups(welded[corner.numpy(force=True)].reshape(-1, 3), mirrored, valid)

    # Each face gives its corners a share of its tangent, by the angle it spans there.
    weights = _corner_angles(vertices, faces, normals).reshape(-1, 1)
    normal = normals[corner].double()
    flat = tangent.repeat_interleave(3, 0)
    share = weights * normalize(flat - dot(normal, flat) * normal)
    share = share * valid.repeat_interleave(3)[:, None]
    labels = torch.from_numpy(group)
    total = torch.zeros(int(group.max(initial=-1)) + 1, 3, dtype=torch.float64)
    total.index_add_(0, labels, share.cpu())

    # A vertex is repeated once per further group among its corners.
    pairs = np.stack([corner.numpy(force=True), group], 1)
    first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)[1:]
    chosen = pairs[first]
    repeats = np.concatenate([[False], chosen[1:, 0] == chosen[:-1, 0]])[: len(chosen)]
    extra = int(repeats.sum())
    target = np.where(repeats, len(vertices) + np.cumsum(repeats) - 1, chosen[:, 0])
    source = np.concatenate([np.arange(len(vertices)), chosen[repeats, 0]])

    out_group = np.full(len(vertices) + extra, -1)
    out_group[target] = chosen[:, 1]
    tangents = _finished(total, out_group, normals.cpu()[torch.from_numpy(source)])
    handedness = np.ones(len(out_group), np.float32)
    group_sign = np.ones(len(total), np.float32)
    counted = np.repeat(valid.numpy(force=True), 3)
    group_sign[group[counted]] = np.repeat(np.where(mirrored, -1.0, 1.0), 3)[counted]
    handedness[out_group >= 0] = group_sign[out_group[out_group >= 0]]
    return TangentFrames(
        vertex_source=torch.from_numpy(source).to(faces),
        faces=torch.from_numpy(target[inverse.reshape(-1)].reshape(-1, 3)).to(faces),
        tangents=torch.cat([tangents, torch.from_numpy(handedness)[:, None]], 1).to(vertices),
    )


def _face_tangents(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"], uv: Float[Tensor, "N 2"]
) -> tuple[Float[Tensor, "F 3"], NDArray[np.bool_], Tensor]:
    """Unit direction of growing u in each face, whether uv mirrors it, and whether both exist."""
    corners = vertices.double()[faces.long()]
    texel = uv.double()[faces.long()]
    edge_a, edge_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # v grows upwards in MikkTSpace and downwards in glTF.
    du_a, dv_a = (texel[:, 1] - texel[:, 0]).unbind(1)
    du_b, dv_b = (texel[:, 2] - texel[:, 0]).unbind(1)
    dv_a, dv_b = -dv_a, -dv_b
    area = du_a * dv_b - du_b * dv_a
    raw = dv_b[:, None] * edge_a - dv_a[:, None] * edge_b
    raw_v = -du_b[:, None] * edge_a + du_a[:, None] * edge_b
    mirrored = area <= 0
    valid = (area != 0) & (raw != 0).any(1) & (raw_v != 0).any(1)
    signed = torch.where(mirrored[:, None], -raw, raw)
    # Scaled first: the squares of tiny triangles would vanish in the guarded square root.
    largest = signed.abs().amax(1, keepdim=True)
    unit = normalize(signed / torch.where(largest > 0, largest, 1.0))
    return unit, mirrored.numpy(force=True), valid


def _corner_angles(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"], normals: Float[Tensor, "N 3"]
) -> Float[Tensor, "F 3"]:
    """Angle of each corner seen along its vertex normal, in radians."""
    corners = vertices.double()[faces.long()]
    normal = normals.double()[faces.long()]

    def in_plane(edge: Tensor) -> Tensor:
        flat = edge - dot(normal, edge) * normal
        largest = flat.abs().amax(-1, keepdim=True)
        return normalize(flat / torch.where(largest > 0, largest, 1.0))

    onward = in_plane(corners.roll(-1, 1) - corners)
    back = in_plane(corners.roll(1, 1) - corners)
    cosine = dot(onward, back).clamp(-ANGLE_COSINE_LIMIT, ANGLE_COSINE_LIMIT)
    return torch.acos(cosine)[..., 0]


def _corner_groups(
    faces: NDArray[np.int64], mirrored: NDArray[np.bool_], valid: Tensor
) -> NDArray[np.int64]:
    """Group label of every corner [3F]: faces linked through edges, of one orientation.

    A face without a tangent of its own joins whatever group it meets.
    """
    count = len(faces)
    neighbour = face_adjacency(torch.from_numpy(faces)).numpy().reshape(-1)
    has_tangent = valid.numpy(force=True)
    face, opposite = np.divmod(np.flatnonzero(neighbour >= 0), 3)
    other = neighbour[neighbour >= 0]
    agree = (mirrored[face] == mirrored[other]) | ~has_tangent[face] | ~has_tangent[other]
    face, opposite, other = face[agree], opposite[agree], other[agree]
    rows, columns = [], []
    for step in (1, 2):
        corner = (opposite + step) % 3
        matches = faces[other] == faces[face, corner][:, None]
        rows.append(3 * face + corner)
        columns.append(3 * other + matches.argmax(1))
    links = np.concatenate(rows), np.concatenate(columns)
    graph = coo_array((np.ones(len(links[0]), bool), links), shape=(3 * count, 3 * count))
    labels: NDArray[np.int64] = connected_components(graph, directed=False)[1].astype(np.int64)
    return labels


def _finished(
    total: Float[Tensor, "G 3"], group: NDArray[np.int64], normals: Float[Tensor, "M 3"]
) -> Float[Tensor, "M 3"]:
    """Unit tangents orthogonal to the normals; any such direction where a group gave none."""
    normal = normals.double()
    found = torch.zeros_like(normal)
    known = torch.from_numpy(group >= 0)
    found[known] = normalize(total[torch.from_numpy(group)[known]])
    axis = torch.zeros_like(normal)
    axis[torch.arange(len(normal)), normal.abs().argmin(1)] = 1.0
    missing = (found == 0).all(1, keepdim=True)
    found = torch.where(missing, axis, found)
    return normalize(found - dot(normal, found) * normal).float()


def tangent_from_world(
    normal_world: Float[Tensor, "P 3"],
    normal: Float[Tensor, "P 3"],
    tangent: Float[Tensor, "P 3"],
    bitangent: Float[Tensor, "P 3"],
) -> Float[Tensor, "P 3"]:
    """Express world normals in interpolated frames, the inverse of `world_from_tangent`.

    The axes are normalised and need not be orthogonal, as in glTF viewers; so the components come
    from a linear solve, not from inner products.

    Returns:
        Unit tangent-space normals with z at least `NORMAL_MIN_Z`.
    """
    n, t, b = normalize(normal), normalize(tangent), normalize(bitangent)
    determinant = dot(t, torch.linalg.cross(b, n))
    magnitude = determinant.abs().clamp_min(FRAME_MIN_DETERMINANT)
    determinant = torch.where(determinant < 0, -magnitude, magnitude)
    x = dot(normal_world, torch.linalg.cross(b, n)) / determinant
    y = dot(normal_world, torch.linalg.cross(n, t)) / determinant
    z = dot(normal_world, torch.linalg.cross(t, b)) / determinant
    local = normalize(torch.cat([x, y, z], -1))
    return normalize(torch.cat([local[:, :2], local[:, 2:].clamp_min(NORMAL_MIN_Z)], -1))


def world_from_tangent(
    normal_tangent: Float[Tensor, "P 3"],
    normal: Float[Tensor, "P 3"],
    tangent: Float[Tensor, "P 3"],
    bitangent: Float[Tensor, "P 3"],
) -> Float[Tensor, "P 3"]:
    """Shading normals from a normal map and interpolated frames, as glTF viewers compute them."""
    n, t, b = normalize(normal), normalize(tangent), normalize(bitangent)
    x, y, z = normal_tangent[:, :1], normal_tangent[:, 1:2], normal_tangent[:, 2:]
    return normalize(x * t + y * b + z * n)


def bitangents(
    normals: Float[Tensor, "N 3"], tangents: Float[Tensor, "N 4"]
) -> Float[Tensor, "N 3"]:
    """Per-vertex bitangents: cross(normal, tangent) times the handedness."""
    across: Tensor = torch.linalg.cross(normals, tangents[:, :3])
    return across * tangents[:, 3:]
