"""Laws that hold in every octree format and profile."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerfbake import build_octree, load, save
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.octrees import FORMATS, every_spelling, read, small_octree, written
from tests.support.scenes import assert_same_octree, octrees

# Values at which number formats go wrong.
EDGES = [0.0, -0.0, 1e-45, 1.17549435e-38, 3.4028235e38, 7.038531e-26, -7.038531e-26, 0.1, 16777217, 65504, 6e-8]


@every_spelling
@settings(max_examples=30)
@given(octree=octrees(), no_child=st.sampled_from([0, -1]))
def test_round_trips_are_exact(name: str, profile: str | None, octree: SparseVoxelOctree, no_child: int) -> None:
    data = written(name, profile, octree, no_child=no_child)
    back = read(name, data)
    named = octree.data_format or (back.data_format if name != "svo.npz" else "")
    assert_same_octree(back, replace(octree, data_format=named))
    assert written(name, profile, octree, no_child=no_child) == data


@every_spelling
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_numbers_at_the_edges_survive(name: str, profile: str | None, dtype: type) -> None:
    octree = small_octree(dtype)
    with np.errstate(over="ignore"):
        edges: npt.NDArray[Any] = np.array(EDGES).astype(dtype)
    values = octree.node_data.copy()
    values.ravel()[: len(edges)] = np.where(np.isfinite(edges), edges, 1)
    octree = replace(octree, node_data=values)
    assert_same_octree(read(name, written(name, profile, octree)), octree)


@every_spelling
@given(bits=st.lists(st.integers(0, 2**32 - 1), min_size=8, max_size=8))
def test_any_finite_float_survives(name: str, profile: str | None, bits: list[int]) -> None:
    values = np.array(bits, np.uint32).view(np.float32).reshape(1, 8)
    values = np.where(np.isfinite(values), values, np.float32(0))
    octree = SparseVoxelOctree((1, 1, 1), np.zeros((1, 8), np.int32), values)
    assert read(name, written(name, profile, octree)).node_data.tobytes() == values.tobytes()


@every_spelling
def test_no_other_format_claims_it(name: str, profile: str | None) -> None:
    head = written(name, profile, small_octree())[:512]
    assert [form for form, line in FORMATS.items() if line.load_module().recognise(memoryview(head))] == [name]


@every_spelling
def test_strided_arrays_are_written_in_order(name: str, profile: str | None) -> None:
    octree = small_octree()
    strided = replace(octree, node_data=np.asfortranarray(octree.node_data))
    assert written(name, profile, strided) == written(name, profile, octree)


@pytest.mark.parametrize("name", ["svo.npz", "svo.pb", "svo.bson", "svo.fb", "svo.capnp"])
def test_bulk_arrays_are_views_of_the_file(name: str) -> None:
    data = written(name, "bulk" if FORMATS[name].choices("profile") else None, small_octree())
    whole = np.frombuffer(data, np.uint8)
    octree = read(name, data)
    assert np.shares_memory(octree.node_data, whole)
    assert np.shares_memory(octree.node_children, whole)


@pytest.mark.parametrize("name", ["svo.npz", "svo.pb", "svo.bson", "svo.fb", "svo.capnp"])
def test_bulk_arrays_are_handed_over_not_copied(name: str) -> None:
    octree = small_octree()
    options = {"profile": "bulk"} if FORMATS[name].choices("profile") else {}
    pieces = [np.frombuffer(piece, np.uint8) for piece in FORMATS[name].load_module().encode(octree, **options)]
    assert any(np.shares_memory(piece, octree.node_data) for piece in pieces)
    assert any(np.shares_memory(piece, octree.node_children) for piece in pieces)


@pytest.mark.parametrize("name", ["svo.npz", "svo.pb", "svo.json", "svo.bson", "svo.fb", "svo.capnp"])
def test_halves_stay_halves_in_bulk(name: str) -> None:
    profile = "bulk" if FORMATS[name].choices("profile") else None
    sizes = [len(written(name, profile, small_octree(dtype))) for dtype in (np.float32, np.float16)]
    saved = small_octree().node_data.nbytes // 2
    assert sizes[0] - sizes[1] == pytest.approx(saved * (4 / 3 if name == "svo.json" else 1), abs=8)


@pytest.mark.parametrize("name", ["svo.pb", "svo.bson", "svo.fb", "svo.capnp"])
@pytest.mark.parametrize("profile", ["report", "bulk"])
def test_nan_is_told_apart_from_numbers_and_kept(name: str, profile: str) -> None:
    octree = small_octree()
    values = octree.node_data.copy()
    values[3, 2:4] = np.nan, -np.inf
    octree = replace(octree, node_data=values)
    assert_same_octree(read(name, written(name, profile, octree)), octree)


@every_spelling
def test_lobes_in_one_row_come_back_in_the_shape_that_they_have(name: str, profile: str | None) -> None:
    octree = replace(small_octree(), data_format="SG4", extra_data=np.arange(16, dtype=np.float32))
    assert octree.extra_data is not None
    assert octree.extra_data.shape == (4, 4)
    assert_same_octree(read(name, written(name, profile, octree)), octree)
    with pytest.raises(InvalidScene, match="extra_data has 3 numbers; allowed: a multiple of 4"):
        replace(octree, extra_data=np.zeros(3, np.float32))


@pytest.mark.parametrize("suffix", ["", ".zst"])
@every_spelling
def test_files_are_read_whatever_their_profile(name: str, profile: str | None, suffix: str, tmp_path: Path) -> None:
    path, octree = tmp_path / f"a.{name}{suffix}", small_octree()
    options: Any = {"profile": profile} if profile else {}
    size = save(path, octree, **options)
    assert size == path.stat().st_size
    assert_same_octree(load(path, SparseVoxelOctree), octree)


@pytest.mark.parametrize("name", [name for name, form in FORMATS.items() if form.choices("profile")])
@given(octree=octrees(dtypes=[np.float32]))
@settings(max_examples=10)
def test_level_sizes_that_lie_are_refused(name: str, octree: SparseVoxelOctree) -> None:
    sizes = octree.level_sizes
    if len(sizes) < 3 or sizes[1] == sizes[2]:
        return
    module = FORMATS[name].load_module()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SparseVoxelOctree, "level_sizes", [sizes[0], sizes[2], sizes[1], *sizes[3:]])
        data = b"".join(module.encode(octree, profile="bulk"))
    with pytest.raises(InvalidFile, match="level_sizes are"):
        read(name, data)


@pytest.mark.data
@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_the_chair_survives_every_format(chair: Path, dtype: Any) -> None:
    octree = build_octree(load(chair / "chair_sh9.npz", N3Tree), resolution=128, dtype=dtype)
    for name, form in FORMATS.items():
        for profile in form.choices("profile") or (None,):
            back = read(name, written(name, profile, octree), limit=8 << 30)
            assert_same_octree(back, octree)
