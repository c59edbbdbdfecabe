"""Choose the sharp frames of a video."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Item = TypeVar("Item")


def measure_sharpness(grey: npt.NDArray[np.uint8]) -> float:
    """Return the mean square of the Laplacian of a grey picture (H, W), 3 pixels or more per side.

    It compares pictures of the same scene: blur by motion or by focus lowers it. Source: Pertuz et al., "Analysis of
    focus measure operators for shape-from-focus" (2013), LAP1 squared.
    """
    grey = grey.astype(np.int32)
    middle = 4 * grey[1:-1, 1:-1]
    laplacian = middle - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
    return float(np.mean(np.square(laplacian, dtype=np.float64)))


def choose_sharpest(frames: Iterable[tuple[float, Item]], *, total: int, count: int) -> Iterator[Item]:
    """Yield the sharpest frame of each of `count` stretches of a video, all nearly equally long.

    frames: the sharpness of each frame with the frame, in order. total: their number, `count` or more; frames beyond
    it belong to the last stretch. Only the best frame of a stretch is kept in memory. Of equally sharp frames, the
    first one is taken.
    """
    best: tuple[float, Any] | None = None
    stretch = 0
    for number, (sharpness, frame) in enumerate(frames):
        here = min(number * count // total, count - 1)
        if best is not None and here != stretch:
            yield best[1]
            best = None
        stretch = here
        if best is None or sharpness > best[0]:
            best = sharpness, frame
    if best is not None:
        yield best[1]
