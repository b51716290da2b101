// The controls and their keys: pause, scrub, world, theme, and a recording's player.

import { write } from "./elements.js";
import { MAX_WORLDS } from "./view.js";
import { whole } from "./words.js";

const byId = (id) => document.getElementById(id);

/** Connects the controls to the actions `act`. `picture()` returns the shown picture. */
export function createControls({ view, act }, picture) {
  const scrub = byId("scrub");
  const shownSerial = () => picture()?.shown?.serial ?? null;
  const toggle = () => act.seek(view.at == null ? shownSerial() : null);

  byId("pause").addEventListener("click", toggle);
  scrub.addEventListener("input", () => act.seek(Number(scrub.value)));
  byId("world").addEventListener("change", (event) => act.world(Number(event.target.value)));
  for (const choice of document.querySelectorAll("input[name=theme]")) {
    choice.addEventListener("change", () => act.theme(choice.value));
  }
  byId("play").addEventListener("click", () => {
    const { playing, ended } = picture().player;
    act.player({ playing: ended || !playing });
  });
  byId("speed").addEventListener("change", (event) => act.player({ speed: Number(event.target.value) }));
  addEventListener("keydown", (event) => pressed(event, { toggle, seek: (key, size) => move(key, size) }));

  function move(key, size) {
    const { kept } = picture() ?? {};
    const from = view.at ?? shownSerial();
    if (!kept || from == null) return;
    const to = { ArrowLeft: from - size, ArrowRight: from + size, Home: kept.first, End: kept.last }[key];
    act.seek(Math.min(Math.max(to, kept.first), kept.last));
  }

  return { draw: (next) => draw(next, view) };
}

// Keys work wherever the focus is, except on elements that use the same keys.
function pressed(event, { toggle, seek }) {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const { target, key } = event;
  if (target.closest("select, input[type=radio]")) return;
  if (key === " " && !target.closest("button")) {
    event.preventDefault();
    toggle();
  } else if (["ArrowLeft", "ArrowRight", "Home", "End"].includes(key)) {
    event.preventDefault();
    seek(key, event.shiftKey ? 10 : 1);
  }
}

function draw(picture, view) {
  drawPause(picture, view);
  drawScrub(picture, view);
  drawWorlds(picture, view);
  drawPlayer(picture.player);
  for (const choice of document.querySelectorAll("input[name=theme]")) choice.checked = choice.value === view.theme;
}

function drawPause(picture, { at }) {
  const button = byId("pause");
  const isLive = at == null;
  button.dataset.live = isLive;
  const newest = picture.source === "live" ? "Go live" : "Follow";
  write(button, isLive ? "Pause" : newest);
}

function drawScrub({ kept, shown }, { at }) {
  const scrub = byId("scrub");
  scrub.disabled = !kept;
  if (!kept) return;
  scrub.min = kept.first;
  scrub.max = kept.last;
  const serial = shown?.serial ?? kept.last;
  // In live mode, the page shows the newest belief, which may be a few steps old. The slider still stands at the end.
  scrub.value = at == null ? kept.last : serial;
  scrub.style.setProperty("--share", kept.last > kept.first ? (scrub.value - kept.first) / (kept.last - kept.first) : 1);
  scrub.setAttribute("aria-valuetext", `entry ${whole(serial)}, step ${whole(shown?.step)}${at == null ? ", newest" : ""}`);
  write(byId("serial"), whole(serial));
  const isGone = at != null && at < kept.first;
  byId("transport").classList.toggle("has-lost-entry", isGone);
  write(byId("kept"), isGone
    ? `oldest; entry ${whole(at)} is no longer kept`
    : at == null ? `newest of ${whole(kept.last - kept.first + 1)}` : `${whole(kept.last - serial)} behind`);
}

function drawWorlds({ info }, view) {
  const select = byId("world");
  // Until a server reports its worlds, only the requested world can be selected.
  const [first, count] = info ? [0, Math.min(info.n_worlds, MAX_WORLDS)] : [view.world, 1];
  if (select.options.length !== count || select.options[0].value !== String(first)) {
    const numbers = Array.from({ length: count }, (_, i) => String(first + i));
    select.replaceChildren(...numbers.map((number) => new Option(number, number)));
  }
  select.value = String(view.world);
}

function drawPlayer(player) {
  byId("player").hidden = !player;
  if (!player) return;
  write(byId("play"), player.ended ? "Play again" : player.playing ? "Stop playing" : "Resume");
  const speed = byId("speed");
  if (document.activeElement !== speed) speed.value = String(player.speed);
  write(byId("clock"), player.ended ? "ended" : `${player.seconds.toFixed(1)} s`);
}
