"""Units of length, and their spellings in files and flags."""

import re
from typing import Final, NamedTuple

from emberwatch.errors import invalid

METRES: Final = {
    "m": 1.0, "km": 1e3, "dm": 0.1, "cm": 0.01, "mm": 1e-3, "ft": 0.3048, "us-ft": 1200 / 3937,
}  # fmt: skip
"""The length of each unit in metres."""
NAMES: Final = {
    "m": "metres", "km": "kilometres", "dm": "decimetres", "cm": "centimetres",
    "mm": "millimetres", "ft": "international feet", "us-ft": "US survey feet",
}  # fmt: skip

#: Other spellings of units, without spaces, and with `m` and `ft` for metre(s) and foot or feet.
_SPELLINGS: Final = {
    "kilom": "km", "decim": "dm", "centim": "cm", "millim": "mm", "internationalft": "ft",
    "usft": "us-ft", "ftus": "us-ft", "ussurveyft": "us-ft", "surveyft": "us-ft",
}  # fmt: skip


class Side(NamedTuple):
    """The side of a cell, as given by a flag."""

    metres: float
    unit: str
    """The unit in the flag, a key of `METRES`."""


def unit_named(words: str) -> str | None:
    """Parses the name of a unit to a key of `METRES`; None for other words."""
    short = re.sub(r"[ _.()-]", "", words.lower())
    short = re.sub(r"met(?:re|er)s?", "m", re.sub("foot|feet", "ft", short))
    short = _SPELLINGS.get(short, short)
    return short if short in METRES else None


def side(flag: str, text: str) -> Side:
    """Parses the side of a cell, such as `30` (metres) or `98.4 ft`."""
    parts = re.fullmatch(r"\s*((?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*(.*?)\s*", text, re.IGNORECASE)
    unit = unit_named(parts[2] or "m") if parts else None
    metres = float(parts[1]) * METRES[unit] if parts and unit else 0.0
    if unit is None or not 1e-3 <= metres < 1e9:
        expected = f"at least 0.001 metres, such as 30 or '98.4 ft' ({', '.join(METRES)})"
        raise invalid(flag, expected, f"'{text}'")
    return Side(metres, unit)
