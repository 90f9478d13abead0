"""Texture atlases: xatlas within a time limit, and box projection, which cannot fail.

Source: xatlas (Young, MIT) for the first. It is super-linear in the number of faces and can hang on
rough meshes, so it runs in a process of its own that is ended when its time is up. Its charts are
packed anew here: some 0.05 % of its texels overlap where a chart folds, and its atlas
has another size than was asked for, which would change the gutter.
"""

import math
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from svim3d.compiled import kernel
from svim3d.mesh import xatlas_process
from svim3d.mesh.mesh import face_adjacency, face_normals_scaled, vertex_normals
from svim3d.mesh.texels import Texels, rasterize_uv
from svim3d.numerics import dot, normalize

MIN_PROJECTED = 0.25  # cosine below which a face would be drawn too narrow in its neighbours' chart
SPLIT_ROUNDS = 4  # times that faces on top of others stay together before each is cut off alone
CHART_TEXELS = 1024  # least resolution for xatlas, which stretches charts to whole texels
BISECTIONS = 24  # of the texture's scale; the last halves it to 1e-7
GRACE_S = 2  # of xatlas beyond its time, in which its parent, if there still is one, ends it
FILL_TARGET = 1.2  # scale at which charts of perfect fit would overfill the texture: upper bound


@dataclass(frozen=True)
class Atlas:
    """Texture coordinates for a mesh, with vertices split along chart borders.

    Attributes:
        vertex_source: index into the given vertices, for each resulting vertex.
        faces: the given faces, in order, over the resulting vertices.
        uv: glTF texture coordinates in [0, 1], origin at the top left; charts do not overlap.
        texels: the atlas rasterised at the size that was asked for.
        charts: number of charts.
        fallback: why xatlas was not used, or None when it was.
    """

    vertex_source: Int[Tensor, "M"]
    faces: Int[Tensor, "F 3"]
    uv: Float[Tensor, "M 2"]
    texels: Texels
    charts: int
    fallback: str | None


def unwrap(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    *,
    texture_size: int,
    gutter_px: int,
    timeout_s: float,
) -> Atlas:
    """Unwrap a mesh with xatlas or, when that fails or takes too long, by box projection.

    Args:
        vertices: world positions.
        faces: counter-clockwise seen from outside; at least one.
        texture_size: texels per side.
        gutter_px: least distance between charts.
        timeout_s: seconds for xatlas; 0 leaves it out.
    """
    if timeout_s <= 0:
        return unwrap_boxes(
            vertices, faces, texture_size=texture_size, gutter_px=gutter_px, reason="as configured"
        )
    try:
        return unwrap_charts(
            vertices, faces, texture_size=texture_size, gutter_px=gutter_px, timeout_s=timeout_s
        )
    except subprocess.TimeoutExpired:
        reason = f"xatlas did not end within {timeout_s:g} s for {len(faces)} faces"
    except (subprocess.CalledProcessError, ValueError, OSError) as error:
        reason = f"xatlas failed: {error}"
    return unwrap_boxes(
        vertices, faces, texture_size=texture_size, gutter_px=gutter_px, reason=reason
    )


def unwrap_charts(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    *,
    texture_size: int,
    gutter_px: int,
    timeout_s: float,
) -> Atlas:
    """Unwrap with xatlas in a child process.

    Raises:
        subprocess.TimeoutExpired: it took too long (and was killed).
        subprocess.CalledProcessError: it crashed.
        ValueError: its result is unusable.
    """
    header = np.array([len(vertices), len(faces), max(texture_size, CHART_TEXELS)], "<i4")
    mesh = vertices.detach().cpu().numpy().astype("<f4"), faces.cpu().numpy().astype("<u4")
    # By file name: the child needs no package path and none of this process's imports.
    content = subprocess.run(
        [sys.executable, "-P", xatlas_process.__file__, str(math.ceil(timeout_s) + GRACE_S)],
        input=header.tobytes() + b"".join(array.tobytes() for array in mesh),
        stdout=subprocess.PIPE,
        timeout=timeout_s,
        check=True,
    ).stdout
    count = int(np.frombuffer(content, "<i4", 1)[0])
    source = np.frombuffer(content, "<u4", count, 4).astype(np.int64)
    corners = np.frombuffer(content, "<u4", 3 * len(faces), 4 + 4 * count).astype(np.int64)
    pixels = np.frombuffer(content, "<f4", 2 * count, 4 + 4 * count + 12 * len(faces))
    if not np.isfinite(pixels).all() or not np.any(pixels):
        raise ValueError("it made no charts")
    corners = corners.reshape(-1, 3)
    flat = pixels.reshape(-1, 2)[corners].astype(np.float64) * [1.0, -1.0]
    layout = _lay_out(corners, flat, np.zeros(len(faces), np.int64), texture_size, gutter_px)
    return layout.atlas(torch.from_numpy(source), like=(vertices, faces), fallback=None)


def unwrap_boxes(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    *,
    texture_size: int,
    gutter_px: int,
    reason: str,
) -> Atlas:
    """Unwrap by projecting connected faces of like direction along the nearest axis."""
    positions = vertices.detach().cpu().double().numpy()
    corners = faces.cpu().numpy().astype(np.int64)
    direction = _box_directions(vertices.detach().cpu(), faces.cpu())
    flat = _project(positions[corners], direction)
    layout = _lay_out(corners, flat, direction, texture_size, gutter_px)
    return layout.atlas(torch.arange(len(vertices)), like=(vertices, faces), fallback=reason)


@dataclass(frozen=True)
class _Layout:
    """Charts placed in the texture: the corner vertex behind each resulting one, faces, uv."""

    source: NDArray[np.int64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64]
    texels: Texels
    charts: int

    def atlas(
        self, vertex_source: Tensor, *, like: tuple[Tensor, Tensor], fallback: str | None
    ) -> Atlas:
        """As tensors, with vertex indices traced back through `vertex_source`."""
        vertices, faces = like
        return Atlas(
            vertex_source=vertex_source[torch.from_numpy(self.source)].to(faces.device),
            faces=torch.from_numpy(self.faces).to(faces),
            uv=torch.from_numpy(self.uv).to(vertices),
            texels=self.texels,
            charts=self.charts,
            fallback=fallback,
        )


def _lay_out(
    corners: NDArray[np.int64],
    flat: NDArray[np.float64],
    label: NDArray[np.int64],
    size: int,
    gutter_px: int,
) -> _Layout:
    """Cut flattened faces into charts that do not overlap, and pack them.

    A chart is a set of faces that hang together and share a label. Where a chart folds over
    itself, the faces on top are cut off: first as charts of their own, after some rounds as single
    faces, which cannot overlap; so it ends, and no texel is claimed twice.

    Args:
        corners: vertices of each face; faces that share two of them hang together.
        flat: the faces in the plane [F, 3, 2], v upwards, all of one scale.
        label: faces with different ones never share a chart.
        size: texels per side.
        gutter_px: least distance between charts.
    """
    neighbour = face_adjacency(torch.from_numpy(corners)).numpy()
    label = label.copy()
    round_index = 0
    while True:
        chart = _connected(neighbour, label)
        pairs, index = np.unique(
            np.stack([np.repeat(chart, 3), corners.reshape(-1)], 1), axis=0, return_inverse=True
        )
        index = index.reshape(-1)
        points = np.zeros((len(pairs), 2))
        points[index] = flat.reshape(-1, 2)
        uv = _pack(points, pairs[:, 0], size, float(gutter_px))
        faces = index.reshape(-1, 3)
        texels = rasterize_uv(torch.from_numpy(uv).float(), torch.from_numpy(faces), size)
        top = np.unique(texels.overlapping.numpy())
        if not len(top):
            return _Layout(pairs[:, 1], faces, uv, texels, int(chart.max()) + 1)
        alone = np.arange(len(top)) if round_index >= SPLIT_ROUNDS else label[top]
        label[top] = label.max() + 1 + alone - alone.min()
        round_index += 1


def _box_directions(vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]) -> NDArray[np.int64]:
    """Axis (0 to 2, or 3 to 5 for its negative) along which each face is projected.

    Chosen by the smooth normal, which gives larger charts on rough surfaces, unless the face
    itself is steep in that direction.
    """
    normal = normalize(face_normals_scaled(vertices, faces))
    smooth = vertex_normals(vertices, faces)[faces.long()].sum(1)
    both = torch.cat([torch.eye(3), -torch.eye(3)]).to(normal)
    wanted = (smooth @ both.T).argmax(1)
    steep = dot(normal, both[wanted])[:, 0] < MIN_PROJECTED
    chosen: NDArray[np.int64] = torch.where(steep, (normal @ both.T).argmax(1), wanted).numpy()
    return chosen


def _connected(neighbour: NDArray[np.int32], label: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number the sets of faces that hang together through edges and share a label."""
    face, side = np.nonzero(neighbour >= 0)
    other = neighbour[face, side]
    same = label[face] == label[other]
    links = coo_array(
        (np.ones(int(same.sum()), bool), (face[same], other[same])), shape=(len(label), len(label))
    )
    components: NDArray[np.int64] = connected_components(links, directed=False)[1].astype(np.int64)
    return components


def _project(points: NDArray[np.float64], direction: NDArray[np.int64]) -> NDArray[np.float64]:
    """Drop each face's axis of projection, keeping counter-clockwise faces so."""
    axis, negative = direction % 3, (direction >= 3)[:, None]
    row = np.arange(len(points))
    first, second = points[row, :, (axis + 1) % 3], points[row, :, (axis + 2) % 3]
    return np.stack([np.where(negative, -first, first), second], -1)


def _pack(
    flat: NDArray[np.float64], chart: NDArray[np.int64], size: int, gutter: float
) -> NDArray[np.float64]:
    """Place charts of equal scale on shelves; uv with the origin at the top left."""
    count = int(chart.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, flat)
    np.maximum.at(high, chart, flat)
    local, extent = flat - low[chart], high - low
    # Lying charts fill shelves better: stand none upright. A quarter turn keeps the orientation.
    tall = extent[:, 1] > extent[:, 0]
    turned = np.stack([local[:, 1], extent[chart, 0] - local[:, 0]], 1)
    local = np.where(tall[chart][:, None], turned, local)
    extent = np.where(tall[:, None], extent[:, ::-1], extent)
    order = np.lexsort((np.arange(count), -extent[:, 0], -extent[:, 1]))
    # So many charts that their gutters alone fill the texture must do with narrower ones.
    while gutter > 0 and _shelves(np.zeros_like(extent), order, gutter, size)[1] > size:
        gutter = gutter / 2 if gutter > 0.25 else 0.0
    fits, fails = 0.0, FILL_TARGET * size / np.sqrt(max((extent.prod(1)).sum(), 1e-30))
    for _ in range(BISECTIONS):
        middle = 0.5 * (fits + fails)
        if _shelves(extent * middle, order, gutter, size)[1] <= size:
            fits = middle
        else:
            fails = middle
    corner = _shelves(extent * fits, order, gutter, size)[0]
    pixels = corner[chart] + local * fits + gutter / 2
    pixels[:, 1] = size - pixels[:, 1]  # v grows downwards
    uv: NDArray[np.float64] = pixels / size
    return uv


@kernel(fastmath=False)
def _shelves(
    extent: NDArray[np.float64], order: NDArray[np.int64], gutter: float, size: float
) -> tuple[NDArray[np.float64], float]:
    """Corners of rectangles placed in order, row by row, and the height they need."""
    corner = np.zeros_like(extent)
    x, y, shelf = 0.0, 0.0, 0.0
    for index in order:
        width, height = extent[index, 0] + gutter, extent[index, 1] + gutter
        if x > 0.0 and x + width > size:
            x, y, shelf = 0.0, y + shelf, 0.0
        if width > size:
            return corner, np.inf
        corner[index, 0], corner[index, 1] = x, y
        x += width
        shelf = max(shelf, height)
    return corner, y + shelf
