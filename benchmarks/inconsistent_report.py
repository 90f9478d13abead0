"""From figures of single cases of inconsistent views to means, intervals, a table, a chart."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from svim3d.metrics.statistics import mean_and_interval, paired

ASSET = "asset"  # the outcome of a case that ended with one


@dataclass(frozen=True)
class Figure:
    """A column of the table."""

    name: str
    title: str
    digits: int


FIGURES = (
    Figure("view_db", "novel views, dB", 1),
    Figure("relight_db", "relit, dB", 1),
    Figure("basecolor_db", "basecolor, dB", 1),
    Figure("normal_deg", "normals, deg", 1),
    Figure("distance", "distance", 4),
)
CHARTED = ("view_db", "relight_db", "basecolor_db", "normal_deg")


@dataclass(frozen=True)
class Case:
    """What was run."""

    orbit: str
    severity: float
    seed: int
    row: str

    @property
    def name(self) -> str:
        """As the results list it."""
        return f"{self.orbit} {self.severity:g} {self.seed} {self.row}"


@dataclass
class Results:
    """Figures by case; of a case without an asset the outcome alone."""

    figures: dict[Case, Mapping[str, float]] = field(default_factory=dict)
    outcomes: dict[Case, str] = field(default_factory=dict)

    def add(self, case: Case, result: Mapping[str, object]) -> None:
        """Take in one case as the results file has it."""
        self.outcomes[case] = str(result["outcome"])
        figures = result.get("figures")
        if isinstance(figures, Mapping):
            self.figures[case] = figures

    def rows(self) -> list[str]:
        """Names of rows in order of appearance."""
        return list(dict.fromkeys(case.row for case in self.outcomes))

    def severities(self) -> list[float]:
        """All severities, rising."""
        return sorted({case.severity for case in self.outcomes})

    def values(self, row: str, severity: float, name: str) -> dict[tuple[str, int], float]:
        """A figure by orbit and seed."""
        return {
            (case.orbit, case.seed): float(figures[name])
            for case, figures in self.figures.items()
            if case.row == row and case.severity == severity and name in figures
        }

    def lost(self, row: str, severity: float) -> tuple[int, int]:
        """Cases of a row that ended without an asset, and all of them."""
        ended = [o for c, o in self.outcomes.items() if (c.row, c.severity) == (row, severity)]
        return sum(o != ASSET for o in ended), len(ended)


def table(results: Results, baseline: str, figures: Iterable[Figure] = FIGURES) -> str:
    """Markdown: means and, in brackets, the difference to a row with its paired interval."""
    columns = list(figures)
    titles = [column.title for column in columns]
    lines = [
        "| severity | row | assets | " + " | ".join(titles) + " |",
        "|" + "---|" * (len(columns) + 3),
    ]
    for severity in results.severities():
        for row in results.rows():
            lost, all_of_them = results.lost(row, severity)
            if not all_of_them:
                continue
            cells = [_cell(results, row, severity, column, baseline) for column in columns]
            counts = f"{all_of_them - lost} of {all_of_them}"
            lines.append(f"| {severity:g} | {row} | {counts} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(results: Results, row: str, severity: float, column: Figure, baseline: str) -> str:
    values = results.values(row, severity, column.name)
    if not values:
        return "-"
    mean, interval = mean_and_interval(values)
    digits = column.digits
    text = f"{mean:.{digits}f}"
    if row == baseline:
        return text if interval is None else f"{text} [{_range(interval, digits)}]"
    differences = paired(values, results.values(baseline, severity, column.name))
    if not differences:
        return text
    mean, interval = mean_and_interval(differences)
    shown = f"{mean:+.{digits + 1}f}"
    if interval is not None:
        shown += f" [{_range(interval, digits + 1)}]"
    return f"{text} ({shown})"


def _range(interval: tuple[float, float], digits: int) -> str:
    return f"{interval[0]:.{digits}f}, {interval[1]:.{digits}f}"


def draw(results: Results, file: Path) -> None:
    """Severity against each charted figure, one line per row, with intervals."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    titles = {figure.name: figure.title for figure in FIGURES}
    figure, panels = pyplot.subplots(
        1, len(CHARTED), figsize=(4.5 * len(CHARTED), 4), layout="constrained"
    )
    for panel, name in zip(panels, CHARTED, strict=True):
        for row in results.rows():
            points = []
            for severity in results.severities():
                values = results.values(row, severity, name)
                if values:
                    points.append((severity, *mean_and_interval(values)))
            if points:
                (line,) = panel.plot([p[0] for p in points], [p[1] for p in points], "o-", ms=4)
                line.set_label(row)
                known = [(s, i) for s, _, i in points if i is not None]
                low, high = ([i[end] for _, i in known] for end in (0, 1))
                panel.fill_between(
                    [s for s, _ in known], low, high, alpha=0.12, color=line.get_color()
                )
        panel.set(xlabel="severity", title=titles[name])
        panel.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    figure.savefig(file, dpi=110)
    pyplot.close(figure)
