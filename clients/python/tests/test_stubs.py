"""The stub of the native module names what the module has: parameters and defaults, too."""

import subprocess
import sys


def test_the_stub_is_that_of_the_module() -> None:
    # `__all__` and the helpers of pickle are for the machine alone.
    allowed = "emberwatch._native.(__all__|read_again|.*.__deepcopy__|.*.__getnewargs__)"
    command = [sys.executable, "-m", "mypy.stubtest", "emberwatch._native", "--concise"]
    command += ["--allowlist", "/dev/stdin", "--ignore-unused-allowlist", "--ignore-disjoint-bases"]
    given = subprocess.run(command, input=allowed, text=True, capture_output=True)
    assert given.returncode == 0, given.stdout
