"""Flags that both commands have, and types of the values of flags."""

import argparse
from collections.abc import Callable
from dataclasses import fields
from typing import Any, NoReturn


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
    add("--name", help="name in the output [the output file's]")
    add("--force", action="store_true", help="replace the output")


def of_flags(kind: Any, flags: argparse.Namespace) -> Any:
    """Returns a dataclass with the values of the flags that have the names of its fields."""
    return kind(**{field.name: getattr(flags, field.name) for field in fields(kind)})


def whole(text: str) -> int:
    """Parses a number of at least 1."""
    number = int(text) if text.isdecimal() and len(text) < 10 else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number, 1 to 999999999, got {text}")
    return number


def several(kind: type, words: str, is_right: Callable[[Any], bool]) -> Callable[[str], Any]:
    """Returns a parser of numbers with commas between them; `words` says which are right."""

    def parse(text: str) -> Any:
        try:
            numbers = tuple(kind(part) for part in text.split(","))
        except ValueError:
            numbers = ()
        if not numbers or not is_right(numbers):
            raise argparse.ArgumentTypeError(f"expected {words}, got {text}")
        return numbers

    return parse
