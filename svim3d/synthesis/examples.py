"""Training examples from nothing but a seed and a number: object, cameras, lights, pictures."""

import json
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras, orbit_cameras
from svim3d.fields.material_field import Materials
from svim3d.render.deferred import Geometry, MaterialSource, SurfacePoints
from svim3d.shading.prefilter import PyramidOperator
from svim3d.synthesis.bodies import turned
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.example import TrainingExample
from svim3d.synthesis.lights import random_light
from svim3d.synthesis.objects import SyntheticObject, random_object
from svim3d.synthesis.trajectories import Trajectory, fitting_distance, random_trajectory
from svim3d.synthesis.views import (
    ViewSamples,
    camera_normals,
    exposure_for,
    on_background,
    sample_views,
)

FOV_DEG = 33.8  # Source: SV3D
DISPLAY_RANGE = (0.5, 0.9)  # display value that the bright part of the object gets


@dataclass(frozen=True)
class Scene:
    """Something to take pictures of, turned as it will be seen.

    Attributes:
        name: tells what it is.
        geometry: world frame; centred, longest side 1.
        materials: of its surface.
        quality: "good" or "low"; low ones do not teach materials.
    """

    name: str
    geometry: Geometry
    materials: MaterialSource
    quality: str


def scene_of(thing: SyntheticObject, yaw_deg: float) -> Scene:
    """An invented object, turned about the upright axis."""
    yaw = turned(1, yaw_deg)

    def materials(points: SurfacePoints) -> Materials:
        # Materials live in the object's own frame.
        rows = thing.material_rows(points.position @ yaw, points.normal @ yaw, points.face)
        return Materials(rows[:, :3], rows[:, 3:4], rows[:, 4:5], torch.zeros_like(points.normal))

    assembly = thing.assembly
    geometry = Geometry(
        vertices=assembly.vertices @ yaw.T,
        faces=assembly.faces,
        normals=assembly.normals @ yaw.T,
        attributes=assembly.vertices.new_zeros(len(assembly.vertices), 0),
    )
    return Scene(thing.name, geometry, materials, thing.quality)


def cameras_for(scene: Scene, trajectory: Trajectory, size: int) -> tuple[Cameras, float]:
    """The trajectory's cameras at the distance that the object needs, and that distance."""
    near = orbit_cameras(trajectory.angles, radius=1.0, fov_y_deg=FOV_DEG, size=size)
    radius = fitting_distance(scene.geometry.vertices, near.c2w[:, :3, :3], FOV_DEG)
    cameras = orbit_cameras(trajectory.angles, radius=radius, fov_y_deg=FOV_DEG, size=size)
    return cameras, radius


def photograph(
    scene: Scene,
    trajectory: Trajectory,
    lights: Sequence[tuple[str, Float[Tensor, "n n 3"]]],
    displays: Sequence[float],
    operator: PyramidOperator,
    *,
    size: int,
    seed: str,
) -> TrainingExample:
    """All pictures of a scene.

    Args:
        scene: what is seen.
        trajectory: where from.
        lights: names and octahedral radiance maps, of the operator's size.
        displays: for each light, the display value of the object's bright part; see
            `exposure_for`.
        operator: prefilters the lights.
        size: side of the pictures, pixels.
        seed: noted in the metadata.
    """
    cameras, radius = cameras_for(scene, trajectory, size)
    samples = sample_views(scene.geometry, scene.materials, cameras)
    mask = samples.mask
    pictures = []
    for (_, radiance), display in zip(lights, displays, strict=True):
        picture = samples.image(samples.radiance(operator(radiance)))
        picture = picture * exposure_for(picture, mask, display)
        pictures.append(on_background(picture, mask, background=1.0, srgb=True))
    elevation, azimuth = (torch.tensor(a) for a in zip(*trajectory.angles, strict=True))
    return TrainingExample(
        rgb=torch.stack(pictures),
        **_material_pictures(samples, mask),
        normal=camera_normals(samples, cameras),
        mask=(mask * 255.0).round().to(torch.uint8),
        elevation_deg=elevation,
        azimuth_deg=azimuth,
        metadata={
            "fov_deg": str(FOV_DEG),
            "radius": f"{radius:.6f}",
            "quality": scene.quality,
            "name": scene.name,
            "seed": seed,
            "environments": json.dumps([name for name, _ in lights]),
            "transfer": "srgb",
        },
    )


def _material_pictures(samples: ViewSamples, mask: Tensor) -> dict[str, Tensor]:
    """Basecolor on white, occlusion-roughness-metallic on black."""
    basecolor = samples.image(samples.basecolor)
    nothing = torch.zeros_like(samples.roughness)
    orm = samples.image(torch.cat([nothing, samples.roughness, samples.metallic], 1))
    return {
        "basecolor": on_background(basecolor, mask, background=1.0, srgb=True),
        "orm": on_background(orm, mask, background=0.0),
    }


def render_example(
    seed: int,
    index: int,
    operator: PyramidOperator,
    *,
    size: int,
    views: int,
    lights: int,
) -> TrainingExample:
    """Example `index` of the data set of a seed: a pure function of both."""
    dice = Dice.of(seed, index)
    thing = random_object(dice)
    scene = scene_of(thing, dice.uniform(0.0, 360.0))
    trajectory = random_trajectory(dice, views)
    environments = [(f"random-{i}", random_light(dice, operator.size)) for i in range(lights)]
    displays = [dice.uniform(*DISPLAY_RANGE) for _ in range(lights)]
    return photograph(
        scene,
        trajectory,
        environments,
        displays,
        operator,
        size=size,
        seed=f"{seed}:{index}",
    )
