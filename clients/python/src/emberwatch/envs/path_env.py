"""`emberwatch/Wildfire-v0`: one step flies one path."""

from dataclasses import replace
from typing import Unpack

from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from emberwatch.client import wire
from emberwatch.envs.base import Reward, WorldEnv, check_reward
from emberwatch.envs.observations import Observations, Parts, has_memory
from emberwatch.envs.session import Session
from emberwatch.envs.settings import Settings, WorldArguments, shows_keywords
from emberwatch.envs.vector_base import WorldVectorEnv


class WildfireEnv(WorldEnv):
    """A robot explores a wildfire, and sees only the cells that it flies over.

    ## Description

    A hidden Markov model spreads a fire over a grid of H x W cells. Each cell is normal, latent or
    on fire. In each step the robot flies a path of T moves. Then the whole world moves once, and
    the robot observes the cells that it visited. Observations have errors: a latent cell mostly
    looks normal. The robot must choose its paths from its earlier observations. The model is
    the one of Yoon et al., *Estimation and Planning of Exploration Over Grid Map Using A
    Spatiotemporal Model with Incomplete State Observations*, equations 2 to 4. Any other model
    file works, too.

    The world is simulated in this process. With `instance`, the environment attaches to a running
    `emberwatch-server` instead, and shares its worlds with other agents and observers.

    ## Action Space

    `MultiDiscrete([4] * T)`: the moves of a path: 0 up (row - 1), 1 down (row + 1), 2 left
    (column - 1), 3 right (column + 1). A move off the grid or into a no-fly cell of the model file
    leaves the robot where it is. There is no `action_masks` for MaskablePPO, because where a move
    leads depends on the moves before it. `WildfireMovesEnv` has masks.

    ## Observation Space

    `observation` names the parts. A sequence of names makes a flat `Dict`; a single name makes the
    space of that part.

    | part | space | meaning |
    |---|---|---|
    | `frame` | `Box(0, 255, (H, W, 1), uint8)` | observed value of each cell; 255: not observed |
    | `image` | `Box(0, 255, (H, W, O + 1), uint8)` | `frame` one-hot, 255 in the value's channel |
    | `robot` | `MultiDiscrete([H, W])` | the robot's row and column |
    | `age` | `Box(0, 255, (H, W, 1), uint8)` | steps since last observed; 255: never, or >= 255 |
    | `belief` | `Box(0, 255, (H, W, S), uint8)` | 255 times each state's probability |
    | `team` | `Box(0, 255, (H, W, 1), uint8)` | `frame` of all robots of the world together |
    | `others` | `Box(0, 255, (H, W, 1), uint8)` | 255 in the cells of the other robots |

    The last channel of `image` is for unobserved cells. With a `sensor_radius` of r, or a sensor in
    the model file, the robot also observes cells up to r rows and columns away from its path. O is
    the number of the model's observations. `belief` is the distribution of the state that the next
    path will observe, given all frames so far: by default of the known model's Bayes filter (paper
    equations 5 and 6), otherwise of another `kind`. Its prior is the default of
    `wrappers.BeliefObservation`.

    ## Rewards

    In the wildfire model, the number of distinct visited cells that burn after the world has moved.
    In general, the sum of the model's rewards over the distinct visited cells. The start cell
    counts only if the path returns to it. In a world of several robots, `reward` chooses between
    `"share"` (the default: a cell that v robots visited pays each of them 1 / v), `"team"` (the
    reward of all robots together), and `"marginal"` (how much lower the team's reward would be
    without this robot).

    ## One Robot of a Team

    With `instance` and for example `robot=2`, the environment flies one robot of a world, and other
    processes fly the other robots. A step waits for the paths of all robots that a client holds,
    but no longer than the server's `--deadline-millis`. A path that comes too late is not flown:
    the step returns the world's current results, and `info["n_missed"]` is the number of steps in
    which this robot stayed where it was. `reset` begins no episode, because other clients share the
    world. It joins the current episode, and uses the argument `seed` only for `np_random`. To fly
    all robots of a world, use `emberwatch.parallel_env`.

    ## Starting State

    The world after `burn_in` steps from the model's initial distribution. This state is a pure
    function of the seed: `reset(seed=s)` begins the same episode here, in the vector environment
    and in Rust. A reset without a seed draws one from `np_random`. The robot is at `start`, and no
    cell has been observed. `reset(options={"resume": True})` begins no episode. It continues the
    current episode, for example after another agent, or after an interrupted step. Parts with a
    memory (`belief`, `age`) then continue from the frames that the server keeps (`--history`).

    ## Episode End

    Never `terminated`. `truncated` after `max_episode_steps` (default 1,000, or the length of the
    task whose id it is; pass another number to `gymnasium.make`, as for a task file with longer
    episodes), or after the number of steps set by the task or by the running server's
    `--max-steps`.

    ## Information

    `step` (k) and `n_visited` (number of distinct visited cells). With `truth=True` also
    `n_target_cells` (number of burning cells on the whole grid), `n_hits` (number of visited cells
    that burn) and `truth` (the hidden states, `(H, W)` uint8). These are for reports and pictures:
    a learner that uses them cheats.

    ## Arguments

    All arguments are keywords of `gymnasium.make("emberwatch/Wildfire-v0", ...)`. Defaults are in
    parentheses. From `model` to `states_offset`, None is the default, or with `instance` the value
    of the running server; another value of `model`, `start` or of recorded states is refused with
    `instance`, except for `model` if the server hides it.

    * `observation`: the parts of the observation (`("frame", "robot")`).
    * `reward`: `"share"`, `"team"` or `"marginal"` (`"share"`).
    * `kind`: the kind of belief in the part `belief`, one of `emberwatch.belief.kinds` that needs
      no checkpoint (`"known"`, the paper's filter).
    * `instance`: the running server to attach to. None: simulate the world in this process. The
      results are byte for byte the same either way.
    * `world`: with `instance`, the number of the server's world (0).
    * `robot`: with `instance`, the index of the robot in its world, if other clients fly the rest
      (None: the world has only this robot).
    * `takeover`: with `instance`, whether to take the world from its holder (False).
    * `task`: the name of a built-in task, such as `"small"`, or the path of a task file
      (`docs/environments/index.md` lists tasks and models). A task determines `robots`, all
      keywords from `model` to `states_offset`, and the length of episodes, so none of them may be
      given with it. With `instance`, it must be the task of the running server.
    * `model` (`"wildfire"`): a `Model`, the name of a built-in one, or the path or the text of a
      model file. All files are read once, when the environment is made.
    * `height` (64), `width` (64): the grid in cells.
    * `n_moves` (64): number of moves in a path, the T above.
    * `burn_in` (10,000): number of steps that the world is simulated before k = 0.
    * `sensor_radius` (-1): number of rows and columns that the robot sees beyond each cell of its
      path; -1: the model's.
    * `start` (`"corner"`): the robot's first cell: `"corner"`, `"centre"`, `"random"`, `"ROW,COL"`.
    * `states` (`""`: none): recorded states instead of a model: the name of built-in states, a
      `.npz` or `.npy` file, or a folder (see `docs/recorded-worlds.md`). Recorded states determine
      `model`, `height`, `width` and `burn_in`, and an episode is truncated at their last step.
    * `states_symmetries` (False): whether the seed also selects a symmetry of the recorded grid.
    * `states_offset` (0): maximum recorded step at which an episode begins; the seed draws one.
    * `truth`: whether to reveal the hidden states in `info` and pictures (False).
    * `timeout`: seconds to wait for a step of a running server, and for the server to start (5).
    * `render_mode`: `"rgb_array"`, `"human"` (a window, or the terminal) or `"ansi"`.

    ## Vectorized environment

    `gymnasium.make_vec("emberwatch/Wildfire-v0", num_envs=64)` is `WildfireVectorEnv`, which steps
    all worlds in one call.

    ## Version History

    * v0: the first.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        observation: Parts = ("frame", "robot"),
        reward: Reward = "share",
        kind: str = "known",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class."""
        session = Session(Settings.of(WildfireEnv, world))
        parts = Observations(observation, session, kind=kind)
        super().__init__(session, parts, _paths(session), pays=check_reward(reward))


class WildfireVectorEnv(WorldVectorEnv):
    """Many robots of `WildfireEnv`, stepped together: all robots of one or more worlds.

    In all three autoreset modes, observations, rewards, episode ends and infos are the same, field
    by field, as from Gymnasium's `SyncVectorEnv` with single environments and the same seeds. World
    i of `reset(seed=s)` has seed s + i. `options={"reset_mask": mask}` resets only some worlds.

    Takes the arguments of `WildfireEnv`, and:

    * `num_envs`: number of robots, a multiple of `robots`. None: the robots of one world.
    * `robots` (1): number of robots of each world. The robots of a world begin and end their
      episodes together.
    * `max_episode_steps`: number of steps after which episodes are truncated; None or -1: never.
    * `autoreset_mode`: a `gymnasium.vector.AutoresetMode`; `NEXT_STEP` by default.
    * `world`: with `instance`, the number of the first world; the other worlds follow it.
    * `render_mode`: `"human"` shows only the first world.
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
        kind: str = "known",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class."""
        pays = check_reward(reward)
        settings = Settings.of(WildfireVectorEnv, world)
        if settings.instance is None and not has_memory(observation):
            settings = replace(settings, history=1)  # a reset with `resume` needs no earlier frames
        session = Session(settings, num_envs)
        super().__init__(
            session,
            Observations(observation, session, kind=kind),
            _paths(session),
            pays=pays,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
        )


def _paths(session: Session) -> spaces.MultiDiscrete:
    """Returns the action space of one robot."""
    return spaces.MultiDiscrete([wire.N_MOVES] * session.spec.n_moves)
