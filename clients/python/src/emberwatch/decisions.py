"""An agent that serves decisions: it estimates and plans, its client chooses the objective.

PROTOCOL.md section 13. `WildfireObjectiveEnv` makes an environment of it.
"""

from __future__ import annotations

from typing import Any, Final

from emberwatch.connection import Connection
from emberwatch.errors import NoServerError
from emberwatch.ports import RESET_TIMEOUT, STEP_TIMEOUT
from emberwatch.replies import Decision, DecisionsInfo, record


class Decisions(Connection):
    """A connection to the agent of one world. Close it, or use it in a `with`."""

    def __init__(
        self, instance: str = "default", world: int = 0, *, timeout: float = STEP_TIMEOUT
    ) -> None:
        names = (f"decisions-{world}", f"wake-agent-{world}", "agent")
        try:
            super().__init__(instance, *names, timeout)
        except NoServerError:
            raise NoServerError(
                f"no agent serves decisions for world {world} of instance {instance!r}: start one "
                f"with `emberwatch-agent serve-decisions --instance {instance} --world {world}`"
            ) from None
        with self._closed_on_error():
            self.info: Final = self._shake_hands(DecisionsInfo)

    def reset(self, seed: int | None = None, *, timeout: float = RESET_TIMEOUT) -> Decision:
        """Begins an episode with a new belief; without a seed, the server chooses one."""
        return self._ask({"op": "reset", "seed": seed}, timeout)

    def decide(self, objective: int, *, timeout: float = 2 * STEP_TIMEOUT) -> Decision:
        """Plans and flies a path for an objective, and takes in what was seen.

        Raises:
            LeaseLostError: If another client took the world over; the agent ends.
            EmberwatchError: With code `"bad_objective"` or `"episode_over"`. Nothing is done.
        """
        return self._ask({"op": "decide", "objective": int(objective)}, timeout)

    def last(self, *, timeout: float = STEP_TIMEOUT) -> Decision:
        """The last decision again; changes nothing."""
        return self._ask({"op": "last"}, timeout)

    def shutdown(self, *, timeout: float = STEP_TIMEOUT) -> None:
        """Releases the world and ends the agent."""
        self.control({"op": "shutdown"}, timeout=timeout)

    def _ask(self, request: dict[str, Any], timeout: float) -> Decision:
        return record(Decision, self.control(request, timeout=timeout))
