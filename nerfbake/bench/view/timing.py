"""Frame times of pages that are open beside each other in one browser.

In each round every page draws a picture from each camera, and the next round begins with the next page; a first round
does not count. What is told is the processor's time of the browser's graphics: without a graphics card that is all of
a frame's work, and other programs do not add to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from nerfbake.bench.measure import Statistics, seconds_of
from nerfbake.bench.progress import Progress
from nerfbake.bench.view.browser import Chromium

NOTE = (
    "ms a frame: the processor's time of the browser's graphics on all cores, median [min..max] over rounds, each the "
    "mean of all cameras' pictures. Where a graphics card draws, it says little, and wall time counts."
)


class Times(NamedTuple):
    """Of each round the graphics' processor time and the wall time of a frame, in ms."""

    spent: list[float]
    wall: list[float]

    def ratio(self, other: Times) -> Statistics | None:
        """By another page's time in the same round; None where graphics take no time of the processor."""
        ratios = [own / by for own, by in zip(self.spent, other.spent, strict=True) if by > 0]
        return Statistics.of(ratios) if ratios else None


def frame_times(
    browser: Chromium, draws: Mapping[str, Callable[[], None]], *, frames: int, rounds: int, progress: Progress
) -> dict[str, Times]:
    """Times of each page by its name; draws: what draws so many frames of it."""
    found = {name: Times([], []) for name in draws}
    order = list(draws)
    for turn in range(rounds + 1):
        with progress(f"round {turn} of {rounds}" if turn else "a round that does not count"):
            for name in order:
                before = browser.graphics_seconds()
                _, wall = seconds_of(draws[name])
                spent = browser.graphics_seconds() - before
                if turn:
                    found[name].spent.append(1e3 * spent / frames)
                    found[name].wall.append(1e3 * wall / frames)
        order = order[1:] + order[:1]
    return found
