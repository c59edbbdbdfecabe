"""Compare nerfbake's own readers and writers of wire formats with the libraries for these formats.

Each figure comes from a separate process, and the two sides take turns, round by round. Each library is used in its
most favourable way; docs/wires.md has the conclusions. pyopenvdb runs in Debian's Python (`make tools`) and measures
itself there.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks.processes import announced
from benchmarks.scenes import Scenes
from nerfbake import Meshes, N3Tree, SparseVoxelOctree, Volume, build_octree, build_vdb, cut_octree, load, save
from nerfbake.bench.environment import environment
from nerfbake.bench.formats.libraries import LIBRARIES
from nerfbake.bench.measure import Result, Statistics, Work, measure
from nerfbake.bench.report import Report, Table
from nerfbake.catalog import format_named
from nerfbake.formats.octree.flatbuffers import FlatbuffersTable as FlatTable
from nerfbake.io.sources import read_file
from nerfbake.scene.mesh import Mesh

Arrays = Sequence[npt.NDArray[Any]]

ROUNDS = 9
SAMPLE = "sample SH16"
NEAR = 1.2  # a library within this factor of nerfbake's time and memory could replace nerfbake's code
EDGE = 512  # squares along an edge of the mesh
PACKAGES = ("numpy", "protobuf", "pymongo", "flatbuffers", "pycapnp", "trimesh")
COLUMNS = ["wire", "direction", "library", "ours ms", "library ms", "library x ours", "ours peak MB", "library peak MB"]
COLUMNS += [f"within {NEAR:g} of both", "exact"]
NOTES = [
    "write: from arrays in memory to a written file; read: until every value has been read. Imports and compiled "
    "kernels are loaded before. Median [min..max].",
    "library x ours: ratio of the fastest rounds, since other work on the cores can only make a round slower.",
    "peak: memory that the step added to its process.",
    "ours: the whole format, with all checks and all small fields; a library handles only the large arrays. "
    "'FlatBuffers, two vectors' is the wire format without the octree's checks, on both sides.",
    "exact: all numbers are restored, on both sides.",
    "VDB: pyopenvdb gets a dense array; it reads with readAll and evalMinMax. glb: positions and triangles.",
]

_PYOPENVDB = """
import json, sys, time, numpy, pyopenvdb
direction, path, dense = sys.argv[1], sys.argv[2], numpy.load(sys.argv[3])
def memory(key):
    return next(int(line.split()[1]) << 10 for line in open("/proc/self/status") if line.startswith(key))
open("/proc/self/clear_refs", "w").write("5")
before, start = memory("VmRSS"), time.perf_counter()
if direction == "write":
    grid = pyopenvdb.FloatGrid()
    grid.copyFromArray(dense)
    pyopenvdb.write(path, grids=[grid])
else:
    grid = pyopenvdb.readAll(path)[0][0]
    grid.evalMinMax()
found = {"seconds": time.perf_counter() - start, "peak": memory("VmHWM") - before}
back = numpy.zeros_like(dense)
grid.copyToArray(back)
print(json.dumps({**found, "exact": bool((back == dense).all())}))
"""


class Wire(NamedTuple):
    """scene: a key of SCENES. form, profile: nerfbake's format. library: one of LIBRARIES, or one in this module."""

    scene: str
    form: str
    library: str
    profile: str | None = None


class Way(NamedTuple):
    """The functions of one side that write its file, and read it as arrays."""

    write: Callable[[Any, Path], Any]
    read: Callable[[Path], Arrays]


WIRES = {
    "Protocol Buffers": Wire("octree", "svo.pb", "protobuf, extend(list)", "report"),
    "BSON": Wire("octree", "svo.bson", "pymongo bson, bytes", "bulk"),
    "FlatBuffers": Wire("octree", "svo.fb", "flatbuffers, NumPy vector", "report"),
    "FlatBuffers, two vectors": Wire("octree", "svo.fb", "flatbuffers, NumPy vector", "report"),
    "Cap'n Proto": Wire("octree", "svo.capnp", "pycapnp, Data", "bulk"),
    "npz": Wire("octree", "svo.npz", "np.savez, np.load"),
    "glb": Wire("mesh", "glb", "trimesh"),
    "VDB": Wire("density", "vdb", "pyopenvdb"),
}
SCENES: dict[str, tuple[str, type]] = {
    "octree": ("octree.svo.npz", SparseVoxelOctree),
    "mesh": ("mesh.glb", Meshes),
    "density": ("density.vdb", Volume),
}


def put_scenes(folder: Path, octree: SparseVoxelOctree, edge: int) -> dict[str, str]:
    """Write each scene, and a small one of the same kind; return a description of the scenes."""
    told_of = {}
    for name, tree, n in (("", octree, edge), ("small_", cut_octree(octree, level=2), 2)):
        volume = build_vdb(tree, grids=("density",))
        scenes: dict[str, Any] = {"octree": tree, "mesh": Meshes((_sheet(n),)), "density": volume}
        for kind, (file, _) in SCENES.items():
            save(folder / f"{name}{file}", scenes[kind])
        dense = np.zeros(tree.size, np.float32)
        dense[tuple(volume.grids[0].topology.coords.T)] = volume.grids[0].values[:, 0]
        np.save(folder / f"{name}density.npy", dense)
        told_of[name] = f"octree: {tree}; mesh: {2 * n * n:,} triangles; density: {volume}"
    return {"scene": told_of[""]}


def _sheet(n: int) -> Mesh:
    """A curved square of n x n quads, with two triangles each."""
    x, y = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij")
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1)
    near, far = np.stack([corner, corner + 1], axis=1), np.stack([corner + n + 1, corner + n + 2], axis=1)
    faces = np.concatenate([np.c_[near, far[:, 1]], np.c_[near[:, 0], far[:, ::-1]]])
    positions = np.stack([x, y, x * y], axis=-1).reshape(-1, 3)
    return Mesh(positions.astype(np.float32), None, faces.astype(np.uint32))


def _ours(name: str, wire: Wire, folder: Path) -> Way:
    kind = SCENES[wire.scene][1]
    module = format_named(wire.form, kind.__name__).load_module()

    options = {"profile": wire.profile} if wire.profile else {}

    def write(scene: Any, path: Path) -> None:
        with path.open("wb") as file:
            file.writelines(module.encode(scene, **options))

    def read(path: Path) -> Arrays:
        return _arrays(module.decode(read_file(path)))

    def read_vectors(path: Path) -> Arrays:
        table = FlatTable.root(read_file(path))
        return table.array(4, "<i4"), table.array(5, "<f4")

    return Way(write, read_vectors if "vectors" in name else read)


def _library(name: str, wire: Wire, folder: Path) -> Way:
    if wire.library == "trimesh":
        return _trimesh()
    if wire.library.startswith("np."):
        return Way(lambda octree, path: np.savez(path, *_arrays(octree)), _np_load)
    (library,) = (library for library in LIBRARIES if library.name == wire.library)
    octree = _scene(wire.scene, folder)

    def write(scene: Any, path: Path) -> None:
        path.write_bytes(library.encode(scene))

    return Way(write, lambda path: library.decode(read_file(path), octree))


def _np_load(path: Path) -> Arrays:
    with np.load(path) as arrays:
        return [arrays[key] for key in arrays.files]


def _trimesh() -> Way:
    trimesh = import_module("trimesh")

    def write(scene: Any, path: Path) -> None:
        (mesh,) = scene.meshes
        path.write_bytes(trimesh.Trimesh(mesh.positions, mesh.faces, process=False).export(file_type="glb"))

    def read(path: Path) -> Arrays:
        (mesh,) = trimesh.load_scene(path, file_type="glb", process=False).geometry.values()
        return mesh.vertices, mesh.faces

    return Way(write, read)


def _arrays(scene: Any) -> Arrays:
    if isinstance(scene, SparseVoxelOctree):
        return scene.node_children, scene.node_data
    if isinstance(scene, Meshes):
        return scene.meshes[0].positions, scene.meshes[0].faces
    return (scene.grids[0].values,)


def _scene(kind: str, folder: Path, *, small: bool = False) -> Any:
    name, scene_type = SCENES[kind]
    return load(folder / f"{'small_' if small else ''}{name}", scene_type)


def writing(wire: str, ours: bool, folder: str) -> Work:
    """The work of writing the scene of a wire format; called in a child process."""
    home = Path(folder)
    target = _target(wire, ours, home)
    if WIRES[wire].library == "pyopenvdb" and not ours:
        return _openvdb("write", target, home)
    way = (_ours if ours else _library)(wire, WIRES[wire], home)
    scene, small = (_scene(WIRES[wire].scene, home, small=small) for small in (False, True))
    way.write(small, home / f"small_{target.name}")  # imports and compiles on first use
    _see(_arrays(scene))
    target.unlink(missing_ok=True)
    return Work(lambda: way.write(scene, target), lambda _: {})


def reading(wire: str, ours: bool, folder: str) -> Work:
    """The work of reading the file of writing(); called in a child process."""
    home = Path(folder)
    target = _target(wire, ours, home)
    if WIRES[wire].library == "pyopenvdb" and not ours:
        return _openvdb("read", target, home)
    way = (_ours if ours else _library)(wire, WIRES[wire], home)
    way.read(home / f"small_{target.name}")
    expected = _arrays(_scene(WIRES[wire].scene, home))

    def run() -> Arrays:
        arrays = way.read(target)
        _see(arrays)
        return arrays

    return Work(run, lambda found: {"exact": _same(found, expected)})


def _openvdb(direction: str, target: Path, home: Path) -> Work:
    command = ["/usr/bin/python3", "-c", _PYOPENVDB, direction, str(target), str(home / "density.npy")]

    def run() -> Any:
        done = subprocess.run(command, check=True, capture_output=True)
        return json.loads(done.stdout)

    return Work(run, dict)


def _target(wire: str, ours: bool, home: Path) -> Path:
    return home / f"{wire}_{'ours' if ours else 'library'}.{WIRES[wire].form}"


def _same(found: Arrays, expected: Arrays) -> bool:
    """True if all numbers are equal, whatever their shapes and types."""
    return all(np.array_equal(np.ravel(a), b.reshape(-1)) for a, b in zip(found, expected, strict=True))


def _see(arrays: Arrays) -> None:
    """Read every value; the cost is almost only the memory access."""
    for array in arrays:
        np.bitwise_xor.reduce(np.ascontiguousarray(array).reshape(-1).view(f"u{array.itemsize}"))


def row(wire: str, direction: str, rounds: list[tuple[Result, Result]]) -> list[Any]:
    """Return the cells of a wire format in one direction; rounds: nerfbake's results and the library's."""
    library = WIRES[wire].library
    if error := next((result.error for pair in rounds for result in pair if result.error), ""):
        return [f"{wire}: {error}", direction, library, *[None] * (len(COLUMNS) - 3)]
    # Figures that a program measured itself take precedence.
    figures = [[(r.facts.get("seconds", r.seconds), r.facts.get("peak", r.peak)) for r in pair] for pair in rounds]
    times = [Statistics.of([1e3 * pair[side][0] for pair in figures]) for side in (0, 1)]
    ratio = times[1].low / times[0].low
    peaks = [max(pair[side][1] for pair in figures) / 1e6 for side in (0, 1)]
    exact = all(result.facts.get("exact", True) for pair in rounds for result in pair)
    near = ratio <= NEAR and peaks[1] <= NEAR * max(peaks[0], 0.1)  # less than 0.1 MB is noise
    return [wire, direction, library, *times, ratio, *peaks, near, exact]


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    octree = build_octree(load(scenes.sample(SAMPLE), N3Tree))
    found: dict[tuple[str, str], list[tuple[Result, Result]]] = {}
    with tempfile.TemporaryDirectory(prefix="nerfbake-bench-") as folder:
        head = put_scenes(Path(folder), octree, EDGE)
        for turn in range(rounds + 1):
            for wire in WIRES:
                with announced(f"{wire}: {f'round {turn} of {rounds}' if turn else 'warming up'}"):
                    for direction, function in (("write", writing), ("read", reading)):
                        pair = [measure(function, wire=wire, ours=side, folder=folder) for side in (True, False)]
                        if turn:
                            found.setdefault((wire, direction), []).append((pair[0], pair[1]))
    head |= {"rounds": str(rounds), **environment(*PACKAGES)}
    table = Table("Wires", COLUMNS, [row(*key, pairs) for key, pairs in found.items()])
    return {"wires": [Report("Wire formats compared with their libraries", head, [table], NOTES)]}
