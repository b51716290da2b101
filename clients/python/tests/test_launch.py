"""Private servers that do not start: each says why, in its own words where it has some."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from failures import fails, refuses
from processes import eventually, is_running, server

from emberwatch import programs
from emberwatch.client import Client
from emberwatch.env import WildfireEnv
from emberwatch.programs import Program

SMALL = {"height": 5, "width": 7, "n_moves": 6, "burn_in": 20}


def launch_error(**settings: object) -> str:
    with fails("program") as raised:
        WildfireEnv(**(SMALL | settings)).reset(seed=1)
    return str(raised.value)


def test_a_server_that_does_not_start_says_why_in_its_own_words() -> None:
    program = Program("emberwatch-server", ["--instance=nowhere", "--start=nowhere"])
    with fails("program", match="emberwatch-server ended with code .*'nowhere'"):
        program.wait_for(lambda: Client("nowhere"))


def test_a_second_server_on_an_instance_says_who_serves_it() -> None:
    started = server()
    program = Program("emberwatch-server", [f"--instance={started.instance}", "--burn-in=0"])
    assert eventually(lambda: not is_running(program.pid))
    words = program.output()
    program.stop()
    assert f"already running, as pid {started.program.pid}" in words
    assert started.connect().acquire().step([3] * 6).result().world.step == 1


def test_a_bad_model_file_is_named_in_the_server_s_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RUST_LOG", "off")
    path = tmp_path / "bad.toml"
    path.write_text("name = 5\n")
    with refuses(r"bad\.toml: .*line 1, column 8"):
        WildfireEnv(model=path, **SMALL)


def test_a_missing_program_is_named_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs.sysconfig, "get_path", lambda _: str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    words = launch_error()
    for part in ("emberwatch-server", str(tmp_path), "pip install", "instance=..."):
        assert part in words


def test_a_program_that_cannot_run_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs.sysconfig, "get_path", lambda _: str(tmp_path))
    for content, words in ((b"no program", "Exec format error"), (None, "Permission denied")):
        path = tmp_path / "emberwatch-server"
        path.write_bytes(content or b"")
        path.chmod(0o700 if content else 0o600)
        assert words in launch_error()


def test_a_program_that_never_answers_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs.sysconfig, "get_path", lambda _: str(tmp_path))
    monkeypatch.setattr(programs, "_START_TIMEOUT", 0.2)
    path = tmp_path / "emberwatch-server"
    check = f'case "$1" in --check) exec {programs.find("emberwatch-server")} "$@";; esac'
    path.write_text(f"#!/bin/sh\n{check}\nexec sleep 60\n")
    path.chmod(0o700)
    started = starting(monkeypatch)
    assert "did not answer within 0.2 s" in launch_error()
    assert [is_running(process.pid) for process in started] == [False]


def starting(
    monkeypatch: pytest.MonkeyPatch, then: Callable[[], None] = lambda: None
) -> list[subprocess.Popen[bytes]]:
    """The processes of programs that start from now on; `then` is called as soon as one runs."""
    start, started = Program._start, []

    def started_too(program: Program, command: list[str]) -> subprocess.Popen[bytes]:
        started.append(start(program, command))
        then()
        return started[-1]

    monkeypatch.setattr(Program, "_start", started_too)
    return started


def test_ctrl_c_while_a_program_starts_leaves_none_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    env = WildfireEnv(**SMALL)
    started = starting(monkeypatch, lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt) as kept:
        env.reset(seed=1)
    assert kept is not None
    assert [is_running(process.pid) for process in started] == [False]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_ends_a_program_that_was_started() -> None:
    program = server().program
    os.kill(program.pid, signal.SIGINT)
    assert eventually(lambda: not is_running(program.pid))


def test_a_forgotten_program_ends() -> None:
    program = Program("emberwatch-server", [f"--instance={programs.unused_instance()}"])
    pid = program.pid
    del program
    assert not is_running(pid)


def test_a_program_that_does_not_stop_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs.sysconfig, "get_path", lambda _: str(tmp_path))
    monkeypatch.setattr(programs, "_STOP_TIMEOUT", 0.1)
    path = tmp_path / "emberwatch-server"
    path.write_text("#!/bin/sh\ntrap '' TERM\necho ready\nwhile :; do sleep 0.01; done\n")
    path.chmod(0o700)
    program = Program("emberwatch-server", [])
    assert eventually(lambda: program.output() == "ready")
    program.stop()
    program.stop()
    assert not is_running(program.pid)


#: Runs the rest of its arguments where shared memory is a file system of 64 MB of its own.
SMALL_MEMORY = 'mount -t tmpfs -o size=64m tmpfs /dev/shm && exec "$@"'


@pytest.fixture
def small_memory() -> Callable[[str], subprocess.CompletedProcess[str]]:
    """Runs Python code with 64 MB of `/dev/shm`, in a mount namespace of its own."""
    is_root = os.getuid() == 0
    unshare = ["unshare", "-m"] if is_root else ["unshare", "-rm"]

    def run(*command: str) -> subprocess.CompletedProcess[str]:
        shell = [*unshare, "sh", "-c", SMALL_MEMORY, "sh", *command]
        return subprocess.run(shell, capture_output=True, text=True, timeout=60)

    if shutil.which("unshare") is None or run("true").returncode != 0:
        pytest.skip("needs a mount namespace: `unshare -rm` is not permitted here")
    return lambda code: run(sys.executable, "-c", code)


def test_a_server_too_large_for_shared_memory_is_refused_before_it_starts(
    small_memory: Callable[[str], subprocess.CompletedProcess[str]],
) -> None:
    code = (
        "from emberwatch.env import WildfireEnv; from emberwatch.errors import EmberwatchError\n"
        "try: WildfireEnv(height=512, width=512, burn_in=0).reset(seed=1)\n"
        "except EmberwatchError as error: print(error)"
    )
    ended = small_memory(code)
    assert ended.returncode == 0, ended.stderr
    for words in ("emberwatch-server ended with code 1", "/dev/shm", "MiB", "free"):
        assert words in ended.stdout, ended.stdout


def test_an_environment_of_the_usual_size_fits_into_64_mb(
    small_memory: Callable[[str], subprocess.CompletedProcess[str]],
) -> None:
    code = (
        "from emberwatch.env import WildfireEnv\n"
        "env = WildfireEnv(burn_in=10); env.reset(seed=1)\n"
        "print(env.step([1] * 64)[4]['step'])"
    )
    ended = small_memory(code)
    assert (ended.returncode, ended.stdout) == (0, "1\n"), ended.stderr
