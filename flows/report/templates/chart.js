// Without this script the drawn picture and the tables are shown.
const data = JSON.parse(document.getElementById("data").textContent);
document.documentElement.classList.add("live");

const PRESETS = "presets";
const EDGE = { left: 72, right: 16, top: 16, bottom: 48 };
const ROOM = { x: 56, y: 32 }; // pixels between labels of an axis, at least
const LETTER = 6.6; // width of a name's letter, about
const [chart, legend, told] = ["chart", "legend", "told"].map(id => document.getElementById(id));
const selects = ["x", "y"].map(id => document.getElementById(id));
const hidden = new Set();

const colour = group => `hsl(${(data.groups.indexOf(group) * 137.5) % 360} 60% 50%)`;
const label = value => String(Number(value.toPrecision(6)));
const element = (name, content = "") =>
  Object.assign(document.createElement(name), { textContent: content });
const draw = (name, attributes, content = "", parent = chart) => {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = content;
  parent.append(made);
  return made;
};

const decades = (digits, low, high) => {
  const found = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++)
    for (const digit of digits) found.push(digit * 10 ** power);
  return found.filter(value => value >= low && value <= high);
};
const multiples = (step, low, high) => {
  const found = [];
  for (let i = Math.ceil(low / step); i * step <= high; i++) found.push(i * step);
  return found;
};
/** Round values between the ends, about as many as have room. */
const ticks = (low, high, most, isRatio) => {
  const unit = 10 ** Math.floor(Math.log10((high - low) / most));
  const sets = isRatio && high / low > 4
    ? [[1, 1.5, 2, 3, 4, 5, 7], [1, 2, 5], [1, 3], [1]].map(digits => decades(digits, low, high))
    : [1, 2, 5, 10].map(digit => multiples(digit * unit, low, high));
  return sets.find(values => values.length <= most) ?? sets.at(-1);
};

/** Where an axis' values lie in the picture, and which are labelled. */
const scale = (axis, values, from, to, room) => {
  const [lay, back] = axis.isRatio ? [Math.log, Math.exp] : [v => v, v => v];
  const laid = values.map(lay);
  const air = 0.07 * (Math.max(...laid) - Math.min(...laid) || 1);
  const low = Math.min(...laid) - air, high = Math.max(...laid) + air;
  const at = value => from + (lay(value) - low) / (high - low) * (to - from);
  const most = Math.max(2, Math.floor(Math.abs(to - from) / room));
  return { at, ticks: ticks(back(low), back(high), most, axis.isRatio) };
};

const drawAxes = (x, y, sx, sy, width, height) => {
  const right = width - EDGE.right, bottom = height - EDGE.bottom;
  for (const tick of sx.ticks) {
    const at = sx.at(tick);
    draw("line", { class: "grid", x1: at, x2: at, y1: EDGE.top, y2: bottom });
    draw("text", { x: at, y: bottom + 18, "text-anchor": "middle" }, label(tick * x.scale));
  }
  for (const tick of sy.ticks) {
    const at = sy.at(tick);
    draw("line", { class: "grid", x1: EDGE.left, x2: right, y1: at, y2: at });
    draw("text", { x: EDGE.left - 8, y: at + 4, "text-anchor": "end" }, label(tick * y.scale));
  }
  const middle = { x: (EDGE.left + right) / 2, y: (EDGE.top + bottom) / 2 };
  draw("text", { x: middle.x, y: height - 8, "text-anchor": "middle" }, x.title);
  const turned = `translate(16 ${middle.y}) rotate(-90)`;
  draw("text", { transform: turned, "text-anchor": "middle" }, y.title);
};

/** Names beside their points, where there is room among all of them. */
const drawNames = (named, spots, width) => {
  const taken = spots.map(({ cx, cy }) => [cx - 6, cy - 6, cx + 6, cy + 6]);
  for (const { point, cx, cy } of named) {
    const wide = point.name.length * LETTER;
    for (const [dx, dy] of [[10, -7], [-10 - wide, -7], [10, 18], [-10 - wide, 18]]) {
      const box = [cx + dx, cy + dy - 11, cx + dx + wide, cy + dy + 3];
      const meets = o => box[0] < o[2] && o[0] < box[2] && box[1] < o[3] && o[1] < box[3];
      if (box[0] < EDGE.left || box[2] > width || taken.some(meets)) continue;
      taken.push(box);
      draw("text", { class: "name", x: cx + dx, y: cy + dy }, point.name);
      break;
    }
  }
};

const drawPoint = ({ point, cx, cy }, x, y, sy, isFront) => {
  const [y1, y2] = point.range[y.name].map(sy.at);
  draw("line", { class: "range", x1: cx, x2: cx, y1, y2 });
  const said = [x, y].map(axis => `${axis.title} ${point.shown[axis.name]}`).join(", ");
  const dot = draw("circle", {
    class: "point", cx, cy, r: point.group === PRESETS ? 8 : 6, stroke: colour(point.group),
    fill: isFront ? colour(point.group) : "var(--paper)", tabindex: 0, role: "img",
    "aria-label": `${point.name}: ${said}`,
  });
  draw("title", {}, `${point.name}: ${said}`, dot);
  for (const event of ["focus", "mouseenter", "click"])
    dot.addEventListener(event, () => tell(point));
};

const drawAll = () => {
  const [x, y] = selects.map(select => data.axes.find(axis => axis.name === select.value));
  const points = data.points.filter(point => !hidden.has(point.group));
  const width = chart.getBoundingClientRect().width;
  const height = Math.min(560, Math.max(360, 0.56 * width));
  chart.setAttribute("viewBox", `0 0 ${width} ${height}`);
  chart.replaceChildren();
  if (!points.length) return;
  const ends = [height - EDGE.bottom, EDGE.top]; // up is better
  const sx = scale(x, points.map(p => p.mean[x.name]), EDGE.left, width - EDGE.right, ROOM.x);
  const sy = scale(y, points.flatMap(p => [p.mean[y.name], ...p.range[y.name]]),
    ...(y.moreIsBetter ? ends : ends.reverse()), ROOM.y);
  drawAxes(x, y, sx, sy, width, height);
  const spots = points
    .map(point => ({ point, cx: sx.at(point.mean[x.name]), cy: sy.at(point.mean[y.name]) }))
    .sort((a, b) => a.cx - b.cx || a.cy - b.cy);
  const front = [];
  for (const spot of spots) if (!front.length || spot.cy < front.at(-1).cy) front.push(spot);
  const steps = front.map(({ cx, cy }) => `H${cx}V${cy}`).join("");
  const begin = `M${front[0].cx} ${front[0].cy}`;
  draw("path", { class: "front", d: `${begin}${steps}H${width - EDGE.right}` });
  const presets = spots.filter(spot => spot.point.group === PRESETS);
  drawNames(new Set([...presets, ...front]), spots, width);
  for (const spot of spots) drawPoint(spot, x, y, sy, front.includes(spot));
};

/** All that is known of a point, below the picture. */
const tell = point => {
  const list = element("dl");
  for (const { name, title } of data.axes) {
    const row = element("div");
    row.append(element("dt", title), element("dd", `${point.shown[name]} (${point.change[name]})`));
    list.append(row);
  }
  const about = element("p", `${point.about}; ${point.stands}`);
  told.replaceChildren(element("strong", point.name), about, list, element("code", point.settings));
};

for (const group of data.groups) {
  const line = element("label"), box = element("input");
  Object.assign(box, { type: "checkbox", checked: true });
  box.style.accentColor = colour(group);
  box.addEventListener("change", () => {
    if (box.checked) hidden.delete(group);
    else hidden.add(group);
    drawAll();
  });
  line.append(box, ` ${group}`);
  legend.append(line);
}
for (const select of selects) select.addEventListener("change", drawAll);
addEventListener("resize", drawAll);
drawAll();
if (data.points.length) tell(data.points.find(p => p.group === PRESETS) ?? data.points[0]);

// Heads of the table order it by their columns.
const heads = document.querySelectorAll("#points thead th");
const compared = (a, b) => isNaN(a) || isNaN(b) ? a.localeCompare(b) : a - b;
heads.forEach((head, column) => {
  const button = Object.assign(element("button", head.textContent), { type: "button" });
  const cell = row => row.cells[column].dataset.value ?? row.cells[column].textContent;
  button.addEventListener("click", () => {
    const body = head.closest("table").tBodies[0];
    const order = head.ariaSort === "ascending" ? "descending" : "ascending";
    const sign = order === "ascending" ? 1 : -1;
    for (const other of heads) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", order);
    body.append(...[...body.rows].sort((a, b) => sign * compared(cell(a), cell(b))));
  });
  head.replaceChildren(button);
});
