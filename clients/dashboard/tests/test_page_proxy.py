"""Tests the dashboard behind nginx, with TLS and below a path, as the documents configure it."""

import re
import shutil
import socket
import ssl
import subprocess
from collections.abc import Callable, Iterator
from http.client import HTTPSConnection
from pathlib import Path

import pytest

from running import PATIENCE, Dashboard, eventually
from test_page_access import answer, handshake

MANUAL = Path(__file__).resolve().parents[3] / "docs/many-machines.md"

CONFIG = """
daemon off;
pid {folder}/nginx.pid;
error_log stderr;
events {{}}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
    {block}
}}
"""


class Proxy:
    """nginx in front of a dashboard."""

    def __init__(self, command: list[str], port: int) -> None:
        self.port, self._command = port, command
        #: The page's address for browsers.
        self.url = f"https://localhost:{port}/fire/"
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen(self._command)
        eventually(lambda: is_open(self.port), "nginx")

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait(PATIENCE)

    def connect(self) -> HTTPSConnection:
        """Opens a connection that trusts the proxy's certificate."""
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        return HTTPSConnection("127.0.0.1", self.port, timeout=PATIENCE, context=context)


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.fixture
def proxy(tmp_path: Path) -> Iterator[Callable[[Dashboard], Proxy]]:
    """Starts nginx with the configuration from the documents: `proxy(dashboard)`."""
    nginx = shutil.which("nginx", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")
    if nginx is None or shutil.which("openssl") is None:
        pytest.skip("no nginx or openssl: apt-get install nginx-light openssl")
    running: list[Proxy] = []

    def begin(dashboard: Dashboard) -> Proxy:
        port = free_port()
        key, certificate = tmp_path / "key", tmp_path / "certificate"
        made = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"]
        made += ["-nodes", "-subj", "/CN=localhost", "-keyout", str(key), "-out", str(certificate)]
        subprocess.run(made, check=True, capture_output=True)
        block = re.search(r"```nginx\n(.*?)```", MANUAL.read_text(), re.DOTALL)[1]
        for words, own in {
            "listen 443": f"listen 127.0.0.1:{port}",
            "/etc/ssl/fire.example.pem": str(certificate),
            "/etc/ssl/fire.example.key": str(key),
            "http://127.0.0.1:8600/": dashboard.url,
        }.items():
            assert words in block
            block = block.replace(words, own)
        file = tmp_path / "nginx.conf"
        file.write_text(CONFIG.format(folder=tmp_path, block=block))
        running.append(Proxy([nginx, "-p", str(tmp_path), "-c", str(file)], port))
        return running[-1]

    yield begin
    for proxy in running:
        proxy.stop()


def is_open(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


def test_the_page_works_with_tls_below_a_path(programs, proxy, open_page):
    server = programs.server(publish_truth=True)
    dashboard = programs.dashboard(server.instance, name="fire.example")
    programs.agent(server.instance)
    behind = proxy(dashboard)

    def status(host: str, origin: str) -> int:
        return handshake(behind.connect(), "/fire/socket", Host=host, Origin=origin)

    assert status("fire.example", "https://fire.example") == 101
    assert status("fire.example", "https://evil.example") == 403
    assert status("fire.example", f"https://fire.example:{behind.port}") == 403
    assert status("evil.example", "https://evil.example") == 403
    response = answer(behind.connect(), "/fire", Host=f"localhost:{behind.port}")
    assert (response.status, response.headers["Location"][-6:]) == (301, "/fire/")
    look = open_page(behind, ignore_https_errors=True)
    look.allowed += ["WebSocket connection to .* failed", "502"]
    look.eventually(lambda: look.has("belief", "truth"), "a belief is shown")
    look.wait_for_steps()
    icon = look.page.locator("h1 img")
    assert icon.evaluate("icon => icon.naturalWidth > 0")
    # The page reconnects when the dashboard and the proxy restart.
    dashboard.kill()
    look.eventually(lambda: "dashboard gone" in look.text("state"), "gone")
    programs.dashboard(server.instance, port=dashboard.port)
    look.wait_for_steps()
    behind.stop()
    look.eventually(lambda: "dashboard gone" in look.text("state"), "gone")
    behind.start()
    look.wait_for_steps()
