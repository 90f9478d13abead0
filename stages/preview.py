"""Preview: the finished GLB, reopened and rendered beside the views it was made from.

Reads the views, the light and the exported asset; writes one labelled sheet and the figures of
how well the asset reproduces the views. What is shown went through the file: a fault of the export
shows here. The render knows no shadows and no interreflection, the views may.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from stages.artifacts import ExportedAsset, FittedField, MaterialViews
from stages.base import Context, Stage
from stages.prefilter_cache import cached_operator
from stages.preview_bounds import LEAST_DB, LEAST_OVERLAP, MOST_ANGLE_DEG
from stages.settings.preview import PreviewConfig
from svim3d.color import srgb_from_linear
from svim3d.io.exr import read_rgb
from svim3d.io.glb import read_mesh
from svim3d.io.image import INK, PAPER, Label, read_png, with_labels, write_png
from svim3d.metrics import mean_angle_deg, psnr
from svim3d.render.deferred import environment_shader
from svim3d.render.pictures import render_pictures
from svim3d.shading.environment import latlong_from_octahedral, octahedral_from_latlong
from svim3d.shading.tonemap import agx

LIGHT_FILE = "environment.exr"
MARGIN, LABEL_WIDTH, HEADER = 8, 104, 36  # pixels
TEXT_PX, TITLE_PX = 13, 15
AIR = 1.06  # pictures are cropped to the object and this much around it
MIN_COVERAGE = 0.5  # pixels that the object mostly covers are compared

Images = dict[str, Float[Tensor, "_ _ _ _"]]  # [views, rows, columns, channels]


@dataclass(frozen=True)
class PreviewSheet:
    """A picture to look at and the figures behind it.

    Attributes:
        sheet: display-encoded, in [0, 1].
        figures: dB inside the mask after display encoding, degrees, coverage overlap.
    """

    sheet: Float[Tensor, "H W 3"]
    figures: dict[str, float]

    def save(self, folder: Path) -> None:
        """Write `preview.png` and `metrics.json`."""
        write_png(folder / "preview.png", self.sheet)
        (folder / "metrics.json").write_text(json.dumps(self.figures, indent=1))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read both."""
        figures = json.loads((folder / "metrics.json").read_text())
        return cls(read_png(folder / "preview.png"), figures)

    def headline(self) -> str:
        """How well the asset reproduces the views."""
        return (
            f"basecolor {self.figures['basecolor_psnr_db']:.1f} dB, "
            f"normals {self.figures['normal_angle_deg']:.1f} deg"
        )


def run(
    views: MaterialViews,
    field: FittedField,
    asset: ExportedAsset,
    *,
    config: PreviewConfig,
    ctx: Context,
) -> PreviewSheet:
    """Render the asset in some cameras of the views and lay all out on one sheet."""
    chosen = _chosen_views(len(views.cameras), views.reference, config.views)
    light = _light(field, asset, ctx)
    shader = environment_shader(cached_operator(ctx.shared, light.shape[0])(light))
    file = ctx.work / "asset.glb"
    file.write_bytes(asset.files["asset.glb"])
    rendered = render_pictures(
        read_mesh(file), views.cameras[chosen], shader, supersample=config.supersample
    )
    given = {
        "radiance": views.radiance[chosen],
        "mask": views.mask[chosen],
        "basecolor": views.basecolor[chosen],
        "roughness": views.roughness[chosen],
        "metallic": views.metallic[chosen],
        "normal_world": views.normal_world[chosen],
    }
    figures = compare(rendered, given)
    if doubts := doubts_of(figures):
        ctx.event(
            "views_disagree",
            f"the asset does not show what the views do: {', '.join(doubts)}; they contradict each "
            "other, or hold what it cannot represent",
        )
    return PreviewSheet(_sheet(given, rendered, light, figures, chosen, config), figures)


def _chosen_views(count: int, reference: int, wanted: int) -> list[int]:
    """The reference and others at even steps around the orbit."""
    wanted = min(wanted, count)
    return [(reference + i * count // wanted) % count for i in range(wanted)]


def _light(field: FittedField, asset: ExportedAsset, ctx: Context) -> Float[Tensor, "N N 3"]:
    """The light delivered with the asset, else the one of phase 1."""
    size = field.environment.shape[0]
    if LIGHT_FILE not in asset.files:
        return field.environment
    file = ctx.work / LIGHT_FILE
    file.write_bytes(asset.files[LIGHT_FILE])
    return octahedral_from_latlong(torch.from_numpy(read_rgb(file)), size)


def compare(rendered: Images, given: Images) -> dict[str, float]:
    """Figures of rendered views against given ones, inside the given masks.

    Radiance is compared after AgX, basecolor with the sRGB curve, the rest as it is.
    """
    covered = given["mask"] > MIN_COVERAGE
    also = rendered["mask"] > MIN_COVERAGE
    encoders = {"radiance": agx, "basecolor": srgb_from_linear}
    figures = {
        f"{name}_psnr_db": psnr(encode(rendered[name]), encode(given[name]), covered)
        for name, encode in {
            **encoders,
            "roughness": torch.Tensor.clone,
            "metallic": torch.Tensor.clone,
        }.items()
    }
    normals = rendered["normal_world"], given["normal_world"]
    figures["normal_angle_deg"] = mean_angle_deg(*normals, covered)
    figures["mask_iou"] = float((covered & also).sum() / (covered | also).sum().clamp_min(1))
    return figures


def doubts_of(figures: dict[str, float]) -> list[str]:
    """Figures of `compare` that no asset of sound views has, in words."""
    doubts = [
        f"{name} {figures[f'{name}_psnr_db']:.1f} dB"
        for name, least in LEAST_DB.items()
        if not figures[f"{name}_psnr_db"] >= least
    ]
    if not figures["normal_angle_deg"] <= MOST_ANGLE_DEG:
        doubts.append(f"normals {figures['normal_angle_deg']:.1f} deg")
    if not figures["mask_iou"] >= LEAST_OVERLAP:
        doubts.append(f"outlines overlap by {figures['mask_iou']:.0%}")
    return doubts


def _sheet(
    given: Images,
    rendered: Images,
    light: Float[Tensor, "N N 3"],
    figures: dict[str, float],
    chosen: list[int],
    config: PreviewConfig,
) -> Float[Tensor, "H W 3"]:
    """Rows of pictures with their labels and, below, the light."""
    on_paper = {
        "input": (agx(given["radiance"]), given["mask"]),
        "asset": (agx(rendered["radiance"]), rendered["mask"]),
        "basecolor": (srgb_from_linear(rendered["basecolor"]), rendered["mask"]),
        "roughness": (rendered["roughness"], rendered["mask"]),
        "metallic": (rendered["metallic"], rendered["mask"]),
        "normal": (rendered["normal_world"] * 0.5 + 0.5, rendered["mask"]),
    }
    notes = {
        "asset": f"{figures['radiance_psnr_db']:.1f} dB",
        "basecolor": f"{figures['basecolor_psnr_db']:.1f} dB",
        "roughness": f"{figures['roughness_psnr_db']:.1f} dB",
        "metallic": f"{figures['metallic_psnr_db']:.1f} dB",
        "normal": f"{figures['normal_angle_deg']:.1f} deg",
    }
    step = config.cell + MARGIN
    # A lat-long picture is two cells wide.
    sheet_width = LABEL_WIDTH + max(2, len(chosen)) * step
    sheet = torch.full((HEADER + (len(on_paper) + 1) * step, sheet_width, 3), PAPER)
    window = _window(torch.maximum(given["mask"], rendered["mask"]))
    labels = [
        Label(LABEL_WIDTH + i * step, HEADER // 2, f"view {view}", TEXT_PX)
        for i, view in enumerate(chosen)
    ]
    for row, (name, (pictures, mask)) in enumerate(on_paper.items()):
        y = HEADER + row * step
        cells = _cells(pictures[window], mask[window], config.cell)
        for column, cell in enumerate(cells):
            x = LABEL_WIDTH + column * step
            sheet[y : y + config.cell, x : x + config.cell] = cell
        labels.append(Label(MARGIN, y + config.cell // 2, name, TITLE_PX))
        labels.append(Label(MARGIN, y + config.cell // 2 + 20, notes.get(name, ""), TEXT_PX))
    y = HEADER + len(on_paper) * step
    panorama = agx(latlong_from_octahedral(light, height=config.cell))
    sheet[y : y + config.cell, LABEL_WIDTH : LABEL_WIDTH + 2 * config.cell] = panorama
    labels.append(Label(MARGIN, y + config.cell // 2, "light", TITLE_PX))
    return with_labels(sheet, labels, ink=INK)


def _window(mask: Float[Tensor, "V H W 1"]) -> tuple[slice, slice, slice]:
    """The centred square of all views that holds whatever any of them covers, and some air."""
    _, height, width, _ = mask.shape
    row, column = torch.nonzero(mask.amax((0, 3)) > 0.0).unbind(1)
    reach = max(
        float((row + 0.5 - height / 2).abs().max()), float((column + 0.5 - width / 2).abs().max())
    )
    half = min(math.ceil(reach * AIR), height // 2, width // 2)
    top, left = height // 2 - half, width // 2 - half
    return slice(None), slice(top, top + 2 * half), slice(left, left + 2 * half)


def _cells(
    pictures: Float[Tensor, "V H W C"], mask: Float[Tensor, "V H W 1"], size: int
) -> Float[Tensor, "V size size 3"]:
    """Lay pictures on the sheet's paper and fit them into square cells."""
    colour = pictures.expand(*pictures.shape[:-1], 3)
    laid = PAPER + mask * (colour - PAPER)
    scaled = torch.nn.functional.interpolate(
        laid.permute(0, 3, 1, 2), size=(size, size), mode="bilinear", antialias=True
    )
    return scaled.permute(0, 2, 3, 1)


PREVIEW = Stage(run)
