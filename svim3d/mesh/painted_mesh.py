"""A mesh with one metallic-roughness material, in whatever form each of its maps has."""

from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.mesh.frames import bitangents
from svim3d.mesh.texels import Texels


@dataclass(frozen=True)
class PaintedMesh:
    """A mesh ready for export: textured, of constants, or coloured per vertex.

    A vertex appears once per texture coordinate, as in glTF. Textures have row 0 at the top and
    `uv` has its origin at the top left, as in glTF; their sizes may differ.

    Attributes:
        vertices: world positions.
        faces: counter-clockwise seen from outside.
        normals: unit, per vertex.
        uv: texture coordinates in [0, 1], or None when nothing is a texture.
        tangents: unit tangent and handedness (+1 or -1), MikkTSpace-compatible; None without a
            normal map.
        basecolor: linear, in [0, 1]: a texture [T, T, 3], per vertex [N, 3], or one colour [3].
        orm: occlusion, roughness, metallic in [0, 1], in the same layouts.
        normal_tangent: texture of unit tangent-space normals, green up, or None.
        orm_factor: multiplies `orm`; None where every map is a texture as it was baked.
    """

    vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    normals: Float[Tensor, "N 3"]
    uv: Float[Tensor, "N 2"] | None
    tangents: Float[Tensor, "N 4"] | None
    basecolor: Float[Tensor, "*texels 3"]
    orm: Float[Tensor, "*orm_texels 3"]
    normal_tangent: Float[Tensor, "T T 3"] | None
    orm_factor: Float[Tensor, "3"] | None = None

    @property
    def textures(self) -> dict[str, Float[Tensor, "_ _ 3"]]:
        """Those of its maps that are pictures."""
        maps = {"basecolor": self.basecolor, "orm": self.orm, "normal": self.normal_tangent}
        return {name: m for name, m in maps.items() if m is not None and m.ndim == 3}

    @property
    def axes(self) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
        """Normal, tangent and bitangent at vertices."""
        assert self.tangents is not None
        across = bitangents(self.normals, self.tangents)
        return self.normals, self.tangents[:, :3].contiguous(), across

    def frame(
        self, texels: Texels
    ) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
        """Normal, tangent and bitangent at texels, as interpolated."""
        normal, tangent, bitangent = (texels.interpolate(self.faces, axis) for axis in self.axes)
        return normal, tangent, bitangent

    def without_needless_seams(self) -> Self:
        """The same without tangents or texture coordinates where no map needs them.

        Vertices that only those had told apart become one again.
        """
        if self.normal_tangent is not None or self.basecolor.ndim == 2:
            return self
        uv = self.uv if self.textures else None
        parts = [self.vertices, self.normals, *([] if uv is None else [uv])]
        rows, index = torch.unique(torch.cat(parts, 1), dim=0, return_inverse=True)
        return replace(
            self,
            vertices=rows[:, :3].contiguous(),
            normals=rows[:, 3:6].contiguous(),
            uv=None if uv is None else rows[:, 6:].contiguous(),
            tangents=None,
            faces=index[self.faces.long()].to(self.faces.dtype),
        )
