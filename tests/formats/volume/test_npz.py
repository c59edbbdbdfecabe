from __future__ import annotations

import dataclasses
import io
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_array_equal

from nerfbake import build_octree, build_octree_from_volume, build_vdb
from nerfbake.errors import InvalidScene, MemoryLimit, NerfbakeError
from nerfbake.formats.volume import npz as vdb_npz
from nerfbake.formats.wire.npz import write_npz
from nerfbake.memory import memory_limit
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTiles
from nerfbake.scene.volume import Volume
from tests.conftest import REPOSITORY
from tests.support.scenes import assert_same_octree, n3tree
from tests.support.vdb_readers import SCENES, index, transform, tree, volume

PAGE = (REPOSITORY / "schemas" / "vdb_npz.md").read_text()
GRIDS: dict[str, Callable[..., Any]] = {
    "float": lambda coords: tree(coords, background=0.1),
    "half": lambda coords: tree(coords, dtype=np.float16, background=-2.5),
    "vec3": lambda coords: tree(coords, channels=3, name="Cd"),
    "half vec3": lambda coords: tree(coords, channels=3, name="", dtype=np.float16),
    "index": index,
    "half index": lambda coords: index(coords, channels=28, dtype=np.float16),
}


def encoded(made: Volume) -> bytes:
    return b"".join(vdb_npz.encode(made))


def decoded(data: bytes, *, limit: int = 1 << 24) -> Volume:
    with memory_limit(limit):
        return vdb_npz.decode(memoryview(data))


def arrays_of(data: bytes) -> dict[str, Any]:
    with np.load(io.BytesIO(data)) as npz:
        return dict(npz)


@pytest.mark.parametrize("kind", GRIDS)
@pytest.mark.parametrize("scene", SCENES)
def test_what_is_written_is_read(scene: str, kind: str) -> None:
    made = volume(GRIDS[kind](SCENES[scene]), tree(SCENES["one voxel"], name="other"))
    data = encoded(made)
    assert vdb_npz.recognise(memoryview(data[:512]))
    back = decoded(data)
    assert back.problems() == []
    assert_array_equal(back.transform, made.transform)
    for read, grid in zip(back.grids, made.grids, strict=True):
        assert (type(read), read.name) == (type(grid), grid.name)
        assert_array_equal(read.topology.coords, grid.topology.coords)
        assert read.values.dtype == grid.values.dtype
        assert read.values.tobytes() == grid.values.tobytes()
        assert_array_equal(read.background, grid.background)
    assert encoded(back) == data


@pytest.mark.parametrize("grids", [("index",), ("density", "sh")])
def test_the_octree_comes_back(grids: tuple[str, ...]) -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    for half in (False, True):
        made = build_vdb(octree, grids=grids, half=half)
        assert_same_octree(build_octree_from_volume(decoded(encoded(made))), build_octree_from_volume(made))


def test_grids_with_the_same_voxels_share_a_tree() -> None:
    cloud = SCENES["a cloud"]
    arrays = arrays_of(encoded(volume(tree(cloud), tree(cloud, channels=3, name="Cd"), tree([[0, 0, 0]], name="dot"))))
    assert arrays["grid_tree"].tolist() == [0, 0, 1]
    assert [key for key in arrays if "leaf_mask" in key] == ["tree_0_leaf_mask", "tree_1_leaf_mask"]
    back = decoded(encoded(volume(tree(cloud), tree(cloud, name="again"))))
    assert back.grids[0].topology is back.grids[1].topology


# -- what the page says ----------------------------------------------------------------------------------------
def page_code() -> dict[str, Any]:
    """What the page's lines define; they import NumPy alone."""
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert re.findall(r"^(?:import|from) .*", code, re.MULTILINE) == ["import numpy as np"]
    defined: dict[str, Any] = {}
    exec(code, defined)
    return defined


@pytest.mark.parametrize("kind", ["float", "half index"])
@pytest.mark.parametrize("scene", ["one voxel", "a full leaf", "the far negative end", "several root tiles", "a cloud"])
def test_the_pages_lookup_finds_every_voxel_and_nothing_else(scene: str, kind: str) -> None:
    grid = GRIDS[kind](SCENES[scene])
    made = volume(tree(SCENES["one voxel"]), grid)
    npz, value_of = arrays_of(encoded(made)), page_code()["value_of"]
    coords = grid.topology.coords[:: 1 + len(grid.topology.coords) // 200]
    places: npt.NDArray[np.int64] = np.concatenate([coords + step for step in ([0, 0, 0], [1, 0, -1], [0, 64, 0])])
    known = dict(zip(map(tuple, grid.topology.coords.tolist()), grid.values, strict=True))
    for place in places.tolist():
        expected = known.get(tuple(place), grid.background)
        assert_array_equal(value_of(npz, 1, *place), np.asarray(expected, grid.values.dtype), str(place))


TOLD = re.findall(r"^\| `([a-z_{}]+)` \| ([^|]+) \| \(([^|]*)\) \|", PAGE, re.MULTILINE)


def assert_told(arrays: dict[str, Any], sizes: dict[str, int], told: list[tuple[str, str, str]]) -> None:
    assert {re.sub(r"_\d+_", "_{}_", key) for key in arrays} == {re.sub(r"{.}", "{}", key) for key, *_ in told}
    sizes |= {
        letter: len(arrays[f"tree_0_{level}_mask"])
        for letter, level in {"u": "upper", "k": "lower", "l": "leaf"}.items()
    }
    for key, dtype, shape in told:
        array = arrays[key.replace("{t}", "0").replace("{g}", "0")]
        assert array.dtype.kind == "U" if dtype == "text" else array.dtype.name in dtype, key
        edges = [edge.strip() for edge in shape.split(",") if edge.strip()]
        assert list(array.shape) == [sizes[edge] if edge in sizes else int(edge) for edge in edges], key


def test_the_page_lists_every_key_with_its_type_and_shape() -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1))]))
    arrays = arrays_of(encoded(build_vdb(octree)))
    assert arrays["vdb_version"] == 1
    sizes = {"any": len(arrays["nerfbake"]), "g": 2, "m + 1": 1 + build_vdb(octree).grids[0].topology.m, "channels": 1}
    assert_told(arrays, sizes, [row for row in TOLD if not re.search("tile|active|grid_{g}_transform", row[0])])


def test_the_page_lists_what_other_programs_need() -> None:
    """A voxel and a tile of each size, the smallest of them inactive, in a place of their own."""
    voxel = tree([[3, 5, 6]]).topology
    lower, upper = (np.zeros_like(mask) for mask in (voxel.lower_mask, voxel.upper_mask))
    lower[0, 7], upper[0, 9] = 1, 2
    tiles = VdbTiles(lower, upper, np.array([[4096, 0, 0]], np.int32))
    values = np.arange(4, dtype=np.float32)[:, None]
    active = np.array([True, False, True, True])
    grid = VdbTree("a", dataclasses.replace(voxel, tiles=tiles), values, np.zeros(1, np.float32), "level set", active)
    made = volume(dataclasses.replace(grid, place=transform(scale=(1, 2, 3))))
    assert made.problems() == []
    arrays = arrays_of(encoded(made))
    assert arrays["vdb_version"] == 2
    told = [row for row in TOLD if row[0] != "nerfbake"]
    assert_told(arrays, {"g": 1, "m + 1": 5, "channels": 1, "r": 1, "m + t": 4}, told)
    assert arrays["tree_0_lower_tile_rank"][0, 14] == 2
    assert arrays["tree_0_upper_tile_rank"][0, 18] == 3
    (back,) = decoded(encoded(made)).grids
    assert isinstance(back, VdbTree)
    assert back.active is not None
    assert_array_equal(back.active, active)
    assert back.topology.same_as(grid.topology)


# -- files that lie --------------------------------------------------------------------------------------------
def flipped(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    array[0, 0] ^= 1
    return array


LIES: dict[str, tuple[str, Callable[[Any], Any], str]] = {
    "another version": ("vdb_version", lambda _: 3, "vdb_version is 3; allowed: 1, 2"),
    "no grids": ("grid_name", lambda _: np.zeros(0, "U1"), "grid_name has 0 names; allowed: 1 to 100"),
    "too many grids": ("grid_name", lambda _: np.zeros(101, "U1"), "grid_name has 101 names"),
    "fewer classes": ("grid_class", lambda a: a[:1], "grid_class has dtype <U10, shape (1,); allowed: (2) of kind U"),
    "a class of its own": ("grid_class", lambda _: np.array(["\x1b[2J", "index"]), "grid_class[0] is '[2J'; allowed"),
    "a tree that is not there": ("grid_tree", lambda _: np.array([0, 7]), "npz has no tree_7_upper_mask"),
    "a tree below 0": ("grid_tree", lambda _: np.array([-1, 0]), "npz has no tree_-1_upper_mask"),
    "long words": ("tree_0_leaf_mask", lambda a: a.astype(np.uint64), "tree_0_leaf_mask has dtype uint64; allowed"),
    "half a mask": ("tree_0_lower_mask", lambda a: a[:, :64], "tree_0_lower_mask has dtype uint32, shape"),
    "a wrong rank": ("tree_0_leaf_rank", lambda a: a + 1, "tree_0_leaf_rank[0, 0] is 2; allowed: 1, the number"),
    "a voxel more": ("tree_0_leaf_mask", flipped, "tree_0_leaf_rank[0, 1] is"),
    "a lower node less": ("tree_0_root_origin", lambda a: a[1:], "upper_mask has 8 rows; allowed: 7, as in root_"),
    "wide origins": ("tree_0_root_origin", lambda a: a.astype(np.int64), "root_origin has shape (8, 3), dtype int64"),
    "an origin astray": ("tree_0_root_origin", lambda a: a + 1, "root_origin[0, 0] is 1; allowed: multiples of 4096"),
    "tiles out of order": ("tree_0_root_origin", lambda a: a[::-1], "root_origin is out of order"),
    "a row less": ("grid_0_table", lambda a: a[1:], "grid 'density' has 899 values; allowed: 900, one per voxel"),
    "no rows": ("grid_0_table", lambda a: a[:0], "grid_0_table has no rows"),
    "no table": ("grid_1_table", lambda a: a[:0], "table of 'index' has shape (0, 4)"),
    "two channels": ("grid_0_table", lambda a: np.repeat(a, 2, axis=1), "(m, 1 or 3) float16 or float32"),
    "a flat transform": ("transform", lambda a: a[:2], "transform has dtype float64, shape (2, 4); allowed: (3, 4)"),
    "a frame that is none": ("nerfbake", lambda _: np.zeros(3, np.uint8), "nerfbake cannot be parsed"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_file_is_refused(lie: str) -> None:
    key, change, said = LIES[lie]
    arrays = arrays_of(encoded(volume(tree(SCENES["a cloud"]), index([[1, 2, 3]]))))
    arrays[key] = change(arrays.get(key))
    with pytest.raises(NerfbakeError) as error:
        decoded(b"".join(write_npz(arrays))).require_sound()
    assert said in str(error.value)


def test_memory_is_bounded() -> None:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays_of(encoded(volume(tree(SCENES["a full leaf"])))))
    with pytest.raises(MemoryLimit, match="grid_0_table needs"):
        decoded(file.getvalue(), limit=12_000)


@pytest.mark.parametrize(
    ("grids", "said"),
    [
        ([tree([])] * 101, "would contain 101 grids; allowed: 100 at most"),
        ([tree([], name="x" * 10_000)], "is 10,000 characters long; allowed: 9,999"),
    ],
)
def test_what_the_format_cannot_hold(grids: list[VdbTree | IndexGrid], said: str) -> None:
    with pytest.raises(InvalidScene) as error:
        encoded(volume(*grids))
    assert said in str(error.value)
    assert len(decoded(encoded(volume(*[tree(SCENES["one voxel"], name="x" * 9_999)] * 100))).grids) == 100
