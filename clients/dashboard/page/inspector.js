// Shows the values of one cell: the pointed-at cell, or by default the first robot's cell.

import { make, swatch } from "./elements.js";
import { NEVER, rampColor } from "./palette.js";
import { cellsOf, mapsOf, shapeOf } from "./wire.js";
import { beliefAge, beliefNames, isTeam, observationNames, seenSince, short, stateNames } from "./words.js";

// Time from the last key to the announcement of the cell, so that held keys do not flood a screen reader.
const QUIET_MILLIS = 400;

export function createInspector(announcer) {
  const root = make("section", "inspector");
  root.setAttribute("aria-label", "one cell in numbers");
  const title = make("h3");
  const list = make("dl");
  root.append(title, list);
  let timer = 0;
  let shownKey = "";

  function draw(picture, cell, palette) {
    const at = cell ?? robotCell(picture);
    if (!at) return;
    const rows = rowsOf(picture, at);
    const heading = `row ${at.row}, col ${at.col}`;
    const hint = cell ? "" : isTeam(picture.shown) ? "robot 0" : "robot";
    const key = JSON.stringify([heading, rows, hint, palette.theme]);
    if (key === shownKey) return;
    shownKey = key;
    title.replaceChildren(make("b", "", {}, heading), make("span", "hint", {}, hint));
    list.replaceChildren(...rows.map((row) => rowElement(row, palette)));
  }

  /** Announces the cell to screen readers once no key has been pressed for a while. */
  function say(picture, cell) {
    clearTimeout(timer);
    timer = setTimeout(() => {
      const facts = rowsOf(picture, cell).map(({ name, value }) => `${name} ${value}`);
      announcer.textContent = `row ${cell.row}, column ${cell.col}: ${facts.join(", ")}`;
    }, QUIET_MILLIS);
  }

  return { root, draw, say };
}

function robotCell({ shown }) {
  const [row, col] = shown?.robots[0].cell ?? [];
  return shown && { row, col };
}

function rowsOf(picture, { row, col }) {
  const { arrays } = picture;
  const at = row * shapeOf(picture).width + col;
  const rows = [];
  if (arrays.truth) rows.push(named("state", arrays.truth[at], stateNames(picture), "states"));
  if (arrays.no_fly) rows.push({ name: "land", value: arrays.no_fly[at] ? "no-fly" : "free" });
  mapsOf(picture).forEach(({ name, range: [least, most] }, map) => {
    const share = arrays.maps[map * cellsOf(picture) + at] / 255;
    rows.push({ name, value: short(least + share * (most - least)), share, ramp: "map" });
  });
  if (arrays.seen) rows.push(seenRow(picture, arrays.seen[at]));
  if (arrays.age && arrays.seen?.[at] !== NEVER) rows.push({ name: "age", value: ageText(arrays.age[at]) });
  const cells = cellsOf(picture);
  if (beliefAge(picture)) rows.push({ name: "belief", value: beliefAge(picture) });
  beliefNames(picture).forEach((name, state) => {
    const share = arrays.belief[state * cells + at] / 255;
    rows.push({ name: `p(${name})`, value: share.toFixed(2), share, ramp: "belief" });
  });
  if (arrays.entropy) rows.push(entropyRow(arrays.entropy[at], beliefNames(picture).length));
  return rows;
}

function seenRow(picture, value) {
  if (value !== NEVER) return named("seen", value, observationNames(picture), "observations");
  const since = seenSince(picture);
  return { name: "seen", value: since ? `not ${since}` : "never" };
}

function named(name, value, names, of) {
  return { name, value: names[value] ?? `value ${value}`, color: [of, value] };
}

function ageText(age) {
  if (age === 0) return "this step";
  return age === 255 ? "255+ steps" : `${age} step${age === 1 ? "" : "s"}`;
}

function entropyRow(value, states) {
  const share = value / 255;
  return { name: "entropy", value: `${(share * Math.log(Math.max(states, 2))).toFixed(2)} nats`, share, ramp: "entropy" };
}

function rowElement({ name, value, color, share, ramp, kind }, palette) {
  const row = make("div", kind && `of-${kind}`);
  if (kind) row.title = value;
  const term = make("dt", "", {}, name);
  const answer = make("dd");
  if (color) answer.append(swatch(palette[color[0]][color[1]]));
  answer.append(value);
  row.append(term, answer);
  if (share !== undefined) addBar(row, share, ramp, palette.theme);
  return row;
}

// The style sheet draws the bar, because a `dl` may contain only terms and descriptions.
function addBar(row, share, ramp, theme) {
  row.className = "has-bar";
  row.style.setProperty("--share", `${share * 100}%`);
  // Starts at a third of the ramp, because its first colours would be invisible on the background.
  row.style.setProperty("--bar", `rgb(${rampColor(ramp, theme, 0.35 + 0.4 * share).join(" ")})`);
}
