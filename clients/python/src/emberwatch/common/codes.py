"""Numbers that every part of the package shares, as PROTOCOL.md has them."""

from typing import Final

#: Byte of a frame where nothing was observed.
UNOBSERVED: Final = 255

#: Number of moves: up, down, left, right.
N_MOVES: Final = 4
