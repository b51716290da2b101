"""Tests servers and agents that start and end, and the page's pause, scrubbing and live view."""

import os

from running import eventually, unused_instance


def test_waits_for_a_server_and_then_shows_what_happens(programs, open_page):
    instance = unused_instance()
    look = open_page(programs.dashboard(instance))
    look.eventually(lambda: look.text("state") == "waiting", "waiting")
    command = look.page.get_by_text(f"emberwatch-server --instance {instance}", exact=True)
    assert command.is_visible()
    by_task = dict.fromkeys(("height", "width", "moves", "burn_in"))
    programs.server(instance, task="small", **by_task)
    look.eventually(lambda: look.text("state") == "serving", "serving")
    programs.agent(instance)
    look.wait_for_steps()
    task = look.page.locator("#task")
    look.eventually(lambda: task.text_content() == "task small", "the task's name")
    look.eventually(lambda: look.text("policy") == "beam", "a policy")
    look.eventually(lambda: look.number("holder") > 0, "a holder")
    look.eventually(lambda: look.number("step") > 0, "a step")
    look.eventually(lambda: look.number("observers") >= 1, "an observer")
    assert not command.is_visible()
    look.eventually(lambda: look.has("belief"), "a belief is shown")
    look.eventually(lambda: look.page.get_by_text("--publish-truth").is_visible(), "no truth")
    assert look.page.get_by_text("needs the truth and a belief").is_visible()
    assert not look.at("panel-truth").is_visible()


def test_a_browser_beyond_the_limit_is_refused_until_another_leaves(watched, open_page):
    """The dashboard serves 32 browsers: this page, and 31 more sockets."""
    many = """() => Promise.all(Array.from({ length: 31 }, () => new Promise((opened) => {
        const socket = new WebSocket(new URL("socket", location.href));
        socket.onopen = () => opened();
        (window.sockets ??= []).push(socket);
    })))"""
    look = watched.look
    look.page.evaluate(many)
    late = open_page(watched.dashboard)
    late.eventually(lambda: "dashboard full" in late.text("state"), "full")
    assert "at most 32 browsers at a time: close one" in late.at("note").text_content()
    look.page.evaluate("() => window.sockets.pop().close()")
    late.eventually(lambda: late.text("state") == "serving", "a place")


def test_keys_pause_and_scrub_from_anywhere(watched, programs):
    look = watched.look
    look.eventually(
        lambda: look.picture(".shown.serial") > look.picture(".kept.first") + 20, "steps"
    )
    watched.agent.interrupt()
    look.page.keyboard.press("Space")
    look.eventually(lambda: look.at("pause").text_content() != "Pause", "paused")
    look.wait_for_pictures()
    at = look.picture(".shown.serial")
    look.wait_for_pictures()
    assert look.picture(".shown.serial") == at, "pictures while paused"
    for key, by in [("ArrowLeft", -1), ("Shift+ArrowLeft", -10), ("ArrowRight", 1)]:
        look.page.keyboard.press(key)
        at += by
        look.eventually(lambda at=at: look.picture(".shown.serial") == at, f"{key} goes to {at}")
    look.page.keyboard.press("Home")
    look.eventually(lambda: look.picture(".shown.serial") == look.picture(".kept.first"), "first")
    look.page.keyboard.press("End")
    look.eventually(lambda: look.picture(".shown.serial") > at, "the newest when it was pressed")
    programs.agent(watched.server.instance)
    look.at("pause").click()
    look.wait_for_steps()


def test_a_server_that_is_killed_is_waited_for_whatever_its_grid(watched, programs):
    server, look = watched.server, watched.look
    server.kill()
    look.eventually(lambda: look.text("state") == "waiting", "waiting")
    assert look.text("note") != ""
    assert look.at("panel-frame").is_visible(), "the last picture stays"
    look.wait_for_pictures()
    box = look.at("panel-seen").bounding_box()
    look.at("panel-seen").hover(position={"x": box["width"] - 2, "y": box["height"] - 2})
    look.eventually(lambda: look.page.get_by_text("row 23, col 31").is_visible(), "the last cell")
    programs.server(server.instance, height=20, width=36, publish_truth=True, seed=9)
    look.eventually(lambda: look.text("state") == "serving", "serving")
    programs.agent(server.instance)
    look.eventually(lambda: look.picture(".shown.seed") == "9", "the new server's world")
    look.eventually(
        lambda: look.picture(".arrays.truth.length") == 20 * 36 and look.has("belief"),
        "the new grid with a belief",
    )
    assert look.pixels("panel-truth").shape == (20, 36, 4)
    assert not look.page.get_by_text("row 23, col 31").is_visible(), "a cell that is no more"
    look.wait_for_steps()


def test_a_dashboard_that_goes_is_waited_for(watched, programs):
    server, _, _, look = watched
    # A fixed port, below the range from which the system assigns ports (from 32768).
    dashboard = programs.dashboard(server.instance, port=20000 + os.getpid() % 10000)
    look.page.goto(dashboard.url)
    look.eventually(look.at("panel-frame").is_visible, "a world")
    look.allowed.append("WebSocket connection to .* failed")
    look.page.evaluate("""() => {
        window.held = [];
        window.draws = window.requestAnimationFrame;
        window.requestAnimationFrame = (draw) => held.push(draw);
    }""")
    look.eventually(lambda: look.page.evaluate("held.length > 0"), "a picture to draw")
    dashboard.kill()
    look.eventually(lambda: "dashboard gone" in look.text("state"), "gone")
    # In one call: a frame that is requested in between would be held for ever.
    draw = """() => {
        window.requestAnimationFrame = window.draws;
        held.splice(0).forEach(draw => draw());
        return state.textContent;
    }"""
    assert "dashboard gone" in look.page.evaluate(draw), "a late picture does not hide it"
    look.at("panel-frame").hover(position={"x": 2, "y": 2})
    look.eventually(lambda: look.page.get_by_text("row 0, col 0").is_visible(), "where it points")
    assert "dashboard gone" in look.text("state"), "nor does a pointer"
    assert look.at("note").is_visible()
    assert look.at("panel-frame").is_visible(), "the last picture stays"
    drawn = look.drawn()
    programs.dashboard(server.instance, port=dashboard.port)
    look.eventually(lambda: look.text("state") == "serving", "serving again")
    eventually(lambda: look.drawn() > drawn + 3, "pictures again")
