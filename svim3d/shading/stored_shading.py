"""Split-sum shading of points that never change, as a stored linear function of the environment.

With geometry, materials and views held fixed, radiance is linear in the environment: every point
reads the same few texels of the pyramid with the same weights.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.numerics import dot
from svim3d.shading.directional_albedo import (
    MIN_N_DOT_V,
    MultipleScattering,
    lobe_albedos,
    lookup_table,
)
from svim3d.shading.dominant_lobe import dominant_direction
from svim3d.shading.linear_operator import SparseOperator
from svim3d.shading.metallic_roughness import diffuse_albedo, specular_f0
from svim3d.shading.octahedral import bilinear_taps
from svim3d.shading.prefilter import EnvironmentPyramid, PyramidLayout


@dataclass(frozen=True)
class StoredShading:
    """What P fixed points take from a pyramid of one layout.

    Attributes:
        lookup: pyramid texels to the prefiltered radiance of all points, then the irradiance.
        specular_share: factor of the prefiltered radiance.
        irradiance_share: factor of the irradiance.
    """

    lookup: SparseOperator
    specular_share: Float[Tensor, "P 3"]
    irradiance_share: Float[Tensor, "P 3"]

    @classmethod
    def build(
        cls,
        normal: Float[Tensor, "P 3"],
        wo: Float[Tensor, "P 3"],
        basecolor: Float[Tensor, "P 3"],
        roughness: Float[Tensor, "P 1"],
        metallic: Float[Tensor, "P 1"],
        layout: PyramidLayout,
        *,
        multiple_scattering: MultipleScattering,
    ) -> Self:
        """Collect taps and shares; arguments as in `split_sum.shade`."""
        n_dot_v = dot(normal, wo)
        visible = n_dot_v.clamp(MIN_N_DOT_V, 1.0)
        single, multiple = lobe_albedos(
            specular_f0(basecolor, metallic),
            visible,
            roughness,
            multiple_scattering=multiple_scattering,
        )
        transmitted = diffuse_albedo(basecolor, metallic) * (1.0 - single - multiple)
        direction = dominant_direction(normal, wo, n_dot_v, lookup_table(visible, roughness)[:, 2:])
        level, fraction = layout.locate(roughness)
        sizes = torch.tensor(layout.sizes, device=normal.device)
        starts = torch.tensor(layout.offsets, device=normal.device)
        taps, weights = [], []
        for step, share in ((0, 1.0 - fraction), (1, fraction)):
            indices, bilinear = bilinear_taps(direction, sizes[level + step])
            taps.append(indices + starts[level + step][:, None])
            weights.append(bilinear * share)
        indices, bilinear = bilinear_taps(normal, layout.irradiance_size)
        texels = layout.offsets[-1]
        specular = _rows(torch.cat(taps, 1), torch.cat(weights, 1), texels)
        irradiance = _rows(indices + layout.offsets[-2], bilinear, texels)
        lookup = SparseOperator(scipy.sparse.vstack([specular, irradiance]).tocsr())
        return cls(lookup, single, multiple + transmitted)

    def __call__(self, pyramid: EnvironmentPyramid) -> Float[Tensor, "P 3"]:
        """Radiance of all points; linear and differentiable in the pyramid."""
        prefiltered, irradiance = self.lookup(pyramid.texels).chunk(2)
        return self.specular_share * prefiltered + self.irradiance_share * irradiance


def _rows(
    indices: Int[Tensor, "P k"], weights: Float[Tensor, "P k"], columns: int
) -> scipy.sparse.csr_matrix:
    """One sparse row per point; taps that fall on the same texel are summed."""
    points, taps = indices.shape
    pointers = np.arange(0, points * taps + 1, taps)
    data = (weights.cpu().numpy().ravel(), indices.cpu().numpy().ravel(), pointers)
    matrix = scipy.sparse.csr_matrix(data, (points, columns))
    matrix.sum_duplicates()
    return matrix
