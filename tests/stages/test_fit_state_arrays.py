"""A fit's state that somebody else has written: refused in one line, or gone on with, and never followed astray."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from nerfbake import fit_field, memory_limit
from nerfbake.errors import InvalidScene, MemoryLimit, NerfbakeError
from nerfbake.scene.schedule import parse_schedule
from nerfbake.stages.views_to_field import FitState
from tests.support.views import sample_views

SCHEDULE = parse_schedule("cells=8,prune=0.03/cells=16,prune=0.02/cells=16,rays=2,split=0.2,prune=0.005")

Arrays = dict[str, Any]
Change = Callable[[Arrays], None]


@cache
def _states() -> list[Arrays]:
    """At every view of a fit."""
    views = sample_views(frames=6, width=24, height=24)
    return [
        {name: array.copy() for name, array in state.arrays().items()}
        for state in fit_field(views, schedule=SCHEDULE, basis="SH4", exposure=True)
    ]


def state(number: int = 14) -> Arrays:
    return {name: array.copy() for name, array in _states()[number].items()}


@pytest.mark.parametrize("number", range(18))
def test_every_state_of_a_fit_is_its_own(number: int) -> None:
    again = FitState.of_arrays(state(number)).arrays()
    for name, array in state(number).items():
        assert again[name].dtype == array.dtype
        np.testing.assert_array_equal(again[name], array)


def put(name: str, index: Any, value: Any) -> Change:
    def change(arrays: Arrays) -> None:
        arrays[name][index] = value

    return change


def replaced(name: str, made: Callable[[Any], Any]) -> Change:
    def change(arrays: Arrays) -> None:
        arrays[name] = made(arrays[name])

    return change


def with_raw(*numbers: float) -> Change:
    """Add raw densities to a state whose densities are constant in each cell."""

    def change(arrays: Arrays) -> None:
        arrays["raw"] = np.array(numbers, np.float32)
        arrays["raw_means"] = np.zeros(len(numbers), np.float32)

    return change


def swapped_places(arrays: Arrays) -> None:
    arrays["places"][:2] = arrays["places"][1::-1]


WRONG: dict[str, tuple[Change, str]] = {
    "nothing": (lambda arrays: arrays.pop("slots"), "the state has no slots; allowed: top, slots, first"),
    "another dtype": (replaced("slots", lambda a: a.astype(np.int32)), "the state's slots has shape .* int32"),
    "another shape": (replaced("top", lambda a: a[:, :-1]), "the state's top has shape"),
    "a number": (replaced("top", lambda a: np.int32(1)), "the state's top has shape"),
    "no bricks": (replaced("slots", lambda a: a[:0]), "the state's first has shape"),
    "values too few": (replaced("values", lambda a: a[:-1]), "the state's values are"),
    "a brick too many": (put("top", (0, 0, 0), 99), "the state's top does not number its bricks"),
    "bricks out of order": (replaced("top", lambda a: np.where(a >= 0, a.max() - a, a)), "the state's top does not"),
    "a leap": (put("top", np.s_[:], -3), "the state's top does not number its bricks"),
    "cells before the first": (put("first", 0, -5), "the state's first does not count its cells"),
    "cells beyond the last": (put("first", -1, 1 << 30), "the state's first does not count its cells"),
    "a brick of too many cells": (put("first", 1, 5000), "the state's first does not count its cells"),
    "a brick without cells": (put("first", 1, 0), "the state's first does not count its cells"),
    "a slot below": (put("slots", (0, 0), -3), "the state's slots point to cells that do not exist"),
    "a slot beyond": (put("slots", (0, 0), 1022), "the state's slots point to cells that do not exist"),
    "a place below": (put("places", 0, -7), "the state's places lie outside of a brick"),
    "a place beyond": (put("places", 0, 2000), "the state's places lie outside of a brick"),
    "places swapped": (swapped_places, "the state's places do not match the slots"),
    "NaN": (put("values", 3, np.nan), r"the state's values\[3\] is nan; allowed: a finite number"),
    "a mean of infinity": (put("means", (0, 0), np.inf), r"the state's means\[0, 0\] is inf"),
    "a weight below 0": (put("seen", (0, 0), -1), "the state's seen are below 0"),
    "a flat box": (replaced("box", lambda a: a[[0, 0]]), "the state's box"),
    "a box of NaN": (put("box", 0, np.nan), "the state's box"),
    "a stage beyond": (put("counters", 0, 9), "the state is at stage 9"),
    "an epoch beyond": (put("counters", 1, 1), "the state is at stage 2, epoch 1"),
    "cells of an old stage": (put("counters", 3, 0), "the state is at stage 2, epoch 0, view 3, built 0"),
    "divided again": (put("counters", 4, 2), "the state is at"),
    "not divided": (put("counters", 4, 0), "the state's lattice has 32 cells an axis; allowed: 16"),
    "gains for a channel": (replaced("gains", lambda a: a[:, :1]), "the state's gains has shape"),
    "a gain of 0": (put("gains", (0, 1), 0), "the state's gains are out of range; allowed: 0.05 to 20"),
    "a seed below 0": (put("counters", 5, -1), "the state's counters are below 0"),
    "a schedule of noise": (replaced("text", lambda a: a[::-1].copy()), "allowed"),
    "another basis": (replaced("text", lambda a: np.frombuffer(b"SH9 " + a.tobytes()[4:], np.uint8)), "values are"),
    "raw densities of wide cells": (with_raw(1.0), "the state's raw are 1; allowed: 0, because some cells are wide"),
    "too few of their means": (replaced("raw_means", lambda a: np.zeros(1, np.float32)), "the state's raw_means has"),
    "a text without end": (replaced("text", lambda a: np.zeros(1 << 20, np.uint8)), "the state's lattice has"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_no_fit_comes_to_is_refused(name: str) -> None:
    change, said = WRONG[name]
    arrays = state()
    change(arrays)
    with pytest.raises(NerfbakeError, match=said):
        FitState.of_arrays(arrays)


WRONG_CORNERS: dict[str, tuple[Change, str]] = {
    "too few": (with_raw(1.0, 2.0), "the state's raw are 2; allowed: [0-9,]+, one for each corner"),
    "NaN": (put("raw", 3, np.nan), r"the state's raw\[3\] is nan"),
    "a mean of infinity": (put("raw_means", 3, np.inf), r"the state's raw_means\[3\] is inf"),
    "a mean below 0": (put("raw_means", 3, -1), "the state's raw_means are below 0"),
    "an opaque one": (put("raw", 3, 1e9), r"the state's raw are -[0-9.]+ to 1e\+09; allowed: -4 to 12"),
    "in the last stage": (
        put("counters", slice(0, 4), (1, 0, 3, 1)),
        "the state's raw exist in stage 1; allowed: none",
    ),
}


@pytest.mark.parametrize("name", WRONG_CORNERS)
def test_corners_that_no_fit_has_are_refused(name: str) -> None:
    change, said = WRONG_CORNERS[name]
    arrays = state(3)
    change(arrays)
    with pytest.raises(NerfbakeError, match=said):
        FitState.of_arrays(arrays)


def test_a_view_that_there_is_not_is_refused() -> None:
    arrays = state()
    arrays["counters"][2] = 6
    found = fit_field(sample_views(frames=6, width=24, height=24), schedule=SCHEDULE, start=FitState.of_arrays(arrays))
    with pytest.raises(InvalidScene, match="the state's view is 6; allowed: below 6"):
        next(found)


def test_nothing_is_made_for_cells_that_are_only_counted() -> None:
    arrays = state()
    arrays["first"][1] = 1 << 27  # and back again: as many as there are, to whoever looks at the last alone
    tracemalloc.start()
    with pytest.raises(InvalidScene, match="the state's first does not count its cells"):
        FitState.of_arrays(arrays)
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()


def test_a_state_counts_as_memory() -> None:
    with memory_limit(10_000), pytest.raises(MemoryLimit, match="the state needs"):
        FitState.of_arrays(state())


@pytest.mark.slow
def test_hundreds_of_damaged_states_are_refused_or_gone_on_with() -> None:
    """Whatever is let through must be safe for compiled code, which would read beyond an array without a word."""
    random, views, gone_on = np.random.default_rng(0), sample_views(frames=6, width=24, height=24), 0
    for _ in range(400):
        arrays = state(int(random.integers(18)))
        name = str(random.choice([name for name, array in arrays.items() if name != "text" and array.size]))
        flat = arrays[name].reshape(-1)
        for at in random.integers(len(flat), size=random.integers(1, 4)):
            near = flat[at] + random.integers(-2, 3)
            flat[at] = random.choice([near, -flat[at], 0, 1, 2, 511, 1e4 if flat.dtype.kind == "f" else 1000])
        try:
            begun = FitState.of_arrays(arrays)
            next(fit_field(views, schedule=SCHEDULE, basis="SH4", start=begun), None)
        except NerfbakeError:
            continue
        gone_on += 1
    assert gone_on > 20
