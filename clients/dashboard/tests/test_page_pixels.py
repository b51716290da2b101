"""Compares every pixel with the displayed array, coloured by a separate table of this test."""

import tomllib

import numpy as np

from conftest import ROOT
from emberwatch import Observer, TruthReader
from running import PATIENCE, eventually

STEPS = 30
UNOBSERVED = 255

# The colours of each ramp at nine stops from 0 to 1. Colours between stops are interpolated.
BELIEF = {
    "light": "f9f8e1 c6e4be 87d0ab 4cb6a6 039aa0 057a91 005c80 003e6f 0d2156",
    "dark": "161d2b 1d3450 0d4f75 046e89 038e97 23af9b 70cb95 b8e095 f8f3a3",
}
ENTROPY = {
    "light": "fff5e8 fcdbc2 fbbda6 f3a099 e38598 cc6f9c a9629c 865796 644c8a",
    "dark": "1e1b25 382340 592855 79315d 97405e b2525b c86958 d38762 dba475",
}
UNSEEN = {"light": "e2e2e2", "dark": "2b2f36"}


def rgb(color: str) -> np.ndarray:
    """Converts a hexadecimal colour, with or without #, to three numbers."""
    return np.array(list(bytes.fromhex(color.lstrip("#"))), float)


def ramp(stops: str, levels: np.ndarray) -> np.ndarray:
    """Returns the colours of levels from 0 to 255 on a ramp."""
    table = np.array([rgb(stop) for stop in stops.split()])
    at = levels / 255 * (len(table) - 1)
    channels = [np.interp(at, range(len(table)), table[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=-1)


def of_values(values: np.ndarray, colors: list[str], unseen: str) -> np.ndarray:
    """Returns the colours of states or observations."""
    table = np.zeros((256, 3))
    table[: len(colors)] = [rgb(color) for color in colors]
    table[UNOBSERVED] = rgb(unseen)
    return table[values]


def check_pixels(look, panel: str, expected: np.ndarray) -> None:
    """Checks that a panel's pixels have these colours. Halves may be rounded either way."""
    pixels = look.pixels(panel).astype(float)
    assert (pixels[..., 3] == 255).all()
    assert pixels.shape[:2] == expected.shape[:2]
    worst = np.abs(pixels[..., :3] - expected).max()
    assert worst <= 0.5 + 1e-9, f"{panel}: expected the colours of its array, got {worst} off"


def test_panels_show_what_was_published(programs, open_page):
    model = ROOT / "config/models/road-ice.toml"
    colors = tomllib.loads(model.read_text())
    states = [state["color"] for state in colors["states"]]
    observations = [value["color"] for value in colors["observations"]]
    world = {"height": 24, "width": 40, "moves": 30, "seed": 5}
    server = programs.server(model=model, publish_truth=True, **world)
    look = open_page(programs.dashboard(server.instance))
    look.eventually(lambda: look.text("state") == "serving", "serving")
    with TruthReader(server.instance) as truths, Observer(server.instance) as frames:
        programs.agent(server.instance, steps=STEPS)
        while (truth := truths.receive(PATIENCE)).step < STEPS:
            pass
        while (frame := frames.receive(PATIENCE)).result.step < STEPS:
            pass
    look.eventually(
        lambda: look.picture(".shown.step") == STEPS and look.has("belief", "truth"),
        f"step {STEPS} with its belief",
    )
    assert (look.array("truth") == truth.states.ravel()).all()
    result = frame.robots[0].result
    assert look.picture(".shown.robots")[0]["cell"] == [result.row, result.col]
    assert (look.array("frame") == frame.frame.ravel()).all()
    assert look.number("step") == STEPS
    unseen = UNSEEN | {"light": "484848"}  # distinct from its states' colours
    for theme in ("light", "dark"):
        look.page.get_by_label(theme).check(force=True)
        check_panels(look, theme, states, observations, unseen[theme])


def check_panels(look, theme, states, observations, unseen) -> None:
    """Checks that the panels' pixels have the colours of their arrays."""
    grid = look.pixels("panel-frame").shape[:2]
    # The page redraws in the browser's next frame.
    frame = of_values(look.array("frame").reshape(grid), observations, unseen)
    eventually(
        lambda: np.abs(look.pixels("panel-frame")[..., :3] - frame).max() < 1, f"the theme {theme}"
    )
    truth = of_values(look.array("truth").reshape(grid), states, unseen)
    check_pixels(look, "panel-truth", truth)
    seen = of_values(look.array("seen").reshape(grid), observations, unseen)
    share = 0.4 + 0.6 * 2 ** (-look.array("age").astype(float).reshape(*grid, 1) / 24)
    check_pixels(look, "panel-seen", rgb(unseen) + (seen - rgb(unseen)) * share)
    for state, levels in enumerate(look.array("belief").reshape(-1, *grid)):
        check_pixels(look, f"panel-belief-{state}", ramp(BELIEF[theme], levels))
    entropy = look.array("entropy").reshape(grid)
    check_pixels(look, "panel-entropy", ramp(ENTROPY[theme], entropy))
