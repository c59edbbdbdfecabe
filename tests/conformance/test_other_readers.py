"""OpenVDB, NanoVDB and Warp find in the frozen volumes what the JSON says: it is not our reader's opinion."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.conformance.case import HOME
from tests.conformance.cases import CASES
from tests.support.foreign_volumes import Seen, places, seen
from tests.support.vdb_readers import tool

CONVERTED = ("fog", "colour", "level_set", "tiles")  # nanovdb_convert knows no Fp16 and no indices
INDICES = ("index", "index_half")
VDBS, NVDBS = ([name for case in CASES for name in case.files if name.endswith(end)] for end in (".vdb", ".nvdb"))
VALIDATED = [name for name in NVDBS if "index" not in name]  # the validator of NanoVDB 32.4 knows no indices


def grids_of(name: str) -> list[dict[str, Any]]:
    """What the JSON of a volume says of its grids."""
    grids: list[dict[str, Any]] = json.loads((HOME / f"volume/{name}.expected.json").read_text())["grids"]
    return grids


def require_same(grid: dict[str, Any], theirs: Seen) -> None:
    """The same active voxels and tiles, and the same value at every other place, active or not."""
    own: dict[tuple[int, ...], tuple[list[float], bool]] = {}
    for voxel, value, active in zip(grid["voxels"], grid["values"], grid["active"], strict=True):
        own[(*voxel, *voxel)] = value, active
    for tile in grid["tiles"]:
        high = [low + tile["edge"] - 1 for low in tile["low"]]
        own[(*tile["low"], *high)] = tile["value"], tile["active"]
    boxes = zip(theirs.low.tolist(), theirs.high.tolist(), theirs.values.tolist(), strict=True)
    found = {(*low, *high): value for low, high, value in boxes}
    assert found == {box: value for box, (value, active) in own.items() if active}
    for place, value, on in zip(places().tolist(), theirs.at.tolist(), theirs.on.tolist(), strict=True):
        box = next((box for box in own if _holds(box, place)), None)
        assert (value, on) == (own[box] if box else (grid["background"], False)), place
    assert (theirs.name, theirs.grid_class) == (grid["name"], grid["class"])
    np.testing.assert_allclose(theirs.transform, grid["transform"], rtol=1e-12)


def _holds(box: tuple[int, ...], place: list[int]) -> bool:
    return all(low <= p <= high for low, p, high in zip(box[:3], place, box[3:], strict=True))


@pytest.mark.tools
@pytest.mark.parametrize("name", VDBS)
def test_openvdb_finds_what_the_json_says(name: str, tmp_path: Path) -> None:
    shutil.copy(HOME / name, tmp_path / "a.vdb")
    stem = Path(name).stem.removesuffix("_zip")
    for grid, theirs in zip(grids_of(stem), seen(tmp_path / "a.vdb"), strict=True):
        require_same(grid, theirs)


@pytest.mark.tools
@pytest.mark.parametrize("name", CONVERTED)
def test_nanovdb_finds_what_the_json_says(name: str, tmp_path: Path) -> None:
    """Its own tool makes a .vdb of it, which OpenVDB reads."""
    file = HOME / f"volume/{name}_zip.nvdb"
    tool("nanovdb_convert", file, tmp_path / "a.vdb")
    (grid,), (theirs,) = grids_of(name), seen(tmp_path / "a.vdb")
    require_same(grid, theirs)


@pytest.mark.tools
@pytest.mark.parametrize("name", VALIDATED)
def test_nanovdb_finds_nothing_wrong(name: str) -> None:
    assert tool("nanovdb_validate", HOME / name) == ""


def array_of(array: Any) -> Any:
    """Warp's array as NumPy's."""
    return array.numpy()


@pytest.mark.parametrize("name", INDICES)
def test_warp_finds_what_the_json_says(name: str) -> None:
    """The voxels in the order of their numbers, and the table that goes with them."""
    data = (HOME / f"volume/{name}_zip.nvdb").read_bytes()
    held = wp.Volume.load_from_nvdb(io.BytesIO(data), device="cpu")
    (grid,) = grids_of(name)
    assert grid["index"] == list(range(1, 1 + len(grid["voxels"])))
    assert array_of(held.get_voxels()).tolist() == grid["voxels"]
    table = array_of(held.feature_array(0)).view(np.float16 if name.endswith("half") else np.float32)
    assert table.reshape(-1, len(grid["background"])).tolist() == [grid["background"], *grid["values"]]
    info = held.get_grid_info()
    np.testing.assert_allclose(np.array(info.transform_matrix).reshape(3, 3), np.array(grid["transform"])[:, :3])
    np.testing.assert_allclose(info.translation, np.array(grid["transform"])[:, 3])
