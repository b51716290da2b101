// Colours of states, observations, beliefs and objectives, and the tables that convert array values to pixels.
// Values are ordered by lightness, so that everything remains readable in greyscale.

// Colours for hidden models: the wildfire model's three, then colours that remain distinct under the common forms of
// colour blindness (Okabe and Ito 2008, with a brown instead of their orange).
const COLORS = ["#3b6ea5", "#e3b23c", "#c8371b", "#009e73", "#cc79a7", "#56b4e9", "#8c510a", "#f0e442"];

// Greys for cells that were not observed, the preferred one first.
const UNSEEN = {
  light: ["#e2e2e2", "#b8b8b8", "#808080", "#484848"],
  dark: ["#2b2f36", "#14171b", "#5a616c", "#a0a6b0"],
};
// Squared distance at which two colours can be distinguished at a glance: 60 of 255 in each channel.
const APART = 3 * 60 * 60;

// Nine stops, evenly spaced from 0 to 1. OKLab lightness changes by the same amount from stop to stop.
const RAMPS = {
  belief: {
    light: ["#f9f8e1", "#c6e4be", "#87d0ab", "#4cb6a6", "#039aa0", "#057a91", "#005c80", "#003e6f", "#0d2156"],
    dark: ["#161d2b", "#1d3450", "#0d4f75", "#046e89", "#038e97", "#23af9b", "#70cb95", "#b8e095", "#f8f3a3"],
  },
  entropy: {
    light: ["#fff5e8", "#fcdbc2", "#fbbda6", "#f3a099", "#e38598", "#cc6f9c", "#a9629c", "#865796", "#644c8a"],
    dark: ["#1e1b25", "#382340", "#592855", "#79315d", "#97405e", "#b2525b", "#c86958", "#d38762", "#dba475"],
  },
  map: {
    light: ["#f4f4f4", "#dcdcdc", "#c4c4c4", "#adadad", "#969696", "#808080", "#6b6b6b", "#565656", "#424242"],
    dark: ["#1c1c1c", "#303030", "#464646", "#5c5c5c", "#737373", "#8b8b8b", "#a4a4a4", "#bdbdbd", "#d7d7d7"],
  },
};

// Colours of a team's paths and robots. All are light, so that dark edges and numbers are visible on them.
const ROBOTS = ["#5ee6c8", "#ff9ad5", "#b9f04a", "#8fd0ff", "#ffa64d", "#c9a8ff", "#f5f09a", "#d9c2a0"];

const IDLE = { name: "nothing yet", color: "#8b93a0" };

// Colours beyond these lists are generated. Hues are this many degrees apart (the golden angle), so that neighbours
// differ; lightness alternates.
const HUE_STEP = 137.508;
const LIGHTNESSES = [0.42, 0.66, 0.3];
const SATURATION = 0.55;

// Colours of objectives that name no state; they differ from the wildfire's colours.
const OBJECTIVES = ["#8a63b8", "#009e73", "#cc79a7", "#56b4e9", "#8c510a"];

export const NEVER = 255;

// Old observations fade: each keeps OLDEST_SHARE of its colour, and the rest of its colour halves every HALF_AGE steps.
// So old cells stay readable, and the last few steps stand out.
const OLDEST_SHARE = 0.4;
const HALF_AGE = 24;

/**
 * Returns the colours of a picture's model under a theme. `states` and `observations` have a "#rrggbb" for any byte;
 * `unseen` is a single colour. The tables of pixels are `stateTable` and `frameTable`, indexed by value, `seenTable` by
 * `value * 256 + age`, `rampTable(name)` by 0..255.
 */
export function paletteOf(picture, theme) {
  const { state_colours: states, observation_colours: observations } = picture.info ?? {};
  return remembered([theme, states, observations], () => make({ states, observations, theme }));
}

function make({ states: ownStates, observations: ownObservations, theme }) {
  const states = colorsOf(ownStates);
  const observations = colorsOf(ownObservations);
  const unseen = unlike([...(ownStates ?? COLORS), ...(ownObservations ?? [])], UNSEEN[theme]);
  const value = (colors) => (at) => channels(at === NEVER ? unseen : colors[at]);
  const seen = value(observations);
  return {
    theme,
    states,
    observations,
    unseen,
    stateTable: table(256, value(states)),
    frameTable: table(256, seen),
    seenTable: table(65536, (at) => faded(seen(at >> 8), channels(unseen), at & 255)),
    rampTable: (name) => remembered([theme, name], () => table(256, (at) => rampColor(name, theme, at / 255))),
  };
}

export function objectiveColor(name, { objectives, names, palette }) {
  if (name === IDLE.name) return IDLE.color;
  const state = names.indexOf(name);
  if (state >= 0) return palette.states[state];
  const others = objectives.filter((other) => !names.includes(other) && other !== IDLE.name);
  const at = Math.max(0, others.indexOf(name));
  return OBJECTIVES[at] ?? generated(at);
}

export function robotColor(at) {
  return ROBOTS[at % ROBOTS.length];
}

export function channels(color) {
  return [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
}

export function rampColor(name, theme, value) {
  const stops = RAMPS[name][theme];
  const at = Math.min(Math.max(value, 0), 1) * (stops.length - 1);
  const below = Math.min(Math.floor(at), stops.length - 2);
  return blend(channels(stops[below]), channels(stops[below + 1]), at - below);
}

export function rampStops(name, theme) {
  return RAMPS[name][theme];
}

// Returns a colour for each byte: first the model's colours, then the colours of this file.
function colorsOf(own) {
  return Array.from({ length: 256 }, (_, at) => own?.[at] ?? COLORS[at] ?? generated(at));
}

function generated(at) {
  const lightness = LIGHTNESSES[at % LIGHTNESSES.length];
  const reach = SATURATION * Math.min(lightness, 1 - lightness);
  const channel = (shift) => {
    const turn = (shift + (at * HUE_STEP) / 30) % 12;
    return Math.round(255 * (lightness - reach * Math.max(-1, Math.min(turn - 3, 9 - turn, 1))));
  };
  return `#${[0, 8, 4].map((shift) => hexadecimal(channel(shift))).join("")}`;
}

function hexadecimal(channel) {
  return channel.toString(16).padStart(2, "0");
}

/** Returns the first grey that is distinct from all colours, or otherwise the most distant grey. */
function unlike(colors, greys) {
  const nearest = (grey) => Math.min(...colors.map((color) => distance(color, grey)));
  return greys.find((grey) => nearest(grey) >= APART)
    ?? greys.reduce((best, grey) => (nearest(grey) > nearest(best) ? grey : best));
}

function distance(one, other) {
  const [a, b] = [channels(one), channels(other)];
  return a.reduce((sum, channel, i) => sum + (channel - b[i]) ** 2, 0);
}

function faded(color, unseen, age) {
  return blend(unseen, color, OLDEST_SHARE + (1 - OLDEST_SHARE) * 2 ** (-age / HALF_AGE));
}

function blend(from, to, share) {
  return from.map((channel, i) => Math.round(channel + (to[i] - channel) * share));
}

// Builds a table of pixels with the byte order of canvas image data. Assumes a little-endian machine, as browsers have.
function table(length, color) {
  const pixels = new Uint32Array(length);
  for (let i = 0; i < length; i += 1) {
    const [red, green, blue] = color(i);
    pixels[i] = ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
  }
  return pixels;
}

const made = new Map();

function remembered(key, build) {
  const name = JSON.stringify(key);
  if (!made.has(name)) made.set(name, build());
  return made.get(name);
}
