"""Screens for ``render_mode="human"``."""

import logging
import os
import sys
import time
from typing import Any, Literal

from emberwatch.render import Picture, ansi, rgb_array

_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
_LOG = logging.getLogger(__name__)


class Screen:
    """A window, or the terminal, that shows pictures to people.

    A window needs pygame and a display (``DISPLAY``, ``WAYLAND_DISPLAY`` or ``SDL_VIDEODRIVER``);
    pygame has one window per process. Without a window, pictures go to the standard output if it is
    a terminal. Without a window or a terminal, a warning is logged once, and nothing is shown. If
    the user closes the window, the program continues without pictures.
    """

    def __init__(self, *, fps: float) -> None:
        """Opens no window yet. `fps`: maximum number of pictures per second."""
        self._fps = fps
        self._next: float | None = None
        self._pygame = _pygame_with_display()
        #: Where pictures are shown.
        self.kind: Literal["window", "terminal", "nothing"] = "window"
        if self._pygame is None:
            self.kind = "terminal" if sys.stdout.isatty() else "nothing"
        if self.kind == "nothing":
            _LOG.warning(
                "render_mode 'human' shows nothing: it needs pygame and a display, or a terminal "
                "as standard output; use 'rgb_array' or 'ansi' to get pictures"
            )

    def show(self, picture: Picture) -> None:
        """Replaces the shown picture; waits first if the last one is too recent for `fps`."""
        if self.kind == "nothing":
            return
        if self._next is not None:
            time.sleep(max(0.0, self._next - time.monotonic()))
        if self.kind == "window":
            self._show_in_window(picture)
        else:
            clear = "\x1b[2J" if self._next is None else ""
            sys.stdout.write(f"{clear}\x1b[H{ansi(picture)}\x1b[K\n\x1b[J")
            sys.stdout.flush()
        self._next = time.monotonic() + 1.0 / self._fps

    def close(self) -> None:
        """Closes the window, if any. Later pictures are not shown. May be called again."""
        if self.kind == "window":
            self._pygame.display.quit()
        self.kind = "nothing"

    def _show_in_window(self, picture: Picture) -> None:
        pygame, image = self._pygame, rgb_array(picture)
        size = image.shape[1::-1]
        window = pygame.display.get_surface()
        if window is None or window.get_size() != size:
            window = pygame.display.set_mode(size)
            pygame.display.set_caption("Emberwatch")
        window.blit(pygame.image.frombuffer(image.tobytes(), size, "RGB"), (0, 0))
        pygame.display.flip()
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()


def _pygame_with_display() -> Any:
    """Returns pygame with an initialised display; None if there is no display or no pygame."""
    if not any(map(os.environ.get, _DISPLAYS)):
        return None
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it prints its version
    try:
        import pygame
    except ImportError:
        return None
    try:
        pygame.display.init()
    except pygame.error:
        return None
    return pygame
