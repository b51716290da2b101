"""An independent client, written from PROTOCOL.md, with iceoryx2's Python binding.

It shares no code with the other clients, so that it does not repeat their errors. Sections in the
comments are sections of PROTOCOL.md.

`wire_reference.py INSTANCE` connects and sends the requests of the compliance suite. Each line of
its standard input is a request, `{"service": "step", "header": [...], "payload": [...]}`, with
bytes as numbers. The client itself fills in the last 16 bytes of the header, which contain the
listener's id. Each line of its standard output is the header and the payload of an answer. The
program fails if an answer violates PROTOCOL.md.
"""

import contextlib
import ctypes
import fcntl
import json
import os
import select
import stat
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import iceoryx2 as iox2

VERSION = 3

#: Maximum number of nodes, listeners and notifiers per service.
MAX_NODES = 64

#: Maximum wait for the lock or for an answer, in seconds.
TIMEOUT = 10.0

SHARED_MEMORY = Path("/dev/shm")
PREFIX = f"emberwatch-{os.getuid()}_"
ROOT = SHARED_MEMORY / f"emberwatch-{os.getuid()}"

BYTES: Any = iox2.Slice[ctypes.c_uint8]

#: Section 3: the format and the field names of each struct.
LAYOUTS = {
    "StepRequest": (
        "=IIQQIIIIQQ",
        "version operation lease sequence first_robot n_robots n_moves flags listener_low "
        "listener_high",
    ),
    "StepReply": (
        "=IIQIIIIIIQQ",
        "version status sequence first_robot n_robots n_worlds flags height width "
        "simulation_nanos detail",
    ),
    "WorldResult": (
        "=QQQdQQIIIHH",
        "step seed episode reward hovered late n_target_cells n_visited n_hits terminated "
        "truncated",
    ),
    "RobotResult": (
        "=ddIIIIIIII",
        "reward marginal n_visited n_hits start_row start_col row col coverage n_moves",
    ),
    "ControlRequest": ("=IIQQQ", "version reserved sequence listener_low listener_high"),
    "ControlReply": ("=IIQ", "version status sequence"),
}


def header_type(name: str) -> Any:
    """Returns a header's type for iceoryx2: a ctypes structure that also has a type name."""
    layout, names = LAYOUTS[name]
    kinds = {"I": ctypes.c_uint32, "Q": ctypes.c_uint64}
    fields = [(field, kinds[it]) for field, it in zip(names.split(), layout[1:], strict=True)]
    type_name = staticmethod(lambda: f"emberwatch.v3.{name}")
    return type(name, (ctypes.Structure,), {"_fields_": fields, "type_name": type_name})


def read(name: str, message: bytes, offset: int = 0) -> dict[str, Any]:
    """Unpacks a struct into a dictionary of its fields."""
    layout, names = LAYOUTS[name]
    return dict(zip(names.split(), struct.unpack_from(layout, message, offset), strict=True))


def check(fits: bool, expected: str, got: object) -> None:
    """Raises an error unless `fits` holds."""
    if not fits:
        raise ValueError(f"expected {expected}, got {got}")


def check_places() -> None:
    """Section 1: checks that only this user can access the directory and the shared memory."""
    with contextlib.suppress(FileExistsError):
        ROOT.mkdir(mode=0o700)
    found = ROOT.lstat()
    is_ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
    check(is_ours and not found.st_mode & 0o022, "a directory of this user alone", ROOT)
    for path in SHARED_MEMORY.glob(f"{PREFIX}*"):
        with contextlib.suppress(FileNotFoundError):
            found = path.lstat()
            check(stat.S_ISREG(found.st_mode) and found.st_uid == os.getuid(), "our file", path)
            if found.st_mode & 0o077:
                path.chmod(found.st_mode & 0o700)


@contextlib.contextmanager
def turn() -> Iterator[None]:
    """Section 1: holds the lock that protects creating and removing nodes, services and ports."""
    path, start = ROOT / "lock", time.monotonic()
    holder, since = None, start
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        with contextlib.suppress(BlockingIOError, FileNotFoundError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(lock), path.stat()):
                break
        inode, now, before = f":{os.fstat(lock).st_ino} ", time.monotonic(), holder
        os.close(lock)
        locks = Path("/proc/locks").read_text().splitlines()
        holder = next((it.split()[4] for it in locks if inode in it and "->" not in it), None)
        since = since if holder == before else now
        if holder is not None and now - since > 2.0:
            yield  # A stopped or frozen process holds the lock: continue without it.
            return
        check(now - start < TIMEOUT, "the lock in time", f"it held by {holder}")
        time.sleep(0.001)
    try:
        yield
    finally:
        os.close(lock)


def make_way() -> None:
    """Section 1: checks for free space. Waits for unfinished files, which would block iceoryx2."""
    free, start = os.statvfs(SHARED_MEMORY), time.monotonic()
    check(free.f_bavail * free.f_frsize >= 512 << 10, "512 KiB of shared memory", free)
    check(free.f_files == 0 or free.f_favail >= 48, "room for 48 files", free)
    while unfinished := [it for it in SHARED_MEMORY.glob(f"{PREFIX}*") if is_unfinished(it)]:
        check(time.monotonic() - start < 1.5, "finished shared memory", unfinished)
        time.sleep(0.01)


def is_unfinished(path: Path) -> bool:
    """Section 1: returns whether a file is still being created. `.data` files may grow later."""
    with contextlib.suppress(FileNotFoundError):
        found = path.lstat()
        return path.suffix != ".data" and not (found.st_size and found.st_mode & stat.S_IRUSR)
    return False


def fill_segments() -> None:
    """Section 1: allocates the memory of segments whose names contain an id of this process."""
    for path in SHARED_MEMORY.glob(f"{PREFIX}*"):
        words = path.name.removeprefix(PREFIX).partition(".")[0].split("_")
        ids = [int(word) for word in words if word.isdecimal() and len(word) < 40]
        if any(it >> 64 & 0xFFFFFFFF == os.getpid() for it in ids):
            with contextlib.suppress(FileNotFoundError), path.open("rb+") as file:
                os.posix_fallocate(file.fileno(), 0, path.stat().st_size)


def create_node() -> Any:
    """Section 1: creates a node in our directory. Disables iceoryx2's signals and clean-ups."""
    config: Any = iox2.config.default()
    config.global_cfg.root_path = iox2.Path.new(f"{ROOT}/")
    config.global_cfg.prefix = iox2.FileName.new(PREFIX)
    config.global_cfg.node.cleanup_dead_nodes_on_creation = False
    config.global_cfg.node.cleanup_dead_nodes_on_destruction = False
    config.global_cfg.service.cleanup_dead_nodes_on_open = False
    builder: Any = iox2.NodeBuilder.new().signal_handling_mode(iox2.SignalHandlingMode.Disabled)
    check_places()
    node = builder.config(config).create(iox2.ServiceType.Ipc)
    check_places()
    return node


class Port:
    """A client of one request-response service."""

    def __init__(self, service: Any, request: str, reply: str) -> None:
        """Opens the port; `service` is iceoryx2's builder."""
        self._size = ctypes.sizeof(header_type(reply))
        builder = service.request_response(BYTES, BYTES).request_header(header_type(request))
        opened = builder.response_header(header_type(reply)).open()
        check(opened.dynamic_config.number_of_servers == 1, "a server", "none")
        # The memory can grow, because the suite sends longer requests than a valid step needs.
        port = opened.client_builder().initial_max_slice_len(4096)
        self._port = port.allocation_strategy(iox2.AllocationStrategy.PowerOfTwo).create()

    def send(self, header: bytes, payload: bytes) -> Any:
        request = self._port.loan_slice_uninit(len(payload))
        ctypes.memmove(request.user_header_ptr, header, len(header))
        ctypes.memmove(request.payload_ptr, payload, len(payload))
        pending = request.assume_init().send()
        check(pending.number_of_server_connections == 1, "a server", "none")
        return pending

    def take(self, pending: Any, response: Any) -> tuple[bytes, bytes]:
        """Copies an answer's header and payload, and frees the answer's memory."""
        header = ctypes.string_at(response.user_header_ptr, self._size)
        payload = ctypes.string_at(response.payload_ptr, response.payload().len())
        response.delete()
        pending.delete()
        return header, payload


class Client:
    """A connection to a server."""

    def __init__(self, instance: str) -> None:
        """Opens all services while it holds the lock, then sends `hello`."""
        self._process: int | None = None
        check_places()
        with turn():
            make_way()
            node = self._node = create_node()

            def service(name: str) -> Any:
                full = f"emberwatch/v{VERSION}/{instance}/{name}"
                return node.service_builder(iox2.ServiceName.new(full))

            def wake(name: str) -> Any:
                builder = service(name).event().max_nodes(MAX_NODES)
                builder = builder.max_listeners(MAX_NODES).max_notifiers(MAX_NODES)
                return builder.open_or_create()

            self._step = Port(service("step"), "StepRequest", "StepReply")
            self._control = Port(service("control"), "ControlRequest", "ControlReply")
            self._notifier = wake("wake-server").notifier_builder().create()
            self._listener = wake("wake-client").listener_builder().create()
            fill_segments()
        number = int(self._listener.id.value)
        self.listener = struct.pack("=QQ", number & (1 << 64) - 1, number >> 64)
        hello = json.dumps({"op": "hello", "protocol": VERSION, "client": "wire_reference"})
        header = struct.pack("=IIQ", VERSION, 0, 1) + self.listener
        self._info = json.loads(self.control(header, hello.encode())[1])
        namespace = os.stat("/proc/self/ns/pid").st_ino
        check(self._info["pid_namespace"] == namespace, "this PID namespace", self._info)
        self._process = os.pidfd_open(self._info["pid"])

    def step(self, header: bytes, payload: bytes) -> tuple[bytes, bytes]:
        """Sends a step request, which may be invalid, and checks the answer."""
        answer = self._exchange(self._step, header, payload)
        self._check_step(read("StepRequest", header), read("StepReply", answer[0]), answer[1])
        return answer

    def control(self, header: bytes, payload: bytes) -> tuple[bytes, bytes]:
        """Sends bytes on `control`, which may be invalid, and checks the answer."""
        answer = self._exchange(self._control, header, payload)
        request, reply = read("ControlRequest", header), read("ControlReply", answer[0])
        told = (reply["version"], reply["sequence"])
        check(told == (VERSION, request["sequence"]), "the request's numbers", reply)
        kind = json.loads(answer[1])["reply"]
        check((kind == "error") == (reply["status"] != 0), "the status of the JSON", reply)
        return answer

    def _exchange(self, port: Port, header: bytes, payload: bytes) -> tuple[bytes, bytes]:
        """Section 8: wakes the server, and waits until it answers or ends."""
        pending = port.send(header, payload)
        self._notifier.notify()
        start, is_gone = time.monotonic(), False
        while True:
            # Receives once more after the server's end, because an answer may have come before it.
            response = pending.receive()
            if response is not None:
                return port.take(pending, response)
            waited = time.monotonic() - start
            check(not is_gone and waited < TIMEOUT, "an answer", f"none after {waited} s")
            if waited > 100e-6:
                # Waits for a wake-up, and discards all that are pending.
                self._listener.timed_wait(iox2.Duration.from_millis(50))
                watched = [] if self._process is None else [self._process]
                is_gone = bool(select.select(watched, [], [], 0)[0])

    def _check_step(self, request: dict[str, Any], reply: dict[str, Any], payload: bytes) -> None:
        """Sections 3 and 4: checks everything that a client must check in an answer."""
        for name in ("sequence", "first_robot", "flags"):
            check(reply[name] == request[name], f"{name} {request[name]}", reply)
        check(reply["version"] == VERSION, f"version {VERSION}", reply)
        n_worlds, n_robots = reply["n_worlds"], reply["n_robots"]
        if reply["status"] != 0:
            check((n_worlds, n_robots, payload) == (0, 0, b""), "an empty refusal", reply)
            return
        info, first = self._info, request["first_robot"]
        height, width, team = info["height"], info["width"], info["n_robots"]
        check((reply["height"], reply["width"]) == (height, width), "the grid of `hello`", reply)
        check(n_robots == request["n_robots"], "the robots asked for", reply)
        worlds = range(first // team, (first + n_robots - 1) // team + 1)
        check(n_worlds == len(worlds), f"{len(worlds)} worlds", reply)
        n_frames = n_worlds if reply["flags"] & 2 else n_robots
        robots, frames = 64 * n_worlds, 64 * n_worlds + 48 * n_robots
        length = frames + n_frames * height * width
        check(len(payload) == length, f"{length} bytes", len(payload))
        for offset in range(0, robots, 64):
            world = read("WorldResult", payload, offset)
            stayed = (world["hovered"] | world["late"]) >> team
            check(stayed == 0, f"bits below {team}", world)
        for offset in range(robots, frames, 48):
            robot = read("RobotResult", payload, offset)
            check(robot["row"] < height and robot["col"] < width, "a cell of the grid", robot)
            check(robot["n_moves"] in (0, info["n_moves"]), "no path, or a whole one", robot)
        shown = set(payload[frames:]) - {255}
        check(shown <= set(range(info["n_observations"])), "observations or 255", shown)


def main() -> None:
    """Sends the requests from standard input, until the input ends."""
    iox2.set_log_level(iox2.LogLevel.Fatal)
    client = Client(sys.argv[1])
    for line in sys.stdin:
        request = json.loads(line)
        header = bytes(request["header"])[:-16] + client.listener
        send = {"step": client.step, "control": client.control}[request["service"]]
        header, payload = send(header, bytes(request["payload"]))
        print(json.dumps([list(header), list(payload)]), flush=True)
    with turn():
        del client, send


if __name__ == "__main__":
    main()
