// Elements made from script.

import { channels } from "./palette.js";

/** An element with a class, data attributes and text. */
export function make(tag, name = "", dataset = {}, text = "") {
  const made = document.createElement(tag);
  if (name) made.className = name;
  Object.assign(made.dataset, dataset);
  if (text) made.textContent = text;
  return made;
}

/** A small square of a colour. */
export function swatch(color) {
  const square = make("i", "swatch");
  square.style.background = `rgb(${channels(color).join(" ")})`;
  return square;
}

/** Sets an element's text, if it differs: what does not change is not laid out again. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A canvas's context, cleared, at the screen's own resolution, in its pixels; null while hidden. */
export function prepare(canvas) {
  const ratio = devicePixelRatio;
  const [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio].map(Math.round);
  if (width === 0 || height === 0) return null;
  const context = canvas.getContext("2d");
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, ratio, width, height };
}
