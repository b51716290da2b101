"""An agent that serves decisions: it estimates and plans, its client chooses among the plans.

PROTOCOL.md section 13. `WildfireObjectiveEnv` makes an environment of it.
"""

import binascii
from base64 import b64decode
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch import _native
from emberwatch.arguments import as_choice, as_list, as_seeds
from emberwatch.connection import CLIENT, RESET_TIMEOUT, STEP_TIMEOUT, Connection, decoded
from emberwatch.errors import bad_answer
from emberwatch.replies import Decision, DecisionsInfo, record, records


class Decisions(Connection):
    """A connection to the agent of some worlds. Close it, or use it in a `with`.

    `reset`, `decide` and `last` return the last decision of each world.
    """

    def __init__(
        self, instance: str = "default", world: int = 0, *, timeout: float = STEP_TIMEOUT
    ) -> None:
        """`world` is the first of its worlds."""
        super().__init__(instance, _native.Agent(instance, world, CLIENT, timeout))
        info = decoded("answer to 'hello'", self._native.info)
        self.info: Final = record(DecisionsInfo, info)
        #: The worlds it acts on.
        self.worlds: Final = range(world, world + self.info.n_worlds)

    def reset(
        self,
        seeds: Iterable[int | None] | None = None,
        *,
        worlds: Sequence[int] | None = None,
        timeout: float = RESET_TIMEOUT,
    ) -> tuple[Decision, ...]:
        """Begins episodes with new beliefs.

        Args:
            seeds: One per world; None: the server derives the next from the world's last.
            worlds: Only these worlds; None: all.
        """
        pairs = as_seeds(seeds, self.worlds if worlds is None else worlds)
        return self._ask({"op": "reset", "worlds": pairs}, timeout)

    def decide(
        self, objectives: Iterable[int | None], *, timeout: float = 2 * STEP_TIMEOUT
    ) -> tuple[Decision, ...]:
        """Flies the path planned for an objective in each world, and takes in what was seen.

        Args:
            objectives: One per world; None: the world stays as it is.

        Raises:
            LeaseLostError: If another client took a world over; the agent ends.
            EmberwatchError: With code `"bad_objective"` or `"episode_over"`. Nothing is done.
        """
        asked = [
            None if one is None else as_choice(one, 2**64)
            for one in as_list(objectives, "objectives")
        ]
        return self._ask({"op": "decide", "objectives": asked}, timeout)

    def last(self, *, timeout: float = STEP_TIMEOUT) -> tuple[Decision, ...]:
        """The last decisions again; changes nothing."""
        return self._ask({"op": "last"}, timeout)

    def features(self, decisions: Sequence[Decision]) -> NDArray[np.float32]:
        """What the next plans promise, of shape (decisions, objectives, features).

        `info` names objectives and features.
        """
        shape = len(decisions), len(self.info.objectives), len(self.info.features)
        try:
            numbers = b"".join(b64decode(made.features, validate=True) for made in decisions)
            return np.frombuffer(bytearray(numbers), "<f4").reshape(shape)
        except (binascii.Error, ValueError):
            raise bad_answer("decisions", f"features of shape {shape}", "others") from None

    def shutdown(self, *, timeout: float = STEP_TIMEOUT) -> None:
        """Releases the worlds and ends the agent."""
        self.control({"op": "shutdown"}, timeout=timeout)

    def _ask(self, request: dict[str, Any], timeout: float) -> tuple[Decision, ...]:
        return records(Decision, self.control(request, timeout=timeout))
