// Formats numbers and names for people, and describes pictures in sentences.

import { cellsOf } from "./wire.js";

const WHOLE = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
const UNKNOWN = "–";

/** Formats a whole number with thousands separators; a dash if the number is unknown. */
export function whole(value) {
  return value == null || Number.isNaN(value) ? UNKNOWN : WHOLE.format(value);
}

/** Formats a number with only the digits worth reading: 1,234; 31.4; 0.412. */
export function short(value) {
  if (value == null || Number.isNaN(value)) return UNKNOWN;
  const size = Math.abs(value);
  if (size >= 100 || Number.isInteger(value)) return whole(value);
  return value.toFixed(size >= 10 ? 1 : size >= 1 ? 2 : 3);
}

export function rangeOf([least, most]) {
  return `${short(least)} to ${short(most)}`;
}

export function text(value) {
  return value == null || value === "" ? UNKNOWN : String(value);
}

export function stateNames(picture) {
  return picture.info?.states ?? picture.agent?.states ?? numbered("state", 3);
}

export function observationNames(picture) {
  return picture.info?.observations ?? [];
}

/** Returns the names of the belief's states, which can be a learned filter's states. Empty without a belief. */
export function beliefNames(picture) {
  const { belief } = picture.arrays;
  if (!belief || !picture.info) return [];
  const count = belief.length / cellsOf(picture);
  const names = picture.agent?.states ?? picture.info.states;
  return names?.length === count ? names : numbered("state", count);
}

export function isTeam(shown) {
  return shown?.robots.length > 1;
}

export function targetName(picture) {
  const target = picture.info?.target_state;
  return target == null ? "target" : stateNames(picture)[target] ?? "target";
}

/** Returns the first step that "seen so far" covers, such as "since k = 12"; empty if it covers the episode. */
export function seenSince({ shown }) {
  return shown?.seen_since > 0 ? `since k = ${whole(shown.seen_since)}` : "";
}

/** Returns the belief's age, such as "3 steps old"; empty if it is about the shown step. */
export function beliefAge({ agent, shown }) {
  const age = agent && shown ? shown.step - agent.step : 0;
  return age > 0 ? `${age === 1 ? "1 step" : `${whole(age)} steps`} old` : "";
}

export function panelSentence(panel, picture) {
  const { shown, info } = picture;
  if (!shown || !info) return `${panel.title}: nothing yet`;
  const at = `at step ${whole(shown.step)}`;
  const believed = `at step ${whole(picture.agent?.step ?? shown.step)}`;
  const cells = whole(cellsOf(picture));
  switch (panel.kind) {
    case "truth":
      return `truth: ${whole(shown.n_target_cells)} of ${cells} cells in state ${targetName(picture)} ${at}`;
    case "seen":
      return `seen so far: ${whole(observed(picture.arrays.seen))} of ${cells} cells observed` +
        `${seenSince(picture) && ` ${seenSince(picture)}`} ${at}`;
    case "frame":
      return `this path: ${whole(shown.n_visited)} cells visited, ${whole(shown.n_hits)} of them ` +
        `${targetName(picture)}, ${isTeam(shown) ? "robots" : "robot"} at ${places(shown)} ${at}`;
    case "map":
      return `map ${panel.name}: factors from ${panel.hint}`;
    case "belief":
      return `belief ${panel.name}: mean probability ${share(picture, panel)} ${believed}`;
    default:
      return `entropy: mean ${share(picture, panel)} of its maximum ${believed}`;
  }
}

export function chartSentence(title, unit, values, current) {
  const known = [...values].filter((value) => !Number.isNaN(value));
  if (known.length === 0) return `${title}: nothing yet`;
  const mean = known.reduce((sum, value) => sum + value, 0) / known.length;
  return `${title}: now ${short(current)}, mean ${short(mean)}, minimum ${short(Math.min(...known))}, ` +
    `maximum ${short(Math.max(...known))} ${unit}`;
}

function places({ robots }) {
  return robots.map(({ cell: [row, col] }) => `row ${row}, column ${col}`).join("; ");
}

function observed(seen) {
  return seen?.reduce((sum, value) => sum + (value !== 255), 0);
}

function share(picture, { kind, state }) {
  const cells = cellsOf(picture);
  const values = kind === "belief"
    ? picture.arrays.belief?.subarray(state * cells, (state + 1) * cells)
    : picture.arrays.entropy;
  return values ? (values.reduce((sum, value) => sum + value, 0) / cells / 255).toFixed(2) : UNKNOWN;
}

function numbered(word, count) {
  return Array.from({ length: count }, (_, i) => `${word} ${i}`);
}
