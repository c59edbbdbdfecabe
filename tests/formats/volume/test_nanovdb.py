"""NanoVDB files as we write and read them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace

import blosc
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import build_octree, build_octree_from_volume, build_vdb
from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit
from nerfbake.formats.volume import nanovdb as vdb_nanovdb
from nerfbake.formats.volume.nanovdb_reader import _unblosced
from nerfbake.formats.wire import nanovdb as nano
from nerfbake.memory import memory_limit
from nerfbake.scene.vdb import IndexGrid
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import Volume
from tests.support.nanovdb import GRIDS, Codec, decoded, encoded
from tests.support.scenes import assert_same_octree, n3tree
from tests.support.vdb_readers import SCENES, bloscked, index, transform, tree, volume


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
    with pytest.raises(InvalidFile, match="a blosc buffer's size would be at bytes"):
        _unblosced(memoryview(data), sum(map(len, parts)) + 100_000)


START = nano.FILE.itemsize + nano.META.itemsize + len(b"density\0")


def grid_since_32_7(data: bytes) -> bytearray:
    """The grid of one of our uncompressed files as version 32.8 writes it: another magic, and the first CRC ends before
    the root."""
    grid = bytearray(data[START:])
    grid[:8], grid[16:20] = b"NanoVDB1", (32 << 21 | 8 << 10).to_bytes(4, "little")
    grid[8:12] = zlib.crc32(grid[16:736]).to_bytes(4, "little")
    return grid


@pytest.mark.parametrize("kind", GRIDS)
def test_the_magic_numbers_since_version_32_7_are_read(kind: str) -> None:
    data = encoded(volume(replace(GRIDS[kind](SCENES["a full leaf"]), name="density")))
    newer = b"NanoVDB2" + data[8:START] + grid_since_32_7(data)
    assert decoded(newer).checksum == "half"
    assert encoded(decoded(newer)) == encoded(decoded(data))
    with pytest.raises(InvalidFile, match="the checksum is"):
        decoded(newer[: START + 600] + b"\xff" + newer[START + 601 :])


def test_grids_one_after_the_other_without_headers_are_read() -> None:
    """As nanovdb::GridHandle::write() and NVIDIA Flow write them."""
    data = encoded(volume(tree(SCENES["a cloud"])))
    raw = grid_since_32_7(data)
    made = decoded(bytes(raw + raw))
    assert made.labels == ["density[0]", "density[1]"]
    for grid in made.grids:
        assert_array_equal(grid.values, decoded(data).grids[0].values)
    for broken, said in ((raw[:-1], "has size"), (raw + b"NanoVDB1", "GridData would be at bytes")):
        with pytest.raises(InvalidFile, match=said):
            decoded(bytes(broken))


@pytest.mark.parametrize("pack", [lambda made: encoded(made, codec="zip"), lambda made: bloscked(encoded(made))])
def test_a_size_that_leaves_out_the_8_bytes_before_a_compressed_grid_is_read(pack: Callable[[Volume], bytes]) -> None:
    """As Warp writes it."""
    made = volume(tree(SCENES["a cloud"]))
    data = bytearray(pack(made))
    meta = np.frombuffer(data, nano.META, 1, nano.FILE.itemsize)
    meta["file_size"] -= 8
    assert encoded(decoded(bytes(data))) == encoded(made)


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
        assert_same_octree(build_octree_from_volume(decoded(encoded(made))), build_octree_from_volume(made))


def test_an_octree_that_comes_back_is_sound() -> None:
    made = build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    back = decoded(encoded(build_vdb(made, grids=("index",)), codec="zip"))
    assert build_octree_from_volume(back).problems() == []


def test_lobes_come_back_with_the_octree() -> None:
    lobes = np.random.default_rng(0).normal(size=(2, 11)).astype(np.float32)
    octree = build_octree(n3tree(data_format="ASG2", extra_data=lobes))
    back = build_octree_from_volume(decoded(encoded(build_vdb(octree, grids=("index",)))))
    assert_same_octree(back, octree)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: volume(tree([]), tree([])), "would contain 2 grids: density[0], density[1]; allowed: `grid=NAME`"),
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
