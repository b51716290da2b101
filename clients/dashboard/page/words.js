// Numbers and names as people read them, and the sentences that stand in for pictures.

import { cellsOf } from "./wire.js";

const WHOLE = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
const UNKNOWN = "–";

/** A whole number with thousands apart; a dash if it is unknown. */
export function whole(value) {
  return value == null || Number.isNaN(value) ? UNKNOWN : WHOLE.format(value);
}

/** A number with so many digits as are worth reading: 1,234; 31.4; 0.412. */
export function short(value) {
  if (value == null || Number.isNaN(value)) return UNKNOWN;
  const size = Math.abs(value);
  if (size >= 100 || Number.isInteger(value)) return whole(value);
  return value.toFixed(size >= 10 ? 1 : size >= 1 ? 2 : 3);
}

/** Text, or a dash if there is none. */
export function text(value) {
  return value == null || value === "" ? UNKNOWN : String(value);
}

/** Names of the hidden states; numbers of a hidden model. */
export function stateNames(picture) {
  return picture.info?.states ?? picture.agent?.states ?? numbered("state", 3);
}

/** Names of what can be observed. */
export function observationNames(picture) {
  return picture.info?.observations ?? [];
}

/** Names of the states that the belief is about: a learned filter has its own. Empty without belief. */
export function beliefNames(picture) {
  const { belief } = picture.arrays;
  if (!belief || !picture.info) return [];
  const count = belief.length / cellsOf(picture);
  const names = picture.agent?.states ?? picture.info.states;
  return names?.length === count ? names : numbered("state", count);
}

/** Whether a world has several robots. */
export function isTeam(shown) {
  return shown?.robots.length > 1;
}

/** The name of the state that pays. */
export function targetName(picture) {
  const target = picture.info?.target_state;
  return target == null ? "target" : stateNames(picture)[target] ?? "target";
}

/** From which step "seen so far" knows, such as "since k = 12"; empty if from the episode's first. */
export function seenSince({ shown }) {
  return shown?.seen_since > 0 ? `since k = ${whole(shown.seen_since)}` : "";
}

/** How old the belief is, such as "of 3 steps before"; empty if it is about the step that is shown. */
export function beliefAge({ agent, shown }) {
  const age = agent && shown ? shown.step - agent.step : 0;
  return age > 0 ? `of ${age === 1 ? "a step" : `${whole(age)} steps`} before` : "";
}

/** What a panel shows, in one sentence, for people who do not see it. */
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
    case "belief":
      return `belief ${panel.name}: mean probability ${share(picture, panel)} ${believed}`;
    default:
      return `entropy: mean ${share(picture, panel)} of the most that is possible ${believed}`;
  }
}

/** What a chart shows, in one sentence. */
export function chartSentence(title, unit, values, current) {
  const known = [...values].filter((value) => !Number.isNaN(value));
  if (known.length === 0) return `${title}: nothing yet`;
  const mean = known.reduce((sum, value) => sum + value, 0) / known.length;
  return `${title}: now ${short(current)}, mean ${short(mean)}, least ${short(Math.min(...known))}, ` +
    `most ${short(Math.max(...known))} ${unit}`;
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
