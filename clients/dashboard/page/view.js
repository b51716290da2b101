// What the visitor wants to see: world, entry, theme. The address's hash keeps world and theme, so that a
// link or a reload brings them back.

const THEMES = ["auto", "light", "dark"];
// Worlds that an address may name while nobody knows how many there are, and that can be selected at all.
export const MOST_WORLDS = 4096;
const darkness = matchMedia("(prefers-color-scheme: dark)");

/**
 * The view, with `asks()` called when another picture is wanted and `changed()` when only looks change.
 * `worlds()` gives how many there are, if that is known.
 */
export function createView({ asks, changed, worlds }) {
  const read = () => readHash(Math.min(worlds() ?? MOST_WORLDS, MOST_WORLDS));
  const view = {
    ...read(),
    /** Serial of the entry to look at; null: the newest. */
    at: null,
    /** For the next ask only: a recording's speed, and whether it plays. */
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

/** The theme in effect, "light" or "dark". */
export function themeOf(view) {
  if (view.theme !== "auto") return view.theme;
  return darkness.matches ? "dark" : "light";
}

/** The next ask; wishes about a recording are told once. */
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

// Style sheets know "auto" as no attribute at all.
function applyTheme({ theme }) {
  if (theme === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
}
