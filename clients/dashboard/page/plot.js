// Draws a chart's canvas: grid, line or strip, and cursors. Colours come from the style sheet.

import { prepare } from "./elements.js";
import { NEVER } from "./palette.js";
import { extent, tickText, ticks } from "./scale.js";

// Sizes relative to the canvas's font size: minimum width of the tick labels left of a plot, and space next to a label.
const LEFT = 3.1;
const SPACE = 0.5;
// Agents publish only some steps. A line bridges the gap between two samples, unless the gap is longer than this many
// usual gaps.
const LONG = 4;
// Half the height of a tick label, which extends above and below its line.
const MARGIN = 0.6;
// Minimum distances between two ticks, vertically and horizontally, so that their labels stay apart.
const TICK = 2.7;
const STEP_TICK = 5.8;
// Height of the text below the strip.
const STEPS = 1.7;

/**
 * Clears a chart's canvas. Returns its context and sizes, and if there are `values`, vertical ticks for them that are
 * at least `apart` apart. Returns null while the canvas is hidden.
 */
export function frameOf(canvas, values, apart = 0) {
  const drawn = prepare(canvas);
  if (!drawn) return null;
  const style = getComputedStyle(canvas);
  const em = parseFloat(style.fontSize);
  const color = (name) => style.getPropertyValue(name);
  const { context, ratio } = drawn;
  const frame = { context, width: drawn.width / ratio, height: drawn.height / ratio, em, color };
  context.scale(ratio, ratio);
  context.font = `${style.fontWeight} ${style.fontSize} ${style.fontFamily}`;
  return values ? { ...frame, rows: rowsOf(frame, values, apart) } : frame;
}

/** Returns the width, in CSS pixels, of the space left of plots that share an axis. `word` names the axis. */
export function roomFor(frames, word) {
  return Math.max(0, ...frames.filter(Boolean).map(({ context, em, rows }) => {
    const width = (text) => context.measureText(text).width;
    const widest = Math.max(...(rows?.map(({ label }) => width(label)) ?? [0]));
    // The first step's label may begin to the left of the plot.
    return Math.max(LEFT * em, widest + 1.2 * SPACE * em, width(word) + (SPACE + 1) * em);
  }));
}

export function drawLine(frame, values, { axis, left, hover, looked }) {
  if (!frame) return;
  const plot = { ...frame, left };
  const { rows } = frame;
  const y = vertical(plot, rows[0].value, rows.at(-1).value);
  drawRows(plot, y);
  drawColumns(plot, axis);
  const runs = runsOf(values, (value) => !Number.isNaN(value), axis.bridge).map((run) =>
    run.map((bin) => [x(plot, axis.binShare(bin)), y(values[bin])]));
  // A filled area represents an amount, so it is drawn only if the axis begins at zero.
  if (rows[0].value === 0) drawArea(plot, runs);
  drawRuns(plot, runs);
  for (const serial of [looked, hover]) drawCursor(plot, axis, serial, values, y);
}

export function drawStrip(frame, values, { axis, left, hover, looked }, colors) {
  if (!frame) return;
  const plot = { ...frame, left };
  const height = frame.height - frame.em * STEPS;
  if (values.length > 0) drawColumns(plot, axis, height);
  for (const { from, to, value } of blocksOf(values, axis.bridge)) {
    if (value >= colors.length) continue;
    const start = x(plot, from / values.length);
    frame.context.fillStyle = colors[value];
    frame.context.fillRect(start, 0, Math.max(1, x(plot, to / values.length) - start), height);
  }
  drawSteps(plot, axis);
  for (const serial of [looked, hover]) drawCursor({ ...plot, height }, axis, serial);
}

function rowsOf({ height, em }, values, apart) {
  const { low, high } = extent(values);
  const base = low > 0.6 * high ? low : Math.min(0, low);
  const top = high > base ? high : base + 1;
  const count = Math.max(1, Math.min(Math.floor(height / (TICK * em)), (top - base) / apart));
  const { at, step } = ticks(base, top, count);
  return at.map((value) => ({ value, label: tickText(value, step) }));
}

function x({ left, width }, share) {
  return left + share * (width - left);
}

function vertical({ height, em }, low, high) {
  const margin = MARGIN * em;
  return (value) => height - margin - ((value - low) / (high - low)) * (height - 2 * margin);
}

function drawRows({ context, width, left, em, color, rows }, y) {
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const { value, label } of rows) {
    context.fillStyle = color("--grid");
    context.fillRect(left, Math.round(y(value)), width - left, 1);
    context.fillStyle = color("--muted");
    context.fillText(label, left - SPACE * em, y(value));
  }
}

function stepsOf({ width, left, em }, axis) {
  const count = Math.max(2, Math.floor((width - left) / (STEP_TICK * em)));
  const [low, high] = [axis.number(axis.first), axis.number(axis.last)];
  const { at, step } = ticks(low, Math.max(high, low + 1), count);
  const whole = step < 1 ? at.filter(Number.isInteger) : at;
  return { at: whole.filter((value) => value >= low && value <= high), step };
}

function drawColumns(frame, axis, height = frame.height - MARGIN * frame.em) {
  frame.context.fillStyle = frame.color("--grid");
  for (const value of stepsOf(frame, axis).at) {
    frame.context.fillRect(Math.round(x(frame, axis.share(axis.serial(value)))), 0, 1, height);
  }
}

function drawSteps(frame, axis) {
  const { context, height, width, em, color } = frame;
  const { at, step } = stepsOf(frame, axis);
  context.fillStyle = color("--muted");
  context.textBaseline = "bottom";
  context.textAlign = "left";
  context.fillText(axis.word, 0, height);
  let free = 0;
  for (const value of at) {
    const label = tickText(value, Math.max(step, 1));
    const wide = context.measureText(label).width;
    const middle = x(frame, axis.share(axis.serial(value)));
    const from = Math.min(Math.max(middle - wide / 2, frame.left - em), width - wide);
    if (from < free) continue;
    context.fillText(label, from, height);
    free = from + wide + SPACE * em;
  }
}

/** Returns the bins with values, grouped into runs. A line joins the bins of a run; long gaps separate runs. */
function runsOf(values, isKnown, bridge) {
  const known = [...values.keys()].filter((bin) => isKnown(values[bin]));
  const gap = Math.max(bridge, LONG * usualGap(known));
  const runs = [];
  known.forEach((bin, i) => {
    if (i > 0 && bin - known[i - 1] <= gap) runs.at(-1).push(bin);
    else runs.push([bin]);
  });
  return runs;
}

function usualGap(known) {
  const gaps = known.slice(1).map((bin, i) => bin - known[i]).sort((a, b) => a - b);
  return gaps[gaps.length >> 1] ?? 1;
}

/** Returns blocks of one objective. A block lasts until the run's next sample with another objective. */
function blocksOf(values, bridge) {
  const blocks = [];
  for (const run of runsOf(values, (value) => value !== NEVER, bridge)) {
    const turns = run.filter((bin, i) => i === 0 || values[bin] !== values[run[i - 1]]);
    turns.forEach((from, i) => blocks.push({ from, to: turns[i + 1] ?? run.at(-1) + 1, value: values[from] }));
  }
  return blocks;
}

function trace({ context }, run) {
  context.beginPath();
  for (const point of run) context.lineTo(...point);
}

function drawArea(frame, runs) {
  const { context, height, em, color } = frame;
  context.fillStyle = color("--line-soft");
  for (const run of runs) {
    trace(frame, run);
    context.lineTo(run.at(-1)[0], height - MARGIN * em);
    context.lineTo(run[0][0], height - MARGIN * em);
    context.fill();
  }
}

function drawRuns(frame, runs) {
  const { context, color } = frame;
  context.strokeStyle = color("--line");
  context.fillStyle = color("--line");
  context.lineWidth = 1.6;
  context.lineJoin = "round";
  for (const run of runs) {
    trace(frame, run);
    if (run.length > 1) context.stroke();
    else context.fillRect(run[0][0] - 1.5, run[0][1] - 1.5, 3, 3);
  }
}

function drawCursor(frame, axis, serial, values, y) {
  if (serial == null || serial < axis.first || serial > axis.last) return;
  const { context, height, color } = frame;
  const at = x(frame, axis.share(serial));
  context.fillStyle = color("--ink");
  context.fillRect(Math.round(at), 0, 1, height);
  const value = values?.[axis.bin(serial)];
  if (value === undefined || Number.isNaN(value)) return;
  context.beginPath();
  context.arc(at, y(value), 3.5, 0, 2 * Math.PI);
  context.fill();
}
