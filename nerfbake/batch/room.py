"""Memory for items that run beside each other: none starts before there is room for it, but one always runs."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from nerfbake.batch.items import Item
from nerfbake.io.sizes import decoded_bytes

_PER_BYTE = 4  # of decoded input: arrays, what is made of them, and pictures that judge it
_PROGRAM = 160 << 20  # bytes of an interpreter with all libraries


class Room:
    """limit: bytes of all items together; None: any number."""

    def __init__(self, limit: int | None) -> None:
        self._limit, self._taken, self._guests = limit, 0, 0
        self._turn, self._changed, self._closed = threading.Lock(), threading.Condition(), False

    @contextmanager
    def taken(self, need: int) -> Iterator[None]:
        """Waits until so many bytes are free, or nothing else runs, and holds them for as long as the block lasts.

        Whoever came first goes first: else the largest items would wait for the smallest for ever.
        """
        with self._turn, self._changed:
            self._changed.wait_for(lambda: self._fits(need))
            self._taken, self._guests = self._taken + need, self._guests + 1
        try:
            yield
        finally:
            with self._changed:
                self._taken, self._guests = self._taken - need, self._guests - 1
                self._changed.notify_all()

    def _fits(self, need: int) -> bool:
        return self._limit is None or self._closed or not self._guests or self._taken + need <= self._limit

    def close(self) -> None:
        """Nobody waits any more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def estimate(self, item: Item, peak: int) -> int:
        """What an item will need: its peak the last time, if there was one, else what its inputs make likely."""
        if self._limit is None:
            return 0
        return peak or _PROGRAM + _PER_BYTE * sum(map(decoded_bytes, (*item.reads, *item.albums)))
