"""An agent that serves decisions: it estimates and plans, its client says what for.

PROTOCOL.md section 13. `WildfireObjectiveEnv` makes an environment of it.
"""

from __future__ import annotations

import threading
from typing import Any, Final

from emberwatch import wire
from emberwatch.channels import Closing, Node
from emberwatch.errors import NoServerError
from emberwatch.ports import RESET_TIMEOUT, STEP_TIMEOUT, Bell, RequestPort
from emberwatch.replies import Decision, DecisionsInfo, ask, record


class Decisions(Closing):
    """A connection to the agent of one world. Close it, or use it in a `with`."""

    def __init__(
        self, instance: str = "default", world: int = 0, *, timeout: float = STEP_TIMEOUT
    ) -> None:
        """Connects and shakes hands.

        Raises:
            NoServerError: If no agent serves decisions for the world.
            VersionMismatchError: If it speaks another protocol version.
            RequestTimeoutError: If it does not answer.
        """
        self._node = Node(instance)
        self._sequence = 0
        self._turn = threading.Lock()
        try:
            self._bell = Bell(self._node, f"wake-agent-{world}", "agent")
            self._port = RequestPort(
                self._bell,
                f"decisions-{world}",
                (wire.ControlRequest, wire.ControlReply),
                slice_len=4096,
                grows=True,
            )
            hello = {"op": "hello", "protocol": wire.VERSION, "client": "emberwatch-python"}
            self.info: Final = record(DecisionsInfo, self._ask(hello, timeout))
            self._bell.watch(self.info.pid)
        except NoServerError:
            self.close()
            raise NoServerError(
                f"no agent serves decisions for world {world} of instance {instance!r}: start one "
                f"with `emberwatch-agent serve-decisions --instance {instance} --world {world}`"
            ) from None
        except BaseException:
            self.close()
            raise

    def reset(self, seed: int | None = None, *, timeout: float = RESET_TIMEOUT) -> Decision:
        """Begins an episode with a new belief; without a seed, the server chooses one."""
        return record(Decision, self._ask({"op": "reset", "seed": seed}, timeout))

    def decide(self, objective: int, *, timeout: float = 2 * STEP_TIMEOUT) -> Decision:
        """Plans and flies a path for an objective, and takes in what was seen.

        Raises:
            BadObjectiveError: If there is no such objective. Nothing is done.
            EpisodeOverError: If the episode was truncated: reset first.
            LeaseLostError: If another client took the world over; the agent ends.
        """
        return record(Decision, self._ask({"op": "decide", "objective": int(objective)}, timeout))

    def last(self, *, timeout: float = STEP_TIMEOUT) -> Decision:
        """The last decision again; changes nothing."""
        return record(Decision, self._ask({"op": "last"}, timeout))

    def shutdown(self, *, timeout: float = STEP_TIMEOUT) -> None:
        """Releases the world and ends the agent."""
        self._ask({"op": "shutdown"}, timeout)

    def close(self) -> None:
        """Closes the connection; the agent goes on. Again is fine."""
        for name in ("_port", "_bell"):
            part = getattr(self, name, None)
            if part is not None:
                part.close()
        self._node.close()

    def _ask(self, request: dict[str, Any], timeout: float) -> dict[str, Any]:
        self._node.check()
        with self._turn:
            self._sequence += 1
            return ask(self._port, self._bell, self._sequence, request, timeout)
