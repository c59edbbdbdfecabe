from __future__ import annotations

import io
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import blosc
import numpy as np
import numpy.typing as npt
import pytest
import warp as wp
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import build_octree, build_vdb, load, octree_of_volume, save
from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit
from nerfbake.formats.volume import nanovdb as vdb_nanovdb
from nerfbake.formats.volume.nanovdb_reader import _unblosced
from nerfbake.formats.wire import nanovdb_nodes as nano
from nerfbake.formats.wire.blosc import unblosc
from nerfbake.memory import memory_limit
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import Volume
from tests.support.scenes import assert_same_octree, n3tree
from tests.support.vdb_readers import SCENES, bloscked, by_coords, index, pyopenvdb, tool, transform, tree, volume
from tests.support.warp_kernels import LOOKUPS

Codec = Literal["none", "zip"]
GRIDS: dict[str, Callable[..., Any]] = {
    "Float": tree,
    "Vec3f": lambda coords: tree(coords, channels=3, name="Cd"),
    "Fp16": lambda coords: tree(coords, dtype=np.float16),
    "OnIndex": index,
    "OnIndex, half": lambda coords: index(coords, channels=28, dtype=np.float16),
}


def encoded(made: Volume, *, codec: Codec = "none") -> bytes:
    return b"".join(vdb_nanovdb.encode(made, codec=codec))


def decoded(data: bytes) -> Volume:
    return vdb_nanovdb.decode(memoryview(data))


@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("kind", GRIDS)
@pytest.mark.parametrize("scene", SCENES)
def test_what_is_written_is_read(scene: str, kind: str, codec: Codec) -> None:
    grid = GRIDS[kind](SCENES[scene])
    back = decoded(encoded(volume(grid), codec=codec))
    assert back.problems() == []
    (read,) = back.grids
    assert_array_equal(read.topology.coords, grid.topology.coords)
    assert (read.name, back.checksum) == (grid.name, "half")
    assert_array_equal(back.transform, transform())
    if kind == "Fp16":
        # 16 bits between a leaf's least and greatest value, the background 0 among them.
        assert_allclose(read.values, grid.values, atol=float(grid.values.max(initial=0)) / 65535)
    else:
        assert read.values.dtype == grid.values.dtype
        assert read.values.tobytes() == grid.values.tobytes()
        assert encoded(back, codec=codec) == encoded(volume(grid), codec=codec)


@pytest.mark.parametrize("kind", GRIDS)
def test_blosc_is_read_as_none_is(kind: str) -> None:
    data = encoded(volume(GRIDS[kind](SCENES["a cloud"])))
    assert encoded(decoded(bloscked(data))) == encoded(decoded(data))


def test_buffers_of_blosc_follow_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 1 GiB each; the same code at 100,000 bytes."""
    monkeypatch.setattr(nano, "BLOSC_CHUNK", 100_000)
    made = volume(tree(SCENES["a cloud"]))
    parts = [b"".join(vdb_nanovdb.encode(made))[16 + 176 + 8 :][at : at + 100_000] for at in range(0, 700_000, 100_000)]
    packed = [blosc.compress(part, 4, cname="lz4") for part in parts if part]
    data = b"".join(len(part).to_bytes(8, "little") + part for part in packed)
    assert _unblosced(memoryview(data), sum(map(len, parts))) == b"".join(parts)
    with pytest.raises(InvalidFile, match="a blosc buffer's size would stand at bytes"):
        _unblosced(memoryview(data), sum(map(len, parts)) + 100_000)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda b: b[:15], "has a blosc buffer of 15 bytes; allowed: 16 or more"),
        (lambda b: b[:-1], r"declares 4,000 bytes packed in \d+; allowed: 4,000 packed in"),
        (lambda b: b[:4] + (1 << 31).to_bytes(4, "little") + b[8:], "declares 2,147,483,648 bytes"),
        (lambda b: b"\xff" + b[1:], "is damaged"),
        (lambda b: b[:16] + b"\xff" * (len(b) - 16), "is damaged"),
    ],
)
def test_a_lying_blosc_buffer_is_refused(change: Callable[[bytes], bytes], said: str) -> None:
    good = blosc.compress(bytes(range(250)) * 16, 4, cname="lz4")
    with pytest.raises(InvalidFile, match=said):
        unblosc(memoryview(change(good)), 4000, "the grid")


def test_a_blosc_buffer_that_declares_too_much_is_not_unpacked() -> None:
    good = blosc.compress(bytes(4000), 4, cname="lz4")
    huge = good[:4] + (1 << 30).to_bytes(4, "little") + good[8:]
    with pytest.raises(InvalidFile, match=r"declares 1,073,741,824 bytes from \d+; allowed: 255 times"):
        unblosc(memoryview(huge), 1 << 30, "the grid")


def test_an_index_with_its_tiles_in_another_order_is_read() -> None:
    """Tile 0 and its nodes moved behind the others, as OpenVDB's order has them; the table's rows go along."""
    made = index([[-1, -1, -1], [0, 0, 0], [1, 0, 0]])
    turned = VdbTopology(
        made.topology.root_origin[::-1].copy(),
        made.topology.upper_mask[::-1].copy(),
        made.topology.lower_mask[::-1].copy(),
        made.topology.leaf_mask[::-1].copy(),
    )
    data = encoded(volume(IndexGrid("index", turned, made.table[[0, 3, 1, 2]])))
    (back,) = decoded(data).grids
    assert_array_equal(back.topology.coords, made.topology.coords)
    assert_array_equal(back.values, made.values)


def test_the_background_is_kept() -> None:
    grid = tree(SCENES["a cloud"], background=-2.5)
    assert decoded(encoded(volume(grid))).grids[0].background == [-2.5]


def test_the_octree_comes_back_from_an_index() -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    octree.node_data.setflags(write=False)
    for half in (False, True):
        made = build_vdb(octree, grids=("index",), half=half)
        assert_same_octree(octree_of_volume(decoded(encoded(made))), octree_of_volume(made))


def test_lobes_come_back_with_the_octree() -> None:
    lobes = np.random.default_rng(0).normal(size=(2, 11)).astype(np.float32)
    octree = build_octree(n3tree(data_format="ASG2", extra_data=lobes))
    back = octree_of_volume(decoded(encoded(build_vdb(octree, grids=("index",)))))
    assert_same_octree(back, octree)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: volume(tree([]), tree([])), "would hold 2 grids; allowed: one"),
        (lambda: volume(tree([], name="x" * 256)), "the grid's name is 256 bytes long; allowed: 255 at most"),
        (lambda: volume(tree([], channels=3, dtype=np.float16)), "is float16; allowed: float32"),
    ],
)
def test_what_the_format_cannot_hold(made: Callable[[], Volume], said: str) -> None:
    with pytest.raises(InvalidScene) as error:
        encoded(made())
    assert said in str(error.value)
    assert decoded(encoded(volume(tree([], name="x" * 255)))).grids[0].name == "x" * 255


def test_a_zipped_grid_that_declares_too_much_is_not_unpacked() -> None:
    data = encoded(volume(tree(SCENES["a cloud"])), codec="zip")
    with pytest.raises(MemoryLimit, match="the grid needs"), memory_limit(100_000):
        vdb_nanovdb.decode(memoryview(data))


def test_a_flipped_bit_below_the_checksum_is_found() -> None:
    data = bytearray(encoded(volume(tree(SCENES["a cloud"]))))
    data[16 + 176 + len("density") + 1 + 620] ^= 1
    with pytest.raises(InvalidFile, match="the checksum is"):
        decoded(bytes(data))


# -- NanoVDB's tools -------------------------------------------------------------------------------------------
@pytest.mark.tools
@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("kind", ["Float", "Vec3f", "Fp16"])
@pytest.mark.parametrize("scene", SCENES)
def test_nanovdbs_tools_take_it(scene: str, kind: str, codec: Codec, tmp_path: Path) -> None:
    grid = GRIDS[kind](SCENES[scene])
    file = tmp_path / "a.nvdb"
    save(file, volume(grid), codec=codec)
    # It exits with 0 whatever it finds: what it says is what counts, and it says nothing of what is right.
    assert tool("nanovdb_validate", file) == ""
    row = next(line.split() for line in tool("nanovdb_print", file).splitlines() if line.startswith("1 "))
    assert row[1:3] == [grid.name, {"Float": "float", "Vec3f": "Vec3f", "Fp16": "Float16"}[kind]]
    assert str(grid.topology.m) in row


# Its own tools print no values of Fp16, and Warp reads zeros: the library itself, every leaf's 512 voxels.
_FP16 = """
#include <nanovdb/util/IO.h>
int main(int, char** files) {
    auto handle = nanovdb::io::readGrid(files[1]);
    auto* grid = handle.grid<nanovdb::Fp16>();
    auto read = grid->getAccessor();
    for (uint32_t i = 0; i < grid->tree().nodeCount(0); ++i) {
        auto& leaf = grid->tree().getFirstLeaf()[i];
        for (uint32_t n = 0; n < 512; ++n) {
            auto at = leaf.offsetToGlobalCoord(n);
            printf("%d %d %d %d %.9g\\n", at[0], at[1], at[2], leaf.isActive(n), read.getValue(at));
        }
    }
}
"""


@pytest.fixture(scope="module")
def fp16_reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fp16")
    (folder / "dump.cpp").write_text(_FP16)
    command = ["g++", "-std=c++17", "-DNANOVDB_USE_ZIP", "dump.cpp", "-o", "dump", "-lz"]
    if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
        pytest.skip("no g++, NanoVDB or zlib headers: `make tools` installs them")
    return folder / "dump"


@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("scene", SCENES)
def test_nanovdb_reads_every_half_voxel(scene: str, codec: Codec, fp16_reader: Path, tmp_path: Path) -> None:
    grid = tree(SCENES[scene], dtype=np.float16)
    save(tmp_path / "a.nvdb", volume(grid), codec=codec)
    lines = np.array([line.split() for line in tool(fp16_reader, tmp_path / "a.nvdb").splitlines()], np.float64)
    lines = lines.reshape(-1, 5)
    assert len(lines) == 512 * len(grid.topology.leaf_mask)
    active = lines[lines[:, 3] == 1]
    seen = by_coords(active[:, :3].astype(int), active[:, 4:].astype(np.float32))
    known = by_coords(grid.topology.coords, grid.values)
    assert seen.keys() == known.keys()
    step = float(grid.values.max(initial=0)) / 65535  # of 16 bits between a leaf's least and greatest
    assert_allclose([seen[place] for place in known], list(known.values()), atol=step)
    assert_allclose(lines[lines[:, 3] == 0, 4], 0, atol=step)
    ours = load(tmp_path / "a.nvdb", Volume).grids[0]
    assert seen == by_coords(ours.topology.coords, ours.values)


@pytest.mark.tools
def test_validation_finds_what_is_broken(tmp_path: Path) -> None:
    data = bytearray(encoded(volume(tree(SCENES["a cloud"]))))
    data[16 + 176 + len("density") + 1 + 620] ^= 1
    (tmp_path / "a.nvdb").write_bytes(data)
    assert "failed" in tool("nanovdb_validate", tmp_path / "a.nvdb")


# Where tiles lie below 0, nanovdb_convert leaves them in OpenVDB's order; ours are sorted by key (nanovdb_reader).
@pytest.mark.tools
@pytest.mark.parametrize("shift", [0, 70, 4000])
@pytest.mark.parametrize("scene", ["one voxel", "a full leaf", "a cloud"])
def test_the_same_bytes_as_nanovdb_convert(scene: str, shift: int, tmp_path: Path) -> None:
    """From our .vdb of the same grid, with all statistics and a partial checksum."""
    made = volume(tree(np.abs(np.unique(np.maximum(SCENES[scene], -70) + shift, axis=0))))
    save(tmp_path / "a.vdb", made)
    save(tmp_path / "a.nvdb", made)
    tool("nanovdb_convert", "-c", "partial", "-s", "all", tmp_path / "a.vdb", tmp_path / "theirs.nvdb")
    assert (tmp_path / "a.nvdb").read_bytes() == (tmp_path / "theirs.nvdb").read_bytes()


@pytest.mark.tools
@pytest.mark.parametrize("codec", ["", "-z", "-b"])
@pytest.mark.parametrize("kind", ["Float", "Vec3f"])
@pytest.mark.parametrize("scene", SCENES)
def test_what_nanovdb_convert_writes_is_read(scene: str, kind: str, codec: str, tmp_path: Path) -> None:
    """Whatever the codec, and whatever the order of the root's tiles."""
    grid = GRIDS[kind](SCENES[scene])
    save(tmp_path / "a.vdb", volume(grid))
    tool("nanovdb_convert", *([codec] if codec else []), tmp_path / "a.vdb", tmp_path / "a.nvdb")
    back = load(tmp_path / "a.nvdb", Volume)
    assert back.problems() == []
    assert_array_equal(back.grids[0].topology.coords, grid.topology.coords)
    assert_array_equal(back.grids[0].values, grid.values)


@pytest.mark.tools
@pytest.mark.parametrize("kind", ["Float", "Vec3f"])
@pytest.mark.parametrize("scene", SCENES)
def test_openvdb_reads_what_nanovdb_convert_makes_of_it(scene: str, kind: str, tmp_path: Path) -> None:
    grid = GRIDS[kind](SCENES[scene])
    save(tmp_path / "a.nvdb", volume(grid))
    tool("nanovdb_convert", tmp_path / "a.nvdb", tmp_path / "a.vdb")
    seen = pyopenvdb(tmp_path / "a.vdb")[grid.name]
    assert by_coords(seen.coords, seen.values) == by_coords(grid.topology.coords, grid.values)
    assert_array_equal(seen.background, grid.background)
    assert_array_equal(seen.transform, transform())


# -- Warp ------------------------------------------------------------------------------------------------------
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
