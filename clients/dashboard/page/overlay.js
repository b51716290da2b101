// Marks over a grid, in device pixels: paths, their starts, the robots, and the pointed-at cell. Each mark has a dark
// and a light part, so that it stands out from every colour of every theme. In a team, the light part has the robot's
// colour.

import { prepare } from "./elements.js";
import { drawFootprint, drawLand } from "./land.js";
import { robotColor } from "./palette.js";
import { shapeOf } from "./wire.js";
import { isTeam } from "./words.js";

const DARK = "#141414";
const LIGHT = "#ffffff";

export function drawMarks(canvas, picture, { cell, hasPaths }) {
  const drawn = prepare(canvas);
  if (!drawn) return;
  const shape = shapeOf(picture);
  const ink = getComputedStyle(canvas).getPropertyValue("--ink");
  const frame = { ...drawn, ink, cell: { x: drawn.width / shape.width, y: drawn.height / shape.height } };
  drawLand(frame, picture);
  if (hasPaths && picture.shown) {
    drawFootprint(frame, picture);
    drawRobots(frame, picture.shown);
  }
  if (cell) drawCross(frame, cell);
}

// Draws all paths below all starts, and all starts below all robots, with the first robot on top.
function drawRobots(frame, shown) {
  const look = (at) => (isTeam(shown) ? { color: robotColor(at), label: String(at) } : {});
  const robots = shown.robots.map((robot, at) => ({ ...robot, ...look(at) })).reverse();
  for (const draw of [drawPath, drawStart, drawRobot]) robots.forEach((robot) => draw(frame, robot));
}

function middle({ cell }, [row, col]) {
  return [(col + 0.5) * cell.x, (row + 0.5) * cell.y];
}

/** Returns the middle of a cell, moved inwards so that a mark of this radius fits on the grid. */
function inside(frame, place, radius) {
  const [x, y] = middle(frame, place);
  const fit = (at, size) => Math.min(Math.max(at, radius), size - radius);
  return [fit(x, frame.width), fit(y, frame.height)];
}

function drawPath(frame, { path, color }) {
  const { context, ratio, cell, ink } = frame;
  context.beginPath();
  for (const place of path) context.lineTo(...middle(frame, place));
  context.lineJoin = "round";
  context.lineCap = "round";
  const width = Math.min(Math.max(cell.x * 0.26, ratio), 3 * ratio);
  // Where cells are one or two pixels wide, the line mostly covers the background instead of cells.
  const dark = cell.x < 2 * ratio ? ink : DARK;
  stroke(context, color ? width + ratio : width, dark);
  if (color) stroke(context, width, color);
}

function stroke(context, width, color) {
  context.lineWidth = width;
  context.strokeStyle = color;
  context.stroke();
}

function drawStart(frame, { path: [place], color }) {
  const { context, ratio, cell } = frame;
  const side = Math.max(cell.x * 0.9, 6 * ratio);
  const [x, y] = inside(frame, place, side / 2 + ratio);
  context.fillStyle = color ?? LIGHT;
  context.fillRect(x - side / 2, y - side / 2, side, side);
  context.strokeStyle = DARK;
  context.lineWidth = 1.5 * ratio;
  context.strokeRect(x - side / 2, y - side / 2, side, side);
}

// A robot that stayed is drawn hollow: as a full ring if it hovered, as a dashed ring if it was late.
function drawRobot(frame, { cell: place, state, color = LIGHT, label }) {
  const { context, ratio, cell } = frame;
  const radius = Math.max(cell.x * 0.85, (label ? 8 : 5) * ratio);
  const [x, y] = inside(frame, place, radius + 1.5 * ratio);
  const hasStayed = state === "hovered" || state === "late";
  disc(context, x, y, radius + 1.5 * ratio, DARK);
  disc(context, x, y, radius, hasStayed ? DARK : color);
  if (hasStayed) ring(context, x, y, radius, { color, isDashed: state === "late" });
  if (!label) return disc(context, x, y, radius * 0.42, DARK);
  context.font = `bold ${radius * (label.length > 1 ? 1 : 1.3)}px sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillStyle = hasStayed ? color : DARK;
  context.fillText(label, x, y + radius * 0.08);
}

function ring(context, x, y, radius, { color, isDashed }) {
  context.beginPath();
  context.arc(x, y, radius * 0.87, 0, 2 * Math.PI);
  const dash = (radius * 0.87 * 2 * Math.PI) / 16;
  context.setLineDash(isDashed ? [dash, dash] : []);
  stroke(context, radius * 0.26, color);
  context.setLineDash([]);
}

function disc(context, x, y, radius, color) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = color;
  context.fill();
}

// Draws a light line next to each dark line, so that one of the two is visible on any cell.
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
