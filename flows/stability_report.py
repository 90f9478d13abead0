"""The report of the stability suite: one HTML file that needs no other, and no script."""

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from flows.stability_cases import OURS
from flows.stability_table import (
    FORBIDDEN,
    Judged,
    Row,
    Verdict,
    breakdowns,
    cells,
    confusion,
)

STYLE = """
:root { color-scheme: light dark; --ink: #1c1f24; --paper: #fff; --line: #c9ced6; --soft: #f3f5f8;
  --bad: #b3261e; --ours: #0b5cad; --plain: #a35200; }
@media (prefers-color-scheme: dark) { :root { --ink: #e7eaee; --paper: #15181c; --line: #444b55;
  --soft: #1f242a; --bad: #ff8a80; --ours: #7db8ff; --plain: #ffb870; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 76rem; margin: 0 auto; padding: 1rem 1.5rem 4rem; }
h2 { margin: 2.5rem 0 .2rem; border-top: 1px solid var(--line); padding-top: 1rem; }
table { border-collapse: collapse; margin: .6rem 0; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: .2rem 0; }
th, td { padding: .15rem .6rem; border-bottom: 1px solid var(--line); text-align: right; }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
thead th { background: var(--soft); }
.bad { color: var(--bad); font-weight: 600; }
.wide { overflow-x: auto; }
figure { display: inline-block; margin: .4rem 1rem .4rem 0; vertical-align: top; }
figcaption { font-size: 13px; max-width: 36rem; }
img { display: block; max-width: 100%; }
svg text { font-size: 11px; fill: var(--ink); }
nav ul { columns: 4; padding-left: 1.2rem; }
"""
HEAD = (
    *("severity", "way", "cases", "failed", "95 %", "p5", "p50", "p95", "worst 10 %"),
    *("asset", "noted", "error", "forbidden"),
)
CHART = (300, 150, 34)  # width, height and margin, pixels
MOST_NOTES = 4  # different ones are shown of a severity


def write_page(
    judged: Sequence[Judged],
    rows: Sequence[Row],
    about: Mapping[str, tuple[str, str]],
    told: Sequence[str],
    file: Path,
) -> None:
    """Write the report.

    Args:
        judged: all cases.
        rows: the same, grouped.
        about: what each hazard is, and what its severities count.
        told: lines on how all was measured.
        file: where to.
    """
    hazards = list(dict.fromkeys(row.hazard for row in rows))
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>Stability</title><style>{STYLE}</style></head><body><main>",
        "<h1>Stability where methods fail</h1>",
        *(f"<p>{html.escape(line)}</p>" for line in told),
        _summary(judged),
        _contents(hazards),
        *(_section(name, rows, about[name]) for name in hazards),
        "</main></body></html>",
    ]
    file.write_text("\n".join(part for part in parts if part))


def _summary(judged: Sequence[Judged]) -> str:
    """How many cases came to what, by way; and those that must not be."""
    ways = list(dict.fromkeys(one.case.way for one in judged))
    body = []
    for verdict in Verdict:
        counts = [sum(o.case.way == w and o.verdict is verdict for o in judged) for w in ways]
        style = ' class="bad"' if verdict in FORBIDDEN and any(counts) else ""
        numbers = "".join(f"<td{style}>{count}</td>" for count in counts)
        body.append(f'<tr><th scope="row" class="text">{verdict}</th>{numbers}</tr>')
    head = "".join(f'<th scope="col">{html.escape(way)}</th>' for way in ways)
    table = (
        "<table><caption>What the cases came to</caption><thead><tr><th scope='col' class='text'>"
        f"outcome</th>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"
    )
    wrong = [one for one in judged if one.verdict in FORBIDDEN and one.case.way == OURS]
    if not wrong:
        return table
    listed = "".join(
        f'<li class="bad">{html.escape(one.case.name)}: {one.verdict}'
        f"{html.escape(_reason(one))}</li>"
        for one in wrong
    )
    return f"{table}<p>Must not be:</p><ul>{listed}</ul>"


def _reason(one: Judged) -> str:
    if error := str(one.result.get("error", "")):
        return f", {error.strip().splitlines()[-1][:200]}"
    return f", {one.lost_db:.1f} dB lost" if math.isfinite(one.lost_db) else ""


def _contents(hazards: Iterable[str]) -> str:
    items = "".join(f'<li><a href="#{name}">{name}</a></li>' for name in hazards)
    return f'<nav aria-label="Hazards"><ul>{items}</ul></nav>'


def _section(name: str, rows: Sequence[Row], about: tuple[str, str]) -> str:
    """A hazard: its tables, curves and pictures."""
    own = [row for row in rows if row.hazard == name]
    breaks = breakdowns(own)
    parts = [
        f'<section id="{name}"><h2>{name}</h2>',
        f"<p>{html.escape(about[0])} (severity: {html.escape(about[1])}).</p>",
    ]
    for variant in dict.fromkeys(row.variant for row in own):
        chosen = [row for row in own if row.variant == variant]
        parts.append(_table(variant or name, chosen, breaks))
        if len({row.severity for row in chosen}) > 1 and any(row.scores for row in chosen):
            parts.append(_chart(variant or name, chosen))
        parts.append(_pictures(chosen))
    if name == "gloss-or-metal":
        parts.append(_confusion([one for row in own for one in row.cases]))
    return "\n".join([*parts, "</section>"])


def _table(title: str, rows: Sequence[Row], breaks: Mapping[tuple[str, str, str], object]) -> str:
    """All severities, one way after the other."""
    body = []
    for row in rows:
        page = cells(row, None)
        bad = ' class="bad"' if page["forbidden"] else ""
        body.append(
            f'<tr><th scope="row">{row.severity:g}</th><td class="text">{row.way}</td>'
            f"<td>{page['cases']}</td><td>{page['rate']:.0%}</td>"
            f"<td>{page['low']:.0%} to {page['high']:.0%}</td>"
            + "".join(
                f"<td>{_decibels(page[c])}</td>"
                for c in ("p5_db", "p50_db", "p95_db", "worst_tenth_db")
            )
            + f"<td>{page['assets']}</td><td>{page['noted']}</td><td>{page['refused']}</td>"
            f"<td{bad}>{page['forbidden']}</td></tr>"
        )
    head = "".join(f'<th scope="col">{title}</th>' for title in HEAD)
    ways = dict.fromkeys((row.hazard, row.variant, row.way) for row in rows)
    at = ", ".join(
        f"{way[2]}: {'none' if breaks[way] is None else f'{breaks[way]:g}'}" for way in ways
    )
    caption = f"{html.escape(title)}; breaks down at {at}; p5 to worst tenth in dB"
    return (
        f'<div class="wide"><table><caption>{caption}</caption><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _decibels(value: float) -> str:
    return f"{value:.1f}" if math.isfinite(value) else "-"


def _chart(title: str, rows: Sequence[Row]) -> str:
    """Median score over severity, a line for each way."""
    width, height, margin = CHART
    severities = sorted({row.severity for row in rows})
    scores = [score for row in rows for score in row.scores]
    low, high = math.floor(min(scores)) - 1, math.ceil(max(scores)) + 1

    def x(severity: float) -> float:
        place = severities.index(severity) / (len(severities) - 1)
        return margin + place * (width - 1.5 * margin)

    def y(score: float) -> float:
        return height - margin * 0.7 - (score - low) / (high - low) * (height - margin)

    lines = []
    for way in dict.fromkeys(row.way for row in rows):
        points = [
            (x(row.severity), y(cells(row, None)["p50_db"]))
            for row in rows
            if row.way == way and row.scores
        ]
        colour = f"var(--{'ours' if way == OURS else 'plain'})"
        dash = "" if way == OURS else ' stroke-dasharray="5 3"'
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
        lines.append(f'<polyline points="{path}" fill="none" stroke="{colour}"{dash}/>')
        lines += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{colour}"/>' for a, b in points]
    axis = "".join(
        f'<text x="{x(s):.1f}" y="{height - 6}" text-anchor="middle">{s:g}</text>'
        for s in severities
    )
    scale = "".join(f'<text x="2" y="{y(v) + 4:.1f}">{v}</text>' for v in (low, high))
    label = html.escape(f"Median score in dB over severity: {title}")
    return (
        f'<figure><svg role="img" aria-label="{label}" width="{width}" height="{height}">'
        f"{''.join(lines)}{axis}{scale}</svg><figcaption>dB over severity; ours drawn through, "
        "plain dashed</figcaption></figure>"
    )


def _pictures(rows: Sequence[Row]) -> str:
    """Of each severity the first seed, with what was told."""
    figures = []
    for row in rows:
        first = row.cases[0]
        said = list(dict.fromkeys(first.notes))
        error = str(first.result.get("error", "")).strip()
        words = "; ".join([*said[:MOST_NOTES], *([error.splitlines()[-1]] if error else [])])
        about = f"severity {row.severity:g}, {row.way}: {first.verdict}"
        text = html.escape(f"{about}. {words}" if words else about)
        strip = first.result.get("strip")
        if strip:
            alt = html.escape(
                f"{row.hazard} {row.variant} {about}: two given views, then twice "
                "truth beside asset"
            )
            figures.append(
                f'<figure><img alt="{alt}" src="data:image/jpeg;base64,{strip}">'
                f"<figcaption>{text}</figcaption></figure>"
            )
        elif words:
            figures.append(f"<p>{text}</p>")
    return "".join(figures)


def _confusion(judged: Sequence[Judged]) -> str:
    """What plastic and metal came out as."""
    counts = confusion([one for one in judged if one.case.way == OURS])
    names = {False: "plastic", True: "metal"}
    body = "".join(
        f'<tr><th scope="row" class="text">{names[was]}</th>'
        f"<td>{counts[was, False]}</td><td>{counts[was, True]}</td></tr>"
        for was in names
    )
    return (
        "<table><caption>What each was, and came out as, over all severities</caption><thead><tr>"
        '<th scope="col" class="text">was</th><th scope="col">plastic</th>'
        f'<th scope="col">metal</th></tr></thead><tbody>{body}</tbody></table>'
    )
