"""When a wait spins, at made-up instants; `protocol/src/wait.rs` tests the same."""

from __future__ import annotations

from emberwatch.spinning import FAILED_SPINS, PAUSE, Spinning

MICRO = 1e-6


def blocks_at(spinning: Spinning, begin: float, polls: list[int]) -> int | None:
    """A wait that polls at these microseconds and finds nothing: when it blocks."""
    spinning.begin(begin)
    return next((at for at in polls if not spinning.goes_on(begin + at * MICRO)), None)


def test_a_wait_spins_for_a_while_then_blocks() -> None:
    spinning = Spinning()
    assert blocks_at(spinning, 5.0, [1, 50, 99, 101]) == 101
    assert not spinning.goes_on(5.0 + 102 * MICRO)


def test_after_three_failed_spins_waits_block_at_once_until_one_tries_again() -> None:
    spinning = Spinning()
    for _ in range(FAILED_SPINS):
        assert blocks_at(spinning, 5.0, [0, 101]) == 101
    assert blocks_at(spinning, 5.0 + 102 * MICRO, [0]) == 0
    assert blocks_at(spinning, 5.0 + PAUSE, [0]) == 0
    again = 5.0 + PAUSE + 102 * MICRO
    assert blocks_at(spinning, again, [0, 101]) == 101
    assert blocks_at(spinning, again + 102 * MICRO, [0]) == 0


def test_what_arrives_while_spinning_makes_up_for_failed_spins() -> None:
    spinning = Spinning()
    for _ in range(10):
        for _ in range(1, FAILED_SPINS):
            assert blocks_at(spinning, 5.0, [0, 101]) == 101
        assert blocks_at(spinning, 5.0, [0, 99]) is None
        spinning.arrived()


def test_what_arrives_after_blocking_does_not() -> None:
    spinning = Spinning()
    for _ in range(FAILED_SPINS):
        assert blocks_at(spinning, 5.0, [0, 101]) == 101
        spinning.arrived()
    assert blocks_at(spinning, 5.0 + 102 * MICRO, [0]) == 0


def test_one_lost_core_is_enough() -> None:
    spinning = Spinning()
    assert blocks_at(spinning, 5.0, [0, 5, 4000]) == 4000
    assert blocks_at(spinning, 5.0 + 4001 * MICRO, [0]) == 0


def test_a_long_block_is_no_lost_core() -> None:
    spinning = Spinning()
    assert blocks_at(spinning, 5.0, [0, 101]) == 101
    assert not spinning.goes_on(5.009)
    assert blocks_at(spinning, 5.009, [0, 99]) is None
