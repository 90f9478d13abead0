"""Sheets of generated views beside true ones."""

import torch
from torch import Tensor
from torch.nn import functional

from benchmarks.generator_views import Case, Views
from svim3d.io.image import Label, with_labels

COLUMNS = 8  # azimuths of a sheet
ENLARGE = 2  # of a view: at 64 px details are hard to see
LABEL_PX, GAP_PX, TEXT_PX, TITLE_PX = 104, 4, 12, 18
PAPER, INK = 1.0, 0.15
BACKDROP = (0.72, 0.80, 0.92)  # behind greys, which reach from black to white
TRUTH, OURS = "true", "ours"


def rows_of(views: Views, who: str) -> dict[str, Tensor]:
    """The pictures of views by label, [K, H, W, 3], scalars as grey."""
    pictures = views.pictures()
    backdrop = 1.0 - views.mask
    grey = {
        name: getattr(views, name) * views.mask + backdrop * torch.tensor(BACKDROP)
        for name in ("roughness", "metallic")
    }
    normal = pictures["normal"] + backdrop
    named = {"RGB": views.rgb, "basecolor": views.basecolor, **grey, "normal": normal}
    return {f"{name}, {who}": picture for name, picture in named.items()}


def case_sheet(case: Case, ours: Views, *, compact: bool = False) -> Tensor:
    """One object as rows of pictures, azimuths across.

    Args:
        case: with its truth, if any.
        ours: the generated views.
        compact: only RGB of the truth, rather than all of it beside each row.
    """
    mine = rows_of(ours, OURS)
    if case.truth is None:
        rows = {"input": case.picture[None], **mine}
    elif compact:
        rows = {"RGB, true": case.truth.rgb, **mine}
    else:
        true = rows_of(case.truth, TRUTH)
        rows = {k: v for pair in zip(true.items(), mine.items(), strict=True) for k, v in pair}
    places = chosen_views(len(case.azimuth_deg))
    titles = [f"{float(case.azimuth_deg[place]):.0f}" for place in places]
    return _compose(rows, places, titles, case.name)


def chosen_views(frames: int) -> list[int]:
    """The reference first, then even steps around."""
    return [(frames - 1 + round(frames * i / COLUMNS)) % frames for i in range(COLUMNS)]


def stack_sheets(sheets: list[Tensor]) -> Tensor:
    """Sheets of equal width below each other."""
    return torch.cat(sheets)


def _compose(rows: dict[str, Tensor], places: list[int], titles: list[str], name: str) -> Tensor:
    side = ENLARGE * next(iter(rows.values())).shape[1]
    step = side + GAP_PX
    canvas = torch.full((TITLE_PX + len(rows) * step, LABEL_PX + len(places) * step, 3), PAPER)
    labels = [Label(GAP_PX, TITLE_PX // 2, name[:20], TEXT_PX)]
    labels += [
        Label(LABEL_PX + i * step + side // 2 - 8, TITLE_PX // 2, f"{title}°", TEXT_PX)
        for i, title in enumerate(titles)
    ]
    for j, (label, pictures) in enumerate(rows.items()):
        top = TITLE_PX + j * step
        labels.append(Label(GAP_PX, top + side // 2, label, TEXT_PX))
        shown = pictures if len(pictures) == 1 else pictures[places]
        for i, picture in enumerate(_enlarged(shown)):
            left = LABEL_PX + i * step
            canvas[top : top + side, left : left + side] = picture
    return with_labels(canvas, labels, ink=INK)


def _enlarged(pictures: Tensor) -> Tensor:
    """Larger by cubic interpolation: squares would distract from shapes."""
    larger = functional.interpolate(
        pictures.movedim(-1, 1), scale_factor=ENLARGE, mode="bicubic", align_corners=False
    )
    return larger.clamp(0.0, 1.0).movedim(1, -1)
