"""`emberwatch/WildfireObjective-v1`: one step chooses the objective of the next path."""

from os import PathLike
from typing import Any, Unpack

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch.common.arguments import as_choice, as_choices
from emberwatch.envs.base import WorldEnv
from emberwatch.envs.plans import FirstBelief, Plans, PlansOwner
from emberwatch.envs.session import Session
from emberwatch.envs.settings import Settings, WorldArguments, shows_keywords
from emberwatch.envs.vector_base import WorldVectorEnv


class WildfireObjectiveEnv(PlansOwner, WorldEnv):
    """The paper's high-level decision: an action chooses the objective of the robot's next path.

    The environment keeps a belief about the world of `WildfireEnv`, plans a path for each of eight
    objectives, and describes each planned path by features. The learner, in the role of the paper's
    deep Q-network (section III.E), chooses which path is flown.

    ## Action Space

    `Discrete(8)`, one action for each of the `objectives`: the probability of the state that pays
    most; the same plus the entropy of the belief, with two different weights (two actions); the
    entropy alone; cells that have long been unobserved; the probability along three paths together;
    the region of the highest probability; the region that has been unobserved for longest.

    ## Observation Space

    `Box(-inf, inf, (8, 26), float32)`: row i describes the path that action i flies.
    `feature_names` names the 26 features, and docs/environments/objective.md explains them. One
    network can score each row separately. `gymnasium.wrappers.FlattenObservation` flattens the rows
    to one vector.

    ## Starting State

    As in `WildfireEnv`. The first belief is the one that `prior` names, or the learned one. With
    ``reset(options={"resume": True})``, it is the belief that the last agent left for the world's
    current step, or is computed from the frames of this episode that the server keeps.

    ## Rewards, Episode End, Information

    As in `WildfireEnv`.

    ## Arguments

    As in `WildfireEnv` without `observation`, `reward` and `robot`, for worlds of one robot. Also:

    * `estimator`: the kind of belief, one that `emberwatch.belief.kinds` lists with `has_options`.
      The default is the kind that `checkpoint` contains, or `emberwatch.belief.RECOMMENDED` without
      a checkpoint.
    * `checkpoint`: the file that `emberwatch-agent train` saved, for learned estimators.
    * `prior`: the first belief of estimators with a known model: `"simulated"` (the default; its
      first computation takes about a second), `"initial"` or `"uniform"`.

    With `instance`, too, this process computes the beliefs and plans. `close` leaves the beliefs to
    the next client of the worlds. If the server hides its model, pass `model` or `checkpoint`.

    ## Vectorized environment

    `gymnasium.make_vec("emberwatch/WildfireObjective-v1", num_envs=64)` is
    `WildfireObjectiveVectorEnv`, which plans for all worlds at once on several threads.

    ## Version History

    * v1: eight plans with features, and a choice of estimators. v0 chose among states and entropy.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        estimator: str | None = None,
        checkpoint: str | PathLike[str] | None = None,
        prior: FirstBelief = "simulated",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class."""
        session = Session(Settings.of(WildfireObjectiveEnv, world))
        self._plans = plans = Plans(session, estimator, checkpoint, prior)
        super().__init__(session, plans, plans.action_space, pays=1)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Flies the path that was planned for the chosen objective.

        Raises:
            EmberwatchError: As in `WildfireEnv.step`.
        """
        choice = np.array([as_choice(action, int(self._plans.action_space.n))])
        with self._session.turn:
            return super().step(self._plans.paths(choice))

    def close(self) -> None:
        self._plans.close(None if self._answer is None else self._answer.results)
        super().close()


class WildfireObjectiveVectorEnv(PlansOwner, WorldVectorEnv):
    """Many worlds of `WildfireObjectiveEnv`, with their steps and plans computed together.

    Takes the arguments of `WildfireObjectiveEnv`, and `num_envs`, `max_episode_steps` and
    `autoreset_mode` of `WildfireVectorEnv`.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        estimator: str | None = None,
        checkpoint: str | PathLike[str] | None = None,
        prior: FirstBelief = "simulated",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class."""
        session = Session(Settings.of(WildfireObjectiveVectorEnv, world), num_envs)
        self._plans = plans = Plans(session, estimator, checkpoint, prior)
        super().__init__(
            session,
            plans,
            plans.action_space,
            pays=1,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
        )

    def close_extras(self, **kwargs: Any) -> None:
        self._plans.close(self._results)
        super().close_extras(**kwargs)

    def _check_actions(self, actions: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
        return as_choices(actions, self.num_envs, int(self._plans.action_space.n))

    def _step_worlds(
        self, actions: NDArray[np.uint8], flown: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        return super()._step_worlds(self._plans.paths(actions), flown)
