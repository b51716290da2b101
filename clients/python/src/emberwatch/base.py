"""What the environments of one world share: its session, its pictures, its beginning."""

from __future__ import annotations

from typing import Any, ClassVar, Final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import SettingError
from emberwatch.model import Model
from emberwatch.replies import Decision
from emberwatch.session import Session, state_to_copy
from emberwatch.settings import Settings, draw_seed
from emberwatch.view import RENDER_FPS, RENDER_MODES, View
from emberwatch.wire import StepAnswer, StepResult

NOTHING_TO_DRAW: Final = (
    "render: nothing to draw; give a render_mode to gymnasium.make and reset first"
)


class WorldEnv(gymnasium.Env[Any, Any]):
    """One world of a private or a running server."""

    metadata: ClassVar[dict[str, Any]] = {  # pyright: ignore[reportIncompatibleVariableOverride]
        "render_modes": list(RENDER_MODES),
        "render_fps": RENDER_FPS,
    }

    def __init__(self, settings: Settings, render_mode: str | None, *, reveals: bool) -> None:
        """Checks the settings; `reveals` puts the hidden states into infos and pictures."""
        self._session: Final = Session(settings)
        self._shape: Final = self._session.shape
        self._view = View(render_mode, self._shape, self._session.model)
        self.render_mode = render_mode
        self._reveals = reveals
        self._truth: NDArray[np.uint8] | None = None
        self._path: NDArray[np.intp] | None = None

    @property
    def model(self) -> Model | None:
        """The model behind the world; None if a running server hides it."""
        return self._session.model

    @property
    def burn_in(self) -> int:
        """Steps that the world is simulated before k = 0."""
        return self._session.burn_in

    @property
    def instance(self) -> str:
        """The server's instance name, once the environment has been reset."""
        return self._session.instance

    def render(self) -> Any:
        """Draws the last frame, path and robot, beside the truth when that is revealed."""
        if self.render_mode is None or not self._is_open():
            gymnasium.logger.warn(NOTHING_TO_DRAW)
            return None
        return None if self.render_mode == "human" else self._draw()

    def close(self) -> None:
        """Gives the world back; a private server stops. Again is fine."""
        self._session.close()
        self._view.close()

    def __getstate__(self) -> dict[str, Any]:
        """For copies, which only a closed environment has."""
        return state_to_copy(self, self._is_open())

    def _is_open(self) -> bool:
        """Whether there has been a reset since it was made or closed."""
        return self._session.is_open

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
        """The `info` of an answer: what is for reports, without the seed."""
        info = reported(result)
        if self._reveals:
            self._truth = truth = self._session.truth(answer)[0]
            info["truth"] = truth.copy()
        return info

    def _draw(self) -> Any:
        raise NotImplementedError


def reported(result: StepResult | Decision) -> dict[str, Any]:
    """What of a result is for reports: without the seed."""
    return {
        "step": result.step,
        "n_target_cells": result.n_target_cells,
        "n_visited": result.n_visited,
        "n_hits": result.n_hits,
    }


def wants_to_resume(options: dict[str, Any] | None, seed: object) -> bool:
    """Reads the options of a reset.

    Raises:
        SettingError: If one is unknown, or a seed is given to go on from.
    """
    for key in options or {}:
        if key != "resume":
            raise SettingError(f"options: expected 'resume', got {key!r}")
    resume = (options or {}).get("resume", False)
    if not isinstance(resume, bool):
        raise SettingError(f"options: expected resume True or False, got {resume!r}")
    if resume and seed is not None:
        raise SettingError("options: expected no seed with resume=True, which begins no episode")
    return resume
