"""What the environments of one world share: its session, its pictures, its beginning."""

from __future__ import annotations

from typing import Any, ClassVar, Final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError
from emberwatch.session import Session, SessionOwner
from emberwatch.settings import draw_seed
from emberwatch.view import RENDER_FPS, RENDER_MODES, View
from emberwatch.wire import StepAnswer, StepResult

NOTHING_TO_DRAW: Final = (
    "render: nothing to draw; give a render_mode to gymnasium.make and reset first"
)

#: Fields of a result that become `info`: not the seed, which gives the hidden states away.
REPORTED: Final = ("step", "n_target_cells", "n_visited", "n_hits")

#: What moves in an environment of one world.
ONE_WORLD: Final = np.ones(1, np.bool_)


class WorldEnv(SessionOwner, gymnasium.Env[Any, Any]):
    """One world of a private or a running server."""

    metadata: ClassVar[dict[str, Any]] = {  # pyright: ignore[reportIncompatibleVariableOverride]
        "render_modes": list(RENDER_MODES),
        "render_fps": RENDER_FPS,
    }

    def __init__(self, session: Session, *, reveals: bool) -> None:
        """`reveals` puts the hidden states into infos and pictures."""
        self._session = session
        self._spec: Final = session.spec
        self.render_mode = session.settings.render_mode
        self._view = View(self.render_mode, self._spec)
        self._reveals = reveals
        self._truth: NDArray[np.uint8] | None = None
        self._path: NDArray[np.intp] | None = None

    def render(self) -> Any:
        """Draws the last frame, path and robot, beside the truth when that is revealed."""
        if self.render_mode is None or not self._is_open():
            gymnasium.logger.warn(NOTHING_TO_DRAW)
            return None
        return None if self.render_mode == "human" else self._draw()

    def close(self) -> None:
        self._session.close()
        self._view.close()

    def _begin(self, seed: int | None, options: dict[str, Any] | None) -> StepAnswer:
        """Begins an episode, or goes on from where the world stands."""
        super().reset(seed=seed)
        if wants_to_resume(options, seed):
            answer = self._session.resume()
        else:
            drawn = draw_seed(self.np_random) if seed is None else seed
            answer = self._session.reset([0], [drawn])
        self._path = None
        return answer

    def _describe(self, answer: StepAnswer, result: StepResult) -> dict[str, Any]:
        info: dict[str, Any] = {name: getattr(result, name) for name in REPORTED}
        if self._reveals:
            self._truth = truth = self._session.truth(answer)[0]
            info["truth"] = truth.copy()
        return info

    def _draw(self) -> Any:
        raise NotImplementedError


def wants_to_resume(options: dict[str, Any] | None, seed: object) -> bool:
    """Reads the options of a reset."""
    for key in options or {}:
        if key != "resume":
            raise InvalidArgumentError(f"options: expected 'resume', got {key!r}")
    resume = (options or {}).get("resume", False)
    if not isinstance(resume, bool):
        raise InvalidArgumentError(f"options: expected resume True or False, got {resume!r}")
    if resume and seed is not None:
        raise InvalidArgumentError(
            "options: expected no seed with resume=True, which begins no episode"
        )
    return resume
