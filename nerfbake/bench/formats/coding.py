"""What a child process of `bench formats` does: write an octree in one serialization, and read it again."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import catalog
from nerfbake.bench.formats.libraries import LIBRARIES
from nerfbake.bench.formats.serializations import RAW, Serialization
from nerfbake.bench.measure import Work
from nerfbake.contract import FileFormat
from nerfbake.io.sources import read_file
from nerfbake.scene.octree import SparseVoxelOctree


def write_scene(path: Path, octree: SparseVoxelOctree) -> None:
    """The octree where the children read it."""
    with path.open("wb") as file:
        file.writelines(_module("svo.npz").encode(octree))


def encoding(row: list[Any], scene: str, target: str) -> Work:
    """The work of writing a file; in a process of its own."""
    octree = _read_scene(scene)
    _read_all((octree.node_children, octree.node_data))  # from the disk into memory, before the clock runs
    encode = _encoder(Serialization(*row))
    Path(target).unlink(missing_ok=True)

    def run() -> None:
        with open(target, "wb") as file:
            file.writelines(encode(octree))

    return Work(run, lambda _: {"size": Path(target).stat().st_size})


def decoding(row: list[Any], scene: str, target: str) -> Work:
    """The work of reading a file until every value has been seen; in a process of its own."""
    octree = _read_scene(scene)
    decode = _decoder(Serialization(*row))

    def run() -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        arrays = decode(read_file(Path(target)), octree)
        _read_all(arrays)
        return arrays

    def check(arrays: tuple[npt.NDArray[Any], npt.NDArray[Any]]) -> dict[str, bool]:
        pairs = zip(arrays, (octree.node_children, octree.node_data), strict=True)
        return {"exact": all(a.dtype == b.dtype and a.tobytes() == b.tobytes() for a, b in pairs)}

    return Work(run, check)


def _encoder(row: Serialization) -> Callable[[SparseVoxelOctree], Iterable[Any]]:
    if row.kind == RAW:
        return lambda octree: [octree.node_children.tobytes(), octree.node_data.tobytes()]
    if row.kind == "library":
        library = next(library for library in LIBRARIES if library.name == row.name)
        return lambda octree: [library.encode(octree)]
    encode = _module(row.name).encode
    options = {"profile": row.profile} if row.profile else {}
    if not row.packed:
        return lambda octree: encode(octree, **options)
    compress = catalog.load_compression().compress
    return lambda octree: compress(encode(octree, **options))


def _decoder(row: Serialization) -> Callable[[memoryview, SparseVoxelOctree], tuple[Any, Any]]:
    if row.kind == RAW:
        return _raw_decode
    if row.kind == "library":
        return next(library for library in LIBRARIES if library.name == row.name).decode
    module, decompress = _module(row.name), catalog.load_compression().decompress

    def decode(view: memoryview, _: SparseVoxelOctree) -> tuple[Any, Any]:
        content = decompress(view) if row.packed else view
        octree = module.decode(content)
        return octree.node_children, octree.node_data

    return decode


def _raw_decode(view: memoryview, octree: SparseVoxelOctree) -> tuple[Any, Any]:
    split = octree.node_children.nbytes
    return np.frombuffer(view[:split], np.int32), np.frombuffer(view[split:], octree.node_data.dtype)


def _read_all(arrays: Iterable[npt.NDArray[Any]]) -> None:
    """Reads every value, as cheaply as can be: what it costs is nearly all the memory's."""
    for array in arrays:
        np.bitwise_xor.reduce(np.ascontiguousarray(array).reshape(-1).view(f"u{array.itemsize}"))


def _read_scene(path: str) -> SparseVoxelOctree:
    octree: SparseVoxelOctree = _module("svo.npz").decode(read_file(Path(path)))
    return octree


def _module(name: str) -> FileFormat:
    return catalog.format_named(name, "SparseVoxelOctree").load_module()
