// The time series: three line charts and the strip of objectives, above one shared axis.

import { drawLine, drawStrip, frameOf, roomFor } from "./plot.js";
import { make, swatch, write } from "./elements.js";
import { objectiveColor } from "./palette.js";
import { across } from "./scale.js";
import { cellsOf } from "./wire.js";
import { chartSentence, short, stateNames, targetName, text, whole } from "./words.js";

const LINES = [
  { id: "reward", array: "series_reward", now: "reward", title: () => "reward", unit: (target) => `${target} cells found in a step` },
  { id: "target", array: "series_target", now: "n_target_cells", apart: 1, title: (target) => `${target} cells`, unit: (_, cells) => `of ${cells}` },
  { id: "log-loss", array: "series_log_loss", now: "log_loss", title: () => "log-loss", unit: () => "nats per cell" },
];

/** Creates the charts in `parent`. A click on a chart calls `seek(serial)`. */
export function createCharts(parent, { pointer, seek }) {
  const charts = [...LINES.map(lineChart), stripChart()];
  parent.append(...charts.map((chart) => chart.figure));
  const canvases = charts.map((chart) => chart.canvas);
  // Shared by all charts: the axis below them, and the width in CSS pixels to the left of the plots.
  let axis = null;
  let left = 0;

  function serialAt({ element, clientX }) {
    const box = element.getBoundingClientRect();
    return axis?.at((clientX - box.left - left) / (box.width - left)) ?? null;
  }

  for (const canvas of canvases) {
    canvas.addEventListener("click", ({ clientX }) => {
      const serial = serialAt({ element: canvas, clientX });
      if (serial != null) seek(serial);
    });
  }

  return {
    /** Returns the number of bins to request: one per pixel of width, from 16 to 2000. */
    bins: () => Math.min(Math.max(Math.round(charts[0].canvas.clientWidth || 300), 16), 2000),
    draw(picture, view, palette) {
      axis = picture.series && across(picture.series);
      for (const chart of charts) chart.begin(chart, picture, axis);
      left = roomFor(charts.map((chart) => chart.frame), axis?.word ?? "");
      const pointed = pointer.on(canvases);
      const hover = pointed && serialAt(pointed);
      const looked = view.at == null ? null : picture.shown?.serial;
      for (const chart of charts) chart.draw(chart, picture, { axis, left, hover, looked }, palette);
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
    begin(chart, picture, axis) {
      const values = picture.arrays[line.array];
      chart.values = axis && values && !values.every(Number.isNaN) ? values : null;
      chart.frame = frameOf(chart.canvas, chart.values, line.apart);
    },
    draw(chart, picture, common) {
      const target = targetName(picture);
      write(chart.parts.title, line.title(target));
      write(chart.parts.unit, line.unit(target, whole(cellsOf(picture))));
      const { values } = chart;
      const { axis, hover } = common;
      write(chart.parts.now, short(hover == null || !values ? picture.shown?.[line.now] : values[axis.bin(hover)]));
      writeHover(chart, common);
      write(chart.absent, values ? "" : absence(line, picture));
      if (values) drawLine(chart.frame, values, common);
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
    begin(chart, picture, axis) {
      const isKnown = axis && picture.arrays.series_objective && picture.objectives.length > 0;
      chart.values = isKnown ? picture.arrays.series_objective : null;
      chart.frame = frameOf(chart.canvas, null);
    },
    draw(chart, picture, common, palette) {
      const names = picture.objectives;
      write(chart.parts.title, "objective");
      const colors = names.map((name) => objectiveColor(name, { objectives: names, names: stateNames(picture), palette }));
      writeNames(chart, names, colors);
      const { values } = chart;
      write(chart.absent, values ? "" : "no objective is published");
      const { axis, hover } = common;
      write(chart.parts.now, text(hover == null || !values ? picture.agent?.objective : names[values[axis.bin(hover)]]));
      writeHover(chart, common);
      if (axis) drawStrip(chart.frame, values ?? [], common, colors);
    },
    describe(chart, picture) {
      chart.canvas.setAttribute("aria-label", `objective: now ${picture.agent?.objective ?? "unknown"}`);
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

function writeHover({ parts }, { axis, hover }) {
  write(parts.at, hover == null ? "" : `at ${axis.word} ${whole(axis.number(hover))}`);
}

function absence({ id }, picture) {
  if (id !== "log-loss") return "nothing yet";
  const { arrays, info, agent } = picture;
  if (arrays.belief && agent && info.states && agent.states.join() !== info.states.join()) {
    return "no score: its states are not the model's";
  }
  if (!arrays.truth) return "needs the truth and a belief";
  if (!arrays.belief) return "needs a belief";
  return info.states ? "nothing yet" : "needs the model";
}
