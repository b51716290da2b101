"""The state of an environment in memory."""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True, eq=False)
class EnvState:
    """The state of an environment, from `clone_state`; it can be pickled.

    Unpickle only states that you saved: like every pickle, a state can run code.
    """

    form: str
    """The class of the environment, and what it observes."""
    worlds: bytes = field(repr=False)
    """The worlds and robots, in the format of a snapshot file. They contain the hidden states."""
    memory: bytes = field(repr=False)
    """The rest: beliefs, memory of frames, moves of incomplete paths, generators."""
