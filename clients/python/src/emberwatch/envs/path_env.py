"""`emberwatch/Wildfire-v0`: one step flies one path, of one robot or of many."""

from typing import Any, Unpack

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch._native import moves
from emberwatch.client import wire
from emberwatch.client.wire import StepAnswer
from emberwatch.common.arguments import as_moves
from emberwatch.envs.base import ONE_ROW, Reward, WorldEnv, check_reward
from emberwatch.envs.observations import Observations, Parts
from emberwatch.envs.session import Session
from emberwatch.envs.settings import Settings, WorldArguments, shows_keywords
from emberwatch.envs.vector_base import WorldVectorEnv, vector_session


class WildfireEnv(WorldEnv):
    """A robot explores a wildfire of which it sees only the cells that it flies over.

    ## Description

    A hidden Markov model spreads a fire over a grid of H x W cells, each normal, latent or on
    fire. In each step the robot flies a path of T moves; then the whole world moves once, and the
    cells visited are observed, with errors: a latent cell mostly looks normal. Where to fly next
    must be decided from what was seen before. The model is that of Yoon et al., *Estimation and
    Planning of Exploration Over Grid Map Using A Spatiotemporal Model with Incomplete State
    Observations*, equations 2 to 4; any other model file runs as well.

    The world is simulated in this process. With `instance`, the environment attaches to a running
    `emberwatch-server` instead, whose worlds other agents and observers share.

    ## Action Space

    `MultiDiscrete([4] * T)`: a path, move by move: 0 up (row - 1), 1 down (row + 1), 2 left
    (column - 1), 3 right (column + 1). A move off the grid or into a no-fly cell of the model file
    leaves the robot where it is. There is no `action_masks`, as MaskablePPO asks for: where a move
    leads depends on those before it. `WildfireMovesEnv` has one.

    ## Observation Space

    `observation` names the parts: a sequence makes a flat `Dict` of them, one name alone that
    part as it is.

    | part | space | meaning |
    |---|---|---|
    | `frame` | `Box(0, 255, (H, W, 1), uint8)` | what was observed; 255 where nothing was |
    | `image` | `Box(0, 255, (H, W, O + 1), uint8)` | 255 in the channel of what was observed |
    | `robot` | `MultiDiscrete([H, W])` | the robot's row and column |
    | `age` | `Box(0, 255, (H, W, 1), uint8)` | steps since it was seen; 255: never, or as many |
    | `belief` | `Box(0, 255, (H, W, S), uint8)` | 255 times each state's probability |
    | `team` | `Box(0, 255, (H, W, 1), uint8)` | `frame`, of what all robots of the world saw |
    | `others` | `Box(0, 255, (H, W, 1), uint8)` | 255 in the cells where other robots are |

    The last channel of `image` stands for nothing observed. With a `sensor_radius` of r, or a
    sensor in the model file, cells up to r rows and columns from the path are seen, too; O counts
    the observations once for each of the sensor's matrices. `belief` is about what the next path
    will meet, by the known model's Bayes filter (paper equations 5 and 6) given all frames so far;
    it begins as `wrappers.BeliefObservation` does.

    ## Rewards

    The number of distinct cells visited that burn after the world moved (in general the sum of the
    model's rewards; of the cells seen, where the model file's sensor says so). The start cell
    counts only if it is flown over again. In a world of several robots `reward` chooses: `"share"`
    (the default), where a cell that v robots visited pays 1 / v to each; `"team"`, the reward of
    all robots together; or `"marginal"`, what that would lack without this robot.

    ## One Robot of a Team

    With `instance` and `robot=2` it is one robot of a world in which other processes fly the
    others. A step waits for the paths of all robots that somebody holds, but no longer than the
    server's `--deadline-ms`. A path that comes too late is not flown: the answer tells how the
    world stands, and `info["n_missed"]` in how many steps this robot stayed where it was. `reset`
    begins no episode, as the world is not its own; it continues from where the world stands, and
    its `seed` is for `np_random` alone. `emberwatch.parallel_env` flies all robots of a world.

    ## Starting State

    The world after `burn_in` steps from the model's initial distribution, a pure function of the
    seed: `reset(seed=s)` begins the same episode here, in the vector environment and in Rust. A
    reset without a seed draws the next one from `np_random`. The robot is at `start`, and nothing
    has been observed. `reset(options={"resume": True})` begins nothing but continues from
    where the world stands, such as after another agent, or after a step that was interrupted.

    ## Episode End

    Never `terminated`. `truncated` after `max_episode_steps` (1,000 unless `gymnasium.make` is
    told otherwise), or after the steps of the task or of the running server's own `--max-steps`.

    ## Information

    `step` (k) and `n_visited` (distinct cells visited). With `truth=True`, for reports and
    pictures, as a learner that uses them cheats: `n_target_cells` (cells burning on the whole
    grid), `n_hits` (of the visited, burning) and the hidden `truth`, `(H, W)` uint8.

    ## Arguments

    All by keyword, through `gymnasium.make("emberwatch/Wildfire-v0", ...)`:

    * `observation`: parts of the observation; `("frame", "robot")` by default.
    * `reward`: `"share"`, `"team"` or `"marginal"`.
    * `instance`: attach to this running server; None: worlds of its own, in this process. The
      results are the same bytes either way.
    * `world`: with `instance`, which of the server's worlds (0).
    * `robot`: with `instance`, which of the world's robots, if others fly the rest (None: the world
      has only one).
    * `takeover`: with `instance`, take the world from its holder (False).
    * `task`: the name of a built-in task, such as `"small"`, or the path of a task file
      (`docs/environments/index.md` lists tasks and models). It decides all keywords from `model` to
      `states_offset`, `robots` and the length of episodes: none of them may stand beside it. With
      `instance`: the name of the running server's.
    * `model`: the name of a built-in model (`"wildfire"`) or the path of a model file;
      `height`, `width` (64), `n_moves` (64, T), `burn_in` (10,000), `sensor_radius` (None: as the
      model says), `start` (`"corner"`, `"centre"`, `"random"` or `"ROW,COL"`): of worlds of its
      own. With `instance` they may be left out, or must agree with the server.
    * `states`: recorded states instead of a model (built-in ones by name, or a `.npz` or `.npy`
      file or a folder, see `docs/recorded-worlds.md`), which decide `height`, `width` and
      `burn_in`; `states_symmetries` (False), `states_offset` (0). The last recorded step truncates.
    * `truth`: reveal the hidden states in `info` and pictures (False).
    * `timeout`: how long to wait for a step of a running server, or until it is there, seconds (5).
    * `render_mode`: `"rgb_array"`, `"human"` (a window, or the terminal) or `"ansi"`.

    ## Vectorized environment

    `gymnasium.make_vec("emberwatch/Wildfire-v0", num_envs=64)` is `WildfireVectorEnv`: one call
    steps all worlds.

    ## Version History

    * v0: the first.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        observation: Parts = ("frame", "robot"),
        reward: Reward = "share",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class."""
        settings = Settings.of(WildfireEnv, world)
        self._pays = check_reward(reward)
        super().__init__(Session(settings))
        self._observations = Observations(observation, self._spec, first=self._robot or 0)
        self.observation_space = self._observations.space
        self.action_space = spaces.MultiDiscrete([wire.N_MOVES] * self._spec.n_moves)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode; with `robot`, continues from where the shared world stands.

        See `WildfireEnv`, *Starting State* and *One Robot of a Team*.
        """
        with self._session.turn:
            self._answer = answer = self._begin(seed, options)
            self._observations.reset(ONE_ROW, answer.frames)
            _, _, _, step, n_visited, cells = answer.native.numbers(self._pays)
            seen = self._seen(answer, step, n_visited, cells)
            self._session.finish()
        return seen

    def step(
        self, action: NDArray[np.integer[Any]]
    ) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Flies a path of T moves.

        Raises:
            InvalidArgumentError: If it is not `(T,)` integers in 0 to 3. Nothing is sent.
            LeaseLostError: If another client took the world over.
            ServerGoneError: If the server has ended; the next reset attaches to its successor.
            RequestTimeoutError: If it does not answer; the world may have moved: reset or resume.
            EmberwatchError: With code `"interrupted"` if an earlier step or reset did not finish,
                as after Ctrl-C: reset or resume. Nothing is sent.
        """
        session = self._session
        with session.turn:
            session.begin_step()
            self._answer = answer = session.step(action)
            self._update(self._observations, answer)
            reward, terminated, truncated, step, n_visited, cells = answer.native.numbers(
                self._pays
            )
            if self.render_mode is not None:
                self._trace(answer, as_moves(action, 1, self._spec.n_moves).reshape(-1))
            observation, info = self._seen(answer, step, n_visited, cells)
            session.finish()
        return observation, reward, terminated, truncated, info

    def _seen(
        self, answer: StepAnswer, step: int, n_visited: int, cells: NDArray[np.int64]
    ) -> tuple[Any, dict[str, Any]]:
        info = self._describe(answer, step, n_visited)
        # The learner may write to its frame: pictures come from another.
        frames = answer.frames if self.render_mode is None else answer.frames.copy()
        if self.render_mode == "human":
            self._draw()
        teams = self._teams(self._observations, answer)
        return self._observations.one(frames, cells, teams), info


class WildfireVectorEnv(WorldVectorEnv):
    """Many robots of `WildfireEnv`, stepped together: all of some worlds.

    Observations, rewards, ends and infos are those of Gymnasium's `SyncVectorEnv` over the single
    environment with the same seeds, field by field, in all three autoreset modes; world i of
    `reset(seed=s)` has seed s + i. `options={"reset_mask": mask}` resets some of the worlds.

    Arguments are those of `WildfireEnv`, and:

    * `num_envs`: number of robots, a multiple of `robots`; None: those of one world.
    * `robots`: robots of each world (1). They begin and end their episodes together.
    * `max_episode_steps`: truncate after so many steps; None or -1: never.
    * `autoreset_mode`: a `gymnasium.vector.AutoresetMode`; `NEXT_STEP` by default.
    * `world`: the first world; the others follow.
    * `render_mode`: `"human"` shows the first world only.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        num_envs: int | None = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        observation: Parts = ("frame", "robot"),
        reward: Reward = "share",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class."""
        pays = check_reward(reward)
        settings = Settings.of(WildfireVectorEnv, world)
        session = vector_session(settings, num_envs)
        super().__init__(
            session,
            Observations(observation, session.spec, session.n_rows),
            spaces.MultiDiscrete([wire.N_MOVES] * session.spec.n_moves),
            pays=pays,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
        )

    def _check_actions(self, actions: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
        n_moves = self._spec.n_moves
        chosen = moves(actions, self.num_envs, n_moves)
        return as_moves(actions, self.num_envs, n_moves) if chosen is None else chosen

    def _fly(self, actions: NDArray[np.uint8], flown: NDArray[np.bool_]) -> NDArray[np.float64]:
        self._exchange(actions, flown)
        return self._columns.rewards.copy()
