// Draws a chart's canvas: grid, line or strip, cursor. Colours come from the style sheet.

import { prepare } from "/elements.js";
import { NEVER } from "/palette.js";
import { extent, tickText, ticks } from "/scale.js";

// Room left of the plots for the ticks' text, in the canvas's font size.
const LEFT = 3.1;
// Agents are sampled now and then: what lies between two samples is drawn unless it is so many times as
// long as is usual between them.
const LONG = 4;
// Half of a tick's text stands out above and below its line.
const MARGIN = 0.6;
// Pixels between two ticks, so that their texts stay apart.
const TICK_PIXELS = 34;
const STEP_TICK_PIXELS = 74;

/** A line chart; `plot` null draws nothing. */
export function drawLine(canvas, plot) {
  const frame = begin(canvas);
  if (!frame || !plot) return;
  const { values, axis } = plot;
  const { low, high } = extent(values);
  const base = low > 0.6 * high ? low : Math.min(0, low);
  const count = Math.max(2, Math.floor(frame.height / TICK_PIXELS));
  const { at, step } = ticks(base, high > base ? high : base + 1, count);
  const y = vertical(frame, at[0], at.at(-1));
  drawRows(frame, at, y, (value) => tickText(value, step));
  drawColumns(frame, axis);
  const runs = runsOf(values, (value) => !Number.isNaN(value), axis.bridge).map((run) =>
    run.map((bin) => [x(frame, axis.binShare(bin)), y(values[bin])]));
  // An area stands for an amount, so only where the axis begins at zero.
  if (at[0] === 0) drawArea(frame, runs);
  drawRuns(frame, runs);
  drawCursor(frame, axis, plot.cursor, values, y);
}

/** The strip of objectives with the axis of steps below; `plot` null draws nothing. */
export function drawStrip(canvas, plot) {
  const frame = begin(canvas);
  if (!frame || !plot) return;
  const { values, axis, colors } = plot;
  const height = frame.height - frame.em * 1.7;
  drawColumns(frame, axis, height);
  for (const { from, to, value } of blocksOf(values, axis.bridge)) {
    if (value >= colors.length) continue;
    const left = x(frame, from / values.length);
    frame.context.fillStyle = colors[value];
    // Half a pixel wider, as neighbours of one colour would show a seam.
    frame.context.fillRect(left, 0, x(frame, to / values.length) - left + 0.5, height);
  }
  drawSteps(frame, axis);
  drawCursor({ ...frame, height }, axis, plot.cursor);
}

function begin(canvas) {
  const drawn = prepare(canvas);
  if (!drawn) return null;
  const style = getComputedStyle(canvas);
  const em = parseFloat(style.fontSize);
  const color = (name) => style.getPropertyValue(name);
  const { context, ratio } = drawn;
  const frame = { context, width: drawn.width / ratio, height: drawn.height / ratio, em, left: LEFT * em, color };
  canvas.dataset.left = frame.left;
  context.scale(ratio, ratio);
  context.font = `${style.fontWeight} ${style.fontSize} ${style.fontFamily}`;
  return frame;
}

function x({ left, width }, share) {
  return left + share * (width - left);
}

function vertical({ height, em }, low, high) {
  const margin = MARGIN * em;
  return (value) => height - margin - ((value - low) / (high - low)) * (height - 2 * margin);
}

function drawRows({ context, width, left, em, color }, at, y, label) {
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const value of at) {
    context.fillStyle = color("--grid");
    context.fillRect(left, Math.round(y(value)), width - left, 1);
    context.fillStyle = color("--muted");
    context.fillText(label(value), left - 0.5 * em, y(value));
  }
}

function stepsOf({ width, left }, axis) {
  const count = Math.max(2, Math.floor((width - left) / STEP_TICK_PIXELS));
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
  context.textAlign = "center";
  for (const value of at) {
    const label = tickText(value, Math.max(step, 1));
    const half = context.measureText(label).width / 2;
    const middle = x(frame, axis.share(axis.serial(value)));
    context.fillText(label, Math.min(Math.max(middle, frame.left + half - em), width - half), height);
  }
}

/** The bins with a value in runs that a line joins: long gaps part them. */
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

// The median: 1 where all bins are known, so that there a few missing ones are seen as a gap.
function usualGap(known) {
  const gaps = known.slice(1).map((bin, i) => bin - known[i]).sort((a, b) => a - b);
  const usual = gaps[gaps.length >> 1] ?? 1;
  return usual > 1 ? usual : 1 / LONG;
}

/** Blocks of one objective: each lasts until the next sample of its run. */
function blocksOf(values, bridge) {
  return runsOf(values, (value) => value !== NEVER, bridge).flatMap((run) =>
    run.map((from, i) => ({ from, to: run[i + 1] ?? from + 1, value: values[from] })));
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
