"""Large, oblong and many worlds; slow browsers; what is not published."""

import pytest

from running import eventually


def test_a_large_world(programs, open_page):
    server = programs.server(height=256, width=256, moves=64, burn_in=50, publish_truth=True)
    look = open_page(programs.dashboard(server.instance))
    programs.agent(server.instance)
    look.eventually(lambda: look.has("belief", "truth"), "a belief is shown")
    look.wait_for_steps()
    assert look.pixels("panel-truth").shape == (256, 256, 4)
    assert look.page.evaluate("document.documentElement.scrollHeight <= innerHeight")


def test_four_worlds(programs, open_page):
    server = programs.server(worlds=4, seed=20)
    look = open_page(programs.dashboard(server.instance), hash="#world=2&theme=dark")
    programs.agent(server.instance, world=2)
    look.wait_for_steps()
    assert look.picture(".shown.seed") == "22"
    assert look.at("world-select").input_value() == "2"
    assert look.page.get_by_label("dark").is_checked()
    look.at("world-select").select_option("3")
    look.eventually(lambda: look.picture(".shown.seed") == "23", "the other world")
    assert look.page.evaluate("location.hash") == "#world=3&theme=dark"
    look.eventually(lambda: look.text("holder") == "nobody", "nobody holds it")
    assert look.page.get_by_text("No agent publishes its belief").is_visible()
    look.page.evaluate("location.hash = '#world=2&theme=light'")
    look.eventually(lambda: look.picture(".shown.seed") == "22", "back by the address")
    look.wait_for_steps()


def test_a_world_that_is_not_there(programs, open_page):
    server = programs.server()
    look = open_page(programs.dashboard(server.instance), hash="#world=7")
    look.eventually(lambda: look.picture(".shown.step") is not None, "a world that is there")
    assert look.picture(".world") == 0


def test_what_is_not_published_is_told(programs, open_page):
    server = programs.server()
    look = open_page(programs.dashboard(server.instance))
    programs.agent(server.instance)
    look.eventually(lambda: look.has("belief"), "a belief is shown")
    assert look.page.get_by_text("--publish-truth").is_visible()
    assert look.page.get_by_text("needs the truth and a belief").is_visible()
    assert not look.at("panel-truth").is_visible()


def test_a_slow_browser_gets_fewer_pictures_and_the_newest(programs, open_page):
    server = programs.server(publish_truth=True)
    look = open_page(programs.dashboard(server.instance))
    client = look.page.context.new_cdp_session(look.page)
    client.send("Emulation.setCPUThrottlingRate", {"rate": 30})
    look.eventually(lambda: look.picture(".shown"), "the world before its first step")
    agent = programs.agent(server.instance, steps=4000)
    agent.wait()
    drawn = look.drawn()
    look.eventually(lambda: look.picture(".shown.step") == 4000, "the newest step")
    assert look.drawn() - drawn < 20, "no pictures were queued"


def test_one_cell_is_the_same_in_all_panels(watched):
    server, look = watched.server, watched.look
    look.page.keyboard.press("Space")
    look.eventually(lambda: look.at("pause").text_content() != "Pause", "paused")
    server.kill()
    look.eventually(lambda: look.text("state") == "waiting", "nothing moves")
    look.at("panel-belief-1").hover(position={"x": 5, "y": 5})
    inspector = look.page.get_by_label("one cell in numbers")
    look.eventually(lambda: "row 0, col 0" in inspector.text_content(), "the cell pointed at")
    for panel in ("truth", "seen", "frame", "belief-0", "belief-2", "entropy"):
        assert look.pixels(f"overlay-{panel}").any(), f"a cross on {panel}"
    width = look.picture(".info.width")
    cells = look.picture(".info.height") * width
    look.page.mouse.move(2, 2)
    look.page.get_by_label("cells of truth").focus()
    look.page.keyboard.press("ArrowDown")
    row, col = look.picture(".info.height") // 2 + 1, width // 2
    look.eventually(lambda: f"row {row}, col {col}" in inspector.text_content(), "one row down")
    belief = look.array("belief")[[state * cells + row * width + col for state in range(3)]]
    for value in belief:
        assert f"{value / 255:.2f}" in inspector.text_content()


@pytest.mark.parametrize("chart", ["reward", "target", "log-loss", "objective"])
def test_charts_tell_values_and_seek(watched, chart):
    look = watched.look
    look.eventually(lambda: look.picture(".kept.last") > 20, "some steps")
    canvas = look.at(f"chart-{chart}")
    canvas.hover(position={"x": 120, "y": 20})
    look.eventually(lambda: look.page.get_by_text("at k").first.is_visible(), "the step there")
    canvas.click(position={"x": 120, "y": 20})
    look.eventually(lambda: look.at("pause").text_content() == "Go live", "paused there")
    eventually(lambda: look.picture(".shown.serial") < look.picture(".kept.last"), "an older entry")
