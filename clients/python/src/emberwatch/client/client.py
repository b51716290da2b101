"""Clients of a running server or of worlds in this process."""

from os import PathLike
from typing import Final

from emberwatch._native import Client as Client
from emberwatch._native import Lease as Lease
from emberwatch.common.arguments import read_settings
from emberwatch.model import Model

#: Connects to a running server.
connect: Final = Client

#: Default timeout of a step, seconds.
STEP_TIMEOUT: Final = 5.0

#: Default timeout of requests that may wait for a burn-in, seconds.
RESET_TIMEOUT: Final = 600.0


def embed(**settings: str | float | bool | PathLike[str] | Model | None) -> Client:
    """Creates worlds inside this process, without a server, and returns a `Client` of them.

    No other process can observe these worlds or fly in them, and closing the client ends them.
    Results that depend only on seeds and actions are byte for byte the same as from a server.
    Leases expire a day after their last use. Ctrl-C interrupts the wait for a reset or a file;
    during a step it takes effect after the step.

    Args:
        settings: Settings of `config/server.toml`, such as `worlds=4`, `task="small"`, `seed=7`;
            None: the default. `model` may also be a `Model`. The setting `instance` and the
            settings for a server's own snapshots do not apply here.

    Raises:
        InvalidArgumentError: If a setting is unknown or invalid.
        NotEnoughMemoryError: If the worlds need more memory than the machine, a cgroup or a
            `ulimit` allows.
        EmberwatchError: With code `"threads"` if the system cannot start threads.
    """
    return Client.embedded(read_settings(settings))
