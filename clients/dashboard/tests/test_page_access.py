"""Tests access to the page: refusal of other sites, screen readers, keys, small screens."""

import base64
import os
from contextlib import closing
from http.client import HTTPConnection, HTTPResponse

import pytest
from axe_playwright_python.sync_playwright import Axe

from running import PATIENCE, Dashboard, unused_instance

PHONE = {"viewport": {"width": 390, "height": 844}, "device_scale_factor": 3, "has_touch": True}
DESK = {"viewport": {"width": 1280, "height": 720}}


def answer(connection: HTTPConnection, path: str, **headers: str) -> HTTPResponse:
    """Returns the answer to a request with exactly these headers."""
    with closing(connection):
        connection.putrequest("GET", path, skip_host=True)
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        with connection.getresponse() as response:
            return response


def handshake(connection: HTTPConnection, path: str, **headers: str) -> int:
    """Returns the status of the answer to a WebSocket's handshake."""
    key = base64.b64encode(os.urandom(16)).decode()
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec_WebSocket_Version": "13"}
    return answer(connection, path, Sec_WebSocket_Key=key, **upgrade, **headers).status


def connect(dashboard: Dashboard) -> HTTPConnection:
    return HTTPConnection("127.0.0.1", dashboard.port, timeout=PATIENCE)


def test_other_sites_are_refused_and_the_page_says_what_it_may_load(programs):
    dashboard = programs.dashboard("page-alone", name="fire.example")
    own = f"127.0.0.1:{dashboard.port}"
    replies = [
        answer(connect(dashboard), "/", Host=host) for host in (own, "fire.example", "evil.example")
    ]
    assert [reply.status for reply in replies] == [200, 200, 403]
    policy = replies[0].headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy

    def socket(host: str, **origin: str) -> int:
        return handshake(connect(dashboard), "/socket", Host=host, **origin)

    assert [socket(own), socket(own, Origin=f"http://{own}")] == [101, 101]
    assert socket("fire.example", Origin="https://fire.example") == 101
    assert socket(own, Origin="http://evil.example") == 403


def serious(look) -> list[str]:
    """Returns the violations that axe rates as serious or critical."""
    found = Axe().run(look.page).response["violations"]
    return [
        f"{problem['id']}: {problem['help']}: {node['html']}"
        for problem in found
        if problem["impact"] in ("serious", "critical")
        for node in problem["nodes"]
    ]


@pytest.mark.parametrize(("theme", "screen"), [("light", DESK), ("dark", PHONE)], ids=str)
def test_it_fits_and_axe_finds_nothing_serious(request, programs, open_page, theme, screen):
    """Also saves a screenshot for people to look at."""
    instance = unused_instance()
    look = open_page(programs.dashboard(instance), color_scheme=theme, **screen)
    look.eventually(lambda: look.text("state") == "waiting", "waiting")
    assert serious(look) == []
    world = {"height": 64, "width": 64, "moves": 64, "burn_in": 12000}
    server = programs.server(instance, publish_truth=True, **world)
    look.eventually(lambda: look.picture(".shown"), "the world before its first step")
    programs.agent(instance)
    look.wait_for_steps()
    look.eventually(lambda: look.has("belief", "truth"), "a belief is shown")
    assert look.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    if screen is DESK:
        assert look.page.evaluate("document.documentElement.scrollHeight <= innerHeight")
    folder = request.config.getoption("--screenshots")
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{'phone' if screen is PHONE else 'desk'}-{theme}.png"
    look.page.screenshot(path=folder / name, full_page=screen is PHONE)
    assert serious(look) == []
    look.page.keyboard.press("Space")
    server.kill()
    look.eventually(lambda: look.text("state") == "waiting", "waiting")
    assert serious(look) == []


def test_tab_reaches_every_control_and_canvases_tell_what_they_show(watched):
    look = watched.look
    truth, chart = look.at("panel-truth"), look.at("chart-reward")
    # Descriptions are updated some time after the drawing.
    look.eventually(
        lambda: "cells in state fire at step" in truth.get_attribute("aria-label"), "the truth"
    )
    label = truth.get_attribute("aria-label")
    look.eventually(lambda: truth.get_attribute("aria-label") != label, "it is kept true")
    look.eventually(lambda: "mean" in chart.get_attribute("aria-label"), "the rewards")
    reached = set()
    for _ in range(40):
        look.page.keyboard.press("Tab")
        reached.add(look.page.evaluate("document.activeElement.dataset.testid ?? ''"))
        name = look.page.evaluate("document.activeElement.getAttribute('aria-label') ?? ''")
        reached.add(name.partition(":")[0])
    assert {"world-select", "pause", "scrub", "cells of truth", "cells of entropy"} <= reached
