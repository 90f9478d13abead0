"""Training examples from nothing but a seed and a number: object, cameras, lights, pictures."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras, orbit_cameras
from svim3d.mesh.source_mesh import SourceMesh
from svim3d.shading.environment import rotate_about_y
from svim3d.shading.prefilter import PyramidOperator
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.example import TrainingExample
from svim3d.synthesis.lights import random_light
from svim3d.synthesis.objects import random_object
from svim3d.synthesis.scenes import Scene, scene_of, scene_of_mesh
from svim3d.synthesis.shadows import DepthPictures, shadowed_radiance
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
class Shot:
    """What a renderer is asked for: all views of a scene in all its lights.

    Attributes:
        scene: what is seen.
        cameras: where from.
        samples: what they see of it, as our rasteriser has it.
        lights: octahedral radiance maps.
    """

    scene: Scene
    cameras: Cameras
    samples: ViewSamples
    lights: Sequence[Float[Tensor, "n n 3"]]


# Linear radiance of all views [V, H, W, 3] in each light, premultiplied by the samples' mask.
Renderer = Callable[[Shot], Sequence[Tensor]]


def rasterised(shot: Shot, operator: PyramidOperator) -> list[Float[Tensor, "V H W 3"]]:
    """Our own renderer: split-sum shading with soft shadows; the operator prefilters the lights."""
    pyramids = [operator(radiance) for radiance in shot.lights]
    shadows = DepthPictures.of(shot.scene.geometry)
    return [shot.samples.image(r) for r in shadowed_radiance(shot.samples, shadows, pyramids)]


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
    renderer: Renderer | None = None,
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
        renderer: of the RGB pictures; None is `rasterised`. All other pictures are always our
            rasteriser's: they show the same surface, and without noise.
    """
    cameras, radius = cameras_for(scene, trajectory, size)
    samples = sample_views(scene.geometry, scene.materials, cameras)
    mask = samples.mask
    pictures = []
    shot = Shot(scene, cameras, samples, [radiance for _, radiance in lights])
    rendered = rasterised(shot, operator) if renderer is None else renderer(shot)
    for picture, display in zip(rendered, displays, strict=True):
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
    mesh: tuple[str, SourceMesh] | None = None,
    maps: Sequence[tuple[str, Float[Tensor, "n n 3"]]] = (),
    renderer: Renderer | None = None,
) -> TrainingExample:
    """Example `index` of the data set of a seed: a pure function of its arguments.

    Args:
        seed: of the data set.
        index: of the example.
        operator: prefilters the lights.
        size: side of the pictures, pixels.
        views: of the trajectory.
        lights: of the example.
        mesh: name and normalised mesh to show; None invents an object.
        maps: names and octahedral maps of the operator's size, from which every other light is
            taken, turned at random; none invents all lights.
        renderer: see `photograph`.
    """
    dice = Dice.of(seed, index)
    if mesh is None:
        thing = random_object(dice)
        scene = scene_of(thing, dice.uniform(0.0, 360.0))
    else:
        scene = scene_of_mesh(*mesh, dice.uniform(0.0, 360.0))
    trajectory = random_trajectory(dice, views)
    environments = [_light(dice, operator.size, maps if i % 2 else ()) for i in range(lights)]
    displays = [dice.uniform(*DISPLAY_RANGE) for _ in range(lights)]
    return photograph(
        scene,
        trajectory,
        environments,
        displays,
        operator,
        size=size,
        seed=f"{seed}:{index}",
        renderer=renderer,
    )


def _light(
    dice: Dice, size: int, maps: Sequence[tuple[str, Float[Tensor, "n n 3"]]]
) -> tuple[str, Float[Tensor, "n n 3"]]:
    """An invented light, or one of the maps, turned; and what it is called."""
    if not maps:
        return "invented", random_light(dice, size)
    name, radiance = maps[dice.integer(0, len(maps) - 1)]
    turn = dice.uniform(0.0, 360.0)
    return f"{name} turned {turn:.0f}", rotate_about_y(radiance, turn)
