"""`BeliefObservation`: replaces the observed frame with a belief about all cells."""

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

from emberwatch.belief import RECOMMENDED, Belief, known, load
from emberwatch.belief.prior import PriorKind, prior_of
from emberwatch.common.arguments import as_json
from emberwatch.common.paths import absolute
from emberwatch.errors import EmberwatchError, InvalidArgumentError, invalid, repr_of
from emberwatch.model import Model


class BeliefObservation(gymnasium.Wrapper[Any, ActType, Any, ActType], RecordConstructorArgs):
    """Observes a belief about an environment's world, from all frames so far, instead of frames.

    The wrapper is for single environments; wrap the environments of a vector one by one.

    Emberwatch's environments report the world's step k in ``info["step"]``, and the belief follows
    it: it is predicted once for each step of the world, and corrected with the last frame. A reset
    that resumes or joins an episode (`resume`, `robot`) continues from the frames that the server
    keeps of it, and warns if some are missing. In environments that do not report k, each step of
    the environment counts as one step of the world.

    ## Observations
    After `reset`, the observation is the prior about ``X_0``, the world after its burn-in. A step
    moves the world from ``X_k`` to ``X_{k+1}``, and its frame shows ``X_{k+1}``. The filter
    predicts, then corrects. The observation is the posterior about ``X_{k+1}``, given all frames
    (eqs. 5 and 6), with the same numbers as the Rust agent's. The agent plans on the predictor,
    which `predict` of ``emberwatch.belief.known(model, prior=observation, kind="known")`` computes
    from an observation of the kind ``"known"``.

    - ``dtype="float32"``: a `Box` of 0 to 1, shape (S, H, W). The S numbers of a cell sum to 1.
    - ``dtype="uint8"``: the same numbers times 255, rounded, shape (H, W, S). This is an image for
      convolutional policies, for example in Stable-Baselines3.
    - ``keep=True``: a `Dict` of the original observations (a single frame as ``"frame"``) and
      ``"belief"``.

    ## Priors
    - ``"simulated"``: how often each cell is in each state after the burn-in of 64 simulated
      worlds, which takes some seconds; later calls read it from ``~/.cache/emberwatch``.
    - ``"initial"``: the model's initial distribution, which is exact for worlds without burn-in.
    - ``"uniform"``: every state equally likely.
    - An array of shape (S, H, W), in which the numbers of each cell sum to 1.
    - ``None``: ``"simulated"`` if the environment has a burn-in, otherwise ``"initial"``.

    ## Arguments
    - `env`: an environment that observes the frame, a `Box` of shape (H, W, 1) and type uint8, or a
      `Dict` with ``"frame"``.
    - `keep`, `dtype`: what is observed, as above.
    - `prior`: one of the priors above.
    - `model`: a `Model`, its name, or the path or the text of its file. The default is
      ``env.unwrapped.model``. It is needed only for servers that do not reveal their model.
    - `kind`: the kind of belief, a key of `emberwatch.belief.kinds`. The default is the kind of the
      checkpoint, or `emberwatch.belief.RECOMMENDED`. ``"known"`` is the paper's filter.
    - `checkpoint`: a file written by `emberwatch-agent train`. The belief is then the one that
      `emberwatch.belief.load` returns, with its own prior and S. A checkpoint needs no model.
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
        RecordConstructorArgs.__init__(
            self,
            keep=keep,
            dtype=dtype,
            prior=as_json(prior),
            model=as_json(absolute(model)),
            kind=kind,
            checkpoint=as_json(absolute(checkpoint)),
        )
        gymnasium.Wrapper.__init__(self, env)  # pyright: ignore[reportUnknownMemberType]
        if dtype not in ("float32", "uint8"):
            raise invalid("dtype", "'float32' or 'uint8'", repr_of(dtype))
        self._keep, self._dtype = keep, dtype
        original = _parts_of(env.observation_space, spaces.Dict)
        height, width = _grid_of(original)
        grid = {"height": height, "width": width}
        if checkpoint is None:
            burn_in = int(getattr(env.unwrapped, "burn_in", 0))
            known_model = _model_of(env, model)
            first = prior_of(prior, known_model, **grid, burn_in=burn_in)
            self._belief = known(known_model, prior=first, kind=kind or RECOMMENDED)
        elif prior is not None:
            raise invalid(
                "prior", "None with a checkpoint, which has its own prior", repr_of(prior)
            )
        else:
            is_hidden = model is None and getattr(env.unwrapped, "model", None) is None
            found = None if is_hidden else _model_of(env, model)
            self._belief = load(checkpoint, **grid, kind=kind, model=found)
        #: Whether an episode has begun and no step since then was interrupted.
        self._is_begun = self._was_begun = False
        self._step = 0
        self.observation_space = self._space(original, height, width)

    @property
    def filter(self) -> Belief:
        """The belief of the current episode, for example to read its entropy or state names.

        Raises:
            gymnasium.error.ResetNeeded: Before the first reset, or after an interrupted step.
        """
        if not self._is_begun:
            raise gymnasium.error.ResetNeeded(
                "BeliefObservation: no episode, or an interrupted step: call reset first"
            )
        return self._belief

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        with self._between():
            observation, info = self.env.reset(seed=seed, options=options)
        self._begin(int(info.get("step", 0)), _frame_of(observation))
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

    def _begin(self, step: int, frame: NDArray[np.uint8]) -> None:
        """Begins an episode, or joins one at a later step."""
        unwrapped: Any = self.env.unwrapped
        continues = getattr(unwrapped, "continues", False)
        if not (continues and self._was_begun and step == self._step):
            self._belief.reset()
            past_frames = getattr(unwrapped, "past_frames", tuple)
            for past in past_frames() if step > 0 else ():
                self._belief.correct(past)
                self._belief.predict()
            self._belief.correct(frame)
        self._step, self._is_begun = step, True

    @contextmanager
    def _between(self) -> Generator[None]:
        """Marks the belief as outdated during a call, and as valid again if the call is refused."""
        self._was_begun, self._is_begun = self._is_begun, False
        try:
            yield
        except (EmberwatchError, gymnasium.error.Error):
            self._is_begun = self._was_begun
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
    if model is not None:
        return Model.named(model)
    revealed = getattr(env.unwrapped, "model", None)
    if isinstance(revealed, Model):
        return revealed
    why = "the environment does not reveal its model (a server: --reveal-model false)"
    if getattr(getattr(env.unwrapped, "world_spec", None), "is_recorded", False):
        why = "recorded worlds have no model"
    raise InvalidArgumentError(
        f"BeliefObservation: {why}. Pass model=: a Model, its name or the path of its file; or "
        "checkpoint=, a belief that `emberwatch-agent train` learned"
    )


def _parts_of(whole: Any, kind: type[Any] = dict) -> dict[str, Any]:
    """Returns the parts of an observation or a space by name; a single frame is ``"frame"``."""
    return dict(whole) if isinstance(whole, kind) else {"frame": whole}


def _grid_of(parts: dict[str, spaces.Space[Any]]) -> tuple[int, int]:
    """Returns the frame's height and width."""
    match parts.get("frame"):
        case spaces.Box(shape=(height, width, 1), dtype=np.dtypes.UInt8DType()):
            return height, width
        case _:
            expected = "a frame of shape (H, W, 1) and type uint8, alone or as 'frame' of a Dict"
            raise invalid("BeliefObservation", f"observations of {expected}", parts)


def _frame_of(observation: Any) -> NDArray[np.uint8]:
    """Returns the frame, shape (H, W)."""
    return _parts_of(observation)["frame"][:, :, 0]
