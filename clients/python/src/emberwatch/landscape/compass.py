"""Compass directions, clockwise from the north, as in maps and weather reports."""

import re
from typing import Final

POINTS: Final = tuple("N NNE NE ENE E ESE SE SSE S SSW SW WSW W WNW NW NNW".split())


def bearing(text: str) -> float | None:
    """Parses a direction to degrees clockwise from the north; None if the text is not a direction.

    A direction is a number, one of `POINTS`, or a point in words, such as `north-west`.
    """
    words = re.sub(r"[\s-]", "", text.lower())
    for name in ("north", "east", "south", "west"):
        words = words.replace(name, name[0])
    if words.upper() in POINTS:
        return POINTS.index(words.upper()) * 360 / len(POINTS)
    try:
        return float(text)
    except ValueError:
        return None
