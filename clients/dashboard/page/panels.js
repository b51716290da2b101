// The panels of grids. Each has a canvas with one pixel per cell, and above it a canvas for marks.

import { make, write } from "./elements.js";
import { drawMarks } from "./overlay.js";
import { beliefAge, beliefNames, panelSentence, rangeOf, seenSince, stateNames } from "./words.js";
import { cellsOf, mapsOf, shapeOf } from "./wire.js";

const OBSERVED = [
  { id: "truth", kind: "truth", title: "truth", hint: "hidden" },
  { id: "seen", kind: "seen", title: "seen so far", hint: "older fades" },
  { id: "frame", kind: "frame", title: "this path", hint: "seen just now" },
];
const ENTROPY = { id: "entropy", kind: "entropy", title: "entropy", hint: "of the belief" };

/** Creates the panels and the inspector in `parent`. Calls `byKey(cell)` when keys select a cell, or null for none. */
export function createPanels(parent, { pointer, byKey, inspector }) {
  let built = { key: "", world: null, beliefs: [], panels: [], landLines: 0 };
  // The cell selected by keys, until the pointer moves over a panel.
  let keyed = null;
  const hold = (cell) => { keyed = cell; byKey(cell); };
  const release = () => { keyed = null; };

  function build(picture) {
    const beliefs = namesOf(picture);
    const maps = mapsOf(picture);
    const landLines = maps.length + (picture.arrays.no_fly ? 1 : 0);
    const key = JSON.stringify([shapeOf(picture), beliefs, stateNames(picture).length, maps, landLines]);
    if (key === built.key) return false;
    const add = (panel) => element(panel, picture, { hold, release });
    const panels = OBSERVED.map(add);
    const believed = beliefs.map((name, state) => add(
      { id: `belief-${state}`, kind: "belief", title: "belief", name, state, hint: `p(${name})` }));
    if (beliefs.length > 0) believed.push(add(ENTROPY));
    const ofMaps = maps.map(({ name, range }, state) => add(
      { id: `map-${state}`, kind: "map", title: "map", name, state, hint: rangeOf(range) }));
    const figures = (all) => all.map((panel) => panel.figure);
    const row = believed.length ? figures(believed) : [noBelief(picture)];
    parent.replaceChildren(...figures(panels), inspector, ...row, ...figures(ofMaps));
    release();
    built = { key, world: picture.world, beliefs, panels: [...panels, ...believed, ...ofMaps], landLines };
    return true;
  }

  // Agents publish a belief only for some entries, so belief panels stay for entries without a belief.
  function namesOf(picture) {
    const names = beliefNames(picture);
    if (names.length > 0 || picture.objectives.length === 0) return names;
    return built.world === picture.world && built.beliefs.length ? built.beliefs : stateNames(picture);
  }

  return {
    build,
    /** Returns what the layout needs: panels, inspector lines, whether a note replaces beliefs, regular columns. */
    places: () => ({
      panels: built.panels.length,
      lines: OBSERVED.length + built.landLines + (built.beliefs.length && built.beliefs.length + 1),
      isBare: built.beliefs.length === 0,
      regular: Math.max(built.beliefs.length + 1, OBSERVED.length + 1),
    }),
    cell(picture) {
      const pointed = keyed ? null : pointer.on(built.panels.map((panel) => panel.grid));
      return pointed ? cellAt(pointed, shapeOf(picture)) : keyed;
    },
    draw: (picture, cell, palette) => built.panels.forEach((panel) => paint(panel, picture, cell, palette)),
    describe: (picture) => built.panels.forEach((panel) => describe(panel, picture)),
  };
}

function element(panel, picture, { hold, release }) {
  const { height, width } = shapeOf(picture);
  const figure = make("figure", "panel", { panel: panel.id });
  const caption = make("figcaption");
  caption.append(make("b", "", {}, panel.name ? `${panel.title}: ${panel.name}` : panel.title));
  caption.append(make("span", "hint", {}, panel.kind === "belief" ? "" : panel.hint));
  const grid = make("div", "grid");
  grid.tabIndex = 0;
  grid.setAttribute("role", "group");
  grid.setAttribute("aria-label", `cells of ${caption.firstChild.textContent}: arrow keys move`);
  const cells = make("canvas", "cells", { testid: `panel-${panel.id}` });
  cells.setAttribute("role", "img");
  cells.width = width;
  cells.height = height;
  const marks = make("canvas", "marks", { testid: `overlay-${panel.id}` });
  marks.setAttribute("aria-hidden", "true");
  const absent = make("p", "absent");
  grid.append(cells, marks, absent);
  figure.append(caption, grid);
  listen(grid, { height, width }, hold);
  for (const type of ["pointermove", "pointerdown"]) grid.addEventListener(type, release);
  const context = cells.getContext("2d");
  return { ...panel, figure, caption, grid, cells, marks, absent, context, image: context.createImageData(width, height) };
}

function paint(panel, picture, cell, palette) {
  const values = valuesOf(panel, picture);
  const [reason, flag] = values ? [""] : absence(panel, picture);
  if (panel.absent.dataset.reason !== reason) {
    panel.absent.dataset.reason = reason;
    panel.absent.replaceChildren(reason, ...(flag ? [make("code", "", {}, flag)] : []));
  }
  panel.figure.classList.toggle("is-absent", !values);
  if (panel.kind === "seen") write(panel.caption.lastChild, seenSince(picture) || panel.hint);
  if (panel.kind === "belief") write(panel.caption.lastChild, beliefAge(picture));
  if (panel.kind === "entropy") write(panel.caption.lastChild, beliefAge(picture) || panel.hint);
  if (values) {
    const pixels = new Uint32Array(panel.image.data.buffer);
    fill(pixels, values, panel, picture, palette);
    panel.context.putImageData(panel.image, 0, 0);
  }
  drawMarks(panel.marks, picture, { cell, hasPaths: panel.kind === "frame" && Boolean(values) });
}

function fill(pixels, values, { kind }, { arrays }, palette) {
  if (kind === "seen" && arrays.age) {
    const table = palette.seenTable;
    for (let i = 0; i < pixels.length; i += 1) pixels[i] = table[(values[i] << 8) | arrays.age[i]];
    return;
  }
  const table = tableOf(kind, palette);
  for (let i = 0; i < pixels.length; i += 1) pixels[i] = table[values[i]];
}

function tableOf(kind, palette) {
  if (["belief", "entropy", "map"].includes(kind)) return palette.rampTable(kind);
  return kind === "truth" ? palette.stateTable : palette.frameTable;
}

function valuesOf({ kind, state }, picture) {
  const { arrays } = picture;
  const planes = { belief: arrays.belief, map: arrays.maps };
  if (!(kind in planes)) return arrays[kind];
  const cells = cellsOf(picture);
  return planes[kind]?.subarray(state * cells, (state + 1) * cells);
}

function absence({ kind }, picture) {
  if (kind === "truth" && picture.source === "recording") return ["This recording holds no hidden states."];
  if (kind === "truth" && !picture.info.publish_truth) return ["The server does not publish it. To see it, start the server with ", "--publish-truth"];
  if (kind === "belief" || kind === "entropy") return ["No belief published at this step or shortly before."];
  return ["Unknown for this step."];
}

function noBelief({ source }) {
  const isRecording = source === "recording";
  const reason = isRecording ? "A recording holds no beliefs." : "No agent publishes its belief on this world.";
  return make("p", "absent no-belief", {}, reason);
}

function describe(panel, picture) {
  const sentence = valuesOf(panel, picture) ? panelSentence(panel, picture) : `${panel.title}: unknown`;
  panel.cells.setAttribute("aria-label", sentence);
}

function cellAt({ element: grid, clientX, clientY }, shape) {
  const box = grid.getBoundingClientRect();
  return inside(shape, {
    row: Math.floor(((clientY - box.top) / box.height) * shape.height),
    col: Math.floor(((clientX - box.left) / box.width) * shape.width),
  });
}

function listen(grid, shape, hold) {
  let held = { row: shape.height >> 1, col: shape.width >> 1 };
  const steps = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
  grid.addEventListener("focus", () => grid.matches(":focus-visible") && hold(held));
  grid.addEventListener("blur", () => hold(null));
  grid.addEventListener("keydown", (event) => {
    const step = steps[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    const size = event.shiftKey ? 10 : 1;
    held = inside(shape, { row: held.row + step[0] * size, col: held.col + step[1] * size });
    hold(held);
  });
}

function inside({ height, width }, { row, col }) {
  return { row: Math.min(Math.max(row, 0), height - 1), col: Math.min(Math.max(col, 0), width - 1) };
}
