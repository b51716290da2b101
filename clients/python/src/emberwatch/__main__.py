"""`python -m emberwatch`: prints the version."""

import argparse

from emberwatch._native import VERSION
from emberwatch.common.output import end_with_reader


def main() -> None:
    """Prints the version, and names the other commands."""
    parser = argparse.ArgumentParser(
        prog="python -m emberwatch",
        epilog="Commands: python -m emberwatch.render.film, python -m emberwatch.landscape. "
        "Programs: emberwatch-server, emberwatch-agent, emberwatch-dashboard.",
    )
    parser.add_argument("--version", action="version", version=f"emberwatch {VERSION}")
    parser.parse_args()
    parser.print_help()


if __name__ == "__main__":
    end_with_reader()
    main()
