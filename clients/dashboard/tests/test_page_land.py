"""Tests maps, no-fly cells, and cells that robots see beyond their path."""

import numpy as np

from conftest import ROOT
from test_page_access import serious
from test_page_pixels import rgb

HEIGHT, WIDTH = 12, 16
NO_FLY = np.zeros((HEIGHT, WIDTH), int)
NO_FLY[:2] = 1
FUEL = np.ones((HEIGHT, WIDTH))
FUEL[:, WIDTH // 2 :] = 3.0


def write_model(folder) -> str:
    """Writes a model with a map, no-fly cells, and a sensor with a radius."""
    text = (ROOT / "config/models/wildfire-burnout.toml").read_text()
    head, rest = text.split("states = [", 1)
    rest = rest.replace("near.burning", 'times = ["fuel"]\nnear.burning', 1)
    maps = f'maps = "land.npz"\nno_fly = {NO_FLY.tolist()}\nsensor = {{ radius = 2 }}\n'
    model = folder / "land.toml"
    model.write_text(f"{head}{maps}states = [{rest}")
    np.savez(folder / "land.npz", fuel=FUEL)
    return model


def test_land_is_drawn_and_told(programs, open_page, tmp_path):
    shape = {"height": HEIGHT, "width": WIDTH, "moves": 6, "start": "8,3"}
    server = programs.server(model=write_model(tmp_path), publish_truth=True, **shape)
    look = open_page(programs.dashboard(server.instance), color_scheme="dark")
    assert programs.agent(server.instance, steps=3).wait() == 0
    look.eventually(lambda: look.picture(".shown.step") == 3 and look.has("belief"), "step 3")
    check_lines(look)
    legend = look.page.locator("#legend").text_content()
    assert "not observedno-flypath" in legend
    check_map(look)
    look.at("panel-truth").hover(position={"x": 2, "y": 2})
    inspector = look.page.get_by_label("one cell in numbers")
    look.eventually(lambda: "landno-flyfuel1" in inspector.text_content(), "its land")
    assert serious(look) == []


def check_map(look) -> None:
    """Checks that the map is drawn from the first to the last grey of its scale."""
    assert "map: fuel1 to 3" in look.page.locator('[data-panel="map-0"]').text_content()
    pixels = look.pixels("panel-map-0")[..., :3]
    expected = np.where(FUEL[..., None] == 1.0, rgb("#1c1c1c"), rgb("#d7d7d7"))
    assert np.abs(pixels.astype(float) - expected).max() <= 1


def check_lines(look) -> None:
    """Checks hatches over no-fly cells, and the line around observed cells."""
    frame = look.array("frame").reshape(HEIGHT, WIDTH)
    for panel in ("truth", "seen", "frame", "belief-2", "entropy"):
        is_marked = look.pixels(f"overlay-{panel}")[..., 3] > 127
        scale = np.array(is_marked.shape) / (HEIGHT, WIDTH)
        edges = [np.round(np.arange(17) * size).astype(int) for size in scale]
        for row, col in np.ndindex(HEIGHT, WIDTH):
            (top, bottom), (left, right) = edges[0][row : row + 2], edges[1][col : col + 2]
            middle = is_marked[top + 3 : bottom - 3, left + 3 : right - 3]
            if NO_FLY[row, col]:
                assert 0.1 < middle.mean() < 0.6, f"hatches of {panel} at {row}, {col}"
            elif panel != "frame" or frame[row, col] == 255:
                assert not middle.any(), f"{panel} at {row}, {col}"
    outline = (frame[2:, :-1] != 255) != (frame[2:, 1:] != 255)
    is_marked = look.pixels("overlay-frame")[..., 3] > 0
    for row, col in np.argwhere(outline):
        assert is_marked[edges[0][row + 2] + 3 : edges[0][row + 3] - 3, edges[1][col + 1]].all()
