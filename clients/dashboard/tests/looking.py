"""Reads what a browser shows: texts, pixels, and the picture from which they were drawn."""

import base64
import re
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Locator, Page, WebSocketRoute

from running import eventually

#: Returns the bytes of a typed array as base64.
_BYTES = """bytes => {
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) {
    text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  }
  return btoa(text);
}"""

#: The browser reports all data that a page receives to the harness, without waiting for the
#: harness. On a busy machine the harness would fall behind by minutes, so pages request at most
#: 2 MB per second.
_PACE = """(() => {
  const BYTES_A_MILLI = 2000;
  window.WebSocket = class extends WebSocket {
    #free = 0;
    constructor(...given) {
      super(...given);
      this.addEventListener("message", ({ data }) => {
        const length = data.byteLength ?? data.size ?? data.length;
        this.#free = Math.max(this.#free, performance.now()) + length / BYTES_A_MILLI;
      });
    }
    send(data) {
      const later = () => this.readyState === WebSocket.OPEN && super.send(data);
      setTimeout(later, Math.max(0, this.#free - performance.now()));
    }
  };
})()"""


class Look:
    """A page under test. `allowed` lists patterns of complaints that the test provokes."""

    def __init__(self, page: Page) -> None:
        """Starts recording the page's errors and warnings."""
        self.page = page
        # The browser warns that reading pixels back is slow, but only tests do so.
        self.allowed = ["willReadFrequently"]
        self._complaints: list[str] = []
        page.add_init_script(_PACE)
        page.on("console", self._hear)
        page.on("pageerror", lambda error: self._complaints.append(f"error: {error}"))

    def _hear(self, message) -> None:
        if message.type in ("error", "warning"):
            self._complaints.append(f"{message.type}: {message.text}")

    def complaints(self) -> list[str]:
        """Returns console messages, including policy violations, that the test has not allowed."""
        return [
            complaint
            for complaint in self._complaints
            if not any(re.search(pattern, complaint) for pattern in self.allowed)
        ]

    def heard(self, pattern: str) -> int:
        return sum(bool(re.search(pattern, complaint)) for complaint in self._complaints)

    def alter(self, change: Callable[[bytes], bytes]) -> None:
        """Reloads the page. From then on, changes the dashboard's messages before they arrive."""

        def route(socket: WebSocketRoute) -> None:
            dashboard = socket.connect_to_server()
            dashboard.on_message(lambda message: socket.send(change(message)))

        self.page.route_web_socket(re.compile("/socket$"), route)
        self.page.reload()

    def slow_down(self, rate: float) -> None:
        client = self.page.context.new_cdp_session(self.page)
        client.send("Emulation.setCPUThrottlingRate", {"rate": rate})

    def at(self, testid: str) -> Locator:
        return self.page.get_by_test_id(testid)

    def text(self, testid: str) -> str:
        return self.at(testid).text_content().strip()

    def number(self, testid: str) -> float:
        """Returns an element's text as a number, or NaN while the text is not a number."""
        text = self.text(testid).replace(",", "")
        return float(text) if re.fullmatch(r"-?[0-9.]+", text) else float("nan")

    def picture(self, expression: str = "") -> object:
        """Returns a part of the last drawn picture, such as `.shown.step`; None if it is
        missing."""
        return self.page.evaluate(f"window.emberwatch?.picture{expression.replace('.', '?.')}")

    def drawn(self) -> int:
        return self.page.evaluate("window.emberwatch?.drawn ?? 0")

    def has(self, *arrays: str) -> bool:
        """Returns whether these arrays are drawn: a page draws nothing before it has the server's
        facts."""
        is_drawn = self.picture(".info") is not None
        return is_drawn and all(self.picture(f".arrays.{name}.length") for name in arrays)

    def array(self, name: str) -> NDArray[np.uint8]:
        return self._bytes(f"window.emberwatch.picture.arrays.{name}")

    def pixels(self, testid: str) -> NDArray[np.uint8]:
        """Returns a canvas's pixels as they were drawn, `(H, W, 4)`."""
        canvas = f"document.querySelector('[data-testid={testid}]')"
        height, width = self.page.evaluate(f"[{canvas}.height, {canvas}.width]")
        image = f"{canvas}.getContext('2d').getImageData(0, 0, {width}, {height}).data"
        return self._bytes(image).reshape(height, width, 4)

    def _bytes(self, expression: str) -> NDArray[np.uint8]:
        text = self.page.evaluate(f"({_BYTES})({expression})")
        return np.frombuffer(base64.b64decode(text), np.uint8)

    def eventually(self, holds: Callable[[], object], what: str) -> None:
        try:
            eventually(holds, what)
        except AssertionError as error:
            error.add_note(f"The page shows {self._situation()}")
            raise

    def _situation(self) -> str:
        return self.page.evaluate("""JSON.stringify(window.emberwatch?.picture, (name, value) =>
            name === "path" || ArrayBuffer.isView(value) ? value.length : value)""")

    def wait_for_pictures(self, count: int = 2) -> None:
        first = self.drawn()
        self.eventually(lambda: self.drawn() >= first + count, f"{count} more pictures")

    def wait_for_steps(self, count: int = 3) -> None:
        """Waits until the page has shown `count` more steps. Agents may start a new episode
        meanwhile."""
        first = float("inf")

        def are_shown() -> bool:
            nonlocal first
            step = self.picture(".shown.step") or 0
            first = min(first, step)
            return step >= first + count

        self.eventually(are_shown, f"{count} more steps")
