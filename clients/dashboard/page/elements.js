// Helpers that create and fill elements.

import { channels } from "./palette.js";

export function make(tag, name = "", dataset = {}, text = "") {
  const made = document.createElement(tag);
  if (name) made.className = name;
  Object.assign(made.dataset, dataset);
  if (text) made.textContent = text;
  return made;
}

export function swatch(color) {
  const square = make("i", "swatch");
  square.style.background = `rgb(${channels(color).join(" ")})`;
  return square;
}

/** Sets an element's text only if the text differs, because each change causes a new layout. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Clears a canvas. Returns its context and its size in device pixels; null while the canvas is hidden. */
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
