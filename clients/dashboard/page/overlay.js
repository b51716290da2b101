// Marks over a grid, in device pixels: the path, where it began, the robot, and the pointed-at cell.
// Marks are dark with a light counterpart, so that they stand out from every colour of every theme.

import { prepare } from "/elements.js";
import { shapeOf } from "/wire.js";

const DARK = "#141414";
const LIGHT = "#ffffff";

/** Draws them; `hasPath` only where the path belongs. */
export function drawMarks(canvas, picture, { cell, hasPath }) {
  const drawn = prepare(canvas);
  if (!drawn) return;
  const shape = shapeOf(picture);
  const ink = getComputedStyle(canvas).getPropertyValue("--ink");
  const frame = { ...drawn, ink, cell: { x: drawn.width / shape.width, y: drawn.height / shape.height } };
  if (hasPath && picture.shown) {
    drawPath(frame, picture.shown.path);
    drawStart(frame, picture.shown.start);
    drawRobot(frame, picture.shown.robot);
  }
  if (cell) drawCross(frame, cell);
}

function middle({ cell }, [row, col]) {
  return [(col + 0.5) * cell.x, (row + 0.5) * cell.y];
}

/** The middle of a cell, as far inside as a mark of that size needs. */
function inside(frame, place, radius) {
  const [x, y] = middle(frame, place);
  const fit = (at, size) => Math.min(Math.max(at, radius), size - radius);
  return [fit(x, frame.width), fit(y, frame.height)];
}

function drawPath(frame, path) {
  const { context, ratio, cell, ink } = frame;
  context.beginPath();
  for (const place of path) context.lineTo(...middle(frame, place));
  context.lineJoin = "round";
  context.lineCap = "round";
  context.lineWidth = Math.min(Math.max(cell.x * 0.26, ratio), 3 * ratio);
  // Over cells of a pixel or two there is more background than cells around the line.
  context.strokeStyle = cell.x < 2 * ratio ? ink : DARK;
  context.stroke();
}

function drawStart(frame, place) {
  const { context, ratio, cell } = frame;
  const side = Math.max(cell.x * 0.9, 6 * ratio);
  const [x, y] = inside(frame, place, side / 2 + ratio);
  context.fillStyle = LIGHT;
  context.fillRect(x - side / 2, y - side / 2, side, side);
  context.strokeStyle = DARK;
  context.lineWidth = 1.5 * ratio;
  context.strokeRect(x - side / 2, y - side / 2, side, side);
}

function drawRobot(frame, place) {
  const { context, ratio, cell } = frame;
  const radius = Math.max(cell.x * 0.85, 5 * ratio);
  const [x, y] = inside(frame, place, radius + 1.5 * ratio);
  disc(context, x, y, radius + 1.5 * ratio, DARK);
  disc(context, x, y, radius, LIGHT);
  disc(context, x, y, radius * 0.42, DARK);
}

function disc(context, x, y, radius, color) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = color;
  context.fill();
}

// A light line beside each dark one: one of the two is seen on any cell.
function drawCross({ context, ratio, width, height, cell }, { row, col }) {
  const left = Math.round(col * cell.x);
  const top = Math.round(row * cell.y);
  const right = Math.round((col + 1) * cell.x);
  const bottom = Math.round((row + 1) * cell.y);
  const line = Math.max(1, Math.round(ratio));
  const [x, y] = [(left + right - line) >> 1, (top + bottom - line) >> 1];
  for (const [shift, color] of [[0, "rgb(20 20 20 / 75%)"], [line, "rgb(255 255 255 / 75%)"]]) {
    context.fillStyle = color;
    context.fillRect(x + shift, 0, line, top);
    context.fillRect(x + shift, bottom, line, height - bottom);
    context.fillRect(0, y + shift, left, line);
    context.fillRect(right, y + shift, width - right, line);
  }
  context.lineWidth = line;
  for (const [grow, color] of [[1.5, LIGHT], [0.5, DARK]]) {
    const out = grow * line;
    context.strokeStyle = color;
    context.strokeRect(left - out, top - out, right - left + 2 * out, bottom - top + 2 * out);
  }
}
