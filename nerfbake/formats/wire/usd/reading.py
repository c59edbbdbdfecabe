"""Read stages with OpenUSD, an optional library, in a process of its own.

OpenUSD is C++ that reads files of anyone: a damaged one may end its process, and a text may take all memory. So it runs
in a child with limits, in an empty folder that holds the layers of the file and nothing else. A layer that refers to
any other file is refused before OpenUSD would open it. Textures are never given to OpenUSD.

    .usda  "#usda"      .usdc  "PXR-USDC"      .usd  either      .usdz  a zip archive, its first file is the layer
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, MemoryLimit, Problem
from nerfbake.formats.wire.usd.content import LAYERS, has_type, kind_of_layer, package_names
from nerfbake.formats.wire.zip_reader import ZIP_MAGIC, ZipReader
from nerfbake.installation import require_installed
from nerfbake.kernels.arrays import Floats

CHILD = Path(__file__).with_name("_child.py")
_LIBRARY = 2 << 30  # bytes of addresses that OpenUSD takes beside the data of a stage
_TIMES = 4  # bytes that it may take for each byte of a file
_SECONDS = 20  # of a CPU, and one more for each 5 MB
_PER_SECOND = 5_000_000
_CHUNK = 1 << 20


class StagePrim(NamedTuple):
    """A prim that was read.

    path    its path in the stage
    kind    its type: ParticleField3DGaussianSplat, Mesh or Camera
    place   (4, 4) float64, from its coordinates to those of the world, in metres
    values  its attributes by name: arrays (n,) or (n, columns), numbers and text
    facts   of a mesh: its materials, the subsets of its faces, and its primvars
    """

    path: str
    kind: str
    place: Floats
    values: Mapping[str, Any]
    facts: Mapping[str, Any]


class StageContent(NamedTuple):
    """What a file holds: its up axis, its prims, the files beside the layer by name, and what was left out.

    turned: nerfbake:up of the default prim, the axis that was up before nerfbake turned the meshes; '' for none.
    """

    up: str
    turned: str
    prims: tuple[StagePrim, ...]
    files: Mapping[str, memoryview]
    notes: tuple[str, ...]

    def of(self, kind: str) -> list[StagePrim]:
        return [prim for prim in self.prims if prim.kind == kind]


def read_stage(view: memoryview, beside: Mapping[str, memoryview] | None = None) -> StageContent:
    """Read a stage. Raises UsageError without OpenUSD, InvalidFile, MemoryLimit.

    beside: the files of the same folder, which a material may name; those of a .usdz are in it.
    """
    require_installed("pxr", "reading USD")
    files: Mapping[str, memoryview]
    if bytes(view[:4]) in ZIP_MAGIC:
        files, layers = _unpacked(view)
    else:
        files, layers = beside or {}, {f"stage{kind_of_layer(view)}": view}
    answer, arrays = run_child(layers)
    if "error" in answer:
        place, found, allowed = answer["error"]
        raise InvalidFile(Problem(place, found, allowed))
    metres = float(answer["metres"])
    if not 1e-9 <= metres <= 1e9:
        raise InvalidFile(Problem("metersPerUnit", f"is {metres:g}", "1e-09 to 1e+09"))
    prims = tuple(_prim(told, arrays, metres) for told in answer["prims"])
    if not prims and has_type(view, "Volume"):
        raise InvalidFile(Problem("the stage", "is that of a volume", "the .vdb beside it"))
    return StageContent(answer["up"], answer["turned"], prims, files, tuple(_notes(answer["left_out"])))


def _unpacked(view: memoryview) -> tuple[dict[str, memoryview], dict[str, memoryview]]:
    """Return all files of a package by name, and its layers, the first of which is the stage."""
    archive = ZipReader(view, "a .usdz")
    names = package_names(archive.members)
    return (
        {name: archive.unpacked(name, name) for name in names if not name.endswith(LAYERS)},
        {name: archive.unpacked(name, name) for name in names if name.endswith(LAYERS)},
    )


def _notes(left_out: Mapping[str, int]) -> Iterator[str]:
    if hidden := left_out.get("hidden", 0):
        yield f"hidden prims are not read: {hidden:,}"
    if later := left_out.get("later times", 0):
        yield f"prims that move or change are read at the first time only: {later:,}"
    others = sorted(kind for kind in left_out if kind not in ("hidden", "later times"))
    if others:
        told = ", ".join(f"{left_out[kind]:,} {kind}" for kind in others[:5])
        yield f"prims of these types are not read: {told}"


def _prim(told: Mapping[str, Any], arrays: memoryview, metres: float) -> StagePrim:
    place = np.array(told["place"], np.float64).reshape(4, 4).T.copy()
    place[:3] *= metres
    if not np.isfinite(place).all() or not (place[3] == (0, 0, 0, 1)).all():
        raise InvalidFile(Problem(str(told["path"]), "has a transform that is not affine", "finite numbers"))
    facts = {name: _resolved(told[name], arrays) for name in ("material", "parts", "primvars") if name in told}
    return StagePrim(str(told["path"]), str(told["kind"]), place, _resolved(told["values"], arrays), facts)


def _resolved(value: Any, arrays: memoryview) -> Any:
    """Return a value of the JSON with the arrays that it refers to."""
    if isinstance(value, list):
        return [_resolved(each, arrays) for each in value]
    if not isinstance(value, dict):
        return value
    if list(value) != ["array"]:
        return {name: _resolved(each, arrays) for name, each in value.items()}
    start, size, dtype, columns = value["array"]
    found: npt.NDArray[Any] = np.frombuffer(arrays[start : start + size], dtype)
    return found.reshape(-1, columns) if columns > 1 else found


# -- the child -------------------------------------------------------------------------------------------------
def run_child(layers: Mapping[str, memoryview]) -> tuple[dict[str, Any], memoryview]:
    """Return the answer of the child: its JSON and its arrays. Raises InvalidFile if it crashes, MemoryLimit."""
    size = sum(map(len, layers.values()))
    memory.require("the stage", _TIMES * size)
    request = {
        "files": [[name, len(data)] for name, data in layers.items()],
        "root": next(iter(layers)),
        "bytes": memory.left() + _LIBRARY,
        "seconds": _SECONDS + size // _PER_SECOND,
    }
    received, code = exchange([json.dumps(request).encode() + b"\n", *layers.values()])
    length = int.from_bytes(received[:8], "little")
    if code or len(received) < 8 + length:
        raise _crash(code)
    answer: dict[str, Any] = json.loads(bytes(received[8 : 8 + length]))
    return answer, received[8 + length :]


def exchange(pieces: Sequence[bytes | memoryview]) -> tuple[memoryview, int]:
    """Write a request to a new child; return what it answers, and its exit code. Raises MemoryLimit."""
    received = bytearray()
    with _child() as process:
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(BrokenPipeError):  # it has crashed already
            for piece in pieces:
                process.stdin.write(piece)
            process.stdin.close()
        while piece := process.stdout.read(_CHUNK):
            memory.hold("the stage", len(piece))
            received += piece
        return memoryview(received).toreadonly(), process.wait()


def _crash(code: int) -> InvalidFile | MemoryLimit:
    ended = f"exit code {code}"
    if code < 0:
        with suppress(ValueError):
            ended = signal.Signals(-code).name
    if code == -signal.SIGXCPU:
        return InvalidFile(Problem("the stage", "takes OpenUSD too long", "a stage that it reads"))
    return InvalidFile(Problem("the stage", f"ends OpenUSD with {ended}", "a file that is not damaged"))


@contextmanager
def _child() -> Iterator[subprocess.Popen[bytes]]:
    """Start the process in an empty folder; kill it if the block fails, also after Ctrl-C."""
    command = [sys.executable, "-P", str(CHILD)]
    one = {"PXR_WORK_THREAD_LIMIT": "1", "OMP_NUM_THREADS": "1"}
    with (
        tempfile.TemporaryDirectory(prefix="nerfbake-usd-") as folder,
        subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=folder,
            env=os.environ | one,
        ) as process,
    ):
        try:
            yield process
        finally:
            process.kill()
            with suppress(BrokenPipeError):
                assert process.stdin is not None
                process.stdin.close()
