// The legends, which explain colours and marks.

import { make, swatch } from "./elements.js";
import { rampStops } from "./palette.js";
import { beliefNames, observationNames, stateNames } from "./words.js";

// Maximum number of names. More names would leave no space for the panels.
const MAX_NAMES = 16;

export function createLegend(list, ramps) {
  let drawn = "";
  return {
    draw(picture, palette) {
      const states = stateNames(picture);
      const observations = observationNames(picture);
      const believed = beliefNames(picture).length;
      const { theme } = palette;
      const { state_colours: ofStates, observation_colours: ofObservations } = picture.info;
      const hasNoFly = Boolean(picture.arrays.no_fly);
      const key = JSON.stringify([states, observations, believed, theme, ofStates, ofObservations, hasNoFly]);
      if (key === drawn) return false;
      drawn = key;
      list.replaceChildren(...values(states, observations, palette), ...marks(palette, hasNoFly));
      ramps.replaceChildren(...(believed ? [
        ramp("belief", theme, "belief: probability of the state", ["0", "0.25", "0.5", "0.75", "1"]),
        ramp("entropy", theme, "entropy of a cell, nats", entropyTicks(believed)),
      ] : []));
      return true;
    },
  };
}

function values(states, observations, palette) {
  const ofStates = named(states, palette.states);
  if (states.join() === observations.join() || observations.length === 0) return ofStates;
  return [word("state"), ...ofStates, word("observed"), ...named(observations, palette.observations)];
}

function named(names, colors) {
  const items = names.slice(0, MAX_NAMES).map((name, i) => value(name, colors[i]));
  return names.length > MAX_NAMES ? [...items, word(`and ${names.length - MAX_NAMES} more`)] : items;
}

function value(name, color) {
  const item = make("li");
  item.append(swatch(color), name);
  return item;
}

function word(text) {
  return make("li", "word", {}, text);
}

function marks({ unseen }, hasNoFly) {
  return [value("not observed", unseen), ...(hasNoFly ? [mark("no-fly")] : []), mark("path"), mark("start"), mark("robot")];
}

function mark(name) {
  const item = make("li");
  item.append(make("i", `mark mark-${name}`), name);
  return item;
}

function entropyTicks(states) {
  const max = Math.log(states);
  return [0, 0.25, 0.5, 0.75, 1].map((share) => (share === 0 ? "0" : (share * max).toFixed(2)));
}

function ramp(name, theme, title, ticks) {
  const figure = make("figure", "ramp");
  figure.append(make("figcaption", "", {}, title));
  const scale = make("div");
  const bar = make("i");
  bar.style.backgroundImage = `linear-gradient(90deg, ${rampStops(name, theme).join(", ")})`;
  const row = make("p");
  row.append(...ticks.map((tick) => make("span", "", {}, tick)));
  scale.append(bar, row);
  figure.append(scale);
  return figure;
}
