"""The materials of one mesh, carried over to another of nearly the same shape."""

from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.mesh.atlas import unwrap
from svim3d.mesh.frames import tangent_frames, tangent_from_world, world_from_tangent
from svim3d.mesh.mesh import vertex_normals
from svim3d.mesh.painted_mesh import PaintedMesh
from svim3d.mesh.projection import SurfaceHits, project_onto
from svim3d.mesh.texels import average_down, rasterize_uv, to_image
from svim3d.numerics import normalize
from svim3d.raster.texture import sample_texture
from svim3d.render.texture_size import halved

GUTTER_PX = 4  # keeps two mip levels of charts apart
ATLAS_TIMEOUT_S = 60.0
SPLITS = 2  # times that faces are cut in four: nearest points are looked for among small ones
FEW_COLOURS = 256  # a picture of no more is a palette, between whose colours nothing lies

Mesh = TypeVar("Mesh", bound=PaintedMesh)


def transferred(
    source: Mesh,
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    *,
    shrink: int = 1,
) -> Mesh:
    """Another mesh with the materials of `source`, its textures laid out anew.

    Args:
        source: whose maps are read, each point's at the nearest point that faces the same way.
        vertices: of the other mesh.
        faces: counter-clockwise seen from outside.
        shrink: a power of two that the textures' sides are divided by, while texels stay whole.
    """
    normals = vertex_normals(vertices, faces)
    plain = replace(source, vertices=vertices, faces=faces, normals=normals, uv=None, tangents=None)
    old = _Source(source)
    if source.basecolor.ndim == 2:
        hits = old.nearest(vertices, normals)
        painted = {name: old.at(hits, getattr(source, name)) for name in ("basecolor", "orm")}
        return replace(plain, **painted)
    if not source.textures:
        return plain
    sizes = {
        name: halved(len(image), len(image) / shrink) for name, image in source.textures.items()
    }
    atlas = unwrap(
        vertices,
        faces,
        texture_size=max(sizes.values()),
        gutter_px=max(1, GUTTER_PX // shrink),
        timeout_s=ATLAS_TIMEOUT_S,
    )
    split = atlas.vertex_source.long()
    frames = tangent_frames(vertices[split], atlas.faces, normals[split], atlas.uv)
    chosen = frames.vertex_source.long()
    laid_out = replace(
        plain,
        vertices=vertices[split][chosen],
        faces=frames.faces,
        normals=normals[split][chosen],
        uv=atlas.uv[chosen],
        tangents=frames.tangents,
    )
    images = {
        name: _repainted(name, image, old, laid_out, sizes[name])
        for name, image in source.textures.items()
    }
    return replace(
        laid_out,
        basecolor=images.get("basecolor", source.basecolor),
        orm=images.get("orm", source.orm),
        normal_tangent=images.get("normal"),
    ).without_needless_seams()


def _repainted(
    name: str, image: Float[Tensor, "T T 3"], old: "_Source", new: PaintedMesh, size: int
) -> Float[Tensor, "size size 3"]:
    """One texture over the new layout; of a smaller one the mean of what its texels cover."""
    assert new.uv is not None
    assert old.mesh.uv is not None
    is_palette = name != "normal" and len(torch.unique(image.reshape(-1, 3), dim=0)) <= FEW_COLOURS
    texels = rasterize_uv(new.uv, new.faces, size if is_palette else len(image))
    points, normals = (texels.interpolate(new.faces, a) for a in (new.vertices, new.normals))
    hits = old.nearest(points, normals)
    uv = old.at(hits, old.mesh.uv)
    if is_palette:
        column, row = (uv * len(image)).long().clamp(0, len(image) - 1).unbind(1)
        return to_image(image[row, column], texels)
    values = sample_texture(image, uv)
    if name == "normal":
        world = world_from_tangent(values, *old.frame(hits))
        values = tangent_from_world(world, *new.frame(texels))
    values, texels = average_down(values, texels, len(image) // size)
    return to_image(normalize(values) if name == "normal" else values, texels)


class _Source:
    """A mesh whose attributes are asked for at points near it."""

    def __init__(self, mesh: PaintedMesh) -> None:
        self.mesh = mesh
        corner = torch.eye(3).expand(len(mesh.faces), 3, 3)
        face = torch.arange(len(mesh.faces))
        for _ in range(SPLITS):
            a, b, c = corner.unbind(1)
            ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
            quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
            corner = torch.cat([torch.stack(quarter, 1) for quarter in quarters])
            face = face.repeat(4)
        self._corner, self._face = corner, face
        self._vertices = self._spread(mesh.vertices)
        self._faces = torch.arange(3 * len(face)).view(-1, 3)

    def _spread(self, attribute: Float[Tensor, "N C"]) -> Float[Tensor, "M C"]:
        """An attribute at the corners of the small faces."""
        whole = attribute[self.mesh.faces[self._face].long()]
        return (self._corner @ whole).reshape(-1, attribute.shape[1])

    def nearest(self, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]) -> SurfaceHits:
        """Where the small faces are nearest to points."""
        return project_onto(points, normals, self._vertices, self._faces)

    def at(self, hits: SurfaceHits, attribute: Float[Tensor, "N C"]) -> Float[Tensor, "P C"]:
        """A vertex attribute there."""
        return hits.interpolate(self._faces, self._spread(attribute))

    def frame(self, hits: SurfaceHits) -> tuple[Tensor, Tensor, Tensor]:
        """Normal, tangent and bitangent there."""
        normal, tangent, bitangent = (self.at(hits, axis) for axis in self.mesh.axes)
        return normal, tangent, bitangent
