"""Somebody who writes down what a job says."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from nerfbake import progress


class Listener:
    """phases, in order of their start; said, line by line; told and shares, how far they were."""

    def __init__(self) -> None:
        self.phases: list[str] = []
        self.said: list[str] = []
        self.told: list[str] = []
        self.shares: list[tuple[float, str]] = []

    def say(self, text: str) -> None:
        self.said.append(text)

    @contextmanager
    def phase(self, text: str) -> Iterator[Callable[[str], None]]:
        self.phases.append(text)
        with progress.listening(lambda share, detail: self.shares.append((share, detail))):
            yield self.told.append
