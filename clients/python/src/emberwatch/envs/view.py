"""Pictures of an environment in its render mode."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.envs.settings import WorldSpec
from emberwatch.errors import invalid, repr_of
from emberwatch.render import Palette, Picture, ansi, rgb_array
from emberwatch.render.screen import Screen

#: The render modes of all environments; pictures per second in a film, and at most in a window.
METADATA: Final[dict[str, Any]] = {
    "render_modes": ["human", "rgb_array", "ansi"],
    "render_fps": 10,
}


class View:
    """A painter of one world: its frame, robots, paths, and hidden states if they are known."""

    def __init__(self, render_mode: str | None, spec: WorldSpec) -> None:
        modes: list[str] = METADATA["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise invalid("render_mode", f"None or one of {', '.join(modes)}", repr_of(render_mode))
        self.mode: Final = render_mode
        self._airspace: Final = spec.airspace
        self._palette: Final = Palette.of(spec.described or spec.n_observations)
        self._screen: Screen | None = None

    def draw(
        self,
        frame: NDArray[np.uint8],
        robots: Sequence[tuple[int, int]],
        paths: Sequence[NDArray[np.intp]],
        truth: NDArray[np.uint8] | None,
    ) -> Any:
        """Returns an image or a text, or shows it and returns None, depending on the mode."""
        picture = Picture(
            frame=frame,
            palette=self._palette,
            robots=robots,
            paths=paths,
            truth=truth,
            airspace=self._airspace,
        )
        if self.mode == "rgb_array":
            return rgb_array(picture)
        if self.mode == "ansi":
            return ansi(picture)
        if self._screen is None:
            self._screen = Screen(fps=METADATA["render_fps"])
        self._screen.show(picture)
        return None

    def close(self) -> None:
        if self._screen is not None:
            self._screen.close()
            self._screen = None
