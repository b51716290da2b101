"""Published samples that belong to given steps: for infos, pictures and rewards by the move."""

import time
from collections.abc import Callable, Sequence
from typing import Final, Generic, TypeVar

from emberwatch.errors import RequestTimeoutError
from emberwatch.observer import Frame, Reader, Truth

#: How long to wait for samples before they are first asked for again, seconds.
_RETRY: Final = 0.02


_Sample = TypeVar("_Sample", Frame, Truth)


class Newest(Generic[_Sample]):
    """The newest samples of consecutive worlds."""

    def __init__(self, subscribe: Callable[[], Reader[_Sample]], worlds: range) -> None:
        self._subscribe = subscribe
        self._reader = subscribe()
        self._worlds = worlds
        self._samples: dict[int, _Sample] = {}

    def at(
        self, moments: Sequence[tuple[int, int, int]], timeout: float, first: int = 0
    ) -> list[_Sample]:
        """The samples of the worlds from `first` on at these moments.

        Args:
            moments: Seed, episode and step of each world.
            first: The first of these worlds, counted from 0.
        """
        wanted = dict(zip(self._worlds[first:], moments, strict=False))
        begin = asked = time.perf_counter()
        n_asked = n_lost = 0
        while any(self._moment(world) != moment for world, moment in wanted.items()):
            now = time.perf_counter()
            if now - begin > timeout:
                raise RequestTimeoutError(f"nothing was published within {timeout} s")
            # The samples of other worlds may have displaced these: a new reader gets all again.
            # Where it missed nothing, they may just take longer.
            if now - asked > (_RETRY if n_lost else _RETRY * 2**n_asked):
                self._reader.close()
                self._reader = self._subscribe()
                asked, n_asked, n_lost = now, n_asked + 1, 0
            sample = self._reader.receive(min(timeout, _RETRY))
            if sample is not None:
                n_lost += sample.n_lost
                if sample.world in self._worlds:
                    self._samples[sample.world] = sample
        return [self._samples[world] for world in wanted]

    def close(self) -> None:
        self._reader.close()

    def _moment(self, world: int) -> tuple[int, int, int] | None:
        sample = self._samples.get(world)
        return None if sample is None else sample.moment
