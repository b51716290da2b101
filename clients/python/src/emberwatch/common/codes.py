"""Constants of PROTOCOL.md that the whole package shares."""

from typing import Final

#: Value of an unobserved cell in a frame.
UNOBSERVED: Final = 255

#: Number of moves: up, down, left, right.
N_MOVES: Final = 4
