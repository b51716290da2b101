"""`python -m emberwatch --version`."""

import argparse
from typing import Final

from emberwatch._native import VERSION

_COMMANDS: Final = """
commands, each with --help:
  python -m emberwatch.render.film   films of recordings
  python -m emberwatch.landscape     recorded worlds from rasters of fires

programs, which are packages of their own (pip install "emberwatch[programs]"):
  emberwatch-server                  simulates worlds that several processes share
  emberwatch-agent                   explores, learns, compares
  emberwatch-dashboard               shows an instance or a recording in a browser
"""


def main() -> None:
    """Prints the version, or what else can be run."""
    parser = argparse.ArgumentParser(
        prog="python -m emberwatch",
        epilog=_COMMANDS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"emberwatch {VERSION}")
    parser.parse_args()
    parser.print_help()


if __name__ == "__main__":
    main()
