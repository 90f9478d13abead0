"""The chart as a page: one file with its data, pictures drawn by its own few lines of script.

Any two figures can be laid against each other; points answer to mouse and keyboard. Without
scripts the page shows the drawn picture and the tables.
"""

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flows.chart_front import AXES, COSTS, CPU, QUALITIES, RELIGHT, Axis, State
from flows.chart_table import Summary, conclusions, settings_of, shown_change, shown_level

STYLE = """
:root { color-scheme: light dark; --ink: #1c1f24; --paper: #fff; --line: #c9ced6; --soft: #f3f5f8;
  --front: #0b5cad; --pale: #6b7480; }
@media (prefers-color-scheme: dark) { :root { --ink: #e7eaee; --paper: #15181c; --line: #444b55;
  --soft: #1f242a; --front: #7db8ff; --pale: #9aa3ae; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 76rem; margin: 0 auto; padding: 1rem 1.5rem 4rem; }
form { display: flex; flex-wrap: wrap; gap: .4rem 1.2rem; align-items: center; margin: 1rem 0; }
#chart { width: 100%; height: auto; border: 1px solid var(--line); border-radius: 6px; }
#chart text { fill: var(--ink); font-size: 12px; }
#chart .grid { stroke: var(--line); stroke-width: .6; }
#chart .front { fill: none; stroke: var(--front); stroke-width: 1.5; }
#chart .range { stroke: var(--pale); stroke-width: 1; opacity: .6; }
#chart .point { cursor: pointer; stroke-width: 2; }
#chart .point:focus { outline: none; stroke: var(--ink); stroke-width: 4; }
#told { min-height: 9.5rem; background: var(--soft); border-radius: 6px; padding: .6rem 1rem; }
#told dl { display: grid; grid-template-columns: repeat(auto-fill, minmax(21rem, 1fr));
  margin: .3rem 0; gap: 0 1rem; }
#told div { display: flex; justify-content: space-between; }
#told dd { margin: 0; font-variant-numeric: tabular-nums; }
#told code { overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: .6rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: .15rem .6rem; border-bottom: 1px solid var(--line); text-align: right;
  white-space: nowrap; }
th:first-child, td.text { text-align: left; }
thead th { background: var(--soft); }
th button { all: unset; cursor: pointer; }
th button:focus-visible, select:focus-visible { outline: 2px solid var(--front); }
#legend label { margin-right: .8rem; white-space: nowrap; }
noscript svg { max-width: 100%; height: auto; background: #fff; }
"""

SCRIPT = r"""
const data = JSON.parse(document.getElementById('data').textContent);
const svg = document.getElementById('chart'), told = document.getElementById('told');
const pick = {x: document.getElementById('x'), y: document.getElementById('y')};
const W = 1000, H = 560, M = {l: 78, r: 24, t: 20, b: 52};
const hidden = new Set();
const colour = group => `hsl(${(data.groups.indexOf(group) * 137.5) % 360} 60% 50%)`;
const node = (name, attributes, text) => {
  const made = document.createElementNS('http://www.w3.org/2000/svg', name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
};
const trim = value => String(Number(value.toPrecision(3)));
function ticks(low, high, isLog) {
  const found = [];
  if (isLog) {
    const steps = high / low > 30 ? [1, 2, 5] : [1, 1.5, 2, 3, 4, 5, 7];
    for (let e = Math.floor(Math.log10(low)); e <= Math.log10(high); e++)
      for (const s of steps) found.push(s * 10 ** e);
  } else {
    const raw = (high - low) / 9, power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].find(s => s * power >= raw) * power;
    for (let i = Math.ceil(low / step); i * step <= high; i++) found.push(i * step);
  }
  return found.filter(value => value >= low && value <= high);
}
function scale(axis, values, from, to) {
  const lay = axis.isRatio ? Math.log : (v => v);
  let low = Math.min(...values.map(lay)), high = Math.max(...values.map(lay));
  const air = (high - low || 1) * 0.07;
  low -= air; high += air;
  const back = axis.isRatio ? Math.exp : (v => v);
  const at = v => from + (lay(v) - low) / (high - low) * (to - from);
  return {at, ticks: ticks(back(low), back(high), axis.isRatio)};
}
function draw() {
  const [x, y] = [data.axes[pick.x.value], data.axes[pick.y.value]];
  const points = data.points.filter(p => !hidden.has(p.group));
  svg.replaceChildren();
  if (!points.length) return;
  const ys = points.flatMap(p => [p.mean[y.name], ...p.range[y.name]]);
  // Up is better.
  const ends = y.moreIsBetter ? [H - M.b, M.t] : [M.t, H - M.b];
  const sx = scale(x, points.map(p => p.mean[x.name]), M.l, W - M.r), sy = scale(y, ys, ...ends);
  for (const t of sx.ticks) {
    svg.append(node('line', {class: 'grid', x1: sx.at(t), x2: sx.at(t), y1: M.t, y2: H - M.b}));
    svg.append(node('text', {x: sx.at(t), y: H - M.b + 18, 'text-anchor': 'middle'},
      trim(t * x.scale)));
  }
  for (const t of sy.ticks) {
    svg.append(node('line', {class: 'grid', x1: M.l, x2: W - M.r, y1: sy.at(t), y2: sy.at(t)}));
    svg.append(node('text', {x: M.l - 8, y: sy.at(t) + 4, 'text-anchor': 'end'},
      trim(t * y.scale)));
  }
  svg.append(node('text', {x: (M.l + W - M.r) / 2, y: H - 10, 'text-anchor': 'middle'}, x.title));
  svg.append(node('text', {transform: `translate(18 ${(M.t + H - M.b) / 2}) rotate(-90)`,
    'text-anchor': 'middle'}, y.title));
  const better = (a, b) => y.moreIsBetter ? a > b : a < b;
  const order = [...points].sort((a, b) => a.mean[x.name] - b.mean[x.name]);
  const front = [];
  for (const p of order)
    if (!front.length || better(p.mean[y.name], front.at(-1).mean[y.name])) front.push(p);
  const path = front.map((p, i) => (i ? `H${sx.at(p.mean[x.name])}V` :
    `M${sx.at(p.mean[x.name])} `) + sy.at(p.mean[y.name])).join('') + `H${W - M.r}`;
  svg.append(node('path', {class: 'front', d: path}));
  const taken = [];
  const place = (p, cx, cy) => {
    const width = p.name.length * 6.6;
    for (const [dx, dy] of [[10, -7], [-10 - width, -7], [10, 18], [-10 - width, 18]]) {
      const box = [cx + dx, cy + dy - 11, cx + dx + width, cy + dy + 3];
      if (box[0] < M.l || box[2] > W || taken.some(o => box[0] < o[2] && o[0] < box[2] &&
        box[1] < o[3] && o[1] < box[3])) continue;
      taken.push(box);
      svg.append(node('text', {x: cx + dx, y: cy + dy}, p.name));
      return;
    }
  };
  const isNamed = p => front.includes(p) || p.group === 'presets';
  for (const p of [...order].sort((a, b) => (b.group === 'presets') - (a.group === 'presets')))
    if (isNamed(p)) place(p, sx.at(p.mean[x.name]), sy.at(p.mean[y.name]));
  for (const p of order) {
    const [cx, cy] = [sx.at(p.mean[x.name]), sy.at(p.mean[y.name])], [a, b] = p.range[y.name];
    svg.append(node('line', {class: 'range', x1: cx, x2: cx, y1: sy.at(a), y2: sy.at(b)}));
    const isFront = front.includes(p), hue = colour(p.group);
    const dot = node('circle', {class: 'point', cx, cy, r: p.group === 'presets' ? 8 : 6,
      fill: isFront ? hue : 'var(--paper)', stroke: hue, tabindex: 0, role: 'img',
      'aria-label': `${p.name}: ${x.title} ${p.shown[x.name]}, ${y.title} ${p.shown[y.name]}`});
    dot.append(node('title', {}, `${p.name}: ${p.shown[x.name]}, ${p.shown[y.name]}`));
    for (const event of ['focus', 'mouseenter', 'click'])
      dot.addEventListener(event, () => tell(p));
    svg.append(dot);
  }
}
function tell(p) {
  const line = text => Object.assign(document.createElement('p'), {textContent: text});
  const list = document.createElement('dl');
  for (const axis of Object.values(data.axes)) {
    const row = document.createElement('div');
    row.append(Object.assign(document.createElement('dt'), {textContent: axis.title}),
      Object.assign(document.createElement('dd'),
        {textContent: `${p.shown[axis.name]} (${p.change[axis.name]})`}));
    list.append(row);
  }
  const name = document.createElement('strong');
  name.textContent = p.name;
  const code = document.createElement('code');
  code.textContent = p.settings;
  told.replaceChildren(name, line(`${p.about}; ${p.stands}`), list, code);
}
for (const group of data.groups) {
  const label = document.createElement('label'), box = document.createElement('input');
  box.type = 'checkbox'; box.checked = true;
  box.addEventListener('change', () => {
    box.checked ? hidden.delete(group) : hidden.add(group);
    draw();
  });
  label.style.color = colour(group);
  label.append(box, ` ${group}`);
  document.getElementById('legend').append(label);
}
for (const select of Object.values(pick)) select.addEventListener('change', draw);
document.querySelectorAll('th button').forEach((button, column) => {
  let sign = 1;
  button.addEventListener('click', () => {
    const body = button.closest('table').tBodies[0];
    const of = row => row.cells[column].dataset.value ?? row.cells[column].textContent;
    const rows = [...body.rows].sort((a, b) => sign * (isNaN(of(a)) || isNaN(of(b))
      ? of(a).localeCompare(of(b)) : of(a) - of(b)));
    sign = -sign;
    body.append(...rows);
  });
});
draw();
if (data.points.length) tell(data.points.find(p => p.group === 'presets') ?? data.points[0]);
"""


def write_page(
    summary: Summary,
    rows: Sequence[Mapping[str, Any]],
    told: Sequence[str],
    drawn: bytes,
    file: Path,
) -> None:
    """Write the page.

    Args:
        summary: of all points.
        rows: of its table.
        told: lines on how all was measured.
        drawn: the chart as SVG, for who lets no scripts run.
        file: where to.
    """
    text = json.dumps(page_data(summary, rows)).replace("<", "\\u003c")
    svg = drawn.decode()
    listed = "".join(f"<li>{_marked(line)}</li>" for line in conclusions(summary))
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>Speed against accuracy</title><style>{STYLE}</style></head><body><main>",
        "<h1>Speed against accuracy</h1>",
        *(f"<p>{_marked(line)}</p>" for line in told),
        f'<form aria-label="Axes">{_choice("x", "Cost", COSTS, CPU)}'
        f"{_choice('y', 'Quality', QUALITIES, RELIGHT)}</form>",
        '<svg id="chart" viewBox="0 0 1000 560" role="group" '
        'aria-label="Cost against quality; up and left is better"></svg>',
        '<div id="legend" role="group" aria-label="Groups that are shown"></div>',
        '<section id="told" aria-live="polite" aria-label="The chosen point"></section>',
        f"<noscript>{svg[svg.index('<svg') :]}</noscript>",
        f"<h2>What it comes to</h2><ul>{listed}</ul>",
        f'<h2>All points</h2><div class="wide">{_table(rows)}</div>',
        f'<script type="application/json" id="data">{text}</script>',
        f"<script>{SCRIPT}</script></main></body></html>",
    ]
    file.write_text("\n".join(parts))


def page_data(summary: Summary, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the script draws: axes, groups, and points with all their figures."""
    points = []
    for row in rows:
        name = str(row["point"])
        point = summary.points[name]
        standing = summary.overall[name]
        by = f" by {standing.by}" if standing.state is State.DOMINATED else ""
        means = {axis.name: summary.mean(name, axis) for axis in AXES}
        points.append(
            {
                "name": name,
                "group": point.group,
                "about": point.about,
                "stands": f"all figures together: {standing.state}{by}",
                "settings": settings_of(point),
                "mean": means,
                "range": {axis.name: mean_range(summary, row, axis) for axis in AXES},
                "shown": {axis.name: shown_level(axis, means[axis.name]) for axis in AXES},
                "change": {axis.name: shown_change(axis, row) for axis in AXES},
            }
        )
    axes = {
        axis.name: {
            "name": axis.name,
            "title": axis.title,
            "isRatio": axis.is_ratio,
            "moreIsBetter": axis.more_is_better,
            "scale": axis.scale,
        }
        for axis in AXES
    }
    groups = list(dict.fromkeys(summary.points[str(row["point"])].group for row in rows))
    return {"axes": axes, "groups": sorted(groups), "points": points}


def mean_range(summary: Summary, row: Mapping[str, Any], axis: Axis) -> tuple[float, float]:
    """The interval of a point's difference to the base, laid about the base's mean."""
    name = str(row["point"])
    if f"{axis.name}_change_low" not in row:
        mean = summary.mean(name, axis)
        return mean, mean
    base = summary.mean(summary.base, axis)
    ends = (row[f"{axis.name}_change_low"], row[f"{axis.name}_change_high"])
    low, high = (base * (1.0 + end) if axis.is_ratio else base + end for end in ends)
    return low, high


def _choice(name: str, title: str, axes: Sequence[Axis], chosen: Axis) -> str:
    options = "".join(
        f'<option value="{axis.name}"{" selected" if axis is chosen else ""}>'
        f"{html.escape(axis.title)}</option>"
        for axis in axes
    )
    return f'<label>{title} <select id="{name}">{options}</select></label>'


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """All points; a button in each head orders by its column."""
    titles = ["point", *(axis.title for axis in AXES), "stands"]
    head = "".join(
        f'<th scope="col"><button type="button">{html.escape(t)}</button></th>' for t in titles
    )
    body = []
    for row in rows:
        cells = "".join(
            f'<td data-value="{row[axis.name]}">{shown_level(axis, row[axis.name])}</td>'
            for axis in AXES
        )
        by = f" by {row['overall_by']}" if row["overall"] == State.DOMINATED else ""
        body.append(
            f'<tr><th scope="row">{html.escape(str(row["point"]))}</th>{cells}'
            f'<td class="text">{html.escape(str(row["overall"]) + by)}</td></tr>'
        )
    return (
        "<table><caption>Medians over orbits</caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"
    )


def _marked(line: str) -> str:
    """A line of Markdown's list as HTML: what stands between backquotes is code."""
    pieces = html.escape(line.removeprefix("- ")).split("`")
    return "".join(f"<code>{p}</code>" if i % 2 else p for i, p in enumerate(pieces))
