"""What tests of benchmarks share."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext


def quiet(_: str) -> AbstractContextManager[None]:
    """Progress that nobody sees."""
    return nullcontext()
