"""`BeliefObservation`: what a filter or another belief makes of the frames, as the observation.

A frame shows a path; the belief is what all frames so far say about every cell. For learning
without memory, the belief is the better observation.
"""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.core import ActType
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike, NDArray

from emberwatch.belief import Belief, known, load
from emberwatch.belief.prior import PriorKind, prior_of
from emberwatch.common.arguments import as_json
from emberwatch.errors import EmberwatchError, InvalidArgumentError, invalid
from emberwatch.model import Model


class BeliefObservation(gymnasium.Wrapper[Any, ActType, Any, ActType], RecordConstructorArgs):
    """Runs a belief beside an environment and observes it: by default the known model's filter.

    For single environments: wrap those of a vector one by one. `terminated` and `truncated` pass
    through; only `reset` begins a new belief. Where ``info["step"]`` tells the world's k, as in
    Emberwatch's own environments, the belief follows it: a step that only flies a move changes
    nothing, and one that flies several paths predicts as often, though it sees the last frame only.
    Elsewhere, a step is taken for one of the world.

    ## Observations
    After `reset`, the prior about ``X_0``, the world after its burn-in. A step moves the world from
    ``X_k`` to ``X_{k+1}`` and its frame shows ``X_{k+1}``: the filter predicts, then corrects, and
    the observation is the posterior about ``X_{k+1}`` given all frames (eqs. 5 and 6). The Rust
    agent's belief has the same numbers; its planner then looks one step further ahead, at the
    predictor of what the next path will meet: `emberwatch.belief.Transition` makes it from this
    observation.

    - ``dtype="float32"``: `Box` of 0 to 1, shape (S, H, W), each cell's sum one.
    - ``dtype="uint8"``: the same times 255, rounded, shape (H, W, S): an image for convolutional
      policies, as of Stable-Baselines3.
    - ``keep=True``: a `Dict` of the original observations (a lone frame as ``"frame"``) and
      ``"belief"``.

    ## Priors
    - ``"simulated"``: how often each cell of 64 simulated worlds is in each state after the
      burn-in. The first time it takes some seconds; ``~/.cache/emberwatch`` keeps it.
    - ``"initial"``: the model's initial distribution, right for worlds without burn-in.
    - ``"uniform"``: every state equally likely.
    - An array of shape (S, H, W), each cell's sum one.
    - ``None``: ``"simulated"`` if the environment has a burn-in, else ``"initial"``.

    ## Arguments
    `env` observes the frame, a `Box` of shape (H, W, 1) and type uint8, or a `Dict` with
    ``"frame"``. `model`, a `Model`, its name, or the path or the text of its file, is for servers
    that do not reveal theirs; else it is ``env.unwrapped.model``. `kind` is one of
    `emberwatch.belief.kinds`. With `checkpoint`, a file of `emberwatch-agent train`, the belief is
    the learned one, as of `emberwatch.belief.load`: it has its own prior and S, and needs no model.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, ActType],
        *,
        keep: bool = False,
        dtype: Literal["float32", "uint8"] = "float32",
        prior: PriorKind | ArrayLike | None = None,
        model: Model | str | Path | None = None,
        kind: str | None = None,
        checkpoint: str | Path | None = None,
    ) -> None:
        text = model.toml if isinstance(model, Model) else as_json(model)
        RecordConstructorArgs.__init__(
            self,
            keep=keep,
            dtype=dtype,
            prior=as_json(prior),
            model=text,
            kind=kind,
            checkpoint=as_json(checkpoint),
        )
        gymnasium.Wrapper.__init__(self, env)  # pyright: ignore[reportUnknownMemberType]
        if dtype not in ("float32", "uint8"):
            raise invalid("dtype", "'float32' or 'uint8'", repr(dtype))
        self._keep, self._dtype = keep, dtype
        original = _parts_of(env.observation_space, spaces.Dict)
        height, width = _grid_of(original)
        grid = {"height": height, "width": width}
        if checkpoint is None:
            burn_in = int(getattr(env.unwrapped, "burn_in", 0))
            known_model = _model_of(env, model)
            first = prior_of(prior, known_model, **grid, burn_in=burn_in)
            self._belief = known(known_model, prior=first, kind="known" if kind is None else kind)
        elif prior is not None:
            raise invalid("prior", "none beside a checkpoint, which has its own", prior)
        else:
            is_hidden = model is None and getattr(env.unwrapped, "model", None) is None
            found = None if is_hidden else _model_of(env, model)
            self._belief = load(checkpoint, **grid, kind=kind, model=found)
        #: Whether an episode has begun, and no step is unfinished.
        self._is_begun = False
        self._step = 0
        self.observation_space = self._space(original, height, width)

    @property
    def filter(self) -> Belief:
        """The belief of the current episode, for its entropy or its states."""
        if not self._is_begun:
            raise gymnasium.error.ResetNeeded(
                "BeliefObservation: call reset first, also after a step that did not finish"
            )
        return self._belief

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        with self._between():
            observation, info = self.env.reset(seed=seed, options=options)
        self._step = int(info.get("step", 0))
        self._belief.reset()
        self._belief.correct(_frame_of(observation))  # empty, but where an episode is resumed
        self._is_begun = True
        return self._observe(observation), info

    def step(self, action: ActType) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        belief = self.filter
        with self._between():
            observation, reward, terminated, truncated, info = self.env.step(action)
        before, self._step = self._step, int(info.get("step", self._step + 1))
        for _ in range(before, self._step):
            belief.predict()
        if self._step > before:
            belief.correct(_frame_of(observation))
        self._is_begun = True
        return self._observe(observation), reward, terminated, truncated, info

    @contextmanager
    def _between(self) -> Generator[None]:
        """Without a belief until what the environment does now is taken in; a refusal keeps it."""
        was_begun, self._is_begun = self._is_begun, False
        try:
            yield
        except (EmberwatchError, gymnasium.error.Error):
            self._is_begun = was_begun
            raise

    def _observe(self, observation: Any) -> Any:
        belief: NDArray[Any] = self.filter.belief
        if self._dtype == "uint8":
            image = np.rint(255.0 * belief).astype(np.uint8)
            belief = np.ascontiguousarray(image.transpose(1, 2, 0))
        return {**_parts_of(observation), "belief": belief} if self._keep else belief

    def _space(
        self, original: dict[str, spaces.Space[Any]], height: int, width: int
    ) -> spaces.Space[Any]:
        n_states = len(self._belief.state_names)
        if self._dtype == "uint8":
            belief = spaces.Box(0, 255, (height, width, n_states), np.uint8)
        else:
            belief = spaces.Box(0.0, 1.0, (n_states, height, width), np.float32)
        return spaces.Dict({**original, "belief": belief}) if self._keep else belief


def _model_of(env: gymnasium.Env[Any, Any], model: Model | str | Path | None) -> Model:
    if isinstance(model, Model):
        return model
    if isinstance(model, str) and "\n" in model:
        return Model.from_toml(model)
    if model is not None:
        return Model.named(model)
    revealed = getattr(env.unwrapped, "model", None)
    if not isinstance(revealed, Model):
        raise InvalidArgumentError(
            "BeliefObservation: expected the world's model, got none: the server does not reveal "
            "it (--reveal-model false); pass model=, a Model, its name or the path of its file"
        )
    return revealed


def _parts_of(whole: Any, kind: type[Any] = dict) -> dict[str, Any]:
    """The parts of an observation, or of its space: those of a dictionary, or a lone frame."""
    return dict(whole) if isinstance(whole, kind) else {"frame": whole}


def _grid_of(parts: dict[str, spaces.Space[Any]]) -> tuple[int, int]:
    """Height and width of the frame."""
    match parts.get("frame"):
        case spaces.Box(shape=(height, width, 1), dtype=np.dtypes.UInt8DType()):
            return height, width
        case _:
            expected = "a frame of shape (H, W, 1) and type uint8, alone or as 'frame' of a Dict"
            raise invalid("BeliefObservation", f"observations of {expected}", parts)


def _frame_of(observation: Any) -> NDArray[np.uint8]:
    """The frame, shape (H, W)."""
    return _parts_of(observation)["frame"][:, :, 0]
