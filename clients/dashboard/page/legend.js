// What colours and marks mean.

import { make, swatch } from "/elements.js";
import { rampStops, stateColor, unseenColor } from "/palette.js";
import { beliefNames, observationNames, stateNames } from "/words.js";

/** The legends above and below the panels; drawn anew only when they change. */
export function createLegend(list, ramps) {
  let drawn = "";
  return {
    draw(picture, theme) {
      const states = stateNames(picture);
      const observations = observationNames(picture);
      const believed = beliefNames(picture).length;
      const key = JSON.stringify([states, observations, believed, theme]);
      if (key === drawn) return false;
      drawn = key;
      list.replaceChildren(...values(states, observations), ...marks(theme));
      ramps.replaceChildren(...(believed ? [
        ramp("belief", theme, "belief: probability of the state", ["0", "0.25", "0.5", "0.75", "1"]),
        ramp("entropy", theme, "entropy of a cell, nats", entropyTicks(believed)),
      ] : []));
      return true;
    },
  };
}

function values(states, observations) {
  if (states.join() === observations.join() || observations.length === 0) return states.map(value);
  // States and observations share colours by number, so both names of a colour are told.
  return [word("state"), ...states.map(value), word("observed"), ...observations.map(value)];
}

function value(name, index) {
  const item = make("li");
  item.append(swatch(stateColor(index)), name);
  return item;
}

function word(text) {
  return make("li", "word", {}, text);
}

function marks(theme) {
  const unseen = make("li");
  unseen.append(swatch(unseenColor(theme)), "not observed");
  return [unseen, mark("path"), mark("start"), mark("robot")];
}

function mark(name) {
  const item = make("li");
  item.append(make("i", `mark mark-${name}`), name);
  return item;
}

function entropyTicks(states) {
  const most = Math.log(states);
  return [0, 0.25, 0.5, 0.75, 1].map((share) => (share === 0 ? "0" : (share * most).toFixed(2)));
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
