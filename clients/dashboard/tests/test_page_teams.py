"""Tests several robots in a world: each robot's state, holder and marks."""

import numpy as np

from teams import STATES, write_recording
from test_page_access import serious
from test_page_pixels import rgb

#: Colours of robots 0 to 2.
COLORS = ["#5ee6c8", "#ff9ad5", "#b9f04a"]


def states(look) -> list[str]:
    return [robot["state"] for robot in look.picture(".shown.robots") or []]


def lines(look) -> list[str]:
    return look.at("robots").locator("li").all_text_contents()


def test_each_robot_is_told_and_marked(programs, open_page, tmp_path):
    file = tmp_path / "team.recording"
    write_recording(file, n_robots=3, n_steps=5)
    look = open_page(programs.dashboard(recording=file), color_scheme="dark")
    look.eventually(lambda: look.text("clock") == "ended", "its end")
    assert states(look) == list(STATES)
    assert lines(look) == ["0flewshare 4", "1hovered", "2late"]
    assert look.number("reward") == 4.5
    assert look.page.get_by_text("team reward").is_visible()
    assert not look.at("holder").is_visible()
    check_marks(look)
    assert serious(look) == []


def check_marks(look) -> None:
    """Checks the marks: a disc for a robot that flew, a ring for hovered, a dashed one for late."""
    pixels = look.pixels("overlay-frame")[..., :3].astype(int)
    scale = np.array(pixels.shape[:2]) / look.pixels("panel-frame").shape[:2]
    radius = max(0.85 * scale[1], 8)
    turns = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    around = np.stack([np.sin(turns), np.cos(turns)], axis=-1)

    def share(robot: int, reach: float) -> float:
        """Returns the share of a circle around a robot that has the robot's colour."""
        middle = (np.array(look.picture(".shown.robots")[robot]["cell"]) + 0.5) * scale
        rows, cols = (middle + reach * radius * around).astype(int).T
        return np.mean((np.abs(pixels[rows, cols] - rgb(COLORS[robot])) < 30).all(-1))

    assert share(0, 0.7) > 0.9
    assert share(1, 0.7) < 0.1
    assert share(2, 0.7) < 0.1
    assert share(1, 0.87) > 0.9
    assert 0.3 < share(2, 0.87) < 0.8
    path = look.picture(".shown.robots")[0]["path"]
    line = pixels[tuple(((np.array(path[3:9]) + 0.5) * scale).astype(int).T)]
    # A line between two rows of pixels covers a part of the dark edge.
    assert (np.abs(line - rgb(COLORS[0])) < 60).all(), "its path has its colour"


def test_a_team_of_an_agent_that_flies_one_that_hangs_and_nobody(programs, open_page):
    server = programs.server(robots=3, deadline_millis=50, lease_millis=600_000, publish_truth=True)
    look = open_page(programs.dashboard(server.instance))
    hanging = programs.agent(server.instance, robots=1)
    look.eventually(lambda: states(look) == ["hovered", "flew", "hovered"], "it flies alone")
    look.eventually(lambda: look.text("believer") == "robot 1", "whose belief it is")
    hanging.suspend()
    flying = programs.agent(server.instance, robots=0)
    look.eventually(lambda: states(look) == ["flew", "late", "hovered"], "two of them")
    look.eventually(lambda: look.text("believer") == "robot 0", "another belief")
    look.wait_for_steps()
    # The page asks the server for holders only at intervals, so they arrive later than steps.
    held = f" · pid {flying.pid}"
    look.eventually(lambda: lines(look)[0].endswith(held), "who holds the first")
    told = lines(look)
    assert told[0].startswith("0flewshare ")
    assert told[1:] == [f"1latepid {hanging.pid}", "2hoveredheld by nobody"]
    hanging.kill()
    look.eventually(lambda: lines(look)[1] == "1hoveredheld by nobody", "it is dead")
    look.wait_for_steps()
