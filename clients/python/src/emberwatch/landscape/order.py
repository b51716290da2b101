"""The order of the files of a folder, by the numbers or dates in their names."""

import re
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Final

from emberwatch.errors import invalid

ORDERS: Final = ("numbers", "day-month", "month-day")
"""The values of `--order`."""
_MONTHS: Final = tuple("jan feb mar apr may jun jul aug sep oct nov dec".split())
_WORD: Final = rf"(?:{'|'.join(_MONTHS)})[a-z]*"
#: Dates that numbers order correctly.
_YEAR_FIRST: Final = re.compile(
    r"(?<!\d)(?<!\d[-_. ])(?:19|20)\d\d[-_. ]?(?:0?[1-9]|1[0-2])[-_. ]?(?:0[1-9]|[12]\d|3[01])"
)
#: Two numbers, or a number and the name of a month, and the year. Without marks between the
#: numbers, or with spaces, a year has four digits.
_YEAR_LAST: Final = re.compile(
    rf"(?i)(?<![\da-z])(\d\d|\d(?=\D)|{_WORD})([-_. ]?)(\d\d?|{_WORD})\2(\d{{4}}|(?<=[-_.])\d\d)"
    r"(?!\d)"
)


def ordered(folder: Path, files: list[Path], order: str | None) -> tuple[list[Path], str]:
    """Returns the files in order, and a note on this order; None: the order that names imply."""
    possible = [order] if order else _possible(files)
    found = {tuple(sorted(files, key=lambda file: _key(file, one))): one for one in possible[::-1]}
    if len(found) != 1:
        orders = " or ".join(sorted(found.values())) or "numbers"
        expected = f"{orders}, as the dates in the names in {folder} are unclear"
        raise invalid("--order", expected, f"none, and {files[0].name}")
    ((names, rule),) = found.items()
    words = "the numbers" if rule == "numbers" else f"the dates ({rule}-year)"
    note = f"{folder}: {len(names)} files by {words} in their names, {names[0].name} first, "
    return list(names), f"{note}{names[-1].name} last"


def _possible(files: Sequence[Path]) -> list[str]:
    """Returns the orders that the names may have."""
    dates = [_YEAR_LAST.search(file.stem) for file in files]
    if not all(dates) or any(_YEAR_FIRST.search(file.stem) for file in files):
        return ["numbers"]
    found = [
        order for order in ORDERS[1:] if all(one and _date(one, order) is not None for one in dates)
    ]
    has_short_years = any(one and len(one[4]) == 2 for one in dates)
    return [*found, "numbers"] if has_short_years or not found else found


def _key(file: Path, order: str) -> list[tuple[int, str]]:
    """Returns a sort key that orders `step_2` before `step_10`."""
    name, found = file.name, _YEAR_LAST.search(file.stem)
    if order != "numbers":
        day = found and _date(found, order)
        if found is None or day is None:
            raise invalid(file, f"a date ({order}-year) in its name, as in --order", name)
        name = f"{name[: found.start()]}{day:%Y-%m-%d}{name[found.end() :]}"
    parts = re.findall(r"\d+|\D+", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _date(found: re.Match[str], order: str) -> date | None:
    """Returns the date in a name; None if it is not a date in this order."""
    parts = [found[1], found[3]]
    words = [part.isalpha() for part in parts]
    is_month_first = words[0] if any(words) else order == "month-day"
    month, day = parts if is_month_first else parts[::-1]
    number = _MONTHS.index(month[:3].lower()) + 1 if month.isalpha() else int(month)
    year = int(found[4]) + (2000 if len(found[4]) == 2 else 0)
    try:
        return date(year, number, int(day))
    except ValueError:
        return None
