"""Where channels live and how they are opened (PROTOCOL.md section 1).

The only module, with `cleanup`, `ports` and `observer`, that knows iceoryx2.
"""

import contextlib
import ctypes
import importlib
import os
import re
import stat
import time
import weakref
from collections.abc import Generator
from pathlib import Path
from typing import Any, Final, Self

from emberwatch import wire
from emberwatch.cleanup import ChannelFiles
from emberwatch.errors import EmberwatchError, invalid
from emberwatch.resources import SHARED_MEMORY, cause, check_room, fill
from emberwatch.turn import LONGEST_WAIT, SHORT_WAIT, cannot_create, turn

_INSTANCE: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")

#: iceoryx2 carries no types.
iox2: Final[Any] = importlib.import_module("iceoryx2")

_BYTES: Final[Any] = iox2.Slice[ctypes.c_uint8]

#: How often to check that a node's files are still there, seconds.
_CHECK_INTERVAL: Final = 0.2

#: How long to wait for a segment to be finished, or to be left over, seconds.
_UNFINISHED: Final = 1.5

iox2.set_log_level(iox2.LogLevel.Fatal)


class Node:
    """One connection's place in shared memory: a node, and everything made from it.

    iceoryx2 does not survive `fork`: there, everything of the parent is left alone for good, and
    using it raises an error with code `"forked"`.
    """

    def __init__(self, instance: str) -> None:
        if not _INSTANCE.fullmatch(instance):
            raise invalid("instance", "1 to 64 characters out of A-Z a-z 0-9 - _", repr(instance))
        self.instance: Final = instance
        self._held: list[Any] = []
        self._usable = True
        self._forked = False
        builder = iox2.NodeBuilder.new().signal_handling_mode(iox2.SignalHandlingMode.Disabled)
        config = _config()
        self._files: list[Path] = []
        self._checked = 0.0
        check_room()
        with in_turn() as is_alone, channel_errors("create a node"):
            _own_segments(SHARED_MEMORY, _prefix())
            _make_way(is_alone)
            self.node: Any = builder.config(config).create(iox2.ServiceType.Ipc)
            # Of the first node of all, iceoryx2 lets everybody write to the counter of nodes.
            _own_segments(SHARED_MEMORY, _prefix())
        self.keep(self.node)
        _nodes.add(self)

    def keep(self, port: Any) -> Any:
        """Remembers something of iceoryx2's, to be closed, or left alone, with this node."""
        self._held.append(port)
        return port

    def check(self) -> None:
        """Raises unless the connection may be used: not closed, not inherited through `fork`."""
        if self._usable:
            return
        if self._forked:
            raise EmberwatchError(
                f"the connection to instance {self.instance!r} belongs to the process that forked "
                "this one; open a new one here (for environments: make them in the child)",
                "forked",
            )
        raise EmberwatchError(f"the connection to instance {self.instance!r} is closed", "closed")

    def close(self) -> None:
        """Leaves the channels; in a forked child it does nothing. May be called again."""
        if not self._usable:
            return
        self._usable = False
        _nodes.discard(self)
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(EmberwatchError):
                stack.enter_context(in_turn(SHORT_WAIT))
            if self._removed_file() is not None:
                self._leak()  # Files of the same names are other programs' by now.
            # The youngest first: ports before the node that they were made from.
            while self._held:
                self._held.pop()
            self.node = None

    def remember_files(self) -> None:
        """Lists the files by which others find this node; call it when all ports are made."""
        base, node = directory(), str(self.node.id.value)
        tags = list((base / "nodes" / node).iterdir())
        names = [f"{it.stem}.service" for it in tags if it.suffix == ".service_tag"]
        services = [base / "services" / name for name in names]
        self._files = [base / "nodes" / f"{_prefix()}{node}.node_monitor", *tags, *services]

    def fill_ports(self) -> None:
        """Gives all memory of the ports of this node its room; call it when they are made."""
        fill(_files_of_user().of_node(int(self.node.id.value)))

    def check_files(self) -> None:
        """Raises if these files were removed, which cuts this node off. Costs little."""
        now = time.monotonic()
        if now - self._checked > _CHECK_INTERVAL:
            removed = self._removed_file()
            if removed is not None:
                raise EmberwatchError(
                    f"{removed} was removed while it was in use: keep cleaners of old files away "
                    f"from {SHARED_MEMORY}",
                    "channel",
                )
            self._checked = now

    def _removed_file(self) -> Path | None:
        return next((path for path in self._files if not path.exists()), None)

    def open_request_response(
        self, service: str, request: type[wire.Header], reply: type[wire.Header]
    ) -> Any:
        """Opens a service that its server has made; `None` if there is none."""
        builder = self.node.service_builder(self._name(service)).request_response(_BYTES, _BYTES)
        builder = builder.request_header(request).response_header(reply)
        try:
            return self.keep(builder.open())
        except iox2.RequestResponseOpenError as error:
            if "DoesNotExist" in str(error):
                return None
            what = f"open {service} on instance {self.instance!r}"
            raise cause(what, error, f"{wire.MAX_NODES} processes") from None

    def other_version(self, service: str) -> int | None:
        """The protocol version of a server on the instance that speaks another one, if any."""
        # Of the files themselves: iceoryx2 opens each service, and may wait for one without end.
        pattern = re.compile(rf'service_name = "emberwatch/v(\d+)/{self.instance}/{service}"')
        versions: set[int] = set()
        for path in (directory() / "services").glob(f"{_prefix()}*.service"):
            with contextlib.suppress(OSError):  # a service that has ended
                found = pattern.finditer(path.read_text(errors="replace"))
                versions |= {int(match[1]) for match in found}
        return max(versions - {wire.VERSION}, default=None)

    def open_publications(
        self, service: str, header: type[wire.Header], readers: int, buffer: int, publishers: int
    ) -> Any:
        builder = self.node.service_builder(self._name(service)).publish_subscribe(_BYTES)
        builder = builder.user_header(header).max_publishers(publishers)
        builder = builder.max_subscribers(readers).max_nodes(wire.MAX_NODES).history_size(1)
        builder = builder.subscriber_max_buffer_size(buffer).subscriber_max_borrowed_samples(1)
        with channel_errors(f"open {service} on instance {self.instance!r}"):
            return self.keep(builder.enable_safe_overflow(True).open_or_create())

    def open_wake(self, service: str) -> Any:
        builder = self.node.service_builder(self._name(service)).event()
        builder = builder.max_listeners(wire.MAX_NODES).max_notifiers(wire.MAX_NODES)
        with channel_errors(f"open {service} on instance {self.instance!r}"):
            return self.keep(builder.max_nodes(wire.MAX_NODES).open_or_create())

    def clean_up(self) -> None:
        """Removes what dead processes left behind, unless another process has the turn."""
        with (
            contextlib.suppress(EmberwatchError),
            in_turn(SHORT_WAIT) as is_alone,
            channel_errors("clean up"),
        ):
            if is_alone:
                _files_of_user().remove_leftovers(_config())

    def abandon(self) -> None:
        """In a forked child: nothing of the parent's may be dropped here, so all of it leaks."""
        self._usable, self._forked = False, True
        self._leak()

    def _leak(self) -> None:
        for port in self._held:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(port))

    def _name(self, service: str) -> Any:
        return iox2.ServiceName.new(f"emberwatch/v{wire.VERSION}/{self.instance}/{service}")


class Closable:
    """What `with` closes."""

    def close(self) -> None:
        """Closes it; may be called again."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def channel_errors(what: str, most: str = f"{wire.MAX_NODES} processes") -> Generator[None]:
    """Turns iceoryx2's errors into one that says what was attempted, and why it failed."""
    try:
        yield
    except EmberwatchError:
        raise
    except Exception as error:
        raise cause(what, error, most) from None


def directory() -> Path:
    """The directory of this user's channels, beside the shared memory: both are there, or none."""
    return SHARED_MEMORY / f"emberwatch-{os.getuid()}"


def in_turn(limit: float = LONGEST_WAIT) -> contextlib.AbstractContextManager[bool]:
    """A turn of making and removing; yields whether no other process has it."""
    return turn(_own_directory(directory()), limit)


def _files_of_user() -> ChannelFiles:
    return ChannelFiles(directory(), SHARED_MEMORY, _prefix())


def _make_way(is_alone: bool) -> None:
    """Removes what dead processes left, and waits for what processes without turns are making.

    iceoryx2 waits without end for an unfinished segment.
    """
    deadline = time.monotonic() + _UNFINISHED
    while True:
        if is_alone:
            with contextlib.suppress(Exception):  # The next program tries again.
                _files_of_user().remove_leftovers(_config())
        unfinished = _files_of_user().unfinished()
        if not unfinished:
            return
        if time.monotonic() > deadline:
            problem = "a process is making it, perhaps a stopped one: continue or kill that"
            raise EmberwatchError(f"{unfinished[0]}: {problem}", "channel")
        time.sleep(0.01)


def _config() -> Any:
    config = iox2.config.default()
    # Only in turn.
    config.global_cfg.node.cleanup_dead_nodes_on_creation = False
    config.global_cfg.node.cleanup_dead_nodes_on_destruction = False
    config.global_cfg.service.cleanup_dead_nodes_on_open = False
    config.global_cfg.root_path = iox2.Path.new(f"{_own_directory(directory())}/")
    config.global_cfg.prefix = iox2.FileName.new(_prefix())
    return config


def _prefix() -> str:
    return f"emberwatch-{os.getuid()}_"


def _own_segments(folder: Path, prefix: str) -> None:
    """Checks that shared memory of this prefix is ours, and closes it to all others."""
    for path in folder.glob(f"{prefix}*"):
        try:
            found = path.lstat()
            if not stat.S_ISREG(found.st_mode) or found.st_uid != os.getuid():
                problem = f"shared memory of this user, got something of user {found.st_uid}"
                raise EmberwatchError(f"{path}: expected {problem}", "channel")
            if found.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
                path.chmod(0o600)
        except FileNotFoundError:  # It belonged to a process that ended.
            continue


def _own_directory(path: Path) -> Path:
    """Creates the directory, mode 0700, or checks that it is ours and only ours to write."""
    try:
        path.mkdir(mode=0o700)
    except FileExistsError:
        pass
    except OSError as error:
        raise cannot_create(path, error) from None
    found = path.lstat()
    if (
        not stat.S_ISDIR(found.st_mode)
        or found.st_uid != os.getuid()
        or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    ):
        raise EmberwatchError(
            f"{path}: expected a directory that belongs to this user and that others cannot "
            f"write to, got mode {stat.filemode(found.st_mode)} of user {found.st_uid}",
            "channel",
        )
    return path


_nodes: weakref.WeakSet[Node] = weakref.WeakSet()


def _abandon_all() -> None:
    for node in list(_nodes):
        node.abandon()


os.register_at_fork(after_in_child=_abandon_all)
