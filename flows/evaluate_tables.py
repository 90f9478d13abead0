"""From scores of objects to the paper's tables: lines of figures over objects."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import fmean
from typing import Any

AZIMUTH_BINS = 8
ANY_ROW = "(any)"  # of what all rows have in common
DRAWN, ASSET, TRUE = "drawn", "asset", "true views"  # subjects of `stages.table_scores`
REFERENCE, GIVEN, NOVEL, RELIT = "reference", "given", "novel", "relit"
# Name, unit and digits of each figure in a table's head.
HEADS = {
    "rgb_db": ("RGB, dB", 2),
    "rgb_ssim": ("RGB, SSIM", 3),
    "basecolor_db": ("basecolor, dB", 2),
    "basecolor_ssim": ("basecolor, SSIM", 3),
    "rgb_lpips": ("RGB, LPIPS", 3),
    "rgb_st_lpips": ("RGB, ST-LPIPS", 3),
    "basecolor_lpips": ("basecolor, LPIPS", 3),
    "basecolor_st_lpips": ("basecolor, ST-LPIPS", 3),
    "basecolor_scaled_db": ("basecolor scaled, dB", 2),
    "roughness_rmse": ("roughness, RMSE", 3),
    "metallic_rmse": ("metallic, RMSE", 3),
    "normal_deg": ("normals, deg", 1),
    "mask_iou": ("outline, IoU", 3),
    "novel_db": ("novel views, dB", 2),
    "novel_ssim": ("novel, SSIM", 3),
    "relit_db": ("relit, dB", 2),
    "relit_ssim": ("relit, SSIM", 3),
    **{f"novel_{n}lpips": (f"novel, {n.upper().replace('_', '-')}LPIPS", 3) for n in ("", "st_")},
    **{f"relit_{n}lpips": (f"relit, {n.upper().replace('_', '-')}LPIPS", 3) for n in ("", "st_")},
    "apart": ("neighbours apart, basecolor", 3),
    "rgb_apart": ("neighbours apart, RGB", 3),
    "compared": ("of pixels", 2),
    "chamfer": ("Chamfer", 4),
    "f_0.01": ("F at 0.01", 3),
    "f_0.02": ("F at 0.02", 3),
    "f_0.05": ("F at 0.05", 3),
    "f_0.1": ("F at 0.1", 3),
    "normal_consistency": ("normals' consistency", 3),
    "volume_iou": ("volume IoU", 3),
    "cpu_s": ("CPU s", 0),
    "psnr_hdr_db": ("PSNR-H", 2),
    "psnr_ldr_db": ("PSNR-L", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
    "normal": ("normal", 3),
    "depth": ("depth, x 1e3", 2),
    "shape": ("shape, x 2e3", 2),
    "failed": ("failed", 0),
    "frechet_efficientnet": ("Fréchet of EfficientNet-Lite0", 2),
    "fid": ("FID", 1),
    "cmmd": ("CMMD", 3),
    "clip_similarity": ("CLIP-S", 1),
}
MATERIALS = (
    *("basecolor_db", "basecolor_ssim", "basecolor_lpips", "basecolor_st_lpips"),
    "basecolor_scaled_db",
    *("roughness_rmse", "metallic_rmse", "normal_deg", "mask_iou"),
)
UNITS = ("db", "ssim", "lpips", "st_lpips")
AGREEMENT = ("apart", "rgb_apart", "compared")
VIEWS = (
    *(f"rgb_{unit}" for unit in UNITS),
    *(f"basecolor_{unit}" for unit in UNITS),
    *("normal_deg", "mask_iou", *AGREEMENT),
)
IN_3D = tuple(f"{name}_{unit}" for name in ("novel", "relit") for unit in UNITS)
SURFACE = ("chamfer", "f_0.01", "f_0.02", "f_0.05", "f_0.1", "normal_consistency", "volume_iou")
ABLATION = ("novel_db", "relit_db", "basecolor_db", "normal_deg", "chamfer", "cpu_s")

# Figures by object and seed.
Sample = tuple[str, int]
Values = dict[Sample, float]
Page = Mapping[str, Any]
Pages = Mapping[Sample, Page]


@dataclass(frozen=True)
class Line:
    """One line of a table.

    Attributes:
        row: whose settings made the assets.
        subject: what was looked at.
        figures: by name, then by object and seed.
        base: the line of the first row that it is compared with; None for that one.
    """

    row: str
    subject: str
    figures: Mapping[str, Values]
    base: "Line | None" = None


@dataclass(frozen=True)
class Table:
    """A table of lines.

    Attributes:
        name: for files.
        title: for people.
        figures: its columns.
        lines: in order.
        notes: below it.
    """

    name: str
    title: str
    figures: tuple[str, ...]
    lines: tuple[Line, ...]
    notes: tuple[str, ...] = field(default=())


def tables_of(results: Mapping[str, Pages], notes: Mapping[str, Sequence[str]]) -> list[Table]:
    """The tables of means over views that the results have figures for.

    Args:
        results: by row, then by object and seed: what `stages.table_scores` found, and the cost.
        notes: by a table's name.
    """
    makers: dict[str, Callable[[Pages], dict[str, dict[str, Values]]]] = {
        "materials": lambda pages: _by_subject(pages, (REFERENCE,), MATERIALS),
        "views": _several_views,
        "relighting": _in_3d,
        "geometry": lambda pages: {ASSET: _of_pages(pages, SURFACE, lambda p: p["surface"])},
        "ablation": lambda pages: {ASSET: _ablation(pages)} if len(results) > 1 else {},
        "azimuth": _by_azimuth,
    }
    titles = {
        "materials": ("Materials of the single view that was given", MATERIALS),
        "views": ("Several views", VIEWS),
        "relighting": ("Novel views and relighting in 3D", IN_3D),
        "geometry": ("Geometry", SURFACE),
        "ablation": ("Ablation", ABLATION),
        "azimuth": ("Error by azimuth", ("rgb_db", "basecolor_db", "normal_deg")),
    }
    tables = []
    for name, maker in makers.items():
        title, figures = titles[name]
        lines = lines_of({row: maker(pages) for row, pages in results.items()})
        known = tuple(f for f in figures if any(line.figures.get(f) for line in lines))
        if lines and known:
            tables.append(Table(name, title, known, tuple(lines), tuple(notes.get(name, ()))))
    return tables


def lines_of(found: Mapping[str, Mapping[str, Mapping[str, Values]]]) -> list[Line]:
    """Lines of all rows; each is compared with the first row's of the same subject.

    Args:
        found: by row, subject and figure.
    """
    first: dict[str, Line] = {}
    lines = []
    for number, (row, subjects) in enumerate(found.items()):
        for subject, figures in subjects.items():
            if not any(figures.values()):
                continue
            is_true = subject.startswith(TRUE)  # they do not depend on how assets are made
            line = Line(ANY_ROW if is_true else row, subject, figures, first.get(subject))
            if number == 0:
                first[subject] = line
            if number == 0 or not is_true:
                lines.append(line)
    return lines


def _of_pages(
    pages: Pages, names: Iterable[str], part: Callable[[Page], Mapping[str, float]]
) -> dict[str, Values]:
    """Figures of each page's part, by name and object."""
    found: dict[Sample, Mapping[str, float]] = {n: part(page) for n, page in pages.items()}
    return {
        figure: {name: f[figure] for name, f in found.items() if figure in f} for figure in names
    }


def mean_views(
    page: Page, parts: Sequence[str], subject: str, *, wanted: Callable[[Page], bool] | None = None
) -> dict[str, float]:
    """Means over the views of some parts; infinite figures of equal pictures are left out."""
    views = [
        view["figures"]
        for view in page["views"]
        if view["part"] in parts and view["subject"] == subject and (not wanted or wanted(view))
    ]
    names = dict.fromkeys(name for figures in views for name in figures)
    means = {}
    for name in names:
        values = [f[name] for f in views if name in f and math.isfinite(f[name])]
        if values:
            means[name] = fmean(values)
    return means


def _by_subject(
    pages: Pages, parts: Sequence[str], names: Sequence[str]
) -> dict[str, dict[str, Values]]:
    return {
        subject: _of_pages(pages, names, partial(mean_views, parts=parts, subject=subject))
        for subject in (DRAWN, ASSET)
    }


def _several_views(pages: Pages) -> dict[str, dict[str, Values]]:
    """The other training views, and test views that were relit in image space."""
    lines = _by_subject(pages, (GIVEN,), VIEWS)
    for subject in (DRAWN, TRUE):
        agreement = _of_pages(pages, AGREEMENT, partial(_agreement, subject=subject))
        told = {name: values for name, values in agreement.items() if values}
        lines[subject] = lines.get(subject, {}) | told
    for subject in (DRAWN, TRUE):
        lines[f"{subject}, relit in 2.5D"] = _of_pages(
            pages,
            VIEWS[: len(UNITS)],
            partial(mean_views, parts=(RELIT,), subject=subject),
        )
    return lines


def _agreement(page: Page, subject: str) -> Mapping[str, float]:
    found: Mapping[str, float] = page["agreement"].get(subject, {})
    return found


def _in_3d(pages: Pages) -> dict[str, dict[str, Values]]:
    """Test views: under the light that was found, and under true ones."""
    return {
        subject: _of_pages(pages, IN_3D, partial(_test_figures, subject=subject))
        for subject in (ASSET, DRAWN, TRUE)
    }


def _test_figures(page: Page, subject: str) -> dict[str, float]:
    found: dict[str, float] = {}
    for name, part in (("novel", NOVEL), ("relit", RELIT)):
        means = mean_views(page, (part,), subject)
        found |= {
            f"{name}_{unit}": means[f"rgb_{unit}"] for unit in UNITS if f"rgb_{unit}" in means
        }
    return found


def _ablation(pages: Pages) -> dict[str, Values]:
    return _of_pages(pages, ABLATION, main_figures)


def main_figures(page: Page) -> dict[str, float]:
    """Those of an asset that settings and seeds are compared by."""
    novel = mean_views(page, (NOVEL,), ASSET)
    materials = {n: v for n, v in novel.items() if n in ("basecolor_db", "normal_deg")}
    return {**_test_figures(page, ASSET), **materials, **page["surface"], **page["cost"]}


def _by_azimuth(pages: Pages) -> dict[str, dict[str, Values]]:
    """Views by where their camera stands, from the photo's."""
    lines = {}
    width = 360.0 / AZIMUTH_BINS
    for subject in (DRAWN, ASSET):
        for number in range(AZIMUTH_BINS):
            lines[f"{subject}, {number * width:g} deg"] = _of_pages(
                pages,
                ("rgb_db", "basecolor_db", "normal_deg"),
                partial(
                    mean_views,
                    parts=(REFERENCE, GIVEN),
                    subject=subject,
                    wanted=partial(_stands_in, number=number),
                ),
            )
    return lines


def _stands_in(view: Page, number: int) -> bool:
    """Whether a view's camera stands in a bin; bins are centred: the first is the photo's side."""
    width = 360.0 / AZIMUTH_BINS
    return int((view["azimuth_deg"] + 0.5 * width) // width) % AZIMUTH_BINS == number
