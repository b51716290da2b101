// Colours of states, of what was seen, of beliefs and of objectives, and the tables that turn
// array values into pixels. Lightness carries the order, so that all of it reads in grey too.

// The wildfire's three, then further ones that stay apart under the common colour blindnesses
// (Okabe and Ito 2008, with a brown for their orange).
const STATES = ["#3a6ea5", "#e0b03c", "#c8381c", "#009e73", "#cc79a7", "#56b4e9", "#8c510a", "#f0e442"];
const UNSEEN = { light: "#e2e2e2", dark: "#2b2f36" };

// Nine stops from 0 to 1, evenly spaced; OKLab lightness changes by the same amount between any two.
const RAMPS = {
  belief: {
    light: ["#f9f8e1", "#c6e4be", "#87d0ab", "#4cb6a6", "#039aa0", "#057a91", "#005c80", "#003e6f", "#0d2156"],
    dark: ["#161d2b", "#1d3450", "#0d4f75", "#046e89", "#038e97", "#23af9b", "#70cb95", "#b8e095", "#f8f3a3"],
  },
  entropy: {
    light: ["#fff5e8", "#fcdbc2", "#fbbda6", "#f3a099", "#e38598", "#cc6f9c", "#a9629c", "#865796", "#644c8a"],
    dark: ["#1e1b25", "#382340", "#592855", "#79315d", "#97405e", "#b2525b", "#c86958", "#d38762", "#dba475"],
  },
};

// For objectives that name no state; apart from the wildfire's colours.
const OBJECTIVES = ["#8a63b8", "#009e73", "#cc79a7", "#56b4e9", "#8c510a"];

/** What stands for "never" in grids of bytes. */
export const NEVER = 255;

// The share of its colour that an observation keeps however old it is, and the age in steps at
// which the rest has halved: old cells stay readable, the last few steps stand out.
const OLDEST_SHARE = 0.4;
const HALF_AGE = 24;

/** The colour of a state or observation, as "#rrggbb". */
export function stateColor(index) {
  return STATES[index % STATES.length];
}

/** The colour of cells where nothing was observed. */
export function unseenColor(theme) {
  return UNSEEN[theme];
}

/** The colour of an objective: that of the state it names, else one of its own. */
export function objectiveColor(name, objectives, states) {
  const named = states.findIndex((state) => name.includes(state));
  if (named >= 0) return stateColor(named);
  const others = objectives.filter((other) => !states.some((state) => other.includes(state)));
  return OBJECTIVES[Math.max(0, others.indexOf(name)) % OBJECTIVES.length];
}

/** "#rrggbb" as [red, green, blue]. */
export function channels(color) {
  return [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
}

/** The colour of `value` of 0..1 on a ramp, as [red, green, blue]. */
export function rampColor(name, theme, value) {
  const stops = RAMPS[name][theme];
  const at = Math.min(Math.max(value, 0), 1) * (stops.length - 1);
  const below = Math.min(Math.floor(at), stops.length - 2);
  return blend(channels(stops[below]), channels(stops[below + 1]), at - below);
}

/** The stops of a ramp, for legends. */
export function rampStops(name, theme) {
  return RAMPS[name][theme];
}

/** The colour of an observation made `age` steps ago. */
export function seenColor(value, age, theme) {
  const unseen = channels(UNSEEN[theme]);
  if (value === NEVER) return unseen;
  const share = OLDEST_SHARE + (1 - OLDEST_SHARE) * 2 ** (-age / HALF_AGE);
  return blend(unseen, channels(stateColor(value)), share);
}

/** Pixels by state or observation, 256 of them. */
export const valueTable = remembered((theme) =>
  table(256, (value) => seenColor(value, 0, theme)));

/** Pixels by observation and age: at `value * 256 + age`. */
export const seenTable = remembered((theme) =>
  table(65536, (at) => seenColor(at >> 8, at & 255, theme)));

/** Pixels of a ramp by value, 0..255. */
export const rampTable = remembered((theme, name) =>
  table(256, (value) => rampColor(name, theme, value / 255)));

function blend(from, to, share) {
  return from.map((channel, i) => Math.round(channel + (to[i] - channel) * share));
}

// Pixels as canvas image data keeps them on little-endian machines, which all browsers run on.
function table(length, color) {
  const pixels = new Uint32Array(length);
  for (let i = 0; i < length; i += 1) {
    const [red, green, blue] = color(i);
    pixels[i] = ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
  }
  return pixels;
}

function remembered(make) {
  const made = new Map();
  return (...key) => {
    const name = key.join(" ");
    if (!made.has(name)) made.set(name, make(...key));
    return made.get(name);
  };
}
