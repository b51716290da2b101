"""`emberwatch/WildfireMoves-v0`: one step flies one move; the world moves after T of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, TypeAlias, Unpack

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.arguments import as_choice
from emberwatch.base import WorldEnv
from emberwatch.errors import InvalidArgumentError
from emberwatch.observations import Observations, image_space
from emberwatch.session import not_reset
from emberwatch.settings import Settings, WorldArguments
from emberwatch.view import fly
from emberwatch.wire import StepAnswer

MovesPart: TypeAlias = Literal["frame", "robot", "age", "visited", "move"]


class WildfireMovesEnv(WorldEnv):
    """The world of `WildfireEnv`, flown move by move.

    ## Description

    As `WildfireEnv`, but one step is one move of the robot. After T moves the path is complete:
    the world moves once, and the cells visited are observed and rewarded.

    ## Action Space

    `Discrete(4)`: 0 up, 1 down, 2 left, 3 right. A move off the grid leaves the robot in place.

    ## Observation Space

    `observation` names the parts, as in `WildfireEnv`: `frame` (of the last complete path),
    `robot`, `age`, and

    | part | space | meaning |
    |---|---|---|
    | `visited` | `Box(0, 255, (H, W, 1), uint8)` | 255 in the cells that this path has visited |
    | `move` | `Discrete(T)` | moves made of this path |

    ## Rewards

    With `reward="path"` (the default) the path's reward comes with its last move, and 0 before:
    what a cell pays is only decided when the world moves, after the flight.

    With `reward="move"` each cell pays when it is first visited, what its hidden state pays
    before the world moves; the last move also brings the difference to the path's true reward,
    which is small, as one step changes few cells. So both sum to the same over each path, but
    the second says more about the hidden state, and earlier: results with the two are not
    comparable. The environment needs the `truth` channel for it: a private server publishes it,
    a running one must.

    ## Episode End

    Never `terminated`. `truncated` after `max_episode_steps` moves (64,000, thus 1,000 paths of
    the default length, unless `gymnasium.make` is told otherwise), or after the running server's
    own `--max-steps`.

    ## Starting State, Information

    As `WildfireEnv`; the information is about the last complete path.

    ## Arguments

    As `WildfireEnv`; `observation` is `("frame", "visited", "robot", "move")` by default, and
    `reward` is `"path"` or `"move"`.

    ## Version History

    * v0: the first.
    """

    def __init__(
        self,
        *,
        observation: MovesPart | Sequence[MovesPart] = ("frame", "visited", "robot", "move"),
        reward: Literal["path", "move"] = "path",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class. No server of its own runs before the first reset."""
        if reward not in ("path", "move"):
            raise InvalidArgumentError(f"reward: expected 'path' or 'move', got {reward!r}")
        reveals = world.get("truth", False)
        self._pays_moves = reward == "move"
        world["truth"] = reveals or self._pays_moves
        super().__init__(Settings.of(WildfireMovesEnv, world), reveals=reveals)
        if self._pays_moves and self.model is None:
            raise InvalidArgumentError("reward='move': expected a server that reveals its model")
        spec = self._spec
        extra = {"visited": image_space(spec), "move": spaces.Discrete(spec.n_moves)}
        self._observations = Observations(observation, spec, extra=extra)
        self.observation_space = self._observations.space
        self.action_space = spaces.Discrete(wire.N_MOVES)
        self._answer: StepAnswer | None = None
        self._states: NDArray[np.uint8] | None = None
        self._start = self._robot = (0, 0)
        self._moves: list[int] = []
        self._visited = np.zeros((spec.height, spec.width), np.uint8)
        self._paid = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode; see `WildfireEnv`."""
        answer = self._begin(seed, options)
        self._observations.reset([0], answer.frames)
        self._begin_path(answer)
        return self._seen(answer)

    def step(self, action: np.integer[Any] | int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Flies one move; the T-th completes the path and moves the world.

        Raises:
            EmberwatchError: As `WildfireEnv.step`.
        """
        moves = [*self._moves, as_choice(action, wire.N_MOVES)]
        if self._answer is None or not self._is_open():
            raise not_reset()
        if len(moves) < self._spec.n_moves:
            reward = self._visit(moves[-1])
            self._paid += reward
            self._moves = moves
            observation, info = self._seen(self._answer)
            return observation, reward, False, False, info
        answer = self._session.step(np.array(moves, np.uint8))
        result = answer.result()
        reward = result.reward - self._paid
        self._path = fly(self._start, moves, self._spec)
        self._observations.update(answer)
        self._begin_path(answer)
        observation, info = self._seen(answer)
        return observation, reward, bool(result.terminated), bool(result.truncated), info

    def _begin_path(self, answer: StepAnswer) -> None:
        result = answer.result()
        self._answer = answer
        self._start = self._robot = (result.row, result.col)
        self._moves = []
        self._visited = np.zeros_like(self._visited)
        self._paid = 0.0
        if self._pays_moves:
            self._states = self._session.truth(answer)[0]

    def _visit(self, move: int) -> float:
        """Moves the robot; returns what its cell pays at once."""
        row, col = fly(self._robot, (move,), self._spec)[0].tolist()
        self._robot = (row, col)
        is_new = not self._visited[row, col]
        self._visited[row, col] = 255
        if self._states is None or self.model is None or not is_new:
            return 0.0
        return float(self.model.reward[self._states[row, col]])

    def _seen(self, answer: StepAnswer) -> tuple[Any, dict[str, Any]]:
        info = self._describe(answer, answer.result())
        row, col = self._robot
        if self.render_mode == "human":
            self._draw()
        # Copies: each move of a path returns the frame again.
        observation = self._observations.one(
            answer.frames[0].copy(),
            row,
            col,
            visited=self._visited[:, :, np.newaxis].copy(),
            move=np.int64(len(self._moves)),
        )
        return observation, info

    def _draw(self) -> Any:
        if self._answer is None:
            return None
        flown = fly(self._start, self._moves, self._spec) if self._moves else self._path
        return self._view.draw(self._answer.frames[0], self._robot, flown, self._truth)
