"""The arrays of a fit's state, as somebody sent them: looked through before any compiled code follows their numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.fit.bricks import EMPTY, SIZE
from nerfbake.kernels.fit.topgrid import top_grid
from nerfbake.scene.base import edge_problems, number_problems, place_problems

BRICKS = ("top", "slots", "first", "places", "values")
COUNTERS = ("stage", "epoch", "view", "built", "divided", "seed")
_MOST_TEXT = 1 << 16  # bytes of a basis and a schedule

Arrays = dict[str, npt.NDArray[Any]]


def own_arrays(arrays: Mapping[str, npt.NDArray[Any]], *, resolutions: tuple[int, int]) -> Arrays:
    """Copies of a state's arrays, which are what they must be for a lattice of so many cells at least and at most.

    Raises InvalidScene for all others, MemoryLimit.
    """
    b, n = (len(arrays[name]) if name in arrays and arrays[name].ndim else 0 for name in ("slots", "places"))
    r = len(arrays["top"]) if "top" in arrays and arrays["top"].ndim else 0
    shapes: dict[str, tuple[type[np.generic], tuple[int | None, ...]]] = {
        "top": (np.int32, (r, r, r)),
        "slots": (np.int16, (b, SIZE)),
        "first": (np.int32, (b + 1,)),
        "places": (np.int16, (n,)),
        "values": (np.float32, (None,)),
        "means": (np.float32, (n, 2)),
        "seen": (np.float32, (n, 2)),
        "box": (np.float64, (2, 3)),
        "counters": (np.int64, (len(COUNTERS),)),
        "sums": (np.float64, (2,)),
        "text": (np.uint8, (None,)),
    }
    if missing := sorted(shapes.keys() - arrays.keys()):
        raise InvalidScene(Problem("the state", f"has no {missing[0]}", ", ".join(shapes)))
    for name, (dtype, shape) in shapes.items():
        array = arrays[name]
        fits = array.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
        if array.dtype != dtype or not fits:
            found = f"has shape {array.shape}, dtype {array.dtype}"
            words = ", ".join("any" if edge is None else str(edge) for edge in shape)
            raise InvalidScene(Problem(f"the state's {name}", found, f"({words}) {np.dtype(dtype)}"))
    if not (resolutions[0] <= 8 * r <= resolutions[1] and not r & (r - 1) and n and arrays["text"].size <= _MOST_TEXT):
        allowed = f"a power of two of bricks, {resolutions[0] // 8} to {resolutions[1] // 8}, and cells in them"
        raise InvalidScene(Problem("the state's lattice", f"has {r} bricks an axis, {n:,} cells", allowed))
    memory.require("the state", memory.size_of({name: arrays[name] for name in shapes}))
    own = {name: np.array(arrays[name]) for name in shapes}
    _require_bricks(own)
    _require_numbers(own)
    return own


def _require_bricks(own: Arrays) -> None:
    """Raises InvalidScene for bricks and cells that do not lead to each other."""
    top, slots, first, places = (own[name] for name in ("top", "slots", "first", "places"))
    counts = first[1:].astype(np.int64) - first[:-1]
    counted = first[0] == 0 and first[-1] == len(places) and bool(((counts >= 1) & (counts <= SIZE)).all())
    problem = None
    if int(np.count_nonzero(top >= 0)) != len(slots) or (top != top_grid(top >= 0)).any():
        problem = Problem(
            "the state's top", "does not number its bricks", "raster order, and the distance to the nearest"
        )
    elif not counted:
        problem = Problem("the state's first", "does not count its cells", f"from 0, up by 1 to {SIZE} a brick")
    elif (slots < EMPTY).any() or (slots >> 1 >= counts[:, None]).any():
        problem = Problem("the state's slots", "name cells that there are not", "-2, -1, or a cell of the brick")
    elif (places < 0).any() or (places >> 1 >= SIZE).any():
        problem = Problem("the state's places", "lie outside of a brick", f"0 to {SIZE - 1}, twice, and wide or not")
    else:
        held = np.repeat(np.arange(len(slots)), counts)
        own_slot = (np.arange(len(places)) - first[held]) << 1 | places & 1
        if (slots[held, places >> 1] != own_slot).any():
            problem = Problem("the state's places", "are not where the slots have them", "each cell at its own place")
    if problem is not None:
        raise InvalidScene(problem)


def _require_numbers(own: Arrays) -> None:
    """Raises InvalidScene for numbers that no fit arrives at."""
    problems = place_problems("the state's box", own["box"])
    problems = problems or edge_problems("the state's box", own["box"][1] - own["box"][0])
    for name in ("values", "means", "seen", "sums"):
        problems = problems or number_problems(f"the state's {name}", own[name])
    for name in ("means", "seen", "sums", "counters"):
        if not problems and (own[name] < 0).any():
            problems = [Problem(f"the state's {name}", "are below 0", "0 or more")]
    if problems:
        raise InvalidScene(problems[0])
