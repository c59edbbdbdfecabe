"""How a benchmark says what it is doing: a context around each step."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

Progress = Callable[[str], AbstractContextManager[object]]


@contextmanager
def told(text: str) -> Iterator[None]:
    """A line on stderr as the step begins."""
    print(text, file=sys.stderr, flush=True)
    yield
