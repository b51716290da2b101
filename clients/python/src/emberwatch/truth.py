"""Hidden states that belong to given steps: for infos, pictures and rewards by the move."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.errors import RequestTimeoutError
from emberwatch.observer import Truth, TruthReader

#: How long to wait for hidden states before they are first asked for again, seconds.
_RETRY: Final = 0.02


class HiddenStates:
    """The newest hidden states of consecutive worlds."""

    def __init__(self, instance: str, first_world: int, shape: tuple[int, int, int]) -> None:
        """`shape` is `(n_worlds, H, W)`."""
        self._reader = TruthReader(instance)
        self._first = first_world
        self._moments: list[tuple[int, int, int]] = [(-1, -1, -1)] * shape[0]
        self._states = np.zeros(shape, np.uint8)

    def at(
        self, moments: Sequence[tuple[int, int, int]], timeout: float, first: int = 0
    ) -> NDArray[np.uint8]:
        """The states of the worlds from `first` on at these moments, `(n, H, W)`; a copy.

        Args:
            moments: Seed, episode and step of each world.
            first: The first of these worlds, counted from 0.
        """
        wanted, last = list(moments), first + len(moments)
        begin = asked = time.perf_counter()
        n_asked = n_lost = 0
        while self._moments[first:last] != wanted:
            now = time.perf_counter()
            if now - begin > timeout:
                raise RequestTimeoutError(f"no hidden states within {timeout} s")
            # The samples of other worlds may have displaced these: a new reader gets all again.
            # Where it missed nothing, they may just take longer.
            if now - asked > (_RETRY if n_lost else _RETRY * 2**n_asked):
                self._reader.close()
                self._reader = TruthReader(self._reader.instance)
                asked, n_asked, n_lost = now, n_asked + 1, 0
            truth = self._reader.receive(min(timeout, _RETRY))
            if truth is not None:
                n_lost += truth.n_lost
                self._take(truth)
        return self._states[first:last].copy()

    def close(self) -> None:
        self._reader.close()

    def _take(self, truth: Truth) -> None:
        index = truth.world - self._first
        if 0 <= index < len(self._moments):
            if truth.states.shape != self._states.shape[1:]:
                raise wire.bad_answer(f"truth: got a grid of {truth.states.shape}")
            self._moments[index] = (truth.seed, truth.episode, truth.step)
            self._states[index] = truth.states
