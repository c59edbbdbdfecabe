"""What a job says while it works, to whoever listens: a terminal, a log, nobody."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

Tell = Callable[[str], None]


class Steps(Protocol):
    """What every job takes as `steps`. The command line's words are one; SILENT is another."""

    def say(self, text: str) -> None:
        """A line about something that was found or written."""

    def phase(self, text: str) -> AbstractContextManager[Tell]:
        """A step of the work: it lasts as long as the block, which may tell where it is. nerfbake.progress.report()
        says how much of it is done."""


class _Silent:
    """Nobody listens."""

    def say(self, text: str) -> None:
        pass

    @contextmanager
    def phase(self, text: str) -> Iterator[Tell]:
        yield lambda text: None


SILENT: Steps = _Silent()
