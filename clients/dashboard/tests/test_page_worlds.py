"""Tests many worlds, slow browsers, and unpublished data."""

import re

from models import write_model


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
    for bad in ("#world=99999999999", "#%&theme=pink"):
        look.page.evaluate(f"location.hash = '{bad}'")
        look.eventually(lambda: look.picture(".shown.seed") == "20", "the first world")
        look.eventually(lambda: look.at("world-select").input_value() == "0", "the first chosen")
        look.at("world-select").select_option("1")
        look.eventually(lambda: look.picture(".shown.seed") == "21", "the second")


def test_ten_observations_of_a_hidden_model(programs, open_page, tmp_path):
    model = write_model(tmp_path / "ten.toml", 2, 10)
    server = programs.server(model=model, reveal_model="false", publish_truth=True)
    look = open_page(programs.dashboard(server.instance))
    agent = programs.agent(server.instance, model=model, steps=40)
    assert agent.wait() == 0
    look.eventually(lambda: look.picture(".shown.step") == 40 and look.has("seen"), "step 40")
    seen = look.array("seen")
    assert {8, 9} <= set(seen), "the observations beyond the page's own table"
    legend = look.page.locator("#legend").text_content()
    assert all(f"kind {i}" in legend for i in range(10))
    frame, pixels = look.array("frame"), look.pixels("panel-frame").reshape(-1, 4)
    colors = {value: set(map(tuple, pixels[frame == value])) for value in set(frame)}
    assert all(len(found) == 1 for found in colors.values()), "a colour for each observation"
    assert len(set.union(*colors.values())) == len(colors), "no two of the same colour"


def test_a_slow_browser_gets_fewer_pictures_and_the_newest(programs, open_page):
    server = programs.server(publish_truth=True)
    look = open_page(programs.dashboard(server.instance))
    # The number of unanswered requests on a connection, after each of its messages.
    waiting: list[int] = []

    def watch(socket) -> None:
        n_waiting = 0

        def count(by: int) -> None:
            nonlocal n_waiting
            n_waiting += by
            waiting.append(n_waiting)

        socket.on("framesent", lambda _: count(1))
        socket.on("framereceived", lambda _: count(-1))

    look.page.on("websocket", watch)
    look.slow_down(10)
    look.page.reload()
    look.eventually(lambda: look.picture(".shown"), "the world before its first step")
    agent = programs.agent(server.instance, steps=400, steps_per_second=200)
    assert agent.wait() == 0
    look.eventually(lambda: look.picture(".shown.step") == 400, "the newest step")
    assert look.drawn() < 400
    assert set(waiting) <= {0, 1, 2}, "no pictures were queued"


def test_one_cell_is_the_same_in_all_panels(watched):
    look = watched.look
    watched.agent.interrupt()
    look.eventually(lambda: look.picture(".agent.is_live") is False, "nothing moves")
    look.eventually(lambda: look.has("belief", "truth"), "a belief of the last step")
    look.at("panel-belief-1").hover(position={"x": 2, "y": 2})
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


def test_charts_tell_values_and_seek(watched):
    look, pause = watched.look, watched.look.at("pause")
    look.eventually(lambda: look.picture(".kept.last") > 20, "some steps")
    # Serial numbers of entries differ from steps if a busy machine has lost frames.
    at = re.compile(r"^at (k|entry) [\d,]+$")
    is_older = "emberwatch.picture.shown.serial < emberwatch.picture.kept.last"
    for chart in ("reward", "target", "log-loss", "objective"):
        canvas = look.at(f"chart-{chart}")
        canvas.hover(position={"x": 120, "y": 20})
        told = look.page.locator(f".chart-{chart} .at").get_by_text(at)
        look.eventually(told.is_visible, "the step there")
        canvas.click(position={"x": 120, "y": 20})
        look.eventually(lambda: pause.text_content() == "Go live", "paused there")
        look.eventually(lambda: look.page.evaluate(is_older), "an older entry")
        pause.click()
        look.eventually(lambda: pause.text_content() == "Pause", "live again")
