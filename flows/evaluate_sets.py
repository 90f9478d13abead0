"""Tables over whole suites and over seeds: pictures as sets, and how far samples differ."""

from collections.abc import Mapping
from pathlib import Path

from flows.evaluate_tables import (
    ASSET,
    Page,
    Sample,
    Table,
    Values,
    lines_of,
    main_figures,
)

SET_FIGURES = ("frechet_efficientnet", "fid", "cmmd", "clip_similarity")
SAMPLE_FIGURES = ("novel_db", "relit_db", "basecolor_db", "normal_deg", "chamfer")
LESS_IS_BETTER = ("normal_deg", "chamfer")
ALL_OBJECTS = "(all)"

Results = Mapping[str, Mapping[Sample, Page]]


def sets_table(results: Results) -> Table | None:
    """Distances of all objects' pictures from the true ones; None without networks.

    Rows are compared by the objects that all of them have, so that all sets are of one size.
    """
    from stages.set_figures import set_figures

    common = sorted(set.intersection(*(set(pages) for pages in results.values())))
    found: dict[str, dict[str, dict[str, Values]]] = {}  # by row, subject and figure
    for row, pages in results.items():
        for seed in sorted({seed for _, seed in common}):
            folders = [Path(pages[s]["folder"]) for s in common if s[1] == seed]
            for subject, figures in set_figures(folders).items():
                held = found.setdefault(row, {}).setdefault(subject, {})
                for name, value in figures.items():
                    held.setdefault(name, {})[ALL_OBJECTS, seed] = value
    lines = lines_of(found)
    known = tuple(f for f in SET_FIGURES if any(line.figures.get(f) for line in lines))
    if not known:
        return None
    objects = len({name for name, _ in common})
    note = (
        f"All views but the photo's of {objects} objects that every row has, on white, against the "
        "true pictures of the same cameras; with several seeds the mean over their sets. Few "
        "pictures lift a Fréchet distance: compare sets of equal size only."
    )
    return Table("sets", "Pictures as sets", known, tuple(lines), (note,))


def samples_table(results: Results) -> Table | None:
    """Mean, best and deviation over seeds; None where each object has but one."""
    from stages.score_summary import over_seeds

    found: dict[str, dict[str, dict[str, Values]]] = {}  # by row, subject and figure
    for row, pages in results.items():
        figures = {sample: main_figures(page) for sample, page in pages.items()}
        held = found.setdefault(row, {})
        for figure in SAMPLE_FIGURES:
            values = {s: f[figure] for s, f in figures.items() if figure in f}
            summaries = over_seeds(values, is_better_high=figure not in LESS_IS_BETTER)
            for name, one in summaries.items():
                if one.count < 2:
                    continue
                parts = {"mean": one.mean, f"best of {one.count}": one.best, "deviation": one.std}
                for part, value in parts.items():
                    told = held.setdefault(f"{ASSET}, {part}", {})
                    told.setdefault(figure, {})[name, 0] = value
    lines = lines_of(found)
    if not lines:
        return None
    known = tuple(f for f in SAMPLE_FIGURES if any(line.figures.get(f) for line in lines))
    note = (
        "Of each object's seeds, then the mean over objects. Compare methods by the mean: the best "
        "rises with the number of samples even if nothing improves."
    )
    return Table("samples", "Samples", known, tuple(lines), (note,))
