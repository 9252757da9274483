"use strict";
// Charts: numbers to curves that can be read at the pointer. Text reaches the document as text nodes alone.

const AXES = {
  steps: "environment steps",
  expert: "environment steps, the expert's included",
  hours: "hours of wall-clock",
};
const HUES = [255, 45, 150, 310, 20, 95, 200, 345, 70, 228, 122, 282, 175, 328, 2, 32];
const SVG = "http://www.w3.org/2000/svg";

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}
const element = (name, attributes = {}, ...children) => fill(document.createElement(name), attributes, children);
const shape = (name, attributes = {}, ...children) => fill(document.createElementNS(SVG, name), attributes, children);
const plural = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;
const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
const known = (value) => value !== null && value !== undefined;

/** Give a node the color of a group; beyond those chosen by eye, hues that stay apart. */
function colored(node, group) {
  node.style.setProperty("--hue", HUES[group] ?? (group * 137.508) % 360);
  node.classList.add("colored");
  return node;
}
const swatch = (group) => colored(element("span", { class: "swatch", "aria-hidden": "true" }), group);

// ── Numbers ──────────────────────────────────────────────────────────────────────────────────────────────────────────

/** Numbers with as many digits as a difference of `step` needs. */
function format(value, step) {
  const digits = Math.min(8, Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
  return value.toLocaleString("en-US", { minimumFractionDigits: digits, maximumFractionDigits: digits }).replace("-", "−");
}

/** A step of 1, 2 or 5 times a power of ten, so that about `count` of them cover the range. */
function niceStep(low, high, count) {
  const rough = (high - low) / Math.max(1, count) || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  return power * ([1, 2, 5].find((factor) => factor * power >= rough) ?? 10);
}

function ticks(low, high, step) {
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, index) => (first + index) * step);
}

/** Some of 1, 2 and 5 times the powers of ten between two logarithms, as numbers; at most `count` if few are enough. */
function logTicks(low, high, count) {
  const choices = [[1, 2, 5], [1, 3], [1]].map((factors) => {
    const found = [];
    for (let power = Math.floor(low); power <= high; power++) found.push(...factors.map((factor) => factor * 10 ** power));
    return found.filter((tick) => Math.log10(tick) >= low && Math.log10(tick) <= high);
  });
  return choices.find((found) => found.length <= count) ?? choices[2];
}

/** Exponential moving average from the first value on; what is missing stays missing. */
function smooth(values, weight) {
  let sum = 0, norm = 0;
  return values.map((value) => {
    if (!known(value)) return null;
    sum = weight * sum + (1 - weight) * value;
    norm = weight * norm + (1 - weight);
    return sum / norm;
  });
}

// ── From runs to points ──────────────────────────────────────────────────────────────────────────────────────────────

/** What the state calls a run of the environment's group with this index, when it is hidden. */
const runKey = (group, run) => `${group}/${run.name}`;

/** Points {step, x, y} of each run of a group that has the series and is shown; y is null in a gap. */
function runPoints(group, index, series, state) {
  return group.runs.filter((run) => run.series[series] && !state.hidden.has(runKey(index, run))).map((run) => {
    const values = smooth(run.series[series], state.smoothing);
    return values.map((y, index) => ({ step: run.axes.steps[index], x: run.axes[state.axis][index], y }))
      .filter((point) => known(point.x));
  });
}

/** Points of the mean over the runs, at the steps that all of them have; y is null where one of them has a gap. */
function meanPoints(runs) {
  const tables = runs.map((points) => new Map(points.map((point) => [point.step, point])));
  if (!tables.length) return [];
  const steps = [...tables[0].keys()].filter((step) => tables.every((table) => table.has(step)));
  return steps.map((step) => {
    const here = tables.map((table) => table.get(step)), ys = here.map((point) => point.y);
    const x = mean(here.map((point) => point.x));
    return ys.every(known) ? { x, y: mean(ys), low: Math.min(...ys), high: Math.max(...ys), count: ys.length } : { x, y: null };
  });
}

// ── A chart ──────────────────────────────────────────────────────────────────────────────────────────────────────────

/** A chart of an environment: `node` to place, `draw` to call whenever the state or the width changed. */
function chartOf(chart, environment, state, height) {
  const plot = element("div", { class: "plot" });
  const tooltip = element("div", { class: "tooltip", role: "status", hidden: "" });
  const caption = element("figcaption", {}, element("strong", {}, chart.title));
  if (chart.note) caption.append(" ", element("span", { class: "muted" }, chart.note));
  if (chart.lines.length > 1) chart.lines.forEach((line, index) => caption.append(
    " ", element("span", { class: index ? "line dashed" : "line" }, line.label)));
  const node = element("figure", {}, caption, element("div", { class: "frame" }, plot, tooltip));

  function draw() {
    const visible = environment.groups.flatMap((group, index) => (state.hidden.has(index) ? [] : chart.lines.map((line, second) => {
      const runs = runPoints(group, index, line.series, state);
      return { index, label: group.label, line, second, runs, mean: meanPoints(runs) };
    })));
    const scales = scalesOf(visible.flatMap((one) => one.runs.flat()), chart, plot.clientWidth, height, state.axis);
    tooltip.hidden = true;
    plot.replaceChildren(scales ? picture(visible, scales, chart, state) : element("p", { class: "muted empty" }, "nothing to draw"));
    if (scales) readable(plot.firstChild, visible, scales, tooltip, state);
  }
  return { node, draw };
}

/** Where numbers lie in the picture; nothing if there are none. */
function scalesOf(points, chart, width, height, axis) {
  const there = points.filter((point) => known(point.y));
  if (!there.length || width < 80) return null;
  const bounds = (values) => values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]);
  let [left, right] = bounds(there.map((point) => point.x));
  const bend = chart.logarithmic ? Math.log10 : (value) => value;
  let [bottom, top] = bounds([...there.map((point) => point.y), ...(known(chart.reference) ? [chart.reference] : [])].map(bend));
  left = Math.min(left, 0);
  if (right === left) right = left + 1;
  const room = (top - bottom || Math.abs(top) || 1) * 0.05;
  [bottom, top] = [bottom - room, top + room];
  const yStep = niceStep(bottom, top, height / 45);
  const yTicks = chart.logarithmic ? logTicks(bottom, top, height / 30) : ticks(bottom, top, yStep);
  const yLabels = yTicks.map((tick) => format(tick, chart.logarithmic ? tick : yStep));
  const read = (value) => format(value, (chart.logarithmic ? value : yStep) / 100);
  const margin = { left: 12 + 7 * Math.max(...yLabels.map((label) => label.length)), right: 24, top: 10, bottom: 26 };
  const inner = { width: width - margin.left - margin.right, height: height - margin.top - margin.bottom };
  const xStep = niceStep(left, right, inner.width / (axis === "hours" ? 70 : 95)), xTicks = ticks(left, right, xStep);
  return {
    width, height, margin, inner, xStep, yTicks, yLabels, xTicks, read,
    x: (value) => margin.left + ((value - left) / (right - left)) * inner.width,
    y: (value) => margin.top + ((top - bend(value)) / (top - bottom)) * inner.height,
    back: (pixel) => left + ((pixel - margin.left) / inner.width) * (right - left),
  };
}

function path(points, scales) {
  let pen = "M";
  return points.map((point) => {
    if (!known(point.y)) { pen = "M"; return ""; }
    const command = `${pen}${scales.x(point.x).toFixed(1)},${scales.y(point.y).toFixed(1)}`;
    pen = "L";
    return command;
  }).join("");
}

/** Points with a gap on either side, of which a path shows nothing. */
const lonely = (points) => points.filter((point, index) =>
  known(point.y) && !known(points[index - 1]?.y) && !known(points[index + 1]?.y));

function picture(visible, scales, chart, state) {
  const { width, height, margin, inner } = scales;
  const root = shape("svg", {
    width, height, viewBox: `0 0 ${width} ${height}`, tabindex: 0, role: "img",
    "aria-label": `${chart.title} over ${AXES[state.axis]}; left and right arrows read values`,
  });
  scales.yTicks.forEach((tick, index) => root.append(
    shape("line", { class: "grid", x1: margin.left, x2: margin.left + inner.width, y1: scales.y(tick), y2: scales.y(tick) }),
    shape("text", { class: "y", x: margin.left - 8, y: scales.y(tick) + 4 }, scales.yLabels[index])));
  for (const tick of scales.xTicks) root.append(
    shape("text", { class: "x", x: scales.x(tick), y: height - 6 }, format(tick, scales.xStep)));
  if (known(chart.reference)) root.append(
    shape("line", { class: "reference", x1: margin.left, x2: margin.left + inner.width, y1: scales.y(chart.reference), y2: scales.y(chart.reference) }));
  const stroke = (one, kind, points) => {
    if (!points.some((point) => known(point.y))) return;
    const look = { class: `${kind}${one.second ? " dashed" : ""}`, "data-group": one.index };
    root.append(colored(shape("path", { ...look, d: path(points, scales) }), one.index));
    const dot = { class: `dot ${kind}`, "data-group": one.index, r: kind === "mean" ? 3 : 2 };
    for (const point of lonely(points)) root.append(
      colored(shape("circle", { ...dot, cx: scales.x(point.x), cy: scales.y(point.y) }), one.index));
  };
  for (const one of visible) if (one.runs.length > 1) one.runs.forEach((points) => stroke(one, "run", points));
  for (const one of visible) stroke(one, "mean", one.mean);
  return root;
}

/** Values at the pointer, or at the place that the arrow keys moved to. */
function readable(root, visible, scales, tooltip, state) {
  const places = [...new Set(visible.flatMap((one) => one.mean.filter((point) => known(point.y)).map((point) => point.x)))].sort((a, b) => a - b);
  const marks = shape("g", { class: "marks" });
  root.append(marks);
  let place = null;
  const nearest = (list, x, of) => list.reduce((best, one) => (Math.abs(of(one) - x) < Math.abs(of(best) - x) ? one : best));

  function show(x) {
    place = x;
    const step = scales.xStep / 100, pixel = scales.x(x), lines = [];
    marks.replaceChildren(shape("line", { class: "cursor", x1: pixel, x2: pixel, y1: scales.margin.top, y2: scales.margin.top + scales.inner.height }));
    for (const one of visible) {
      const there = one.mean.filter((other) => known(other.y));
      if (!there.length || x < there[0].x || x > there.at(-1).x) continue;
      const point = nearest(one.mean, x, (other) => other.x);
      if (!known(point.y)) continue;  // in a gap
      marks.append(colored(shape("circle", { class: "dot", cx: scales.x(point.x), cy: scales.y(point.y), r: 3.5 }), one.index));
      const notes = [];
      if (point.count > 1) notes.push(`${scales.read(point.low)} to ${scales.read(point.high)}`);
      if (point.x !== x) notes.push(`at ${format(point.x, step)}`);
      lines.push([swatch(one.index), element("span", { class: "label" }, one.label), element("span", {}, one.line.label),
        element("span", { class: "value" }, scales.read(point.y)), element("span", { class: "muted" }, notes.join(", "))]);
    }
    tooltip.replaceChildren(element("div", { class: "place" }, `${format(x, step < 1 && state.axis !== "hours" ? 1 : step)} ${AXES[state.axis]}`),
      ...lines.map((line) => element("div", { class: "row" }, ...line)));
    tooltip.hidden = false;
    const left = pixel > scales.width / 2 ? pixel - tooltip.offsetWidth - 12 : pixel + 12;
    tooltip.style.left = `${Math.max(0, Math.min(left, scales.width - tooltip.offsetWidth))}px`;
  }
  function hide() {
    place = null;
    tooltip.hidden = true;
    marks.replaceChildren();
  }
  function move(event) {
    const x = scales.back(event.clientX - root.getBoundingClientRect().left);
    if (places.length) show(nearest(places, x, (other) => other));
  }
  root.addEventListener("pointermove", move);
  root.addEventListener("pointerdown", move);
  root.addEventListener("pointerleave", hide);
  root.addEventListener("blur", hide);
  root.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.key === "Escape") hide();
    if (!by || !places.length) return;
    event.preventDefault();
    const next = place === null ? (by > 0 ? 0 : places.length - 1) : places.indexOf(place) + by;
    show(places[Math.max(0, Math.min(next, places.length - 1))]);
  });
}
