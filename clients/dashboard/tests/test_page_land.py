"""Tests zones, no-fly cells, and cells that robots see beyond their path."""

import numpy as np

from conftest import ROOT
from test_page_access import serious
from test_page_pixels import UNSEEN, rgb

HEIGHT, WIDTH = 12, 16
ZONES = {"grass": "#7a9a3a", "town": "#8a5a9a"}
NO_FLY = np.zeros((HEIGHT, WIDTH), int)
NO_FLY[:2] = 1
ZONE_MAP = np.zeros((HEIGHT, WIDTH), int)
ZONE_MAP[:, WIDTH // 2 :] = 1


def model_of_zones() -> str:
    """Returns a wildfire model with two zones, no-fly cells, and a sensor with a radius."""
    text = (ROOT / "config/models/wildfire.toml").read_text()
    head, states = text.split("[[states]]", 1)
    states, kernel = states.split("[[kernel]]", 1)
    maps = f"zone_map = {ZONE_MAP.tolist()}\nno_fly = {NO_FLY.tolist()}\n"
    sensor = "[sensor]\nradius = 2\n"
    zones = "".join(f'[[zones]]\nname = "{name}"\ncolor = "{ZONES[name]}"\n' for name in ZONES)
    kernels = [
        f"[[kernel]]{kernel}".replace("[[kernel]]", f'[[kernel]]\nzone = "{name}"')
        for name in ZONES
    ]
    return head + maps + sensor + zones + "[[states]]" + states + "".join(kernels)


def test_land_is_drawn_and_told(programs, open_page, tmp_path):
    theme = "dark"
    model = tmp_path / "zones.toml"
    model.write_text(model_of_zones())
    shape = {"height": HEIGHT, "width": WIDTH, "moves": 6, "start": "8,3"}
    server = programs.server(model=model, publish_truth=True, **shape)
    look = open_page(programs.dashboard(server.instance), color_scheme=theme)
    assert programs.agent(server.instance, steps=3).wait() == 0
    look.eventually(lambda: look.picture(".shown.step") == 3 and look.has("belief"), "step 3")
    check_cells(look, theme)
    check_lines(look)
    legend = look.page.locator("#legend").text_content()
    assert "not observedgrasstownno-flypath" in legend
    look.at("panel-truth").hover(position={"x": 2, "y": 2})
    inspector = look.page.get_by_label("one cell in numbers")
    look.eventually(lambda: "landgrass, no-fly" in inspector.text_content(), "its zone")
    assert serious(look) == []


def check_cells(look, theme: str) -> None:
    """Checks that observed cells have their colours, and other cells their zone's pale colour."""
    frame = look.array("frame").reshape(HEIGHT, WIDTH)
    pixels = look.pixels("panel-frame")[..., :3].astype(float)
    colors = [rgb(color) for color in look.picture(".info.observation_colours")]
    assert len(colors) == 3
    tints = [0.4 * rgb(color) + 0.6 * rgb(UNSEEN[theme]) for color in ZONES.values()]
    table = np.array([*colors, *tints])
    expected = table[np.where(frame == 255, len(colors) + ZONE_MAP, np.minimum(frame, 2))]
    assert np.abs(pixels - expected).max() <= 0.5 + 1e-9


def check_lines(look) -> None:
    """Checks hatches over no-fly cells, dots between zones, and the line around observed cells."""
    frame = look.array("frame").reshape(HEIGHT, WIDTH)
    for panel in ("truth", "seen", "frame", "belief-2", "entropy"):
        is_marked = look.pixels(f"overlay-{panel}")[..., 3] > 127
        scale = np.array(is_marked.shape) / (HEIGHT, WIDTH)
        edges = [np.round(np.arange(17) * size).astype(int) for size in scale]
        for row, col in np.ndindex(HEIGHT, WIDTH):
            (top, bottom), (left, right) = edges[0][row : row + 2], edges[1][col : col + 2]
            middle = is_marked[top + 3 : bottom - 3, left + 3 : right - 3]
            if NO_FLY[row, col]:
                assert 0.1 < middle.mean() < 0.5, f"hatches of {panel} at {row}, {col}"
            elif panel != "frame" or frame[row, col] == 255:
                assert not middle.any(), f"{panel} at {row}, {col}"
        border = is_marked[edges[0][2] + 3 :, edges[1][WIDTH // 2]]
        assert border.mean() > 0.9, f"between the zones of {panel}"
    outline = (frame[2:, :-1] != 255) != (frame[2:, 1:] != 255)
    is_marked = look.pixels("overlay-frame")[..., 3] > 0
    for row, col in np.argwhere(outline):
        assert is_marked[edges[0][row + 2] + 3 : edges[0][row + 3] - 3, edges[1][col + 1]].all()
