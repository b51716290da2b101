// The time series: three lines and the strip of objectives above one common axis.

import { drawLine, drawStrip } from "/plot.js";
import { make, swatch, write } from "/elements.js";
import { objectiveColor } from "/palette.js";
import { across } from "/scale.js";
import { cellsOf } from "/wire.js";
import { chartSentence, short, stateNames, targetName, text, whole } from "/words.js";

const LINES = [
  { id: "reward", array: "series_reward", now: "reward", title: () => "reward", unit: (target) => `${target} cells found in a step` },
  { id: "target", array: "series_target", now: "n_target_cells", title: (target) => `${target} cells`, unit: (_, cells) => `of ${cells}` },
  { id: "log-loss", array: "series_log_loss", now: "log_loss", title: () => "log-loss", unit: () => "nats per cell" },
];

/** The charts in `parent`; `hover(serial)` and `seek(serial)` hear of pointers on them. */
export function createCharts(parent, { hover, seek }) {
  const charts = [...LINES.map(lineChart), stripChart()];
  parent.append(...charts.map((chart) => chart.figure));
  let axis = null;
  for (const { canvas } of charts) listen(canvas, () => axis, { hover, seek });

  return {
    /** Bins worth asking for: as many as there are pixels to draw them on. */
    bins: () => Math.min(Math.max(Math.round(charts[0].canvas.clientWidth || 300), 16), 2000),
    draw(picture, view, palette) {
      axis = picture.series && across(picture.series);
      charts.forEach((chart) => chart.draw(chart, picture, axis, view, palette));
    },
    describe: (picture) => charts.forEach((chart) => chart.describe(chart, picture)),
  };
}

function frame(id, rest) {
  const figure = make("figure", `chart chart-${id}`);
  const caption = make("figcaption");
  const parts = { title: make("b"), unit: make("span", "hint"), at: make("span", "at"), now: make("output") };
  parts.now.setAttribute("aria-live", "off");
  caption.append(parts.title, parts.unit, parts.at, parts.now);
  const canvas = make("canvas", "", { testid: `chart-${id}` });
  canvas.setAttribute("role", "img");
  const plot = make("div", "plot");
  const absent = make("p", "absent");
  plot.append(canvas, absent);
  figure.append(caption, plot);
  return { id, figure, canvas, absent, caption, parts, ...rest };
}

function lineChart(line) {
  return frame(line.id, {
    line,
    draw(chart, picture, axis, view) {
      const target = targetName(picture);
      write(chart.parts.title, line.title(target));
      write(chart.parts.unit, line.unit(target, whole(cellsOf(picture))));
      const values = picture.arrays[line.array];
      const cursor = cursorOf(picture, view);
      const hovered = view.hover != null && axis && values ? values[axis.bin(clamp(view.hover, axis))] : null;
      write(chart.parts.now, short(hovered ?? picture.shown?.[line.now]));
      writeHover(chart, axis, view);
      const isEmpty = !values || !axis || values.every(Number.isNaN);
      write(chart.absent, isEmpty ? absence(line, picture) : "");
      drawLine(chart.canvas, isEmpty ? null : { values, axis, cursor });
    },
    describe(chart, picture) {
      const values = picture.arrays[line.array] ?? [];
      const target = targetName(picture);
      const unit = line.unit(target, whole(cellsOf(picture)));
      chart.canvas.setAttribute("aria-label", chartSentence(line.title(target), unit, values, picture.shown?.[line.now]));
    },
  });
}

function stripChart() {
  return frame("objective", {
    draw(chart, picture, axis, view, palette) {
      const values = picture.arrays.series_objective;
      const names = picture.objectives ?? [];
      write(chart.parts.title, "objective");
      const colors = names.map((name) => objectiveColor(name, { objectives: names, names: stateNames(picture), palette }));
      writeNames(chart, names, colors);
      const isEmpty = !values || !axis || names.length === 0;
      write(chart.absent, isEmpty ? "no agent tells its objective" : "");
      const hovered = !isEmpty && view.hover != null ? names[values[axis.bin(clamp(view.hover, axis))]] : null;
      write(chart.parts.now, text(hovered ?? picture.agent?.objective));
      drawStrip(chart.canvas, axis && { values: isEmpty ? [] : values, axis, colors, cursor: cursorOf(picture, view) });
    },
    describe(chart, picture) {
      chart.canvas.setAttribute("aria-label", `objective: now ${picture.agent?.objective ?? "not known"}`);
    },
  });
}

function writeNames(chart, names, colors) {
  const key = JSON.stringify([names, colors]);
  if (chart.key === key) return;
  chart.key = key;
  chart.parts.unit.replaceChildren(...names.map((name, i) => {
    const item = make("span", "name");
    item.append(swatch(colors[i]), name);
    return item;
  }));
}

function writeHover({ parts }, axis, { hover }) {
  write(parts.at, hover != null && axis ? `at ${axis.word} ${whole(axis.number(clamp(hover, axis)))}` : "");
}

// The entry pointed at, else the one that is looked at; the newest needs no mark.
function cursorOf(picture, { hover, at }) {
  return hover ?? (at != null ? picture.shown?.serial : null);
}

function clamp(serial, { first, last }) {
  return Math.min(Math.max(serial, first), last);
}

function absence({ id }, picture) {
  if (id !== "log-loss") return "nothing yet";
  const { arrays, info, agent } = picture;
  if (arrays.belief && agent && info.states && agent.states.join() !== info.states.join()) {
    return "no score: its states are not the model's";
  }
  if (!arrays.truth) return "needs the truth and a belief";
  if (!arrays.belief) return "needs a belief";
  return info.states ? "nothing yet" : "needs to know the model";
}

function listen(canvas, axis, { hover, seek }) {
  const serial = (event) => {
    const box = canvas.getBoundingClientRect();
    const left = parseFloat(canvas.dataset.left ?? 0);
    return axis()?.at((event.clientX - box.left - left) / (box.width - left));
  };
  canvas.addEventListener("pointermove", (event) => hover(serial(event) ?? null));
  canvas.addEventListener("pointerleave", () => hover(null));
  canvas.addEventListener("click", (event) => {
    const at = serial(event);
    if (at != null) seek(at);
  });
}
