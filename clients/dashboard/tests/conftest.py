"""Fixtures: a deadline for each test, programs that end with the test, and a browser."""

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import pytest
from playwright.sync_api import Browser, BrowserContext, sync_playwright

from looking import Look
from running import PATIENCE, Dashboard, Program, Programs

#: Deadline of a whole test, in seconds. It is long, so that a busy machine does not fail a test.
DEADLINE = 900

ROOT = Path(__file__).resolve().parents[3]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds options for the programs, the browser, and the folder of pictures."""
    parser.addoption("--programs", type=Path, default=ROOT / "target/debug")
    parser.addoption("--chromium", default=shutil.which("chromium"))
    parser.addoption("--screenshots", type=Path, default=ROOT / "target/screenshots")
    parser.addoption("--throttle", type=float, default=1.0, help="how many times slower pages run")


@pytest.fixture(autouse=True)
def deadline() -> Iterator[None]:
    def late(_number: int, _frame: object) -> None:
        raise TimeoutError(f"still running after {DEADLINE} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(DEADLINE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="session")
def chromium(request: pytest.FixtureRequest) -> Iterator[Browser]:
    path = request.config.getoption("--chromium")
    if path is None:
        pytest.fail("expected `chromium` on the PATH (apt-get install chromium), or --chromium")
    # Chromium cannot use its sandbox as root, for example in containers.
    flags = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=flags, timeout=120_000)
        yield browser
        browser.close()


@pytest.fixture
def programs(request: pytest.FixtureRequest) -> Iterator[Programs]:
    """Starts programs, for example with `programs.server(worlds=4)`. They end with the test."""
    with ExitStack() as stack:
        yield Programs(request.config.getoption("--programs"), stack)


@pytest.fixture
def open_page(request: pytest.FixtureRequest, chromium: Browser) -> Iterator[Callable[..., Look]]:
    """Opens a dashboard's page: `open_page(dashboard, hash="#world=2", color_scheme="dark")`.

    At the end of the test, the page must have no complaints that the test has not allowed.
    """
    throttle = request.config.getoption("--throttle")
    looks: list[Look] = []
    contexts: list[BrowserContext] = []

    def open_one(dashboard: Dashboard, *, hash: str = "", **settings: object) -> Look:
        context = chromium.new_context(**{"viewport": {"width": 1280, "height": 720}} | settings)
        context.set_default_timeout(1000 * PATIENCE)
        contexts.append(context)
        look = Look(context.new_page())
        looks.append(look)
        look.slow_down(throttle)
        look.page.goto(dashboard.url + hash)
        return look

    yield open_one
    complaints = [complaint for look in looks for complaint in look.complaints()]
    for context in contexts:
        context.close()
    assert complaints == []


class Watched(NamedTuple):
    """A server that publishes hidden states, an agent, and a page that shows the agent's belief."""

    server: Program
    dashboard: Dashboard
    agent: Program
    look: Look


@pytest.fixture
def watched(programs: Programs, open_page: Callable[..., Look]) -> Watched:
    server = programs.server(publish_truth=True)
    dashboard = programs.dashboard(server.instance)
    agent = programs.agent(server.instance)
    look = open_page(dashboard)
    look.eventually(lambda: look.has("belief", "truth"), "a belief is shown")
    return Watched(server, dashboard, agent, look)
