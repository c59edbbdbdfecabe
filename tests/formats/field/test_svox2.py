"""svox2's ckpt.npz: what its own program means by it, in both dialects, and what is refused in a line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import LatticeField, load
from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.field import svox2 as reader
from nerfbake.memory import memory_limit
from tests.support.hostile import refused
from tests.support.lattices import CENTRE, RADIUS, SHAPE, svox2, svox2_file
from tests.support.n3trees import archive

Arrays = dict[str, Any]


def read(arrays: Arrays) -> LatticeField:
    return reader.decode(memoryview(archive(arrays)))


@pytest.mark.parametrize("deflated", [False, True])
def test_rows_are_found_by_their_links(deflated: bool) -> None:
    arrays = svox2(empty=0.3, plain=False)
    lattice = reader.decode(memoryview(svox2_file(arrays, deflated=deflated)))
    lattice.require_usable()  # the row of NaN is nobody's
    assert lattice.shape == SHAPE
    assert_array_equal(lattice.links, arrays["links"])
    assert_array_equal(lattice.density, arrays["density_data"][:, 0])
    assert_array_equal(lattice.features, arrays["sh_data"])
    assert lattice.features.dtype == np.float16
    assert_array_equal(lattice.box, np.stack([CENTRE - RADIUS, CENTRE + RADIUS]).astype(np.float64))
    assert (lattice.at_corners, lattice.dialect, lattice.notes) == (False, "svox2", ())


def test_the_oldest_files_have_the_density_first_and_no_box() -> None:
    arrays = svox2(size=4)
    old = {"links": arrays["links"], "data": np.hstack([arrays["density_data"], arrays["sh_data"]]).astype(np.float32)}
    lattice = read(old)
    assert_array_equal(lattice.density, arrays["density_data"][:, 0])
    assert_array_equal(lattice.features, arrays["sh_data"].astype(np.float32))
    assert_array_equal(lattice.box, [[-1.0] * 3, [1.0] * 3])
    assert lattice.dialect == "svox2, old"


def test_one_radius_stands_for_three() -> None:
    assert_array_equal(read(svox2() | {"radius": np.float32(2), "center": np.zeros(3)}).box, [[-2.0] * 3, [2.0] * 3])


def test_a_background_is_left_out_with_a_note() -> None:
    layers = {"background_links": np.zeros((8, 4), np.int32), "background_data": np.zeros((3, 2, 4), np.float32)}
    (note,) = read(svox2() | layers).notes
    assert note.startswith("the background")


@pytest.mark.parametrize("name", ["ckpt.npz", "chair.ckpt.npz", "plenoxels.npz", "fog.bin"])
def test_it_is_told_by_what_it_holds(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(svox2_file())
    assert isinstance(load(tmp_path / name), LatticeField)


def put(key: str, value: Any) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.update({key: value})


def without(key: str) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        del arrays[key]

    return change


def at(key: str, index: Any, value: float) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[key] = arrays[key].copy()
        arrays[key][index] = value

    return change


LIES: dict[str, tuple[Callable[[Arrays], None], str]] = {
    "link past the end": (at("links", (1, 2, 3), 211), "links[1, 2, 3] is 211; allowed: below 211"),
    "links beyond 32 bits": (put("links", np.full(SHAPE, 1 << 40)), "links contain numbers beyond 32 bits"),
    "links are floats": (put("links", np.zeros(SHAPE, np.float32)), "links has dtype float32"),
    "links are flat": (put("links", np.zeros(210, np.int32)), "links has dtype int32, shape (210,)"),
    "no links": (put("links", np.zeros((0, 6, 7), np.int32)), "links has shape (0, 6, 7)"),
    "too many nodes an axis": (put("links", np.zeros((1, 1, 4097), np.int32)), "links has shape (1, 1, 4097)"),
    "odd colours": (put("sh_data", np.zeros((211, 26), np.float16)), "sh_data has 26 columns; allowed: 3, 12, 27"),
    "fewer colours": (put("sh_data", np.zeros((7, 27), np.float16)), "sh_data has 7 rows; allowed: 211"),
    "whole densities": (put("density_data", np.zeros((211, 1), np.int32)), "density_data has dtype int32"),
    "NaN density": (at("density_data", 3, np.nan), "density[3] is nan; allowed: a finite number"),
    "infinite colour": (at("sh_data", (3, 5), np.inf), "colours[3, 5] is inf; allowed: a finite number"),
    "NaN radius": (put("radius", np.full(3, np.nan, np.float32)), "the lattice's box[0, 0] is nan"),
    "radius of 0": (put("radius", np.zeros(3, np.float32)), "the lattice's edges[0] is 0"),
    "radius of two": (put("radius", np.zeros(2, np.float32)), "radius has dtype float32, shape (2,)"),
    "learned texture": (put("basis_type", np.int64(4)), "basis_type is 4, a learned texture; allowed: spherical"),
    "MLP": (put("basis_type", np.int64(255)), "basis_type is 255, an MLP; allowed: spherical harmonics"),
    "unknown basis": (put("basis_type", np.int64(9)), "basis_type is 9, unknown"),
    "missing colours": (without("sh_data"), "npz has no sh_data"),
    "objects": (put("sh_data", np.array([None], object)), "sh_data holds Python objects (pickle)"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_checkpoint_is_refused(lie: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    change, expected = LIES[lie]
    arrays = svox2()
    change(arrays)
    assert expected in refused(tmp_path, svox2_file(arrays), capfd)


def test_a_texture_without_a_type_is_a_texture() -> None:
    arrays = svox2() | {"basis_data": np.zeros((2, 2, 2, 9), np.float32)}
    del arrays["basis_type"]
    with pytest.raises(InvalidFile, match="a learned texture"):
        read(arrays)


def test_two_thousand_million_nodes_take_no_memory() -> None:
    """Zeros inflate a thousandfold: what is declared is asked for before it is believed."""
    data = archive(svox2() | {"links": np.zeros((1024, 256, 256), np.int32)})
    assert len(data) < 1 << 20
    with memory_limit(1 << 26), pytest.raises(MemoryLimit, match="links needs"):
        reader.decode(memoryview(data))
