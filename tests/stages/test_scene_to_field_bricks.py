"""A fitted field in pictures: directly, and as everything that it is written as."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import (
    BrickField,
    RadianceField,
    build_field,
    build_n3tree,
    build_octree_from_bricks,
    build_vdb_from_bricks,
    load,
    orbit_cameras,
    render_field,
    save,
)
from tests.support.brick_fields import (
    brick_fields,
    lattice_points,
    sampled,
    some_brick_field,
    some_shelled_field,
)


@given(brick_fields())
def test_every_cell_keeps_its_values(field: BrickField) -> None:
    assert_array_equal(build_field(field).sample(lattice_points(field)), sampled(field))


def pictures(field: RadianceField, like: RadianceField) -> Any:
    """(frames, H, W, 4): colour and alpha."""
    images = [render_field(field, camera) for camera in orbit_cameras(like, frames=3, width=60, height=50).cameras]
    return np.stack([np.concatenate([image.colour, image.alpha[..., None]], axis=2) for image in images])


WAYS: dict[str, Callable[[BrickField], Any]] = {
    "a.npz": build_n3tree,
    "a.svo.npz": build_octree_from_bricks,
    "a.svo.pb": lambda field: build_octree_from_bricks(field, layout="compact"),
    "index.nvdb": lambda field: build_vdb_from_bricks(field, grids=("index",)),
    "index.vdb.npz": lambda field: build_vdb_from_bricks(field, grids=("index",)),
    "sh.vdb.npz": lambda field: build_vdb_from_bricks(field, grids=("density", "sh")),
    "sh.vdb": lambda field: build_vdb_from_bricks(field, grids=("density", "sh")),
}


@pytest.mark.parametrize("name", WAYS)
def test_the_written_file_looks_like_the_field(name: str, tmp_path: Path) -> None:
    """Formats round the place in the world, .npz to float32: 3e-5 of a colour's range is the most that was seen."""
    field = some_brick_field(basis=9, share=0.3, empty=True)
    direct = build_field(field)
    seen = pictures(direct, direct)
    assert seen[..., 3].mean() > 0.2
    save(tmp_path / name, WAYS[name](field))
    assert_allclose(pictures(build_field(load(tmp_path / name)), direct), seen, atol=2e-4)


@pytest.mark.parametrize("way", [lambda field: build_n3tree(field, dtype="float16")])
def test_halves_look_nearly_like_the_field(way: Callable[[BrickField], Any]) -> None:
    field = some_brick_field(basis=9, share=0.3)
    direct = build_field(field)
    assert_allclose(pictures(build_field(way(field)), direct), pictures(direct, direct), atol=5e-3)


def test_wide_cells_stay_whole() -> None:
    field = some_brick_field()
    direct = build_field(field)
    assert direct.values is field.values
    widths = {float(width) for width in direct.cells.width}
    assert {1.0, 2.0} <= widths


@pytest.mark.parametrize("shells", [2, 6])
def test_scenery_looks_like_its_tree_and_keeps_its_values(shells: int) -> None:
    field = some_shelled_field(shells=shells, basis=4)
    direct, of_tree = build_field(field), build_field(build_n3tree(field))
    assert direct.values is field.values  # a copy is a third of the memory with which a fit ends
    assert_array_equal(pictures(direct, of_tree), pictures(of_tree, of_tree))
