"""A trial: views that a pipeline is given, and what is true of the object that they show.

All pictures are our own rasteriser's (split sum, no shadows), so that a trial without its hazard
can be reconstructed well: what is lost beyond that is the hazard's work.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras, fitting_radius, orbit_angles, orbit_cameras
from svim3d.mesh.source_mesh import SourceMesh
from svim3d.render.deferred import environment_shader
from svim3d.render.pictures import render_pictures
from svim3d.shading.octahedral import texel_directions
from svim3d.shading.prefilter import PyramidOperator
from svim3d.shading.studio import studio_radiance
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.lights import random_light

FOV_Y_DEG = 33.8  # Source: SV3D
FILL = 0.85  # of the picture's height, that the object's bounding sphere takes
ELEVATION_DEG, SWING_DEG = 10.0, 20.0  # of the given orbit
HELD_OUT = ((35.0, 15.0), (-20.0, 105.0), (5.0, 195.0), (50.0, 285.0))  # elevation, azimuth, deg
SUPERSAMPLE = 3  # samples per pixel and axis
EXPOSED, EXPOSED_QUANTILE = 0.8, 0.95  # radiance that a twentieth of the covered values exceed

Images = dict[str, Float[Tensor, "V H W _"]]


@dataclass(frozen=True)
class Truth:
    """What the asset is held against.

    Attributes:
        mesh: the object; centred, its longest side 1.
        cameras: stand where no given view does.
        images: what they see in the given light: the images of an orbit.
        relit: radiance that they see in a light that no view shows, premultiplied.
        new_light: that light, octahedral.
        watertight: whether the object's surface is closed.
        euler: V - E + F of what can be seen of it; None where nobody asks.
    """

    mesh: SourceMesh
    cameras: Cameras
    images: Images
    relit: Float[Tensor, "V H W 3"]
    new_light: Float[Tensor, "n n 3"]
    watertight: bool = True
    euler: int | None = None


@dataclass(frozen=True)
class Trial:
    """What a pipeline is given, and the truth.

    Attributes:
        cameras: of the given views.
        images: of an orbit; the hazard's work is done.
        reference: index of the view that was asked for.
        truth: what it should come to.
        light: a lat-long map [h, 2h, 3]; where there is one, the pipeline is given the mesh itself
            and this light instead of views.
    """

    cameras: Cameras
    images: Images
    reference: int
    truth: Truth
    light: Float[Tensor, "h w 3"] | None = None


@dataclass(frozen=True)
class Darkroom:
    """Where trials are photographed.

    Attributes:
        operator: prefilters the lights.
        size: rows and columns of the pictures.
        views: of the given orbit.
    """

    operator: PyramidOperator
    size: int = 64
    views: int = 12

    def trial(
        self,
        mesh: SourceMesh,
        seed: int,
        *,
        views: int | None = None,
        fill: float = FILL,
        elevations_deg: tuple[float, float] = (ELEVATION_DEG, SWING_DEG),
        euler: int | None = None,
    ) -> Trial:
        """Truthful views of a normalised mesh in the built-in studio.

        Args:
            mesh: what is shown.
            seed: of the light in which the asset is tried.
            views: of the orbit, if other than usual.
            fill: share of the picture's height that the object's bounding sphere takes.
            elevations_deg: mean and swing of the orbit.
            euler: see `Truth`.
        """
        angles = orbit_angles(views or self.views, *elevations_deg)
        radius = fitting_radius(mesh.vertices, FOV_Y_DEG, fill)
        cameras = orbit_cameras(angles, radius=radius, fov_y_deg=FOV_Y_DEG, size=self.size)
        others = orbit_cameras(
            list(HELD_OUT),
            radius=fitting_radius(mesh.vertices, FOV_Y_DEG, FILL),
            fov_y_deg=FOV_Y_DEG,
            size=self.size,
        )
        given = self.pictures(mesh, cameras, self.studio())
        exposure = exposure_of(given)
        seen = self.pictures(mesh, others, self.studio() * exposure)
        new_light = random_light(Dice.of(seed, 1), self.operator.size)
        relit = self.pictures(mesh, others, new_light)
        fair = exposure_of(relit)
        truth = Truth(
            mesh=mesh,
            cameras=others,
            images=seen,
            relit=relit["radiance"] * fair,
            new_light=new_light * fair,
            euler=euler,
        )
        given["radiance"] = given["radiance"] * exposure
        return Trial(cameras, given, len(cameras) - 1, truth)

    def studio(self) -> Float[Tensor, "n n 3"]:
        """The built-in light."""
        return studio_radiance(texel_directions(self.operator.size))

    def pictures(self, mesh: SourceMesh, cameras: Cameras, light: Float[Tensor, "n n 3"]) -> Images:
        """The images of an orbit, without depth, which no generator knows."""
        shader = environment_shader(self.operator(light))
        images = render_pictures(mesh, cameras, shader, supersample=SUPERSAMPLE)
        del images["depth"]
        return images


def exposure_of(images: Images) -> float:
    """Factor that brings the bright part of the object to `EXPOSED`."""
    covered = images["mask"][..., 0] > 0.5
    bright = torch.quantile(images["radiance"][covered].amax(-1), EXPOSED_QUANTILE)
    return EXPOSED / max(float(bright), 1e-6)


@dataclass(frozen=True)
class Hazard:
    """Something that goes wrong, from not at all to badly.

    Attributes:
        name: of the command line.
        about: what it is, in a line.
        unit: what a severity counts.
        severities: rising; the first is harmless and gives the reference.
        make: the trial of a severity, a seed and a variant; for an atlas a harmless one.
        notes: kinds of events that tell an operator of it.
        variants: of the hazard; one without a name where there are none.
        is_perturbation: whether the paper's plain method is to be measured beside ours.
        measured: the asset of one run; the atlas of a mesh without any run; or whether runs repeat.
    """

    name: str
    about: str
    unit: str
    severities: tuple[float, ...]
    make: Callable[[Darkroom, float, int, str], Trial]
    notes: tuple[str, ...] = ()
    variants: tuple[str, ...] = ("",)
    is_perturbation: bool = False
    measured: Literal["asset", "atlas", "repeat"] = "asset"
