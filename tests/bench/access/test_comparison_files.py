from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import build_octree, build_vdb
from nerfbake.bench.access.comparison import file_rows
from tests.support.scenes import n3tree


def test_a_density_that_float16_cannot_hold_costs_its_rows_only(tmp_path: Path) -> None:
    tree = build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    tree.node_data[-1, -1] = 1e6
    density, index = (build_vdb(tree, grids=(grid,)) for grid in ("density", "index"))
    rows = file_rows(tmp_path, 4, tree, density, index)
    refused = [what for what, _, size in rows if size is None]
    assert refused == [
        f"{what} half: grid {what!r} holds 1e+06; allowed: up to 65504 for --half" for what in ("density", "index")
    ]
    assert [what for what, _, size in rows if size] == [
        "octree .svo.npz", "octree .svo.pb", "density .nvdb", "density .nvdb zip", "density .vdb", "density .vdb zip",
        "index .nvdb", "index .nvdb zip",
    ]  # fmt: skip


def test_a_format_that_is_too_small_costs_its_row_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.formats.octree.protobuf.MAX_2GIB", 100)
    tree = build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    density, index = (build_vdb(tree, grids=(grid,)) for grid in ("density", "index"))
    (refused,) = (what for what, _, size in file_rows(tmp_path, 4, tree, density, index) if size is None)
    assert refused.startswith("octree .svo.pb: svo.pb would take ")
    assert refused.endswith("allowed: 100, protobuf's limit")
