"""How much of a step is done: loops report it, and whoever listens shows it.

    with listening(show):
        for camera in each(cameras):  # show(0.25, ""), show(0.5, ""), ...
            render(camera)

The listener is a context variable, so that pure functions need no argument for it. A loop inside a loop's body reports
its part of that body. Threads that a kernel starts have no listener, and report nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Item = TypeVar("Item")
Listener = Callable[[float, str], None]

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


def report(share: float, detail: str = "") -> None:
    """Tells the listener, if there is one, that this share of the step is done, 0 to 1, and what is being done."""
    if (listener := _listener.get()) is not None:
        listener(min(max(share, 0.0), 1.0), detail)


@contextmanager
def listening(listener: Listener | None) -> Iterator[None]:
    """Inside the block this one hears what is reported, and no other; None: nobody."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def part(begin: float, end: float) -> Iterator[None]:
    """A block that is the step's part from `begin` to `end`, 0 to 1, whatever share of itself it reports."""
    outer = _listener.get()
    if outer is None:
        yield
        return
    with listening(lambda share, detail: outer(begin + (end - begin) * share, detail)):
        yield
    outer(end, "")


def each(items: Collection[Item]) -> Iterator[Item]:
    """The items of a loop: when its body ends, the step is so much further."""
    for number, item in enumerate(items):
        with part(number / len(items), (number + 1) / len(items)):
            yield item
