"""`Screen`: shows what `emberwatch.render` draws to people, for ``render_mode="human"``."""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import os
import sys
import time
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

_LOG = logging.getLogger(__name__)


class Screen:
    """Shows pictures to people: in a window, else in the terminal, else not at all.

    A window needs pygame and a display (``DISPLAY``, ``WAYLAND_DISPLAY`` or ``SDL_VIDEODRIVER``);
    pygame has one per process. Without it, the standard output must be a terminal. Without either,
    a warning is logged once and nothing is shown. Closing the window ends only the show.
    """

    def __init__(self, *, title: str = "Emberwatch", fps: float = 0.0) -> None:
        """Finds out where to show; opens nothing yet.

        Args:
            title: The window's.
            fps: Most pictures a second, by waiting; 0 does not wait.
        """
        self._title, self._fps = title, fps
        self._next: float | None = None
        self._window: Any = None
        self._pygame = _pygame_with_display()
        self._kind: Literal["window", "terminal", "nothing"] = "window"
        if self._pygame is None:
            self._kind = "terminal" if sys.stdout.isatty() else "nothing"
        if self._kind == "nothing":
            _LOG.warning(
                "render_mode 'human' shows nothing: there is no display with pygame installed, and "
                "the output is no terminal; use 'rgb_array' or 'ansi' to get pictures"
            )

    @property
    def kind(self) -> Literal["window", "terminal", "nothing"]:
        """Where pictures go: a window takes `rgb_array`'s, a terminal `ansi`'s, nothing either."""
        return self._kind

    def show(self, picture: NDArray[np.uint8] | str) -> None:
        """Shows a picture in place of the last one.

        Args:
            picture: From `rgb_array` for a window, from `ansi` for a terminal.

        Raises:
            TypeError: The picture is the other kind.
        """
        if self._kind == "window":
            if isinstance(picture, str):
                raise TypeError("show: expected an array, as kind is 'window', got a text")
            self._show_in_window(picture)
        elif self._kind == "terminal":
            if not isinstance(picture, str):
                raise TypeError("show: expected a text, as kind is 'terminal', got an array")
            clear = "\x1b[2J" if self._next is None else ""
            sys.stdout.write(f"{clear}\x1b[H{picture}\x1b[K\n\x1b[J")
            sys.stdout.flush()
        self._pace()

    def close(self) -> None:
        """Closes the window, if there is one; later pictures are not shown. May be called again."""
        if self._window is not None:
            self._pygame.display.quit()
        self._window, self._kind = None, "nothing"

    def _show_in_window(self, image: NDArray[np.uint8]) -> None:
        pygame, (height, width, _) = self._pygame, image.shape
        if self._window is None or self._window.get_size() != (width, height):
            self._window = pygame.display.set_mode((width, height))
            pygame.display.set_caption(self._title)
        surface = pygame.image.frombuffer(image.tobytes(), (width, height), "RGB")
        self._window.blit(surface, (0, 0))
        pygame.display.flip()
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()

    def _pace(self) -> None:
        now = time.monotonic()
        at = now if self._next is None else max(now, self._next)
        if self._kind != "nothing":
            time.sleep(at - now)
            self._next = at + (1.0 / self._fps if self._fps > 0.0 else 0.0)


def _pygame_with_display() -> Any:
    """Pygame with its display ready, or None."""
    if not any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")):
        return None
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it greets
            pygame = importlib.import_module("pygame")
    except ImportError:
        return None
    try:
        pygame.display.init()
    except pygame.error:
        return None
    return pygame
