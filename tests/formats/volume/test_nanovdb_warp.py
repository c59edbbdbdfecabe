"""Warp reads what we write, voxel by voxel and row by row."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import build_octree, build_vdb, load
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.volume import Volume
from tests.support.nanovdb import GRIDS, Codec, encoded
from tests.support.scenes import n3tree
from tests.support.vdb_readers import SCENES, by_coords, transform, volume
from tests.support.warp_kernels import LOOKUPS


def looked_up(made: Volume, kind: str, coords: npt.NDArray[np.int32], codec: Codec) -> tuple[Any, npt.NDArray[Any]]:
    held = wp.Volume.load_from_nvdb(io.BytesIO(encoded(made, codec=codec)), device="cpu")
    dtype = {"Float": wp.float32, "Vec3f": wp.vec3, "OnIndex": wp.int32}[kind]
    out = wp.zeros(len(coords), dtype=dtype, device="cpu")
    places: Any = wp.array(coords, dtype=wp.vec3i, device="cpu")
    wp.launch(LOOKUPS[kind], len(coords), [held.id, places, out], device="cpu")
    return held, out.numpy()  # type: ignore[no-untyped-call]


def around(grid: VdbTree | IndexGrid) -> npt.NDArray[np.int32]:
    """The active voxels, and their neighbours, most of them inactive."""
    coords = grid.topology.coords
    return np.concatenate([np.add(coords, step) for step in ([0, 0, 0], [1, 1, 1], [0, 0, -1], [8, 0, 0])])


@pytest.mark.slow
@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("kind", ["Float", "Vec3f"])
@pytest.mark.parametrize("scene", [scene for scene in SCENES if scene != "nothing"])
def test_warp_reads_every_voxel(scene: str, kind: str, codec: Codec) -> None:
    grid = GRIDS[kind](SCENES[scene])
    places = around(grid)
    held, values = looked_up(volume(grid), kind, places, codec)
    known = by_coords(grid.topology.coords, grid.values)
    background = tuple(grid.background.tolist())
    expected = [known.get(tuple(place), background) for place in places.tolist()]
    assert_array_equal(values.reshape(len(places), -1), np.array(expected))
    assert held.get_grid_info().name == grid.name
    assert_allclose(np.array(held.get_grid_info().transform_matrix).reshape(3, 3), transform()[:, :3])
    assert_allclose(held.get_grid_info().translation, transform()[:, 3])


@pytest.mark.slow
@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("kind", ["OnIndex", "OnIndex, half"])
@pytest.mark.parametrize("scene", [scene for scene in SCENES if scene != "nothing"])
def test_warp_reads_every_row_of_the_table(scene: str, kind: str, codec: Codec) -> None:
    grid = GRIDS[kind](SCENES[scene])
    places = around(grid)
    held, rows = looked_up(volume(grid), "OnIndex", places, codec)
    number = {tuple(place): i for i, place in enumerate(grid.topology.coords.tolist())}
    # Warp numbers voxels from 0; the table's row 0 is the background.
    assert_array_equal(rows, [number.get(tuple(place), -1) for place in places.tolist()])
    assert_array_equal(held.get_voxels().numpy(), grid.topology.coords)
    info = held.get_feature_array_info(0)
    assert (info.name, info.value_size, info.value_count) == ("M_vdb", grid.table.itemsize, grid.table.size)
    assert held.feature_array(0).numpy().tobytes() == grid.table.tobytes()


@pytest.mark.slow
def test_warp_reads_the_table_before_an_octrees_frame() -> None:
    made = build_vdb(build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH9")), grids=("index",))
    held, _ = looked_up(made, "OnIndex", made.grids[0].topology.coords, "none")
    assert held.feature_array(0).numpy().tobytes() == made.grids[0].table.tobytes()  # type: ignore[union-attr]


@pytest.mark.parametrize("codec", ["none", "zip", "blosc"])
def test_what_warp_saves_is_read(codec: Any, tmp_path: Path) -> None:
    """Its grids have NanoVDB's newer magic number, and the sizes of compressed ones leave out 8 bytes."""
    tiles: Any = wp.array(np.array([[0, 0, 0], [-20, 4, 300]], np.int32), dtype=wp.int32, device="cpu")
    for background, expected in ((1.5, [1.5]), (wp.vec3(1.0, 2.0, 3.0), [1, 2, 3])):
        made = wp.Volume.allocate_by_tiles(tiles, 0.25, bg_value=background, translation=(1, 2, 3), device="cpu")
        made.save_to_nvdb(str(tmp_path / "a.nvdb"), codec)
        (grid,) = load(tmp_path / "a.nvdb", Volume).grids
        assert grid.topology.leaf_origin.tolist() == [[0, 0, 0], [-24, 0, 296]]
        assert (grid.values == expected).all()
        assert_allclose(
            load(tmp_path / "a.nvdb", Volume).transform, [[0.25, 0, 0, 1], [0, 0.25, 0, 2], [0, 0, 0.25, 3]]
        )
