// The visitor's choices: world, entry, theme. The address's hash stores world and theme, so that a link or a reload
// restores them.

const THEMES = ["auto", "light", "dark"];
// Maximum number of selectable worlds, and of worlds that an address may name before their number is known.
export const MAX_WORLDS = 4096;
const darkness = matchMedia("(prefers-color-scheme: dark)");

/**
 * Creates the view. It calls `asks()` when it needs another picture, and `changed()` when only the appearance changes.
 * `worlds()` returns the number of worlds, if known.
 */
export function createView({ asks, changed, worlds }) {
  const read = () => readHash(Math.min(worlds() ?? MAX_WORLDS, MAX_WORLDS));
  const view = {
    ...read(),
    /** Serial of the entry to look at; null for the newest. */
    at: null,
    /** For the next request only: a recording's new speed, and whether to play it. */
    player: { speed: null, playing: null },
  };

  const act = {
    seek(serial) { view.at = serial; asks(); changed(); },
    world(world) { if (world !== view.world) { view.world = world; view.at = null; writeHash(view); asks(); } },
    theme(theme) { view.theme = theme; writeHash(view); applyTheme(view); changed(); },
    player(wish) { Object.assign(view.player, wish); asks(); },
  };

  darkness.addEventListener("change", changed);
  addEventListener("hashchange", () => {
    const { world, theme } = read();
    act.world(world);
    act.theme(theme);
  });
  applyTheme(view);
  return { view, act };
}

export function themeOf(view) {
  if (view.theme !== "auto") return view.theme;
  return darkness.matches ? "dark" : "light";
}

/** Returns the next request. Changes to a recording's player are sent only once. */
export function askOf(view, bins) {
  const { speed, playing } = view.player;
  view.player = { speed: null, playing: null };
  return { world: view.world, at: view.at, bins, speed, playing };
}

function readHash(worlds) {
  const hash = new URLSearchParams(location.hash.slice(1));
  const world = /^\d+$/.test(hash.get("world")) ? Number(hash.get("world")) : 0;
  const theme = hash.get("theme");
  return {
    world: world < worlds ? world : 0,
    theme: THEMES.includes(theme) ? theme : "auto",
  };
}

function writeHash({ world, theme }) {
  history.replaceState(null, "", `#world=${world}&theme=${theme}`);
}

// In the style sheet, "auto" is the absence of the attribute.
function applyTheme({ theme }) {
  if (theme === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
}
