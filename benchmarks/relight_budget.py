"""Why relit pictures differ from path-traced ones: pictures that are each right in one thing more.

The first is the split sum. Then, by sampling with the true materials and normals of the pixels: no
shadows (`sampled`: rid of the errors of split sum and prefilter), true shadows cast by the mesh of
the data folder (`shadow`), and light passed on once and up to five times (`bounce 1`, `bounce 5`).
Where a ray lands, materials and normals are those of the nearest pixel of all known views. What is
then left is neither light transport nor shading model: above all that a pixel holds one normal for
all the bumps within it, next the denoiser and the noise of both pictures, and Cycles' dimming of
the diffuse base.

Columns: PSNR after AgX of each picture against the truth, then the share of the split sum's squared
error that each step removes (negative: adds), and what is left. Two halves of the samples are
multiplied, so that their noise does not count.
"""

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from svim3d.numerics import dot, normalize, reflect
from svim3d.shading.directional_albedo import MIN_N_DOT_V, lobe_albedos
from svim3d.shading.environment import (
    direction_from_latlong,
    latlong_from_direction,
    latlong_solid_angles,
    sample_latlong,
)
from svim3d.shading.lobe_sampling import tangent_frame
from svim3d.shading.metallic_roughness import diffuse_albedo, specular_f0
from svim3d.shading.microfacet import (
    alpha_from_roughness,
    sample_visible_normal,
    visible_normal_density,
)
from svim3d.shading.monte_carlo import specular_brdf

STEPS = ("split", "sampled", "shadow", "bounce 1", "bounce 5")
VERTICES = 6  # of a path, as the truth was rendered
TO_LIGHT, TO_SPECULAR, TO_DIFFUSE = 0.4, 0.4, 0.2  # shares of directions, joined by the balance
OFFSET = 2e-4  # world units that rays start off the surface
SURVIVAL = 0.05  # least chance to go on
HIDDEN = -0.3  # cosine of a looked-up normal with the view, below which it is another surface's
POINTS = 200_000  # of the known surface, drawn from all views


class LightSampler:
    """Directions by the brightness of a lat-long map."""

    def __init__(self, radiance: Tensor) -> None:
        self.height, self.width, _ = radiance.shape
        omega = latlong_solid_angles(self.height, self.width, radiance)[..., 0]
        mean = radiance.mean(-1)
        # Bilinear lookup carries light into neighbours, hence the largest of three by three.
        padded = torch.nn.functional.pad(mean[None, None], (1, 1, 1, 1), mode="circular")
        brightest = torch.nn.functional.max_pool2d(padded, 3, 1)[0, 0]
        share = (0.5 * (brightest + mean) + 0.05 * mean.mean()) * omega
        share = share / share.sum()
        self.density = share / omega
        self.cumulated = np.cumsum(share.double().numpy().ravel())

    def draw(self, count: int, rng: np.random.Generator) -> Tensor:
        """Unit directions."""
        texel = np.searchsorted(self.cumulated, rng.random(count) * self.cumulated[-1])
        row, column = np.divmod(np.minimum(texel, self.density.numel() - 1), self.width)
        top, bottom = (np.cos((row + i) / self.height * np.pi) for i in (0, 1))
        polar = np.arccos(np.clip(top + (bottom - top) * rng.random(count), -1.0, 1.0)) / np.pi
        uv = np.stack([(column + rng.random(count)) / self.width, polar], -1)
        return direction_from_latlong(torch.from_numpy(uv).float())

    def density_towards(self, d: Tensor) -> Tensor:
        """Per steradian."""
        u, v = latlong_from_direction(d).unbind(-1)
        row = (v * self.height).long().clamp(0, self.height - 1)
        return self.density[row, (u * self.width).long() % self.width][:, None]


class World:
    """The true mesh for rays, and the materials and normals of its nearest known points."""

    def __init__(self, file: Path, case: Any) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        mesh = trimesh.load(file, process=False)
        self.scene = rtcore_scene.EmbreeScene()
        TriangleMesh(self.scene, np.asarray(mesh.vertices[mesh.faces], np.float32))
        self.face_normals = torch.from_numpy(np.array(mesh.face_normals)).float()
        g = case.gbuffer
        inside = [g.mask[view, ..., 0] > 0.99 for view in range(len(g))]
        points = torch.cat([g.positions(v)[m] for v, m in enumerate(inside)])
        images = torch.cat([g.basecolor, g.roughness, g.metallic, g.normal_world], -1)
        known = torch.cat([images[v][m] for v, m in enumerate(inside)])
        chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:POINTS]
        self.tree, self.known = cKDTree(points[chosen].numpy()), known[chosen]

    def trace(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Face that each ray meets, -1 for none, and the distance."""
        rays = (x.contiguous().float().numpy() for x in (origin, direction))
        found = self.scene.run(*rays, query="INTERSECT", output=True)
        distance = torch.from_numpy(found["tfar"].copy()).float()[:, None]
        return torch.from_numpy(found["primID"].astype(np.int64)), distance

    def materials(self, point: Tensor) -> Tensor:
        """Basecolor, roughness, metallic and normal, eight numbers for each point."""
        return self.known[torch.from_numpy(self.tree.query(point.numpy())[1])]


def scatter(
    material: Tensor, wo: Tensor, sampler: LightSampler, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Light directions, and reflectance times cosine over their density."""
    basecolor, roughness, metallic = material[:, :3], material[:, 3:4], material[:, 4:5]
    normal, count = material[:, 5:], len(material)
    frame = torch.stack([*tangent_frame(normal), normal], -2)
    local = (frame @ wo[..., None])[..., 0]
    local = normalize(torch.cat([local[:, :2], local[:, 2:].clamp_min(MIN_N_DOT_V)], -1))
    cosine_o, alpha = dot(normal, wo).clamp_min(MIN_N_DOT_V), alpha_from_roughness(roughness)
    f0 = specular_f0(basecolor, metallic)
    u = torch.from_numpy(rng.random((count, 3))).float()
    to_light = (frame @ sampler.draw(count, rng)[..., None])[..., 0]
    mirrored = reflect(local, sample_visible_normal(local, alpha, u[:, :2]))
    radius, angle = u[:, :1].sqrt(), 2.0 * math.pi * u[:, 1:2]
    about = torch.cat([radius * angle.cos(), radius * angle.sin(), (1 - u[:, :1]).sqrt()], -1)
    choice = u[:, 2:]
    wi = torch.where(choice < TO_LIGHT + TO_SPECULAR, mirrored, about)
    wi = torch.where(choice < TO_LIGHT, to_light, wi)
    world, wh = (wi[:, None] @ frame)[:, 0], normalize(wi + local)
    density = TO_LIGHT * sampler.density_towards(world)
    density += TO_SPECULAR * visible_normal_density(cosine_o, wh[:, 2:], alpha)
    density += TO_DIFFUSE * wi[:, 2:].clamp_min(0.0) / math.pi
    lit = wi[:, 2:] > 1e-4
    cosine = torch.where(lit, wi[:, 2:], 1.0)
    single, _ = lobe_albedos(f0, cosine_o, roughness, multiple_scattering=False)
    reflectance = diffuse_albedo(basecolor, metallic) * (1.0 - single) / math.pi
    reflectance = reflectance + specular_brdf(
        cosine_o, cosine, wh[:, 2:], dot(local, wh), f0, alpha
    )
    return world, reflectance * torch.where(lit, cosine / density.clamp_min(1e-9), 0.0)


def trace_paths(
    case: Any, view: int, world: World, samples: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Radiance [H, W, 3] without shadows, and [VERTICES, H, W, 3] by the paths' greatest length."""
    g, cameras = case.gbuffer, case.gbuffer.cameras
    pixels = torch.nonzero(case.mask(view).reshape(-1))[:, 0]
    images = torch.cat([g.basecolor, g.roughness, g.metallic, g.normal_world], -1)
    seen, sampler = images[view].reshape(-1, 8)[pixels], LightSampler(case.radiance)
    rotation, centre = cameras.c2w[view, :3, :3], cameras.positions[view]
    open_sky = torch.zeros(g.mask[view].numel(), 3)
    light = torch.zeros(VERTICES, g.mask[view].numel(), 3)
    for _ in range(samples):
        jitter = torch.from_numpy(rng.random((len(pixels), 2))).float()
        x = pixels % cameras.width + jitter[:, 0] - 0.5 * cameras.width
        y = 0.5 * cameras.height - pixels // cameras.width - jitter[:, 1]
        local = torch.stack([x, y, torch.full_like(x, -cameras.focal_px)], -1)
        wo = -normalize(local) @ rotation.T
        face, distance = world.trace(centre.expand_as(wo), -wo)
        live = torch.nonzero(face >= 0)[:, 0]
        point, wo = (centre - wo * distance)[live], wo[live]
        pixel, material, face = pixels[live], seen[live], face[live]
        carried = torch.ones_like(point)
        for vertex in range(VERTICES):
            wi, weight = scatter(material, wo, sampler, rng)
            carried = carried * weight
            if vertex == 0:
                sky = carried * sample_latlong(case.radiance, wi) / samples
                open_sky.index_add_(0, pixel, sky)
            side = world.face_normals[face]
            side = torch.where(dot(side, wo) < 0.0, -side, side)
            useful = (dot(side, wi)[:, 0] > 0.0) & (carried.amax(-1) > 0.0)
            point, wi, pixel, carried = (
                x[useful] for x in (point + OFFSET * side, wi, pixel, carried)
            )
            if not len(point):
                break
            face, distance = world.trace(point, wi)
            away = face < 0
            sky = carried[away] * sample_latlong(case.radiance, wi[away]) / samples
            light[vertex].index_add_(0, pixel[away], sky)
            chance = carried.amax(-1).clamp(SURVIVAL, 1.0)
            on = ~away & (torch.from_numpy(rng.random(len(face))).float() < chance)
            point, wo = (point + wi * distance)[on], -wi[on]
            pixel, face, carried = pixel[on], face[on], (carried / chance[:, None])[on]
            material = world.materials(point)
            front = dot(material[:, 5:], wo)[:, 0] > HIDDEN
            point, wo, pixel, face, carried, material = (
                x[front] for x in (point, wo, pixel, face, carried, material)
            )
    shape = g.mask.shape[1:3]
    return open_sky.view(*shape, 3), light.cumsum(0).view(VERTICES, *shape, 3)


def report_budget(data: Path, rows: list[tuple[Any, int, dict[str, Tensor]]], samples: int) -> None:
    """Print the chain of one view of each case."""
    print("\nbudget" + " " * 8 + "".join(f"{s:>9}" for s in STEPS) + "   shares of squared error")
    for case, view, pictures in rows:
        world = World(data / "orbits" / case.asset / "mesh.ply", case)
        target, mask = case.display(view), case.mask(view)[..., 0]
        errors = []
        for seed in (0, 1):
            rng = np.random.default_rng(seed)
            free, by_length = trace_paths(case, view, world, samples // 2, rng)
            chain = [pictures["off"], free, by_length[0], by_length[1], by_length[-1]]
            errors.append([(case.display(view, c) - target)[mask] for c in chain])
        # The noise of both halves is independent, so it averages out of the product.
        squared = [float((a * b).mean()) for a, b in zip(*errors, strict=True)]
        decibels = [-10.0 * math.log10(s) for s in squared]
        removed = [(a - b) / squared[0] for a, b in itertools.pairwise(squared)]
        shares = zip((*STEPS[1:], "left"), (*removed, squared[-1] / squared[0]), strict=True)
        text = "".join(f"{d:9.2f}" for d in decibels)
        text += "   " + "  ".join(f"{name} {share:.0%}" for name, share in shares)
        print(f"{case.asset:9}{case.light:5}{text}", flush=True)
