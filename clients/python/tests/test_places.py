"""Where a client connects: instance names, waiting for servers, the lock."""

import fcntl
import importlib.util
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest
from failures import fails
from processes import CHANNELS, PATIENCE, ctrl_c, eventually, server, unused_instance

from emberwatch import _native, errors
from emberwatch.client.client import connect

US = os.getpid()


def test_connect_waits_for_a_server_that_starts_later(caplog: pytest.LogCaptureFixture) -> None:
    instance = unused_instance()
    with ThreadPoolExecutor() as threads:
        waiting = threads.submit(connect, instance, wait=PATIENCE)
        assert eventually(lambda: "waiting up to 20 s" in caplog.text)
        started = server(instance)
        with waiting.result(2 * PATIENCE) as client:
            assert client.info.pid == started.program.pid
    # Logged once by this test, and once by `server` if its program was slow.
    assert caplog.text.count("waiting up to 20 s") in (1, 2)
    assert f"no server on instance {instance!r}" in caplog.text


def test_a_lock_wait_ends_by_timeout_or_ctrl_c() -> None:
    started = server()
    with (CHANNELS / "lock").open("rb+") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with fails("channel", match=f"the lock within .*, but it is still held by pid {US}"):
            connect(started.instance, timeout=0.01)
        with ctrl_c(partial(time.sleep, 0.3)):  # a lock that is held for 2 s is ignored
            connect(started.instance)
    started.connect().status()


def test_a_stopped_lock_holder_blocks_nobody() -> None:
    code = (
        "import fcntl, os, signal, sys; lock = open(sys.argv[1], 'r+'); "
        "fcntl.flock(lock, fcntl.LOCK_EX); print(flush=True); os.kill(os.getpid(), signal.SIGSTOP)"
    )
    command = [sys.executable, "-c", code, str(CHANNELS / "lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as holder:
        try:
            assert holder.stdout is not None
            holder.stdout.readline()
            with pytest.raises(errors.NoServerError):
                connect("nobody-here")
            assert holder.poll() is None
        finally:
            holder.kill()


def another_copy(folder: Path) -> ModuleType:
    """Loads a second copy of the native module, as a plugin with its own copy does."""
    copy = shutil.copy(_native.__file__, folder)
    spec = importlib.util.spec_from_file_location("emberwatch._native", copy)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_second_copy_of_the_library_is_refused_while_the_first_is_connected(
    tmp_path: Path,
) -> None:
    started = server()
    copy = another_copy(tmp_path)
    with started.connect() as client:
        lease = client.acquire()
        for opens in (copy.Client, copy.Observer):
            with fails("channel", match="one copy of Emberwatch's library in this process"):
                opens(started.instance)
            lease.step([3] * 6)
