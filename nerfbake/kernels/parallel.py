"""Work in chunks on every core: NumPy lets go of the interpreter while it copies and adds."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable
from threading import Thread
from typing import TypeVar

Item = TypeVar("Item")


def over_chunks(work: Callable[[int, int], None], count: int, chunk: int) -> None:
    """work(begin, end) for every chunk of 0 .. count, shared out among the cores.

    Each chunk must write to places of its own; then what comes out does not depend on the number of cores. The
    first error ends the other threads' work and is raised here.
    """
    starts = range(0, count, chunk)
    threads = min(len(starts), os.cpu_count() or 1)
    errors: list[BaseException] = []

    def run(own: range) -> None:
        try:
            for start in own:
                if not errors:
                    work(start, min(start + chunk, count))
        except BaseException as error:
            errors.append(error)

    others = [Thread(target=run, args=(starts[k::threads],)) for k in range(1, threads)]
    for thread in others:
        thread.start()
    run(starts[::threads] if threads else starts)
    for thread in others:
        thread.join()
    if errors:
        raise errors[0]


def ahead(items: Iterable[Item]) -> Generator[Item]:
    """The same items, each made while the one before it is used."""
    source, made = iter(items), list[Item]()
    errors: list[BaseException] = []

    def make() -> None:
        try:
            made.append(next(source))
        except BaseException as error:
            errors.append(error)

    make()
    while made:
        item = made.pop()
        maker = Thread(target=make)
        maker.start()
        try:
            yield item
        finally:
            maker.join()
    if not isinstance(errors[0], StopIteration):
        raise errors[0]
