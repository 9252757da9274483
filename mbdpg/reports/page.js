"use strict";
// Draws the report from the JSON beside it, with what chart.js defines; both are one script.

const BUTTONS = { steps: "steps", expert: "steps + expert's", hours: "hours" };

function button(text, pressed, onClick) {
  const node = element("button", { type: "button", "aria-pressed": pressed }, ...[text].flat());
  node.addEventListener("click", () => onClick(node));
  return node;
}

function axisSwitch(environment, state, draw) {
  const runs = environment.groups.flatMap((group) => group.runs);
  const useful = {
    steps: true,
    expert: runs.some((run) => run.axes.expert.some((value, index) => known(value) && value > run.axes.steps[index])),
    hours: runs.some((run) => run.axes.hours.some(known)),
  };
  const missing = { expert: "no run learned from an expert's steps", hours: "no run has timings" };
  const buttons = Object.keys(AXES).map((axis) => {
    const node = button(BUTTONS[axis], axis === state.axis, () => {
      state.axis = axis;
      buttons.forEach((other) => other.setAttribute("aria-pressed", other === node));
      draw();
    });
    node.dataset.axis = axis;
    node.disabled = !useful[axis];
    if (node.disabled) node.title = missing[axis];
    return node;
  });
  return element("div", { class: "switch", role: "group", "aria-label": "horizontal axis" }, ...buttons);
}

function smoothingSlider(state, draw) {
  const shown = element("output", {}, "off");
  const slider = element("input", { type: "range", min: 0, max: 0.95, step: 0.05, value: 0 });
  slider.addEventListener("input", () => {
    state.smoothing = Number(slider.value);
    shown.textContent = state.smoothing ? state.smoothing.toFixed(2) : "off";
    draw();
  });
  return element("label", { class: "smoothing" }, "smoothing", slider, shown);
}

function legend(environment, state, draw) {
  const toggle = (key, ...content) => button(content, true, (node) => {
    if (!state.hidden.delete(key)) state.hidden.add(key);
    node.setAttribute("aria-pressed", !state.hidden.has(key));
    draw();
  });
  const groups = environment.groups.map((group, index) => toggle(
    index, swatch(index), element("span", {}, group.label), element("span", { class: "muted" }, plural(group.runs.length, "run"))));
  const runs = environment.groups.flatMap((group, index) => (group.runs.length < 2 ? [] : group.runs.map((run) => toggle(
    runKey(index, run), swatch(index), element("span", {}, run.name)))));
  return [
    element("div", { class: "legend", role: "group", "aria-label": "groups shown" }, ...groups),
    ...(runs.length ? [element("details", { class: "runs" },
      element("summary", { class: "muted" }, "single runs; a mean is over those shown"),
      element("div", { class: "legend", role: "group", "aria-label": "runs shown" }, ...runs))] : []),
  ];
}

function table(content, groups) {
  const labels = groups.map((group) => group.label), own = content.header[0] === "group";
  const align = (column) => (content.numeric.includes(column) ? { class: "number" } : {});
  const head = content.header.map((text, column) => element("th", { scope: "col", ...align(column) }, text));
  const rows = content.rows.map((row) => element("tr", {}, ...row.map((text, column) => {
    if (column) return element("td", align(column), text);
    return element("th", { scope: "row" }, own ? element("span", { class: "group" }, swatch(labels.indexOf(text)), text) : text);
  })));
  return element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": content.title },
    element("table", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows)));
}

/** The titled table, or nothing if it has no row. */
function titled(content, groups) {
  return content.rows.length ? [element("h3", {}, content.title), table(content, groups)] : [];
}

/** The table behind its title, open if that is asked for. */
function folded(content, groups, open) {
  if (!content.rows.length) return [];
  const summary = element("summary", {}, content.title, " ", element("span", { class: "muted" }, String(content.rows.length)));
  return [element("details", open ? { open: "" } : {}, summary, table(content, groups))];
}

function section(environment) {
  const state = { axis: "steps", smoothing: 0, hidden: new Set() };
  const charts = environment.charts.map((chart, index) => chartOf(chart, environment, state, index ? 190 : 360));
  const axisTitle = element("p", { class: "axis muted" });
  const draw = () => {
    axisTitle.textContent = AXES[state.axis];
    charts.forEach((chart) => chart.draw());
  };
  const [main, ...small] = charts.map((chart) => chart.node);
  const node = element("section", {},
    element("h2", {}, environment.name),
    element("div", { class: "controls" }, axisSwitch(environment, state, draw), smoothingSlider(state, draw)),
    ...legend(environment, state, draw), main, axisTitle,
    ...environment.notes.map((note) => element("p", { class: "note" }, note)),
    ...environment.scores.flatMap((scores) => titled(scores, environment.groups)),
    ...titled(environment.problems, environment.groups), ...titled(environment.clock, environment.groups),
    ...(small.length ? [element("h3", {}, "Model and critics, on evaluation episodes"), element("div", { class: "small" }, ...small)] : []),
    ...environment.settings.flatMap((settings, index) => folded(settings, environment.groups, index === 0)));
  new ResizeObserver(draw).observe(node);  // calls at once, too
  return node;
}

function film(video) {
  const caption = element("figcaption", {}, video.name);
  if (!video.source) return element("figure", {}, caption, element("p", { class: "note" }, video.note));
  return element("figure", {}, caption, element("video", { controls: "", preload: "metadata", "aria-label": video.name, src: video.source }));
}

function begin() {
  const content = JSON.parse(document.getElementById("data").textContent);
  const groups = content.environments.flatMap((environment) => environment.groups);
  const counts = [plural(groups.flatMap((group) => group.runs).length, "run"), plural(groups.length, "group"), plural(content.environments.length, "environment")];
  document.querySelector("main").replaceChildren(
    element("header", {}, element("h1", {}, "mbdpg report"), element("p", { class: "muted" }, counts.join(" · "))),
    ...titled(content.left_out, []),
    ...content.environments.map(section),
    ...(content.videos.length ? [element("section", {}, element("h2", {}, "Videos"), element("div", { class: "small" }, ...content.videos.map(film)))] : []));
}

begin();
