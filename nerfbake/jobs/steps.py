"""What a job says while it works, to whoever listens: a terminal, a log, nobody."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

Tell = Callable[[str], None]
TellShare = Callable[[float, str], None]  # how much of the work is done, 0 to 1, and where it is


class Steps(Protocol):
    """What every job takes as `steps`. The command line's words are one; SILENT is another."""

    def say(self, text: str) -> None:
        """A line about something that was found or written."""

    def phase(self, text: str) -> AbstractContextManager[Tell]:
        """A step of the work that may take a while: it lasts as long as the block, which may tell how far it is."""

    def progress(self, text: str) -> AbstractContextManager[TellShare]:
        """A long step of which it is known how much is done: it lasts as long as the block, which tells it."""


class _Silent:
    """Nobody listens."""

    def say(self, text: str) -> None:
        pass

    @contextmanager
    def phase(self, text: str) -> Iterator[Tell]:
        yield lambda text: None

    @contextmanager
    def progress(self, text: str) -> Iterator[TellShare]:
        yield lambda share, text: None


SILENT: Steps = _Silent()
