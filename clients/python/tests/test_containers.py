"""Containers: PID namespaces that share `/dev/shm`, a `/dev/shm` that fills, no temporary folder.

Each in a mount namespace of its own; skipped where none may be made.
"""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from typing import Any

import pytest
from failures import fails
from processes import Program, server, unused_instance

from emberwatch import programs
from emberwatch.model import Model

#: Runs Python code, its arguments behind, in a mount namespace with a `/dev/shm` of its own.
Run = Callable[..., subprocess.CompletedProcess[str]]

SMALL = "height=5, width=7, n_moves=6, burn_in=5"

#: Says what an error says: its code and its words.
HEAD = """
import os, subprocess, sys, time
import emberwatch
from emberwatch.env import WildfireEnv
from emberwatch.errors import EmberwatchError
from emberwatch.programs import Program, find
def fill(left=0):
    with open("/dev/shm/filler", "wb") as file:
        while True:
            found = os.statvfs("/dev/shm")
            try: return os.posix_fallocate(file.fileno(), 0, found.f_bavail * found.f_frsize - left)
            except OSError: time.sleep(0.01)  # A program took a page in between.
def tell(what, call):
    try: print(what, call(), flush=True)
    except EmberwatchError as error: print(what, error.code, error, flush=True)
"""


@pytest.fixture
def apart() -> Run:
    """Runs Python code where `/dev/shm` is its own."""
    user = [] if os.getuid() == 0 else ["-r"]
    unshare = ["unshare", "-m", *user, "sh", "-c"]

    def run(code: str, options: str = "size=64m") -> subprocess.CompletedProcess[str]:
        shell = f'mount -t tmpfs -o {options} tmpfs /dev/shm && exec "$@"'
        command = [*unshare, shell, "sh", sys.executable, "-W", "ignore", "-c", HEAD + code]
        return subprocess.run(command, capture_output=True, text=True, timeout=120)

    pid = [*unshare, "unshare -p -f --mount-proc true"]
    if shutil.which("unshare") is None or subprocess.run(pid, check=False).returncode != 0:
        pytest.skip("needs mount and PID namespaces: `unshare` is not permitted here")
    return run


#: Runs code in a PID namespace of its own.
INSIDE = """
def inside(code, *arguments):
    command = ["unshare", "-p", "-f", "--mount-proc", sys.executable, "-W", "ignore", "-c"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen([*command, code, *arguments], **pipes, text=True)
"""


def test_private_servers_of_two_pid_namespaces_are_never_mixed_up(apart: Run) -> None:
    code = f"""
code = '''
import os, sys
from emberwatch.env import WildfireEnv
env = WildfireEnv({SMALL.replace("height=5", "height=int(sys.argv[1])")})
frame = env.reset(seed=1)[0]["frame"]
print(os.getpid(), frame.shape[0], flush=True)
sys.stdin.readline()
for _ in range(20): info = env.step([1] * 6)[4]
env.close()
print(info["step"], flush=True)
'''
first, second = inside(code, "5"), inside(code, "6")
print([it.stdout.readline().split() for it in (first, second)])
print([it.communicate()[0].split() for it in (first, second)])
"""
    ended = apart(INSIDE + code, "size=256m")
    assert ended.stdout == "[['1', '5'], ['1', '6']]\n[['20'], ['20']]\n", ended.stderr


def test_a_server_of_another_pid_namespace_is_named_so_and_goes_on(apart: Run) -> None:
    code = """
server = Program("emberwatch-server", ["--instance=lab", "--burn-in=5"])
client = server.wait_for(lambda: emberwatch.connect("lab", wait=20))
lease = client.acquire()
code = '''
import emberwatch, subprocess
from emberwatch.programs import find
try: emberwatch.connect("lab")
except emberwatch.EmberwatchError as error: print(error.code, error)
for command in ("status", "stop"):
    words = [find("emberwatch-server"), command, "--instance=lab"]
    print(command, subprocess.run(words, capture_output=True, text=True).stderr.strip())
words = [find("emberwatch-server"), "--instance=lab", "--burn-in=5"]
print("second", subprocess.run(words, capture_output=True, text=True).stderr.strip())
'''
print(inside(code).communicate()[0], end="")
print(lease.step([1] * 64).result().world.step, server.exit_code() is None)
"""
    ended = apart(INSIDE + code, "size=256m")
    lines = ended.stdout.splitlines()
    assert len(lines) == 5, ended
    assert lines[0].startswith("pid_namespace ")
    for line in lines[:4]:
        assert "'lab'" in line or '"lab"' in line, line
        assert "another PID namespace" in line, line
        assert "--pid=container:NAME" in line, line
    assert lines[4] == "1 True", lines


@pytest.mark.parametrize("left", [0, 4096, 16384, 131072])
def test_with_little_shared_memory_programs_say_so_and_do_not_die(apart: Run, left: int) -> None:
    code = f"""
server = Program("emberwatch-server", ["--instance=lab", "--burn-in=5"])
client = server.wait_for(lambda: emberwatch.connect("lab", wait=20))
lease = client.acquire()
fill({left})
tell("connect", lambda: emberwatch.connect("lab"))
tell("observe", lambda: next(iter(emberwatch.observe("lab", timeout=2))))
tell("environment", lambda: WildfireEnv(burn_in=0).reset(seed=1))
words = [find("emberwatch-server"), "status", "--instance=lab"]
print("status", subprocess.run(words, capture_output=True, text=True).stderr.strip())
for _ in range(200): lease.step([1] * 64)
print(client.status().n_steps)
"""
    ended = apart(code)
    assert ended.returncode == 0, ended
    *lines, n_steps = ended.stdout.splitlines()
    assert (len(lines), n_steps) == (4, "200"), ended
    for line in lines:
        assert "shared memory: expected 512 KiB free in /dev/shm, got" in line, line
        assert "--shm-size" in line, line


def test_a_full_shared_memory_kills_no_server_with_observers(apart: Run) -> None:
    code = """
flags = ["--instance=lab", "--worlds=8", "--publish-truth=true", "--burn-in=5"]
server = Program("emberwatch-server", flags)
client = server.wait_for(lambda: emberwatch.connect("lab", wait=20))
lease = client.acquire(0, 8)
others = [emberwatch.connect("lab") for _ in range(4)]
observers = [emberwatch.observe("lab", timeout=5) for _ in range(3)]
truth = emberwatch.TruthReader("lab")
fill()
for _ in range(300): lease.step([[1] * 64] * 8)
for observer in observers: print(next(iter(observer)).world in range(8))
for other in others: print(other.observe(0, 8).first_robot, len(other.status().worlds))
tell("belief", lambda: lease.leave_belief(client.observe(0, 1).result(), "x", bytes(300000)))
print(lease.reset(range(8))[0].step, server.pid == client.status().pid)
"""
    ended = apart(code)
    assert ended.returncode == 0, ended
    lines = ended.stdout.splitlines()
    assert lines[:3] == ["True"] * 3, ended
    assert lines[3:7] == ["0 8"] * 4, ended
    assert lines[7].startswith("belief channel shared memory: expected"), ended
    assert lines[8:] == ["0 True"], ended


def test_an_observer_that_comes_to_a_full_server_harms_nobody(apart: Run) -> None:
    code = """
server = Program("emberwatch-server", ["--instance=lab", "--height=200", "--width=200",
    "--burn-in=0", "--moves=6"])
client = server.wait_for(lambda: emberwatch.connect("lab", wait=20))
lease = client.acquire()
fill(600 * 1024)
observer = emberwatch.observe("lab", timeout=1)
for _ in range(200): lease.step([1] * 6)
print(client.status().n_steps, "expected" in server.output() and "free" in server.output())
os.unlink("/dev/shm/filler")
lease.step([1] * 6)
print(next(iter(observer)).result.step)
"""
    ended = apart(code, "size=80m")
    assert (ended.returncode, ended.stdout) == (0, "200 True\n201\n"), ended


def test_a_long_answer_without_room_is_refused_and_kills_no_server(apart: Run) -> None:
    code = """
flags = ["--instance=lab", "--worlds=256", "--robots=8", "--height=5", "--width=5", "--moves=4"]
server = Program("emberwatch-server", [*flags, "--burn-in=0"])
client = server.wait_for(lambda: emberwatch.connect("lab", wait=20))
fill()
tell("status", client.status)
os.unlink("/dev/shm/filler")
print(len(client.status().worlds))
"""
    ended = apart(code, "size=128m")
    refusal, n_worlds = ended.stdout.splitlines()
    assert refusal.startswith("status no_memory shared memory: expected"), ended
    assert n_worlds == "256", ended


def test_too_few_files_in_shared_memory_are_called_so(apart: Run) -> None:
    code = """
tell("connect", lambda: emberwatch.connect("lab"))
"""
    ended = apart(code, "size=64m,nr_inodes=30")
    assert "shared memory: expected room for 48 files in /dev/shm, got" in ended.stdout, ended


def test_a_low_limit_on_file_sizes_is_called_so() -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    started = server()
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, before[1]))
    try:
        words = "expected a limit on file sizes of at least 512 KiB, got 1 KiB"
        with fails("channel", match=words):
            started.connect()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_private_names_are_random() -> None:
    first, second = unused_instance(), unused_instance()
    assert first.rpartition("-")[2] != second.rpartition("-")[2]


def test_a_server_that_was_not_started_is_not_taken_for_the_own() -> None:
    other = server()
    own = Program("emberwatch-server", [f"--instance={unused_instance()}", "--burn-in=0"])
    with fails("program", match=f"which was started, got pid {other.program.pid}"):
        own.wait_for(other.connect)
    assert other.status().pid == other.program.pid


def _no_folder(*_: Any, **keywords: Any) -> Any:
    if keywords.get("dir") is None:
        raise FileNotFoundError(2, "No usable temporary directory found")
    return FOLDER(**keywords)


FOLDER = tempfile.TemporaryDirectory


def test_no_temporary_folder_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs.tempfile, "TemporaryFile", _no_folder)
    assert server().status().pid > 0
    assert Model.named("wildfire-small").n_states > 1
