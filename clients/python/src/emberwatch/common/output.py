"""Flags and standard output of the commands `python -m emberwatch...`."""

import argparse
import math
import signal
from collections.abc import Callable
from typing import NoReturn


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        """Exits with code 2 and the message."""
        self.exit(2, f"{self.prog}: {message}\n")


def number(
    kind: type[float], least: float, most: float = math.inf, unit: str = ""
) -> Callable[[str], float]:
    """Returns a function that parses a flag's number, which must be within `least` to `most`.

    Its error names the `unit`.
    """

    def parse(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            sort = "a whole number" if kind is int else unit or "a number"
            limits = f"{least} or more" if most == math.inf else f"{least} to {most}"
            raise argparse.ArgumentTypeError(f"expected {sort}, {limits}, got {text}")
        return value

    return parse


def end_with_reader() -> None:
    """Ends this process silently, as other programs end, if its reader leaves early (`| head`)."""
    if hasattr(signal, "SIGPIPE"):  # not on Windows
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
