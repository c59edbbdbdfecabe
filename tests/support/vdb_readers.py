"""Read our files with other programs: pyopenvdb in a separate interpreter, and the tools of OpenVDB and NanoVDB."""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import blosc
import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.formats.volume import openvdb_writer
from nerfbake.formats.wire import nanovdb as nano
from nerfbake.formats.wire.openvdb import BLOSC
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import topology_of
from nerfbake.scene.volume import Volume

# Every active voxel as the library reads it. Tiles appear as boxes of more than one voxel.
_DUMP = """
import sys, numpy, pyopenvdb
grids, metadata = pyopenvdb.readAll(sys.argv[1])
out = {}
for i, grid in enumerate(grids):
    voxels = [(item.min, item.max, item.value) for item in grid.citerOnValues()]
    out[f"{i}.name"] = grid.name
    out[f"{i}.low"] = numpy.array([v[0] for v in voxels], "i8").reshape(-1, 3)
    out[f"{i}.high"] = numpy.array([v[1] for v in voxels], "i8").reshape(-1, 3)
    out[f"{i}.values"] = numpy.array([v[2] for v in voxels], "f8")
    out[f"{i}.background"] = numpy.array(grid.background, "f8")
    corners = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    out[f"{i}.world"] = numpy.array([grid.transform.indexToWorld(corner) for corner in corners])
    out[f"{i}.type"] = grid.valueTypeName
    out[f"{i}.half"] = grid.saveFloatAsHalf
    out[f"{i}.class"] = grid.gridClass
numpy.savez(sys.argv[2], count=len(grids), **out)
"""


class Seen(NamedTuple):
    """A grid as read by pyopenvdb."""

    name: str
    coords: npt.NDArray[np.int64]
    values: npt.NDArray[np.float64]
    background: npt.NDArray[np.float64]
    transform: npt.NDArray[np.float64]
    type: str
    half: bool
    grid_class: str


def pyopenvdb(path: Path) -> dict[str, Seen]:
    """Read all grids of a .vdb. A separate interpreter is needed: pyopenvdb requires an older NumPy."""
    dump = path.with_suffix(".dump.npz")
    subprocess.run(["/usr/bin/python3", "-c", _DUMP, str(path), str(dump)], check=True, timeout=60)
    with np.load(dump) as npz:
        seen = {}
        for i in range(int(npz["count"])):
            assert (npz[f"{i}.low"] == npz[f"{i}.high"]).all(), "an active tile"
            world = npz[f"{i}.world"]
            transform = np.column_stack([(world[1:] - world[0]).T, world[0]])
            background = np.atleast_1d(npz[f"{i}.background"])
            values = npz[f"{i}.values"].reshape(-1, len(background))
            facts = (str(npz[f"{i}.type"]), bool(npz[f"{i}.half"]), str(npz[f"{i}.class"]))
            name = str(npz[f"{i}.name"])
            seen[name] = Seen(name, npz[f"{i}.low"], values, background, transform, *facts)
    return seen


def tool(*arguments: str | Path) -> str:
    """Run a tool of OpenVDB or NanoVDB, and return its output on stdout and stderr."""
    done = subprocess.run(list(map(str, arguments)), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def by_coords(coords: npt.NDArray[Any], values: npt.NDArray[Any]) -> dict[tuple[int, ...], tuple[float, ...]]:
    """{coordinates: values} of all voxels, to compare them independently of their order."""
    found = {tuple(c): tuple(v) for c, v in zip(coords.tolist(), values.astype(np.float64).tolist(), strict=True)}
    assert len(found) == len(coords)
    return found


@contextmanager
def blosc_for_zip() -> Iterator[None]:
    """Make save() write .vdb files as other programs do: blosc (LZ4, shuffled), with short buffers uncompressed."""

    def pack(data: memoryview) -> bytes:
        packed = blosc.compress(bytes(data), 4, cname="lz4") if len(data) >= 48 else data
        smaller = len(packed) < len(data)
        return struct.pack("<q", len(packed) if smaller else -len(data)) + (packed if smaller else data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(openvdb_writer, "ZIP", BLOSC)
        patch.setattr(openvdb_writer, "_zipped", pack)
        yield


def bloscked(nvdb: bytes) -> bytes:
    """Compress an uncompressed .nvdb with codec 2, blosc."""
    file, meta = np.frombuffer(nvdb, nano.FILE, 1).copy(), np.frombuffer(nvdb, nano.META, 1, nano.FILE.itemsize).copy()
    front = nano.FILE.itemsize + nano.META.itemsize + int(meta["name_size"][0])
    packed = blosc.compress(nvdb[front:], 4, cname="lz4")
    file["codec"] = meta["codec"] = nano.CODECS["blosc"]
    meta["file_size"] = 8 + len(packed)
    name = nvdb[nano.FILE.itemsize + nano.META.itemsize : front]
    return b"".join([file.tobytes(), meta.tobytes(), name, struct.pack("<Q", len(packed)), packed])


def transform(*, scale: tuple[float, float, float] = (0.25, 0.25, 0.25)) -> npt.NDArray[np.float64]:
    return np.column_stack([np.diag(scale), [-1.5, 2.25, 0.125]])


def tree(
    coords: npt.ArrayLike, *, channels: int = 1, dtype: Any = np.float32, name: str = "density", background: float = 0
) -> VdbTree:
    """A tree with a different value for every voxel."""
    topology, order = topology_of(np.asarray(coords, np.int64).reshape(-1, 3))
    values = 0.5 + np.arange(len(order) * channels, dtype=np.float64).reshape(-1, channels) / 64
    return VdbTree(name, topology, values[order].astype(dtype), np.full(channels, background, np.float32))


def index(coords: npt.ArrayLike, *, channels: int = 4, dtype: Any = np.float32) -> IndexGrid:
    topology, order = topology_of(np.asarray(coords, np.int64).reshape(-1, 3))
    table = np.zeros((len(order) + 1, channels), dtype)
    table[1:] = (1 + np.arange(len(order) * channels).reshape(-1, channels) / 64)[order]
    return IndexGrid("index", topology, table)


def volume(*grids: VdbTree | IndexGrid) -> Volume:
    return Volume(grids, transform())


_random = np.random.default_rng(7)
_full_leaf = np.stack(np.unravel_index(np.arange(512), (8, 8, 8)), axis=1)
# Scenes that expose errors: each node level alone, both signs, root tiles in both orders, extreme coordinates.
SCENES = {
    "nothing": np.zeros((0, 3), np.int64),
    "one voxel": np.array([[3, 5, 6]]),
    "a full leaf": _full_leaf + 8,
    "the far negative end": np.array([[-(2**20), -(2**20), -(2**20)], [-1, -1, -1], [0, 0, 0]]),
    "several root tiles": np.array([[x, y, z] for x in (-4097, -1, 4096) for y in (-9000, 7) for z in (-1, 0, 8192)]),
    "a cloud": np.unique(_random.integers(-70, 200, (900, 3)), axis=0),
    "a shuffled cloud": _random.permutation(np.unique(_random.normal(0, 40, (700, 3)).astype(np.int64), axis=0)),
}
