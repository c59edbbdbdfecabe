from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_array_equal

from nerfbake.formats.field import n3tree as n3tree_npz
from nerfbake.scene.n3tree import N3Tree
from tests.support.n3trees import archive, held_out, svox
from tests.support.scenes import n3tree, n3trees


def read(data: bytes, **options: Any) -> N3Tree:
    return n3tree_npz.decode(memoryview(data), **options)


def assert_same_tree(a: N3Tree, b: N3Tree) -> None:
    assert a.data_format == b.data_format
    assert_array_equal(a.child, b.child)
    assert a.data.dtype == b.data.dtype
    assert a.data.tobytes() == b.data.tobytes()
    assert_array_equal(a.offset.astype(np.float32), b.offset.astype(np.float32))
    assert_array_equal(a.invradius.astype(np.float32), b.invradius.astype(np.float32))


@given(n3trees())
def test_what_is_written_is_read_and_numpy_reads_it_too(tree: N3Tree) -> None:
    data = b"".join(n3tree_npz.encode(tree))
    assert_same_tree(read(data), tree)
    with np.load(io.BytesIO(data)) as npz:
        assert set(svox(tree)) <= set(npz.files)
        assert_array_equal(npz["child"], tree.child)
        # svox's own integrity rule: every live node's parent_depth names the cell that points to it.
        for rows, cells in zip(tree.levels[1:], tree.parent_cells[1:], strict=True):
            assert_array_equal(npz["parent_depth"][rows, 0], cells)
            assert_array_equal(tree.child.ravel()[cells], rows - cells // tree.N**3)


@given(n3trees())
def test_stored_and_deflated_archives_read_the_same(tree: N3Tree) -> None:
    arrays = svox(tree) | ({} if tree.extra_data is None else {"extra_data": tree.extra_data})
    for deflated in (True, False):
        back = read(archive(arrays, deflated=deflated))
        assert_same_tree(back, tree)
        assert (back.extra_data is None) == (tree.extra_data is None)
        assert back.dialect == "svox"


def test_legacy_archives() -> None:
    tree = n3tree(data_format="SH4")
    arrays = svox(tree)
    del arrays["invradius3"], arrays["data_format"]
    back = read(archive(arrays | {"invradius": np.float64(0.4)}))
    assert (back.dialect, back.data_format) == ("legacy", "SH4")
    assert_array_equal(back.invradius, np.full(3, np.float32(0.4), np.float64))


def test_four_values_without_a_format_are_rgba() -> None:
    arrays = svox(n3tree(data_format="RGBA"))
    del arrays["data_format"]
    assert read(archive(arrays)).data_format == "RGBA"


@pytest.mark.parametrize("retained", [0, 1, 3])
def test_quantised_archives(retained: int) -> None:
    random = np.random.default_rng(retained)
    tree = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4")
    b, codes = 4 - retained, 16
    colors = random.normal(0, 1, (b, codes, 3)).astype(np.float16)
    quant_map = random.integers(0, codes, (b, *tree.child.shape)).astype(np.uint16)
    arrays = {key: value for key, value in svox(tree).items() if key in ("data_dim", "child", "invradius3", "offset")}
    arrays |= {"data_format": np.array("SH4"), "quant_colors": colors, "quant_map": quant_map}
    arrays["sigma"] = tree.data[..., -1]
    kept = random.normal(0, 1, (retained, *tree.child.shape, 3)).astype(np.float16)
    if retained:
        arrays["data_retained"] = kept
    back = read(archive(arrays))
    assert back.dialect == ("quantised+retained" if retained else "quantised")
    assert back.data.dtype == np.float16
    cell = (1, 0, 1, 0)
    for i in range(4):
        rgb = kept[(i, *cell)] if i < retained else colors[i - retained, quant_map[(i - retained, *cell)]]
        assert_array_equal(back.data[cell][[i, 4 + i, 8 + i]], rgb)
    assert back.data[cell][12] == tree.data[(*cell, -1)]


def test_big_endian_and_fortran_order_are_read() -> None:
    tree = n3tree(splits=[(0, (1, 0, 1))])
    arrays = svox(tree)
    arrays["data"] = np.asfortranarray(tree.data.astype(">f2"))
    arrays["child"] = tree.child.astype(">i4")
    assert_same_tree(read(archive(arrays)), tree)


def test_a_companion_marks_a_forward_facing_scene() -> None:
    assert read(archive(svox(n3tree())), companion=True).ndc


def test_pixels_of_photographs_come_back_and_svox_finds_its_own_keys() -> None:
    tree = n3tree(held_out=held_out())
    data = b"".join(n3tree_npz.encode(tree))
    back = read(data).held_out
    assert back is not None
    assert tree.held_out is not None
    assert (back.every, back.background, back.cameras.samples) == (2, (0.25, 0.5, 1.0), 2)
    for a, b in zip(back.looks(), tree.held_out.looks(), strict=True):
        for one, other in zip(a, b, strict=True):
            assert_array_equal(one.rays()[1], other.rays()[1])
    for found, meant in zip(back.pixels, tree.held_out.pixels, strict=True):
        assert_array_equal(found, meant)
    with np.load(io.BytesIO(data)) as npz:
        assert {name for name in npz.files if not name.startswith("held_out_")} == set(svox(tree))
    assert read(archive(svox(tree))).held_out is None
