"""Messages and progress of a job: the protocol for a listener, such as a terminal or a log, and a silent one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

Tell = Callable[[str], None]


class Steps(Protocol):
    """The `steps` argument of every job. console.Console is one implementation, SILENT another."""

    def say(self, text: str) -> None:
        """Print a line about something that was found or written."""

    def phase(self, text: str) -> AbstractContextManager[Tell]:
        """Run a block as a step of the work, which calls the yielded function with details.

        The block reports the share that is done with nerfbake.progress.report().
        """


class _Silent:
    """Discards all messages."""

    def say(self, text: str) -> None:
        pass

    @contextmanager
    def phase(self, text: str) -> Iterator[Tell]:
        yield lambda text: None


SILENT: Steps = _Silent()
