"""Flags that both commands have."""

from argparse import ArgumentParser
from typing import Final

from emberwatch.common.output import number

WHOLE: Final = number(int, 1, 999_999_999)
METRES: Final = number(float, 1e-3, 10**9, "metres")


def add_common(parser: ArgumentParser) -> None:
    """Adds the flags for reading each file and for the output."""
    add = parser.add_argument
    add("--variable", metavar="NAME", help="the variable or layer, if a file has several")
    add("--band", type=WHOLE, metavar="N", help="the only band to read from each file [all]")
    nodata = "a number that means no value"
    add("--nodata", type=float, action="append", default=[], metavar="X", help=nodata)
    add("--oblong", action="store_true", help="allow cells that are not square on the ground")
    add("--force", action="store_true", help="replace the output")
