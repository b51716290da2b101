// Writes the page's texts: state, note, facts, and the notice while the page waits for a server or step.

import { write } from "./elements.js";
import { createRobots } from "./robots.js";
import { beliefAge, isTeam, short, stateNames, targetName, text, whole } from "./words.js";

const byId = (id) => document.getElementById(id);

export function createFacts() {
  const announce = byId("announce");
  const robots = createRobots(byId("robots"));
  let said = "";
  // Whether pictures fail to arrive or to decode; the page shows this until one succeeds.
  let isTroubled = false;

  // Announces each change of state once to screen readers.
  function say(sentence) {
    if (sentence === said) return;
    said = sentence;
    announce.textContent = sentence;
  }

  function drawWell(picture) {
    const state = stateOf(picture);
    const problem = picture.note ?? picture.player?.error;
    drawState(state, isToldLarge(picture) ? null : problem);
    say(problem ?? `${state}, world ${picture.world}`);
  }

  function drawTrouble(state, note, sentence) {
    isTroubled = true;
    drawState(state, note);
    say(sentence);
  }

  return {
    draw(picture, view) {
      if (!isTroubled) drawWell(picture);
      drawServer(picture);
      const world = picture.status?.worlds.find((other) => other.world === picture.world);
      drawWorld(picture, world);
      robots.draw(picture, world?.holder_pids);
      drawAgent(picture, view.at == null);
      drawEmpty(picture);
    },
    recovered() { isTroubled = false; },
    gone(reason) {
      if (reason) drawTrouble("full", `The dashboard refuses this browser: ${reason}. Trying again every second.`, reason);
      else drawTrouble("gone", "The dashboard is gone; reconnecting every second.", "dashboard gone, reconnecting");
    },
    failed(error) {
      const problem = `This page cannot read the dashboard's picture: ${error.message}`;
      drawTrouble("unreadable", problem, "this page cannot read the dashboard's picture");
    },
  };
}

// A recording has no server: it plays, pauses or ends.
function stateOf({ state, source, player }) {
  if (source !== "recording" || state !== "serving") return state;
  if (player?.ended) return "ended";
  return player?.playing === false ? "paused" : "playing";
}

// Until a server is found for the first time, a notice that fills the page says that it is waiting for one.
function isToldLarge({ state, source, info }) {
  return state === "waiting" && source === "live" && !info;
}

function drawState(state, note) {
  write(byId("state"), { gone: "dashboard gone, reconnecting", full: "dashboard full, reconnecting" }[state] ?? state);
  byId("state-pill").dataset.state = state;
  byId("note").hidden = !note;
  write(byId("note"), note ?? "");
}

function drawServer({ info, status, lost, instance, source }) {
  const isLive = source === "live";
  write(byId("source"), isLive ? "instance" : "recording");
  write(byId("instance"), instance);
  byId("instance").title = instance;
  write(byId("task"), info?.task ? `task ${info.task}` : "");
  for (const fact of document.querySelectorAll(".of-server")) fact.hidden = !isLive;
  write(byId("rate"), short(status?.steps_per_second));
  write(byId("observers"), whole(status?.n_observers));
  write(byId("observers-word"), status?.n_observers === 1 ? "observer" : "observers");
  drawLost(lost);
}

// Always shows the number of lost frames, because zero is good news. Shows other losses only if there are any.
function drawLost(lost) {
  const others = [["truth", lost?.truth], ["beliefs", lost?.agent]].filter(([, count]) => count > 0);
  const words = others.map(([name, count]) => ` · ${name} ${whole(count)}`).join("");
  write(byId("lost"), whole(lost?.frames));
  write(byId("lost-others"), words);
  const fact = byId("lost-fact");
  fact.title = `lost since attached: frames ${whole(lost?.frames)}${words}`;
  fact.classList.toggle("is-alarming", lost?.frames > 0 || others.length > 0);
}

function drawWorld(picture, world) {
  const { shown } = picture;
  write(byId("step"), whole(shown?.step));
  write(byId("reward-word"), isTeam(shown) ? "team reward" : "reward");
  write(byId("reward"), short(shown?.reward));
  write(byId("hits"), shown ? `${targetName(picture)} in ${whole(shown.n_hits)} of ${whole(shown.n_visited)} cells` : "");
  write(byId("seed"), text(shown?.seed));
  write(byId("episode"), ending(shown));
  write(byId("holder"), holder(world));
  // For a team, each robot's line names its holder.
  byId("holder-fact").hidden = isTeam(shown) && !world?.resetting;
}

function ending(shown) {
  if (!shown) return text(null);
  return `${shown.episode}${shown.truncated ? ", truncated" : shown.terminated ? ", ended" : ""}`;
}

function holder(world) {
  if (!world) return text(null);
  return world.resetting ? "burning in" : text(world.holder_pids[0] ?? "nobody");
}

function drawAgent(picture, isNewest) {
  const { agent, source } = picture;
  // If the belief is about an earlier step, the objective and plan of the shown path are unknown.
  const plan = beliefAge(picture) ? null : agent;
  const isSilent = isNewest && source === "live" && agent?.is_live === false;
  write(byId("policy"), text(agent?.policy));
  write(byId("silent"), isSilent ? "silent" : "");
  write(byId("objective"), text(plan?.objective));
  write(byId("belief-from"), text(agent?.belief_from));
  write(byId("believer"), isTeam(picture.shown) ? flownBy(agent) : "");
  write(byId("plan"), plan?.plan_millis == null ? text(null) : `${Number(plan.plan_millis.toPrecision(2))} ms`);
}

function flownBy(agent) {
  if (!agent) return "";
  const { first_robot: first, n_robots: count } = agent;
  return count > 1 ? `robots ${first}–${first + count - 1}` : `robot ${first}`;
}

// Before the first step, the page shows how to start instead of empty panels.
function drawEmpty(picture) {
  const { instance, source, info, shown, world, player } = picture;
  const isEmpty = !info || !shown;
  byId("empty").hidden = !isEmpty;
  for (const id of ["facts", "stage"]) byId(id).hidden = isEmpty;
  // A recording may begin with a long pause, which the speed control shortens.
  byId("transport").hidden = isEmpty && !player;
  byId("server").hidden = !info;
  if (!isEmpty) return;
  const isAwaited = !info && source === "live";
  write(byId("empty-lead"), isAwaited ? "Waiting for a server on instance" : "Waiting for the first step of");
  write(byId("empty-of"), isAwaited || !info ? instance : `world ${world}`);
  byId("empty-start").hidden = !isAwaited;
  write(byId("empty-command"), `emberwatch-server --instance ${instance}`);
}

export function titleOf(picture) {
  if (!picture?.shown) return "Emberwatch";
  return `k ${whole(picture.shown.step)} · ${picture.info?.model ?? stateNames(picture).join("/")} · Emberwatch`;
}
