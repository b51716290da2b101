// Draws lines over the cells, in device pixels: hatches over no-fly cells, and a line around the observed cells. Each
// line has a dark and a light stroke side by side, so that one of the two is visible on any cell.

import { NEVER } from "./palette.js";
import { cellsOf, shapeOf } from "./wire.js";

// Minimum size of a cell, in CSS pixels, for lines. They would hide smaller cells.
const MIN_LINE_CELL = 3;
// Distance between a hatch's lines in CSS pixels. Each cell has a line, and most of its colour stays visible.
const HATCH = { min: 4, max: 9 };
const DARK = "#141414";
const LIGHT = "#ffffff";
// Widths of the light line and of the dark line on top of it, in CSS pixels.
const SOLID = { light: 2.4, dark: 1.2 };
const THIN = { light: 2, dark: 1 };

// The layer is kept, because it is the same for all panels and rarely changes.
let kept = { key: "", layer: null };

export function drawLand(frame, picture) {
  const { arrays: { no_fly: noFly }, info } = picture;
  if (!noFly) return;
  const { width, height, ratio } = frame;
  const key = JSON.stringify([info.pid, shapeOf(picture), width, height, ratio]);
  if (key !== kept.key) kept = { key, layer: layerOf(frame, picture) };
  frame.context.drawImage(kept.layer, 0, 0);
}

export function drawFootprint(frame, picture) {
  const { arrays, info } = picture;
  if (!info.radius || frame.cell.x < MIN_LINE_CELL * frame.ratio) return;
  outline(frame, picture, (at) => arrays.frame[at] !== NEVER, SOLID);
}

function layerOf(frame, picture) {
  const layer = new OffscreenCanvas(frame.width, frame.height);
  hatch({ ...frame, context: layer.getContext("2d") }, picture, picture.arrays.no_fly);
  return layer;
}

// Draws a line between neighbouring cells for which `of` returns different values.
function outline({ context, ratio, cell }, picture, of, line) {
  const { height, width } = shapeOf(picture);
  context.beginPath();
  const side = (row, col, down, right) => {
    context.moveTo(Math.round(col * cell.x), Math.round(row * cell.y));
    context.lineTo(Math.round((col + right) * cell.x), Math.round((row + down) * cell.y));
  };
  for (let at = 0; at < cellsOf(picture); at += 1) {
    const [row, col] = [Math.floor(at / width), at % width];
    if (col + 1 < width && of(at) !== of(at + 1)) side(row, col + 1, 1, 0);
    if (row + 1 < height && of(at) !== of(at + width)) side(row + 1, col, 0, 1);
  }
  stroke(context, ratio, line);
}

function hatch({ context, ratio, width, height, cell }, picture, noFly) {
  const { width: columns } = shapeOf(picture);
  context.save();
  context.beginPath();
  for (let at = 0; at < noFly.length; at += 1) {
    if (!noFly[at]) continue;
    const [row, col] = [Math.floor(at / columns), at % columns];
    const [left, top] = [Math.round(col * cell.x), Math.round(row * cell.y)];
    context.rect(left, top, Math.round((col + 1) * cell.x) - left, Math.round((row + 1) * cell.y) - top);
  }
  context.clip();
  context.beginPath();
  const step = Math.min(Math.max(1.4 * Math.min(cell.x, cell.y), HATCH.min * ratio), HATCH.max * ratio);
  for (let x = 0; x < width + height; x += step) {
    context.moveTo(x, 0);
    context.lineTo(x - height, height);
  }
  stroke(context, ratio, THIN);
  context.restore();
}

function stroke(context, ratio, { light, dark }) {
  for (const [color, width] of [[LIGHT, light], [DARK, dark]]) {
    context.strokeStyle = color;
    context.lineWidth = width * ratio;
    context.stroke();
  }
}
