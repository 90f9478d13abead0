"""What the prefilter is measured against: brute force, the paper's eager form, SH and SG lights.

All work on octahedral maps of linear radiance, as `svim3d.shading.prefilter` does.
"""

import math

import torch
from torch import Tensor

from svim3d.numerics import normalize
from svim3d.shading.lobe_sampling import (
    cosine_lobe_samples,
    ggx_lobe_samples,
    sample_lod,
    tangent_frame,
)
from svim3d.shading.octahedral import sample_octahedral, texel_directions, texel_solid_angles
from svim3d.shading.prefilter_spec import LOD_BIAS

CHUNK = 1 << 14  # directions of the brute force held in memory at a time
COSINE_SHARPNESS = 2.133  # Source: Meder and Bruderlin 2018, the SG nearest to a clamped cosine
SG_STEPS = 250  # of Adam, until the fit no longer improves
SG_LOBES = 24


def brute_force(radiance: Tensor, axes: Tensor, alpha: Tensor, subdivision: int) -> Tensor:
    """Lobes of width `alpha` [P, 1] about `axes` [P, 3] over texels of constant radiance.

    Every texel is seen by subdivision^2 points.
    """
    n = radiance.shape[0] * subdivision
    directions, omega = texel_directions(n).view(-1, 3), texel_solid_angles(n).view(-1)
    fine = radiance.repeat_interleave(subdivision, 0).repeat_interleave(subdivision, 1)
    fine = fine.reshape(-1, radiance.shape[-1])
    total = torch.zeros(len(axes), fine.shape[1], dtype=torch.float64)
    weight = torch.zeros(len(axes), 1, dtype=torch.float64)
    for start in range(0, len(directions), CHUNK):
        chunk = slice(start, start + CHUNK)
        cosine = (axes @ directions[chunk].T).clamp_(0.0, 1.0)
        half_sine_squared = 0.5 * (1.0 - cosine)
        spread = alpha * alpha * (1.0 - half_sine_squared) + half_sine_squared
        lobe = cosine / (spread * spread) * omega[chunk]
        total += (lobe @ fine[chunk]).double()
        weight += lobe.sum(1, keepdim=True).double()
    return (total / weight).float()


def eager_mips(radiance: Tensor, sizes: tuple[int, ...]) -> list[Tensor]:
    """Mips as an eager renderer makes them: solid-angle weighted 2 x 2 means, one by one."""
    mips, omega = [radiance], texel_solid_angles(sizes[0])[..., None]
    for n in sizes[1:]:
        energy = (mips[-1] * omega).view(n, 2, n, 2, 3).sum((1, 3))
        omega = omega.view(n, 2, n, 2, 1).sum((1, 3))
        mips.append(energy / omega)
    return mips


def eager_level(mips: list[Tensor], size: int, roughness: float | None, count: int) -> Tensor:
    """The paper's level as plain torch: a loop over samples, lookups worked out at every step."""
    samples = (
        cosine_lobe_samples(count) if roughness is None else ggx_lobe_samples(count, roughness)
    )
    local, density, weight = (t.float() for t in samples)
    normals = texel_directions(size).view(-1, 3)
    tangent, bitangent = tangent_frame(normals)
    offsets = [0]
    for mip in mips:
        offsets.append(offsets[-1] + mip.shape[0] ** 2)
    total = torch.zeros(len(normals), 3)
    for s in range(len(local)):
        x, y, z = local[s]
        direction = normalize(x * tangent + y * bitangent + z * normals)
        share = float(1.0 / (count * density[s]))
        lod = sample_lod(direction, share, mips[0].shape[0], len(mips) - 1, LOD_BIAS)
        lower = lod.floor().clamp_max(len(mips) - 2)
        blend = lod - lower
        # One lookup per mip in use, as texture units do not exist here.
        for level in lower.unique().long().tolist():
            chosen = (lower[:, 0] == level).nonzero()[:, 0]
            sharp = sample_octahedral(mips[level], direction[chosen])
            coarse = sample_octahedral(mips[level + 1], direction[chosen])
            value = sharp + blend[chosen] * (coarse - sharp)
            total = total.index_add(0, chosen, weight[s] / weight.sum() * value)
    return total


def sh_basis(d: Tensor) -> Tensor:
    """Real spherical harmonics to order 2 at unit directions [P, 3]: [P, 9]."""
    x, y, z = d.unbind(-1)
    terms = [
        0.282095 * torch.ones_like(x),
        0.488603 * y,
        0.488603 * z,
        0.488603 * x,
        1.092548 * x * y,
        1.092548 * y * z,
        0.315392 * (3.0 * z * z - 1.0),
        1.092548 * x * z,
        0.546274 * (x * x - y * y),
    ]
    return torch.stack(terms, -1)


class ShLight:
    """Irradiance / pi from nine coefficients.

    Source: Ramamoorthi and Hanrahan 2001, "An efficient representation for irradiance environment
    maps".
    """

    def __init__(self, size: int) -> None:
        omega = texel_solid_angles(size).view(-1, 1)
        self._projection = (sh_basis(texel_directions(size).view(-1, 3)) * omega).T.contiguous()
        self._damping = torch.tensor([1.0, *3 * [2.0 / 3.0], *5 * [0.25]])[:, None]

    def coefficients(self, radiance: Tensor) -> Tensor:
        """Nine coefficients per channel."""
        return self._damping * (self._projection @ radiance.reshape(self._projection.shape[1], -1))


class SgLight:
    """Spherical Gaussians amplitude exp(sharpness (axis . d - 1)), fitted by least squares."""

    def __init__(self, radiance: Tensor) -> None:
        d = texel_directions(radiance.shape[0]).view(-1, 3)
        omega = texel_solid_angles(radiance.shape[0]).view(-1, 1)
        target = radiance.reshape(-1, 3)
        index = torch.arange(SG_LOBES) + 0.5
        height, turn = 1.0 - 2.0 * index / SG_LOBES, math.pi * (1.0 + 5.0**0.5) * index
        ring = (1.0 - height * height).sqrt()
        self.axis = torch.stack([ring * turn.cos(), height, ring * turn.sin()], -1)
        self.log_sharpness = torch.full((SG_LOBES, 1), math.log(10.0))
        mean = float((target * omega).sum() / (3.0 * omega.sum()))
        self.log_amplitude = torch.full((SG_LOBES, 3), math.log(mean))
        # One lobe starts on the brightest texel, or no fit would find a sun.
        brightest = int(target.sum(1).argmax())
        self.axis[0], self.log_sharpness[0] = d[brightest], math.log(2000.0)
        self.log_amplitude[0] = target[brightest].clamp_min(mean).log()
        adam = torch.optim.Adam([p.requires_grad_() for p in self.parameters()], lr=0.03)
        for _ in range(SG_STEPS):
            adam.zero_grad()
            cosine = d @ normalize(self.axis).T
            shown = torch.exp(self.log_sharpness.exp().T * (cosine - 1.0))
            residual = shown @ self.log_amplitude.exp() - target
            ((residual**2 * omega).sum() / (target**2 * omega).sum()).backward()
            adam.step()

    def parameters(self) -> list[Tensor]:
        """What the fit moves."""
        return [self.axis, self.log_sharpness, self.log_amplitude]

    def filtered(self, axes: Tensor, roughness: float | None) -> Tensor:
        """Mean radiance under the lobe about each axis, in closed form.

        The GGX lobe is an SG of sharpness 1 / (2 alpha^2) about the reflected ray, the cosine one
        of 2.133; their product has the sum. Source: Wang et al. 2009, "All-frequency rendering of
        dynamic, spatially-varying reflectance", section 4.
        """
        lobe = COSINE_SHARPNESS + (0.0 if roughness is None else 0.5 / roughness**4)
        if roughness == 1.0:
            lobe = COSINE_SHARPNESS  # that GGX lobe is the cosine lobe
        sharpness = self.log_sharpness.exp()
        mean = sharpness * normalize(self.axis)
        distance = (lobe * axes[:, None] + mean).norm(dim=-1).clamp_min(1e-6)
        exponent = distance - lobe - sharpness[:, 0]
        product = exponent.exp() * (1.0 - torch.exp(-2.0 * distance)) / distance
        norm = (1.0 - math.exp(-2.0 * lobe)) / lobe
        return product @ self.log_amplitude.exp() / norm
