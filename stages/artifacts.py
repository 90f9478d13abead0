"""What passes between stages: frozen values that save to and load from a folder.

All tensors are float32 on the CPU, channel last. Nothing is pickled.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from svim3d.cameras import Cameras
from svim3d.fields.material_field import MaterialField, MaterialFieldSpec
from svim3d.io.exr import MAX_HALF, read_rgb, write_rgb
from svim3d.io.image import read_png, write_png
from svim3d.io.orbit import read_orbit, write_orbit
from svim3d.io.orbit_sheet import orbit_sheet
from svim3d.io.weights import load_tensors, save_tensors
from svim3d.mesh.marching import extract_surface
from svim3d.mesh.painted_mesh import PaintedMesh
from svim3d.numerics import normalize
from svim3d.render.view_warps import ViewCorrections
from svim3d.shading.environment import latlong_from_octahedral


@dataclass(frozen=True)
class MaterialViews:
    """V views of one object with materials: what the generator makes.

    Attributes:
        cameras: V poses; all views share field of view and size.
        radiance: scene-linear, premultiplied by `mask`.
        mask: coverage in [0, 1].
        basecolor: linear, straight (not premultiplied); zero where the mask is.
        roughness: perceptual, straight.
        metallic: straight.
        normal_world: unit shading normals, straight.
        reference: index of the view at azimuth 0 that the asset was asked for by.
        depth: distance along the camera's -z axis, zero where nothing is; None where nobody knows.
        confidence: how much each pixel counts: 0 not at all, 1 wholly, as all do where this is
            None; more than 1 beside what is less certain.
    """

    cameras: Cameras
    radiance: Float[Tensor, "V H W 3"]
    mask: Float[Tensor, "V H W 1"]
    basecolor: Float[Tensor, "V H W 3"]
    roughness: Float[Tensor, "V H W 1"]
    metallic: Float[Tensor, "V H W 1"]
    normal_world: Float[Tensor, "V H W 3"]
    reference: int
    depth: Float[Tensor, "V H W 1"] | None = None
    confidence: Float[Tensor, "V H W 1"] | None = None

    def premultiplied(self, longest_px: int) -> tuple[Cameras, dict[str, Tensor]]:
        """What an optimisation compares renders with: images times coverage, cameras to match.

        Where there is `confidence`, it comes with them as it is: a weight for each pixel's losses.

        Args:
            longest_px: larger views are averaged down to at most this size; the whole picture stays
                in view.
        """
        planes = {
            "mask": self.mask,
            "radiance": self.radiance,
            "basecolor": self.basecolor * self.mask,
            "roughness": self.roughness * self.mask,
            "metallic": self.metallic * self.mask,
            "normal_world": normalize(self.normal_world) * self.mask,
            **({} if self.confidence is None else {"confidence": self.confidence}),
        }
        factor = -(-max(self.cameras.height, self.cameras.width) // longest_px)
        height, width = self.cameras.height // factor, self.cameras.width // factor
        if factor > 1:
            planes = {name: _averaged(plane, height, width) for name, plane in planes.items()}
        return self.cameras.resized(height, width), planes

    def save(self, folder: Path) -> None:
        """Write an orbit folder (the exchange format, see README) and a sheet to look at."""
        known = {name: v for name, v in vars(self).items() if isinstance(v, Tensor)}
        write_orbit(folder, self.cameras, known, reference=self.reference)
        write_png(folder / "views.png", orbit_sheet(self.cameras, known))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read an orbit folder."""
        cameras, images, reference = read_orbit(folder)
        return cls(cameras=cameras, reference=reference, **images)

    def headline(self) -> str:
        """Number and size of the views."""
        views, height, width, _ = self.radiance.shape
        return f"{views} views of {width} x {height}"


def _averaged(images: Tensor, height: int, width: int) -> Tensor:
    """Area means of channel-last images."""
    pooled = adaptive_avg_pool2d(images.permute(0, 3, 1, 2), (height, width))
    return pooled.permute(0, 2, 3, 1).contiguous()


@dataclass(frozen=True)
class EnvironmentLight:
    """Radiance from all directions.

    Attributes:
        radiance: octahedral map, linear, non-negative; see `svim3d.shading.octahedral`.
    """

    radiance: Float[Tensor, "N N 3"]

    def save(self, folder: Path) -> None:
        """Write the octahedral map in full precision and a lat-long picture of it."""
        write_rgb(folder / "environment_octahedral.exr", self.radiance.numpy(), half=False)
        write_rgb(folder / "environment.exr", self.latlong().numpy(), half=True)

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read the octahedral map."""
        return cls(torch.from_numpy(read_rgb(folder / "environment_octahedral.exr")))

    def latlong(self) -> Float[Tensor, "H W 3"]:
        """The map as the picture that is written has it, in half floats."""
        height = max(16, self.radiance.shape[0])
        latlong = latlong_from_octahedral(self.radiance, height=height)
        return latlong.clamp_max(MAX_HALF).half().float()

    def headline(self) -> str:
        """Size and mean brightness of the map."""
        return f"{len(self.radiance)} px map, mean radiance {self.radiance.mean():.2f}"


@dataclass(frozen=True)
class FittedField:
    """Phase 1's result: where the surface is, what it is made of, what lights it.

    Attributes:
        sdf: signed distance at the nodes of a cubic grid over [-half_extent, half_extent]^3, index
            order x, y, z; positive inside. A density field is stored as the grid of
            (density - threshold), scaled to about unit gradient at the surface.
        half_extent: half the side of the cube, world units.
        material_spec: shape of the material field.
        material_state: its parameters (`MaterialField.state_dict()`).
        environment: octahedral radiance as optimised with the field.
        corrections: how the views have to be read; None where that was not asked.
    """

    sdf: Float[Tensor, "n n n"]
    half_extent: float
    material_spec: MaterialFieldSpec
    material_state: dict[str, Tensor]
    environment: Float[Tensor, "N N 3"]
    corrections: ViewCorrections | None = None

    def save(self, folder: Path) -> None:
        """Write one safetensors file and a readable spec."""
        tensors = {"sdf": self.sdf, "environment": self.environment}
        tensors |= {} if self.corrections is None else self.corrections.tensors()
        tensors |= {f"material.{name}": value for name, value in self.material_state.items()}
        save_tensors(folder / "field.safetensors", tensors)
        spec = {"half_extent": self.half_extent, "materials": asdict(self.material_spec)}
        (folder / "field.json").write_text(json.dumps(spec, indent=1))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read both files."""
        tensors = load_tensors(folder / "field.safetensors")
        spec = json.loads((folder / "field.json").read_text())
        return cls(
            sdf=tensors.pop("sdf"),
            environment=tensors.pop("environment"),
            corrections=ViewCorrections.taken_from(tensors),
            half_extent=spec["half_extent"],
            material_spec=MaterialFieldSpec(**spec["materials"]),
            material_state={name.removeprefix("material."): t for name, t in tensors.items()},
        )

    def own_surface(self) -> "RefinedSurface":
        """The grid's zero set with phase 1's materials and light: what is there without phase 2.

        It has no faces where the grid has no inside.
        """
        vertices, faces = extract_surface(self.sdf, self.half_extent)
        return RefinedSurface(
            vertices=vertices,
            faces=faces,
            material_spec=self.material_spec,
            material_state=self.material_state,
            environment=self.environment,
            corrections=self.corrections,
        )

    def headline(self) -> str:
        """Resolution of the surface grid."""
        return f"sdf grid of {len(self.sdf)}^3 nodes"


@dataclass(frozen=True)
class RefinedSurface:
    """Phase 2's result: an explicit surface with its own material field and light.

    Attributes:
        vertices: world positions.
        faces: counter-clockwise seen from outside; closed and manifold.
        material_spec: shape of the material field.
        material_state: its parameters, refined from phase 1.
        environment: octahedral radiance.
        corrections: how the views have to be read; None where that was not asked.
    """

    vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    material_spec: MaterialFieldSpec
    material_state: dict[str, Tensor]
    environment: Float[Tensor, "M M 3"]
    corrections: ViewCorrections | None = None

    def save(self, folder: Path) -> None:
        """Write one safetensors file and a readable spec."""
        tensors = {
            "vertices": self.vertices,
            "faces": self.faces,
            "environment": self.environment,
        }
        tensors |= {} if self.corrections is None else self.corrections.tensors()
        tensors |= {f"material.{name}": value for name, value in self.material_state.items()}
        save_tensors(folder / "surface.safetensors", tensors)
        spec = {"materials": asdict(self.material_spec)}
        (folder / "surface.json").write_text(json.dumps(spec, indent=1))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read both files."""
        tensors = load_tensors(folder / "surface.safetensors")
        spec = json.loads((folder / "surface.json").read_text())
        return cls(
            vertices=tensors.pop("vertices"),
            faces=tensors.pop("faces"),
            environment=tensors.pop("environment"),
            corrections=ViewCorrections.taken_from(tensors),
            material_spec=MaterialFieldSpec(**spec["materials"]),
            material_state={name.removeprefix("material."): t for name, t in tensors.items()},
        )

    def material_field(self, device: torch.device) -> MaterialField:
        """The material field with its parameters, on a device, for evaluation."""
        field = MaterialField(self.material_spec)
        field.load_state_dict(self.material_state)
        return field.to(device).requires_grad_(False)

    def headline(self) -> str:
        """Number of triangles."""
        return f"{len(self.faces)} faces"


@dataclass(frozen=True)
class TexturedMesh(PaintedMesh):
    """Phase 3's result, or what stands in for it: a mesh ready for export."""

    def save(self, folder: Path) -> None:
        """Write textures as PNG (basecolor sRGB, 8 bit) and all else as safetensors."""
        tensors = {"vertices": self.vertices, "faces": self.faces, "normals": self.normals}
        for name in ("uv", "tangents", "orm_factor"):
            if getattr(self, name) is not None:
                tensors[name] = getattr(self, name)
        for name, values in (("basecolor", self.basecolor), ("orm", self.orm)):
            if values.ndim == 3:
                write_png(folder / f"{name}.png", values, srgb=name == "basecolor")
            else:
                tensors[name] = values
        if self.normal_tangent is not None:
            write_png(folder / "normal.png", self.normal_tangent * 0.5 + 0.5)
        save_tensors(folder / "mesh.safetensors", tensors)

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote."""
        tensors = load_tensors(folder / "mesh.safetensors")
        for name in ("basecolor", "orm"):
            if name not in tensors:
                tensors[name] = read_png(folder / f"{name}.png", srgb=name == "basecolor")
        normal = None
        if (folder / "normal.png").is_file():
            normal = read_png(folder / "normal.png") * 2.0 - 1.0
        return cls(
            vertices=tensors["vertices"],
            faces=tensors["faces"],
            normals=tensors["normals"],
            uv=tensors.get("uv"),
            tangents=tensors.get("tangents"),
            basecolor=tensors["basecolor"],
            orm=tensors["orm"],
            normal_tangent=normal,
            orm_factor=tensors.get("orm_factor"),
        )

    def headline(self) -> str:
        """Number of triangles and what carries the materials."""
        sizes = [len(image) for image in self.textures.values()]
        paint = f"{max(sizes)} px textures" if sizes else "one material"
        if self.basecolor.ndim == 2:
            paint = "coloured per vertex"
        return f"{len(self.faces)} faces, {paint}"


@dataclass(frozen=True)
class FinishedFiles:
    """Files as their user gets them.

    Attributes:
        files: relative name -> content.
        summary: counts and checks, for the run's table.
    """

    files: dict[str, bytes]
    summary: dict[str, float | int | str | bool]

    def save(self, folder: Path) -> None:
        """Write every file and the summary."""
        for name, content in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        (folder / "summary.json").write_text(json.dumps(self.summary, indent=1))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read them back."""
        return cls(
            files={
                str(f.relative_to(folder)): f.read_bytes()
                for f in sorted(folder.rglob("*"))
                if f.is_file() and f.name != "summary.json"
            },
            summary=json.loads((folder / "summary.json").read_text()),
        )


class ExportedAsset(FinishedFiles):
    """The asset: always `asset.glb`, other formats on request; checked on the reopened file."""

    def headline(self) -> str:
        """Size of the GLB."""
        return f"asset.glb of {len(self.files['asset.glb']) / 2**20:.2f} MiB"


class RelitViews(FinishedFiles):
    """Views under another light.

    `views/` holds per view a multi-layer EXR (scene-linear) and a PNG (as displayed); beside it lie
    the contact sheet, the turntable and, where materials were changed, the record of the edits.
    """

    def headline(self) -> str:
        """How many pictures, of what size."""
        about = self.summary
        turns = f", {about['frames']} turns of the light" if about["frames"] != 1 else ""
        return f"{about['views']} views of {about['width']} x {about['height']}{turns}"
