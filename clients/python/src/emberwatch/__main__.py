"""`python -m emberwatch --version`."""

import argparse
from typing import Final

from emberwatch._native import VERSION
from emberwatch.common.output import end_with_reader

_COMMANDS: Final = """
commands, each with --help:
  python -m emberwatch.render.film   makes films of recordings
  python -m emberwatch.landscape     makes recorded worlds from rasters of fires

programs in separate packages (pip install --find-links FOLDER "emberwatch[programs]"):
  emberwatch-server                  simulates worlds that several processes share
  emberwatch-agent                   explores worlds, trains policies, compares them
  emberwatch-dashboard               shows an instance or a recording in a browser
"""


def main() -> None:
    """Prints the version, or a list of the commands and programs."""
    parser = argparse.ArgumentParser(
        prog="python -m emberwatch",
        epilog=_COMMANDS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"emberwatch {VERSION}")
    parser.parse_args()
    parser.print_help()


if __name__ == "__main__":
    end_with_reader()
    main()
