"""What the generator is judged by: views as they are displayed, and where true ones come from.

All colours are sRGB over white, normals those of the camera, everything at the model's size.
"""

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from stages.base import Context
from stages.prepare import PREPARE
from stages.settings.prepare import PrepareConfig
from svim3d.cameras import orbit_angles
from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.diffusion.groups import SMALLEST_COVERAGE, GeneratedViews, without_background
from svim3d.io.image import read_png
from svim3d.io.orbit import read_orbit
from svim3d.io.training_data import read_example
from svim3d.numerics import normalize

COVERED = 0.5  # coverage above which a pixel shows the object
FILL, BORDER = 0.9, 0.96  # training's framing: of the reference view, and of all views
FOV_DEG = 33.8  # assumed of photos
PHOTO_OVERSIZE = 4  # photos are cut out at this multiple of the model's size
PHOTO_ELEVATION_DEG = 10.0  # assumed: the elevation at which SV3D stands unless told


@dataclass(frozen=True)
class Views:
    """K views, channel last, [K, H, W, C].

    Attributes:
        rgb: over white, display-referred.
        basecolor: over white, sRGB.
        roughness: straight.
        metallic: straight.
        normal: of the camera, unit, zero where nothing is.
        mask: coverage.
    """

    rgb: Tensor
    basecolor: Tensor
    roughness: Tensor
    metallic: Tensor
    normal: Tensor
    mask: Tensor

    @classmethod
    def of_pictures(cls, pictures: dict[str, Tensor], mask: Tensor) -> "Views":
        """From the four pictures of a clip in [0, 1], colours over white, the rest over black."""
        seen = (mask > 0.0).to(mask)
        orm = without_background(pictures["orm"], mask, 0.0) * seen
        normal = normalize(2.0 * without_background(pictures["normal"], mask, 0.0) - 1.0)
        return cls(
            pictures["rgb"],
            pictures["basecolor"],
            orm[..., 1:2],
            orm[..., 2:3],
            normal * seen,
            mask,
        )

    @classmethod
    def of_generated(cls, views: GeneratedViews) -> "Views":
        """As they would be displayed over white."""
        return cls(
            over_white(srgb_from_linear(views.rgb_linear), views.mask),
            over_white(srgb_from_linear(views.basecolor), views.mask),
            views.roughness,
            views.metallic,
            views.normal_camera,
            views.mask,
        )

    def pictures(self) -> dict[str, Tensor]:
        """The four pictures that an autoencoder sees, in [0, 1]."""
        nothing = torch.zeros_like(self.mask)
        orm = torch.cat([nothing, self.roughness, self.metallic], -1) * self.mask
        normal = (self.normal + 1.0) / 2.0 * self.mask
        return {"rgb": self.rgb, "basecolor": self.basecolor, "orm": orm, "normal": normal}


@dataclass(frozen=True)
class Case:
    """One object: what the generator gets, and the truth where it is known.

    Attributes:
        name: for people.
        picture: the reference view over white, display-referred, [H, W, 3].
        mask: its coverage, [H, W, 1].
        elevation_deg: of all cameras, the reference last.
        azimuth_deg: likewise; the reference's is 0.
        fov_deg: of all cameras.
        truth: None for a photo.
        has_materials: whether the true materials are worth comparing with.
    """

    name: str
    picture: Tensor
    mask: Tensor
    elevation_deg: Tensor
    azimuth_deg: Tensor
    fov_deg: float
    truth: Views | None
    has_materials: bool = True


def over_white(straight: Tensor, mask: Tensor) -> Tensor:
    """Straight display-referred colour over white."""
    return straight * mask + (1.0 - mask)


def window_weights(inside: int, outside: int, start: float, length: float) -> Tensor:
    """Exact area resampling of one axis as a matrix [outside, inside].

    Args:
        inside: pixels of the source.
        outside: pixels of the result, which span the window.
        start: where the window begins, in source pixels; parts beyond the source count as zero.
        length: of the window.
    """
    step = length / outside
    low = start + step * torch.arange(outside, dtype=torch.float64)[:, None]
    edge = torch.arange(inside, dtype=torch.float64)[None]
    overlap = torch.minimum(low + step, edge + 1.0) - torch.maximum(low, edge)
    return (overlap.clamp(min=0.0) / step).float()


def resample(pictures: Tensor, size: int, zoom: float = 1.0) -> Tensor:
    """Area-resample [..., H, W, C], whose outside is zero, zoomed about the picture's centre."""
    side = pictures.shape[-2]
    length = side / zoom
    weights = window_weights(side, size, (side - length) / 2.0, length)
    rows = torch.einsum("ai,...ijc->...ajc", weights, pictures)
    return torch.einsum("bj,...ajc->...abc", weights, rows)


def read_case(file: Path, size: int, light: int) -> Case:
    """A training example as a case, under one of its lights."""
    stored = read_example(file)
    planes = {
        name: getattr(stored, name).float() / 255.0
        for name in ("basecolor", "orm", "normal", "mask")
    }
    planes["rgb"] = stored.rgb[light % len(stored.rgb)].float() / 255.0
    if planes["mask"].shape[-2] != size:
        planes = {name: resample(plane, size) for name, plane in planes.items()}
    truth = Views.of_pictures(planes, planes["mask"])
    return Case(
        name=f"{file.stem} {stored.metadata['name']}",
        picture=truth.rgb[-1],
        mask=truth.mask[-1],
        elevation_deg=stored.elevation_deg,
        azimuth_deg=stored.azimuth_deg,
        fov_deg=float(stored.metadata["fov_deg"]),
        truth=truth,
        has_materials=stored.metadata["quality"] != "low",
    )


def example_files(folder: Path) -> list[Path]:
    """All examples of a folder, in the order of their names.

    Raises:
        ValueError: there are none.
    """
    files = sorted(folder.rglob("*.safetensors"))
    if not files:
        raise ValueError(f"wanted rendered examples (*.safetensors), {folder} holds none")
    return files


def read_examples(folder: Path, size: int, limit: int | None = None) -> Iterator[Case]:
    """Cases of a folder one at a time; lights take turns. A limit spreads over all files."""
    files = example_files(folder)
    count = len(files) if limit is None else min(limit, len(files))
    for index in range(count):
        yield read_case(files[index * len(files) // count], size, light=index)


def framing_zoom(mask: Tensor) -> float:
    """Zoom about the picture's centre that brings an orbit to the framing of training.

    The reference view's longer side takes `FILL` of the picture, or less where another view would
    leave `BORDER`. Training moves the camera instead, so perspective differs a little.
    """
    side = mask.shape[-2]
    covered = mask[..., 0] > COVERED

    def span(line: Tensor) -> tuple[float, float]:
        where = torch.nonzero(line)[:, 0]
        return float(where.min()) - side / 2.0, float(where.max()) + 1.0 - side / 2.0

    reference = [span(covered[-1].any(axis)) for axis in (0, 1)]
    farthest = max(abs(v) for axis in (1, 2) for v in span(covered.any(axis).any(0)))
    fill = FILL * side / max(high - low for low, high in reference)
    return min(fill, BORDER * side / 2.0 / farthest)


def read_orbit_case(folder: Path, size: int) -> Case:
    """A path-traced orbit, its reference picture zoomed by the same similarity as the truth."""
    cameras, images, reference = read_orbit(folder, "train")
    told = json.loads((folder / "orbit.json").read_text())["reference"]
    order = [*range(reference + 1, len(cameras)), *range(reference + 1)]
    x, y, z = cameras.positions[order].unbind(-1)
    azimuth_deg = torch.rad2deg(torch.atan2(x, z)).remainder(360.0)
    elevation_deg = torch.rad2deg(torch.atan2(y, torch.hypot(x, z)))
    coverage = images["mask"][order]
    zoom = framing_zoom(coverage)
    mask = resample(coverage, size, zoom)

    def straight(premultiplied: Tensor) -> Tensor:
        return resample(premultiplied, size, zoom) / mask.clamp(min=SMALLEST_COVERAGE)

    rgb = srgb_from_linear(straight(images["radiance"][order] * told["exposure"]))
    basecolor = srgb_from_linear(straight(images["basecolor"][order] * coverage))
    world = images["normal_world"][order] * coverage
    camera = torch.einsum("kji,khwj->khwi", cameras.c2w[order, :3, :3], world)
    seen = (mask > 0.0).to(mask)
    truth = Views(
        rgb=over_white(rgb, mask),
        basecolor=over_white(basecolor, mask),
        roughness=straight(images["roughness"][order] * coverage) * seen,
        metallic=straight(images["metallic"][order] * coverage) * seen,
        normal=normalize(resample(camera, size, zoom)) * seen,
        mask=mask,
    )
    picture, mask = read_cut_out(folder / told["file"], size, zoom)
    angles = (elevation_deg, azimuth_deg.where(azimuth_deg < 359.99, torch.zeros(())))
    return Case(folder.name, picture, mask, *angles, cameras.fov_y_deg, truth)


def read_cut_out(file: Path, size: int, zoom: float) -> tuple[Tensor, Tensor]:
    """A picture with opacity, zoomed: over white, and its coverage."""
    stored = read_png(file)
    return shrink_cut_out(stored[..., :3], stored[..., 3:], size, zoom)


def shrink_cut_out(
    straight: Tensor, coverage: Tensor, size: int, zoom: float = 1.0
) -> tuple[Tensor, Tensor]:
    """A display-referred picture resampled in linear light: over white, and its coverage."""
    mask = resample(coverage, size, zoom)
    light = resample(linear_from_srgb(straight) * coverage, size, zoom)
    shown = srgb_from_linear(light / mask.clamp(min=SMALLEST_COVERAGE))
    return over_white(shown, mask), mask


def read_photo_case(file: Path, size: int, views: int, network: Path | None) -> Case:
    """A photo as the prepare stage cuts it out, asked for all around at one elevation."""
    config = PrepareConfig(size=size * PHOTO_OVERSIZE, network=network)
    cpu = torch.device("cpu")
    with (
        tempfile.TemporaryDirectory() as work,
        Context("prepare", cpu, 0, Path(work), Path(work)) as ctx,
    ):
        prepared = PREPARE.run(file, config=config, ctx=ctx)
    picture, mask = shrink_cut_out(prepared.rgb, prepared.mask, size)
    elevation, azimuth = torch.tensor(orbit_angles(views, PHOTO_ELEVATION_DEG, 0.0)).unbind(-1)
    return Case(file.stem, picture, mask, elevation, azimuth, FOV_DEG, truth=None)
