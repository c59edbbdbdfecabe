"""Progress reports: loops report the finished part of a step, and a listener shows it.

    with listening(show):
        for camera in each(cameras):  # show(0.25, ""), show(0.5, ""), ...
            render(camera)

The listener is a context variable, so that pure functions need no argument for it. A loop inside another loop's body
reports its part of that body. Threads that help with a loop of kernels.parallel report nothing.
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
    """Report the finished share of the step, 0 to 1, and the current activity to the listener, if there is one."""
    if (listener := _listener.get()) is not None:
        listener(min(max(share, 0.0), 1.0), detail)


@contextmanager
def listening(listener: Listener | None) -> Iterator[None]:
    """Use this listener, and no other, inside the block; None: no listener."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def end_reports() -> None:
    """Report nothing from here on in this context: the cheap listening(None) of a context of its own."""
    _listener.set(None)


@contextmanager
def part(begin: float, end: float) -> Iterator[None]:
    """Map the shares reported inside the block, 0 to 1, to the range from `begin` to `end` of the step."""
    outer = _listener.get()
    if outer is None:
        yield
        return
    with listening(lambda share, detail: outer(begin + (end - begin) * share, detail)):
        yield
    outer(end, "")


def each(items: Collection[Item]) -> Iterator[Item]:
    """Yield the items of a loop and report the progress after each one."""
    for number, item in enumerate(items):
        with part(number / len(items), (number + 1) / len(items)):
            yield item
