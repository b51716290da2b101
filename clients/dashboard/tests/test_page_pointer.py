"""Tests that the page shows the values under a resting pointer, even when they change."""

import re

import pytest

PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True}


def is_at(look, cell: str) -> bool:
    """Returns whether the inspector shows this cell, such as "row 1, col 2"."""
    return look.page.get_by_label("one cell in numbers").locator("h3 b").text_content() == cell


def is_at_robot(look) -> bool:
    """Returns whether the inspector shows the robot's cell, because no cell is pointed at."""
    hint = look.page.get_by_label("one cell in numbers").locator("h3 .hint")
    return hint.text_content() == "robot"


def middle(look, panel: str, row: int, col: int) -> tuple[float, float]:
    """Returns the position of a cell's middle in the window."""
    box = look.at(panel).bounding_box()
    height, width = look.page.evaluate(
        "[emberwatch.picture.shown.height, emberwatch.picture.shown.width]"
    )
    return (
        box["x"] + (col + 0.5) * box["width"] / width,
        box["y"] + (row + 0.5) * box["height"] / height,
    )


def told(look, chart: str) -> str:
    """Returns the step whose value a chart shows, such as "at k 12"."""
    return look.page.locator(f".chart-{chart} .at").text_content()


@pytest.fixture
def resting(programs, open_page):
    """Opens a page with 24 x 32 cells on which no agent acts yet, so that nothing changes."""
    server = programs.server(publish_truth=True)
    look = open_page(programs.dashboard(server.instance))
    look.eventually(lambda: look.has("truth"), "the world before its first step")
    look.eventually(lambda: look.text("holder") == "nobody", "the server's facts")
    look.wait_for_pictures()
    return server, look


def test_values_come_under_the_pointer(resting, programs):
    server, look = resting
    canvas = look.at("chart-target")
    canvas.hover(position={"x": canvas.bounding_box()["width"] - 1, "y": 20})
    look.eventually(lambda: told(look, "target") == "at k 0", "all that there is")
    assert programs.agent(server.instance, steps=40).wait() == 0
    # No step is lost, because 40 steps fit into a reader's buffer.
    look.eventually(lambda: told(look, "target") == "at k 40", "the step that came there")
    value = look.page.locator(".chart-target output")
    look.eventually(
        lambda: value.text_content() == str(look.picture(".shown.n_target_cells")), "its value"
    )


def test_what_moves_under_the_pointer_is_told(resting):
    _, look = resting
    look.page.mouse.move(*middle(look, "panel-truth", 23, 31))
    look.eventually(lambda: is_at(look, "row 23, col 31"), "the last cell")
    # The keys or the pointer select the cell, whichever was used last.
    look.page.get_by_label("cells of seen so far").focus()
    look.page.keyboard.press("ArrowDown")
    look.eventually(lambda: is_at(look, "row 13, col 16"), "where the key went")
    look.page.mouse.move(*middle(look, "panel-truth", 6, 7))
    look.eventually(lambda: is_at(look, "row 6, col 7"), "where the pointer went then")
    # After the pointer has left, no cell is pointed at.
    look.page.get_by_label("cells of seen so far").blur()
    look.page.mouse.move(2, 2)
    look.eventually(lambda: is_at_robot(look), "it left the panel")
    # Scrolling moves the page under the resting pointer.
    look.page.set_viewport_size({"width": 800, "height": 600})
    look.wait_for_pictures()
    x, y = middle(look, "panel-truth", 3, 4)
    look.page.mouse.move(x, y)
    look.eventually(lambda: is_at(look, "row 3, col 4"), "the cell pointed at")
    by = middle(look, "panel-truth", 5, 4)[1] - y
    look.page.evaluate(f"scrollBy(0, {by})")
    look.eventually(lambda: is_at(look, "row 5, col 4"), "two rows further down")


def test_a_panel_that_goes_is_pointed_at_no_more(programs, open_page):
    server = programs.server(worlds=2, seed=20)
    look = open_page(programs.dashboard(server.instance))
    assert programs.agent(server.instance, steps=5).wait() == 0
    look.eventually(lambda: look.picture(".agent.is_live") is False, "its last belief")
    look.page.mouse.move(*middle(look, "panel-belief-1", 3, 4))
    look.eventually(lambda: is_at(look, "row 3, col 4"), "the cell pointed at")
    look.page.evaluate("location.hash = '#world=1'")
    look.eventually(lambda: look.picture(".shown.seed") == "21", "a world without beliefs")
    look.eventually(lambda: is_at_robot(look), "no panel is there")


def test_a_finger_points_while_it_touches(programs, open_page):
    server = programs.server(publish_truth=True)
    look = open_page(programs.dashboard(server.instance), **PHONE)
    assert programs.agent(server.instance, steps=40).wait() == 0
    look.eventually(lambda: look.picture(".agent.is_live") is False, "the last picture")
    client = look.page.context.new_cdp_session(look.page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        places = [{"x": x, "y": y} for x, y in points]
        client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})

    look.at("panel-truth").scroll_into_view_if_needed()
    touch("touchStart", middle(look, "panel-truth", 3, 4))
    look.eventually(lambda: is_at(look, "row 3, col 4"), "the cell touched")
    touch("touchEnd")
    look.eventually(lambda: is_at_robot(look), "the finger was lifted")
    look.at("chart-reward").scroll_into_view_if_needed()
    box = look.at("chart-reward").bounding_box()
    touch("touchStart", (box["x"] + box["width"] / 2, box["y"] + 20))
    look.eventually(lambda: re.fullmatch(r"at k \d+", told(look, "reward")), "the step touched")
    step = told(look, "reward").removeprefix("at k ")
    touch("touchEnd")
    look.eventually(lambda: told(look, "reward") == "", "the finger was lifted")
    look.eventually(lambda: look.text("step") == step, "the tap went to that step")
