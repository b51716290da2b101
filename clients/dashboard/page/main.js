// Connects the parts of the page: receives a picture, draws it, and requests the next one. Reading order: wire.js,
// socket.js, view.js, then the drawing: panels.js, charts.js, facts.js, controls.js.

import { createCharts } from "./charts.js";
import { createControls } from "./controls.js";
import { createFacts, titleOf } from "./facts.js";
import { createInspector } from "./inspector.js";
import { createLayout } from "./layout.js";
import { createLegend } from "./legend.js";
import * as colours from "./palette.js";
import { createPanels } from "./panels.js";
import { createPointer } from "./pointer.js";
import { connect } from "./socket.js";
import { askOf, createView, themeOf } from "./view.js";
import { shapeOf } from "./wire.js";

// Interval between updates of descriptions and title, so that people can follow them.
const DESCRIBE_MILLIS = 2000;

const byId = (id) => document.getElementById(id);
let picture = null;
let described = 0;
let isRedrawDue = false;
let hasFailed = false;

const { view, act } = createView({
  asks: () => link?.hurry(), changed: redraw, worlds: () => picture?.info?.n_worlds,
});
const inspector = createInspector(byId("announce-cell"));
const pointer = createPointer(redraw);
const panels = createPanels(byId("panels"), { pointer, byKey, inspector: inspector.root });
const charts = createCharts(byId("charts"), { pointer, seek: act.seek });
const legend = createLegend(byId("legend"), byId("ramps"));
const facts = createFacts();
const controls = createControls({ view, act }, () => picture);
const layout = createLayout(
  { stage: byId("stage"), field: document.querySelector(".field"), panels: byId("panels") }, panels.places);

// Tests read the drawn picture and its colours here.
window.emberwatch = { picture: null, drawn: 0, colours };

const link = connect({
  ask: () => askOf(view, charts.bins()),
  show,
  superseded: (next) => next.world !== view.world,
  up: (isUp, reason) => { if (!isUp) facts.gone(reason); },
  failed,
});

function show(next) {
  picture = next;
  facts.recovered();
  // A restarted server counts entries from the start again, so the selected entry no longer exists.
  if (view.at != null && next.kept && view.at > next.kept.last) view.at = null;
  // A link may name a world that this server lacks.
  if (next.info && view.world >= next.info.n_worlds) act.world(0);
  draw();
  window.emberwatch.picture = picture;
  window.emberwatch.drawn += 1;
}

// Pictures may keep failing in the same way. The page shows the error as long as it lasts; the console logs it once.
function failed(error) {
  facts.failed(error);
  if (!hasFailed) console.error(error);
  hasFailed = true;
}

function draw() {
  const palette = colours.paletteOf(picture, themeOf(view));
  facts.draw(picture, view);
  controls.draw(picture);
  if (!picture.info || !picture.shown) return;
  const isRebuilt = panels.build(picture);
  const isRelabelled = legend.draw(picture, palette);
  layout.draw(shapeOf(picture), isRebuilt || isRelabelled);
  const cell = panels.cell(picture);
  panels.draw(picture, cell, palette);
  charts.draw(picture, view, palette);
  inspector.draw(picture, cell, palette);
  describe(isRebuilt);
}

function describe(isDue) {
  const now = performance.now();
  if (!isDue && now - described < DESCRIBE_MILLIS) return;
  described = now;
  panels.describe(picture);
  charts.describe(picture);
  document.title = titleOf(picture);
}

// Redraws the current picture, at most once per frame, when the pointer moves or sizes change.
function redraw() {
  if (isRedrawDue || !picture) return;
  isRedrawDue = true;
  requestAnimationFrame(() => { isRedrawDue = false; draw(); });
}

function byKey(cell) {
  redraw();
  if (cell && picture?.shown) inspector.say(picture, cell);
}

addEventListener("resize", redraw);
// Whenever any element changes its size, one of these two elements does, too.
const sizes = new ResizeObserver(redraw);
for (const element of [document.body, byId("stage")]) sizes.observe(element);
