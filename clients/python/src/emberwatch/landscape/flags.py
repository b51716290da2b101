"""Flags that both commands have."""

import argparse
from typing import NoReturn


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        """Exits with code 2 and the message."""
        self.exit(2, f"{self.prog}: {message}\n")


def add_common(parser: argparse.ArgumentParser) -> None:
    """Adds the flags for reading each file and for the output."""
    add = parser.add_argument
    add("--variable", metavar="NAME", help="the variable or layer, if a file has several")
    add("--band", type=whole, metavar="N", help="the only band to read from each file [all]")
    add("--nodata", type=float, action="append", metavar="X", help="a number that means no value")
    add("--oblong", action="store_true", help="allow cells that are not square on the ground")
    add("--force", action="store_true", help="replace the output")


def whole(text: str) -> int:
    """Parses a number of at least 1."""
    number = int(text) if text.isdecimal() and len(text) < 10 else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number, 1 to 999999999, got {text}")
    return number


def metres(text: str) -> float:
    """Parses a side of cells."""
    try:
        side = float(text)
    except ValueError:
        side = 0.0
    if not 1e-3 <= side < 1e9:
        raise argparse.ArgumentTypeError(f"expected at least 0.001 metres, got {text}")
    return side
