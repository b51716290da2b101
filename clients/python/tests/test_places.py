"""Where a client connects: limits, instance names, and the directory of the channels."""

import errno
import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from failures import fails, refuses
from processes import PATIENCE, connects, eventually, server

from emberwatch import channels, cleanup, errors
from emberwatch import turn as turn_module
from emberwatch.client import connect
from emberwatch.observer import observe
from emberwatch.programs import unused_instance

US = os.getpid()


def test_a_seventeenth_client_is_told_the_limit_and_others_go_on() -> None:
    started = server()
    clients = [started.connect() for _ in range(15)]
    with fails("channel", match="expected at most 16 clients at a time, got one more"):
        started.connect()
    assert clients[-1].acquire().step([3] * 6).result().world.step == 1
    clients[0].close()
    assert eventually(lambda: connects(started))


def test_without_a_server_the_instance_and_the_remedy_are_named() -> None:
    with pytest.raises(errors.NoServerError) as raised:
        connect("nobody-here")
    assert "'nobody-here'" in str(raised.value)
    assert "emberwatch-server --instance nobody-here" in str(raised.value)


def test_a_server_that_is_started_later_is_waited_for(caplog: pytest.LogCaptureFixture) -> None:
    instance = unused_instance()
    with ThreadPoolExecutor() as threads:
        waiting = threads.submit(connect, instance, wait=PATIENCE)
        assert eventually(lambda: "waiting up to 20 s" in caplog.text)
        started = server(instance)
        with waiting.result(2 * PATIENCE) as client:
            assert client.info.pid == started.program.pid
    assert len(caplog.records) == 1
    assert f"no server on instance {instance!r}" in caplog.text


@pytest.mark.parametrize("name", ["", "a/b", "a b", ".", "ä", "x" * 65, "a\n", "a\0"])
def test_a_bad_instance_name_is_refused(name: str) -> None:
    with refuses("instance: expected 1 to 64 characters"):
        connect(name)


def test_the_longest_instance_name_is_served() -> None:
    name = f"python-{US}-".ljust(64, "x")
    assert server(name).connect().instance == name


@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777])
def test_a_directory_that_others_can_write_to_is_refused(
    mode: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tmp_path.chmod(mode)
    _refuses(tmp_path, "others cannot write to", monkeypatch)


def test_a_directory_that_is_a_link_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "real").mkdir(mode=0o700)
    (tmp_path / "link").symlink_to("real")
    _refuses(tmp_path / "link", "expected a directory", monkeypatch)


def test_a_file_in_place_of_the_directory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch(mode=0o600)
    _refuses(tmp_path / "file", "expected a directory", monkeypatch)
    _refuses(tmp_path / "file/below", "create", monkeypatch)


def test_a_directory_of_another_user_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner = tmp_path.stat().st_uid
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    _refuses(tmp_path, "belongs to this user", monkeypatch)


def test_the_directory_is_created_for_this_user_alone(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        place = channels._own_directory(tmp_path / "new")
    finally:
        os.umask(before)
    assert place.stat().st_mode & 0o777 == 0o700


def test_shared_memory_of_our_prefix_is_ours_and_closed_to_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("emberwatch_1_a", "emberwatch_10_a"):
        (tmp_path / name).touch()
        (tmp_path / name).chmod(0o666)
    channels._own_segments(tmp_path, "emberwatch_1_")
    assert (tmp_path / "emberwatch_1_a").stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "emberwatch_10_a").stat().st_mode & 0o777 == 0o666
    owner = tmp_path.stat().st_uid
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    with fails("channel", match=f"something of user {owner}"):
        channels._own_segments(tmp_path, "emberwatch_1_")


def _segment(name: str) -> Path:
    uid = os.getuid()
    return Path(f"/dev/shm/emberwatch-{uid}_{'0123456789abcdef' * 2}{US:08x}_{name}")


def _identity(pid: int, seconds: float) -> int:
    return pid << 64 | int(seconds)


def test_what_dead_processes_left_half_made_is_removed_and_the_young_of_others_stays() -> None:
    nobody = 1 << 30
    dead = [_segment(f"{_identity(nobody, time.monotonic())}.dynamic")]
    dead += [_segment(f"{_identity(US, max(time.monotonic() - 60, 0))}.data")]
    dead += [_segment(f"{_identity(nobody, 0)}_{_identity(nobody, 1)}.connection")]
    young = _segment(f"{_identity(US, time.monotonic() + 60)}.dynamic")
    for path in dead:
        path.touch(0o200)
    young.write_text("finished")
    node = channels.directory() / "nodes" / str(_identity(nobody, time.monotonic()))
    node.mkdir()
    (node / "emberwatch-0_node.details").touch(0o600)
    try:
        with pytest.raises(errors.NoServerError):
            connect("nobody-here")
        assert [path for path in (*dead, node) if path.exists()] == []
        assert young.exists()
    finally:
        young.unlink()


def test_what_a_living_process_does_not_finish_is_not_waited_for_without_end() -> None:
    young = _segment(f"{_identity(US, time.monotonic() + 60)}.dynamic")
    young.touch(0o200)
    try:
        with fails("channel", match=young.name):
            connect("nobody-here")
    finally:
        young.unlink()


def test_services_are_opened_in_one_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    started = server()
    events: list[str] = []
    turn = channels.turn

    @contextmanager
    def noted(*arguments: Any) -> Iterator[bool]:
        is_outermost = turn_module._held.alone is None
        with turn(*arguments) as alone:
            events.extend(["turn"] * is_outermost)
            yield alone

    monkeypatch.setattr(channels, "turn", noted)
    for name in ("open_request_response", "open_publications", "open_wake"):
        opens = getattr(channels.Node, name)

        def counted(self: channels.Node, *rest: Any, opens: Any = opens) -> Any:
            events.append("open")
            return opens(self, *rest)

        monkeypatch.setattr(channels.Node, name, counted)
    opened = [connect(started.instance), observe(started.instance)]
    # Only the port for steps is made in a turn of its own: the server tells its size.
    assert events == ["turn", *["open"] * 4, "turn", "turn", "open", "open"]
    for one in opened:
        one.close()


def test_a_lock_that_is_interrupted_is_free_for_others(tmp_path: Path) -> None:
    code = """
import signal, sys
from pathlib import Path
from emberwatch import turn

def interrupt(frame, event, argument):
    if frame.f_code.co_filename == turn.__file__:
        steps[0] -= 1
        if steps[0] == 0:
            raise KeyboardInterrupt
    return interrupt

for number in range(1, 200):
    steps = [number]
    sys.settrace(interrupt)
    try:
        with turn.turn(Path(sys.argv[1])):
            pass
    except KeyboardInterrupt:
        pass
    sys.settrace(None)
    turn._held.alone = None
    with turn.turn(Path(sys.argv[1]), 0.0) as alone:
        assert alone, number
    if steps[0] > 0:
        print("done")
        break
"""
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.stdout == "done\n", done.stderr


def test_a_lock_that_is_given_up_leaves_no_file_open(tmp_path: Path) -> None:
    with (tmp_path / "lock").open("wb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        words = f"expected the lock within 0.01 s, got it held by pid {os.getpid()}$"
        expected = fails("channel", match=words)
        with expected as raised, turn_module.turn(tmp_path, 0.01):
            pass
    given_up = [lock for lock in turn_module._locks if lock.name == str(tmp_path / "lock")]
    assert raised.value and all(lock.closed for lock in given_up)


def test_an_unreadable_process_counts_as_living(monkeypatch: pytest.MonkeyPatch) -> None:
    young = _segment(f"{_identity(1 << 30, time.monotonic())}.dynamic")
    young.touch(0o200)

    def unreadable(_pid: int) -> str | None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(cleanup, "process_state", unreadable)
    places = channels._files_of_user()
    try:
        with channels.in_turn(), pytest.raises(OSError):
            places.remove_leftovers(channels._config())
        assert young.exists()
    finally:
        young.unlink()


def test_a_stopped_process_in_its_turn_keeps_nobody_waiting() -> None:
    with channels.in_turn():
        pass
    code = (
        "import fcntl, os, signal, sys; lock = open(sys.argv[1], 'r+'); "
        "fcntl.flock(lock, fcntl.LOCK_EX); print(flush=True); os.kill(os.getpid(), signal.SIGSTOP)"
    )
    command = [sys.executable, "-c", code, str(channels.directory() / "lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as holder:
        try:
            assert holder.stdout is not None
            holder.stdout.readline()
            with pytest.raises(errors.NoServerError):
                connect("nobody-here")
            assert holder.poll() is None
        finally:
            holder.kill()


def _refuses(place: Path, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(channels, "directory", lambda: place)
    with fails("channel", match=words) as raised:
        connect("default")
    assert str(place) in str(raised.value)
