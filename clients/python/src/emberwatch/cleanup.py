"""Removes what processes leave that die at any instruction (PROTOCOL.md section 9).

During a turn every file is one of three: part of a node whose process lives, of a service that such
a node uses, or left over.
"""

import importlib
import os
import shutil
import stat
import time
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from emberwatch.turn import process_state

_iox2: Final[Any] = importlib.import_module("iceoryx2")

#: What a living process made less than this ago may be unfinished, as not all take turns; seconds.
_MAKING: Final = 1.0


class ChannelFiles:
    """Where channels' files are, and what their names begin with."""

    def __init__(self, root: Path, shared: Path, prefix: str) -> None:
        self._root, self._shared, self._prefix = root, shared, prefix

    def unfinished(self) -> list[Path]:
        """Segments that are not finished, which iceoryx2 might wait for without end."""
        return [path for path in _entries(self._shared, self._prefix) if self._is_unfinished(path)]

    def of_node(self, node: int) -> list[Path]:
        """The segments of a living node's ports and services."""
        ports, hashes = self._used({node})
        services = _entries(self._root / "services", self._prefix, ".service")
        services = [it for it in services if it.stem.removeprefix(self._prefix) in hashes]
        used = ports | set(map(_service_id, services))
        return [it for it in _entries(self._shared, self._prefix) if self._ids(it) & used]

    def remove_leftovers(self, config: Any) -> None:
        """Removes what dead processes left; call it in a turn that no other process shares.

        The first error ends it: what cannot be read may belong to a process that lives.
        """
        # Files before nodes and tags, to leave out what others make meanwhile without turns.
        node_files = _entries(self._root / "nodes")
        service_files = _entries(self._root / "services", self._prefix, ".service")
        folders = (self._shared, self._root)
        port_files = [path for folder in folders for path in _entries(folder, self._prefix)]
        living, dead = _nodes(config)
        ports, services = self._used(living)
        for path in self.unfinished():
            ids = self._ids(path)
            # Living ports may be making it now in another PID namespace, which cannot be seen.
            is_of_living = bool(ids) and ids <= ports
            if not is_of_living and not any(map(_is_in_the_making, ids)):
                _remove(path)
        for node in dead:
            identity = int(node.id.value)
            # iceoryx2 cannot remove a folder with unfinished tags, which mean nothing yet.
            for path in filter(_is_writable, _entries(self._folder(identity))):
                _remove(path)
            # Else none of its memory is used by others; the details go last.
            if node.details is None:
                if (self._folder(identity) / f"{self._prefix}node.details").exists():
                    living.add(identity)  # They could not be read.
            elif services & self._tags(identity, ".service_tag"):
                try:
                    node.try_remove_stale_resources()
                except _iox2.NodeCleanupFailure:
                    living.add(identity)
        self._remove_nodes(node_files, living)
        ports, services = self._used(living)
        used = ports | set(self._remove_services(service_files, services))
        for path in port_files:
            ids = self._ids(path)
            if ids and not ids & used and not any(map(_is_in_the_making, ids)):
                _remove(path)

    def _remove_nodes(self, files: list[Path], living: set[int]) -> None:
        for path in files:
            identity = path.name.removeprefix(self._prefix).partition(".node_monitor")[0]
            if identity.isdecimal() and int(identity) not in living:
                if not _is_in_the_making(int(identity)):
                    _remove(path)

    def _remove_services(self, files: list[Path], hashes: set[str]) -> Iterator[int]:
        """Removes services that nobody uses; yields the ids of the others."""
        for path in files:
            if path.stem.removeprefix(self._prefix) not in hashes:
                _remove(path)
                continue
            with suppress(FileNotFoundError):
                yield _service_id(path)

    def _used(self, living: set[int]) -> tuple[set[int], set[str]]:
        """Ids of the ports, and hashes of the services' names, that living nodes use."""
        ports, services = set[int](), set[str]()
        for node in living:
            ports |= {int(port) for port in self._tags(node, ".port_tag")}
            services |= self._tags(node, ".service_tag")
        return ports, services

    def _folder(self, node: int) -> Path:
        return self._root / "nodes" / str(node)

    def _tags(self, node: int, suffix: str) -> set[str]:
        """What a node's folder has finished tags of one kind for."""
        found = _entries(self._folder(node), self._prefix, suffix)
        found = (path for path in found if not _is_writable(path))
        return {path.name.removeprefix(self._prefix).removesuffix(suffix) for path in found}

    def _ids(self, path: Path) -> set[int]:
        """The ids in `<prefix><hash>_<id>[_<id>].<kind>` or `<prefix><id>.event`."""
        words = path.name.removeprefix(self._prefix).partition(".")[0].split("_")
        # The segments of one port are numbered; a hash has letters, or more digits than an id.
        return {int(word) for word in words if word.isdecimal() and 10 < len(word) < 40}

    def _is_unfinished(self, path: Path) -> bool:
        """A segment can be read only when it is finished."""
        with suppress(FileNotFoundError):
            found = path.lstat()
            # A living port's memory grows without a turn, and is not opened before.
            grows = path.suffix == ".data" and any(map(_lives, self._ids(path)))
            return not grows and (found.st_size == 0 or not found.st_mode & stat.S_IRUSR)
        return False


def _nodes(config: Any) -> tuple[set[int], list[Any]]:
    """The ids of living nodes, and the dead ones."""
    living: set[int] = set()
    dead: list[Any] = []
    for node in _iox2.Node.list(_iox2.ServiceType.Ipc, config):
        if isinstance(node, _iox2.NodeState.Dead):
            dead.append(node._0)
        elif isinstance(node, _iox2.NodeState.Alive):
            living.add(int(node._0.id.value))
        elif isinstance(node, _iox2.NodeState.Inaccessible) or _lives(int(node._0.value)):
            # Of undefined state are those that died in their start, and those that cannot be read.
            living.add(int(node._0.value))
    return living, dead


def _service_id(path: Path) -> int:
    identity = tomllib.loads(path.read_text())["unique_service_id"]
    return identity["unique_value"] << 64 | identity["payload_value"]


def _is_in_the_making(identity: int) -> bool:
    """Whether an id was begun just now, by a process that lives."""
    seconds, nanos = (identity >> shift & 0xFFFFFFFF for shift in (0, 32))
    return time.monotonic() - seconds - nanos * 1e-9 < _MAKING and _lives(identity)


def _lives(identity: int) -> bool:
    """Whether the process that began an id lives, or another one of its number."""
    return process_state(identity >> 64 & 0xFFFFFFFF) not in (None, "Z", "X")


def _is_writable(path: Path) -> bool:
    """A tag, or a node's details, can be written to until it is finished."""
    with suppress(FileNotFoundError):
        return bool(path.lstat().st_mode & stat.S_IWUSR)
    return False


def _entries(folder: Path, prefix: str = "", suffix: str = "") -> list[Path]:
    with suppress(FileNotFoundError):
        names = os.listdir(folder)
        return [folder / it for it in names if it.startswith(prefix) and it.endswith(suffix)]
    return []


def _remove(path: Path) -> None:
    with suppress(OSError):  # What stays is removed by the next program.
        shutil.rmtree(path) if path.is_dir() else path.unlink()
