from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import wires
from benchmarks.suite import RESULTS
from nerfbake import build_octree
from nerfbake.bench.measure import Result
from tests.conftest import REPOSITORY
from tests.support.scenes import n3tree


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wires")
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1)), (1, (0, 1, 1))], data_format="SH4"))
    wires.put_scenes(folder, octree, edge=3)
    return folder


@pytest.mark.parametrize(
    ("wire", "ours"),
    [
        pytest.param(
            wire, ours, marks=[pytest.mark.tools] if wires.WIRES[wire].library == "pyopenvdb" and not ours else []
        )
        for wire in wires.WIRES
        for ours in (True, False)
    ],
)
def test_both_sides_write_and_read_every_number(wire: str, ours: bool, folder: Path) -> None:
    writing = wires.writing(wire, ours, str(folder))
    writing.check(writing.run())
    reading = wires.reading(wire, ours, str(folder))
    assert reading.check(reading.run())["exact"] is True


def test_a_wrong_number_would_be_seen() -> None:
    right = [np.arange(6).reshape(2, 3)]
    assert wires._same([np.arange(6.0)], right)
    assert not wires._same([np.array([0, 1, 2, 3, 4, 6])], right)
    assert not wires._same([np.arange(5)], right)


def test_only_what_is_near_in_time_and_in_memory_could_take_a_place() -> None:
    ours = Result(1.0, 10_000_000)
    for theirs, near in (
        (Result(1.1, 11_000_000), True),
        (Result(1.3, 10_000_000), False),
        (Result(0.1, 20_000_000), False),
    ):
        cells = dict(zip(wires.COLUMNS, wires.row("npz", "read", [(ours, theirs)]), strict=True))
        assert cells["within 1.2 of both"] is near
    missing = wires.row("npz", "read", [(ours, Result(error="not installed: numpy"))])
    assert missing == ["npz: not installed: numpy", "read", "np.savez, np.load", *[None] * 7]


def test_the_page_has_the_figures_of_the_last_run() -> None:
    page = (REPOSITORY / "docs" / "wires.md").read_text()
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| ")]
    told = {row[0]: dict(zip(("write", "read"), row[2:4], strict=True)) for row in rows[1:]}
    lines = [line for line in (RESULTS / "wires.md").read_text().splitlines() if line.startswith("| ")]
    columns, _, *measured = [line.strip("| ").split(" | ") for line in lines]
    assert tuple(columns) == tuple(wires.COLUMNS)
    for cells in measured:
        row = dict(zip(columns, cells, strict=True))
        if row["wire"] in told:
            figures = [row[name] for name in ("library x ours", "library peak MB", "ours peak MB")]
            assert told[row["wire"]].pop(row["direction"]) == "{} times, {} beside {}".format(*figures)
    assert not any(told.values())
