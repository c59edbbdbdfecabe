"""PlenVDB's folders: the same as DirectVoxGO's file with the same numbers, merged ones too, and what is refused."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import LatticeField, load, memory_limit
from nerfbake.cli.main import run
from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.field import dvgo as whole
from nerfbake.formats.field import plenvdb as reader
from nerfbake.formats.volume import openvdb
from nerfbake.scene.lattice_field import MlpColour
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.vdb_topology import VdbTiles, VdbTopology
from nerfbake.scene.volume import Volume
from tests.support.lattices import SHAPE
from tests.support.n3trees import archive
from tests.support.plenvdb import (
    Files,
    grid_file,
    grids_of,
    merged,
    merged_folder,
    model_file,
    plenvdb,
    plenvdb_folder,
    written,
)
from tests.support.torch_files import dvgo, dvgo_file


def read(files: Files) -> LatticeField:
    return reader.decode({name: memoryview(data) for name, data in files.items()})


def assert_same(found: LatticeField, expected: LatticeField) -> None:
    """Bit for bit, but for the dialect."""
    assert found.features.dtype == expected.features.dtype
    for name in ("links", "density", "features", "box", "occupied"):
        assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    for name in ("activation", "at_corners", "least", "notes"):
        assert getattr(found, name) == getattr(expected, name), name
    assert str(found.colour) == str(expected.colour)
    if isinstance(found.colour, MlpColour) and isinstance(expected.colour, MlpColour):
        assert_array_equal(found.colour.first, expected.colour.first)


@pytest.mark.parametrize("mlp", ["random", "none"])
def test_a_folder_is_what_directvoxgos_file_is(mlp: str, tmp_path: Path) -> None:
    """The grids' order in finecolor.vdb is another than that of their numbers."""
    checkpoint = plenvdb(mlp=mlp)
    folder = written(tmp_path / "vdb_scene", plenvdb_folder(checkpoint))
    found = load(folder, LatticeField)
    assert_same(found, whole.decode(memoryview(dvgo_file(checkpoint))))
    assert found.dialect == "PlenVDB"
    assert run(["check", str(folder)]) == 0


def test_merged_rows_are_the_lattice_in_halves(tmp_path: Path) -> None:
    checkpoint = plenvdb()
    found = load(written(tmp_path / "vdb_scene", merged_folder(checkpoint)), LatticeField)
    expected = whole.decode(memoryview(dvgo_file(merged(checkpoint))))
    mask = checkpoint["model_state_dict"]["mask_cache.mask"]
    assert 0 < np.count_nonzero(mask) < mask.size
    assert_array_equal(found.links >= 0, mask)
    assert found.features.dtype == np.float16
    assert_array_equal(found.density[found.links[mask]], expected.density.reshape(SHAPE)[mask])
    assert_array_equal(found.features[found.links[mask]], expected.features.reshape(*SHAPE, -1)[mask])
    assert_array_equal(found.occupied, mask)
    assert_array_equal(found.box, expected.box)
    assert (found.activation, found.dialect) == (expected.activation, "PlenVDB, merged")


def test_merged_rows_may_be_floats_of_full_width() -> None:
    checkpoint = plenvdb()
    state, files = checkpoint["model_state_dict"], merged_folder(checkpoint)
    mask = state["mask_cache.mask"]
    den = np.append(np.float32(0), state["density.grid"][0, 0][mask])
    col = np.concatenate([np.zeros((1, 6), np.float32), state["k0.grid"][0][:, mask].T])
    found = read(files | {"mergeddata.npz": archive({"den": den, "col": col})})
    assert_array_equal(found.density, den)
    assert_array_equal(found.features, col)


def test_grids_that_are_not_merged_come_first() -> None:
    checkpoint = plenvdb()
    assert read(merged_folder(checkpoint) | plenvdb_folder(checkpoint)).dialect == "PlenVDB"


def test_a_tile_takes_no_more_memory_than_there_is() -> None:
    """One of 128^3, in a file of some kilobytes."""
    checkpoint = plenvdb(shape=(2, 2, 2))
    files = plenvdb_folder(checkpoint)
    with memory_limit(1 << 20), pytest.raises(MemoryLimit, match="the lattice needs"):
        read(files | {"finedensity.vdb": _tile()})
    with pytest.raises(InvalidFile, match=r"grid \[0\] has \(2, 2, 2\) nodes; allowed: \(128, 128, 128\)"):
        read(files | {"finedensity.vdb": _tile()})


def _tile() -> bytes:
    upper = np.zeros((1, 512), np.uint64)
    tiles = VdbTiles(np.zeros((0, 64), np.uint64), upper.copy(), np.zeros((0, 3), np.int32))
    tiles.upper_mask[0, 0] = 1
    empty = np.zeros((0, 64), np.uint64), np.zeros((0, 8), np.uint64)
    topology = VdbTopology(np.zeros((1, 3), np.int32), upper, *empty, tiles)
    tree = VdbTree("", topology, np.full((1, 1), 2, np.float32), np.zeros(1, np.float32))
    return b"".join(openvdb.encode(Volume((tree,), np.eye(4)[:3])))


# -- OpenVDB itself --------------------------------------------------------------------------------------------
_WRITE = """
import sys, numpy, pyopenvdb as vdb
arrays = numpy.load(sys.argv[1] + "/arrays.npz")
def grid(kind, array, zero):
    made = kind()
    made.fill((0, 0, 0), tuple(edge - 1 for edge in array.shape[:3]), zero)
    made.copyFromArray(numpy.ascontiguousarray(array))
    made.prune(zero)
    return made
density, features = arrays["density"], arrays["features"]
vdb.write(sys.argv[1] + "/finedensity.vdb", grids=[grid(vdb.FloatGrid, density, 0.0)])
colours = [grid(vdb.Vec3SGrid, features[..., i:i + 3], (0.0,) * 3) for i in range(0, features.shape[3], 3)]
vdb.write(sys.argv[1] + "/finecolor.vdb", grids=colours)
rows = vdb.FloatGrid()
rows.copyFromArray(arrays["rows"])
vdb.write(sys.argv[1] + "/mergedidxs.vdb", grids=[rows])
"""


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """A checkpoint whose lattice has blocks of zeros, and its grids as OpenVDB's own Python writes them."""
    folder = tmp_path_factory.mktemp("plenvdb")
    checkpoint = plenvdb(shape=(17, 9, 26))
    state = checkpoint["model_state_dict"]
    for key in ("density.grid", "k0.grid"):
        state[key][:, :, :, :8, 8:24] = 0
    rows = np.zeros(state["mask_cache.mask"].shape)
    rows[state["mask_cache.mask"]] = np.arange(1, np.count_nonzero(state["mask_cache.mask"]) + 1)
    features = np.moveaxis(state["k0.grid"][0], 0, -1)
    np.savez(folder / "arrays.npz", density=state["density.grid"][0, 0], features=features, rows=rows)
    subprocess.run(["/usr/bin/python3", "-c", _WRITE, str(folder)], check=True, timeout=60)
    return checkpoint, folder


@pytest.mark.tools
def test_openvdbs_own_files_are_read_with_their_tiles(theirs: tuple[dict[str, Any], Path]) -> None:
    checkpoint, folder = theirs
    names = ("finedensity.vdb", "finecolor.vdb")
    files = {name: (folder / name).read_bytes() for name in names} | {"fine_last.tar": model_file(checkpoint)}
    for name in names:
        for grid in openvdb.decode(memoryview(files[name])).grids:
            assert sum(grid.topology.tile_counts), name
    assert_same(read(files), whole.decode(memoryview(dvgo_file(checkpoint))))


@pytest.mark.tools
def test_openvdbs_own_merged_grid_is_read(theirs: tuple[dict[str, Any], Path]) -> None:
    checkpoint, folder = theirs
    ours = merged_folder(checkpoint)
    found = read(ours | {"mergedidxs.vdb": (folder / "mergedidxs.vdb").read_bytes()})
    assert_same(found, read(ours))


# -- what is refused -------------------------------------------------------------------------------------------
CHECKPOINT = plenvdb()
DENSITY, COLOURS = grids_of(CHECKPOINT)
MASK = CHECKPOINT["model_state_dict"]["mask_cache.mask"]
ROWS = np.where(MASK, np.cumsum(MASK).reshape(SHAPE), 0).astype(np.float32)[..., None]
N = int(np.count_nonzero(MASK))


def without(name: str) -> Callable[[Files], None]:
    def change(files: Files) -> None:
        del files[name]

    return change


def but(name: str, data: bytes) -> Callable[[Files], None]:
    return lambda files: files.update({name: data})


def changed(grid: Any, place: tuple[int, ...], value: float) -> Any:
    grid = grid.copy()
    grid[place] = value
    return grid


def model_without(key: str) -> bytes:
    checkpoint = plenvdb()
    del checkpoint["model_state_dict"][key]
    return model_file(checkpoint)


FULL = np.ones(SHAPE, bool)
MOVED = np.pad(DENSITY, ((1, 0), (0, 0), (0, 0), (0, 0)))
LIES: dict[str, tuple[Callable[[Files], None], str]] = {
    "no model": (without("fine_last.tar"), "fine_last.tar is missing; allowed: fine_last.tar, and finedensity.vdb"),
    "no colours": (without("finecolor.vdb"), "finecolor.vdb is missing"),
    "no density": (without("finedensity.vdb"), "finedensity.vdb is missing"),
    "no shift": (but("fine_last.tar", dvgo_file(dvgo(mlp="none", dialect="early"))), "finecolor.vdb: the file has 2"),
    "another file": (but("fine_last.tar", b"no zip"), "fine_last.tar: file is not a complete zip archive"),
    "NDC": (but("fine_last.tar", dvgo_file(plenvdb() | {"model_kwargs": {"mpi_depth": 3}})),
            "fine_last.tar: model_kwargs has mpi_depth: a forward-facing scene (NDC)"),
    "no box": (but("fine_last.tar", model_without("xyz_min")), "fine_last.tar: model_state_dict has no xyz_min"),
    "no grid": (but("finedensity.vdb", b"x" * 200), "finedensity.vdb: the file starts with"),
    "cut": (lambda files: files.update({"finedensity.vdb": files["finedensity.vdb"][:-9]}), "finedensity.vdb: "),
    "two densities": (but("finedensity.vdb", grid_file(DENSITY, DENSITY)), "finedensity.vdb: the file has 2 grids"),
    "a colour": (but("finedensity.vdb", grid_file(COLOURS[0])), "finedensity.vdb: the file has 1 grids, of 3"),
    "no colour": (but("finecolor.vdb", grid_file(DENSITY)), "finecolor.vdb: the file has 1 grids, of 1"),
    "fewer colours": (but("finecolor.vdb", grid_file(COLOURS[0])),
                      "finecolor.vdb: the file has 1 grids of 3 channels; allowed: 6 channels"),
    "a hole": (but("finedensity.vdb", grid_file(DENSITY, at=changed(FULL, (2, 3, 4), 0))),
               "finedensity.vdb: the grid is active at 209 voxels from (0, 0, 0) to (4, 5, 6); allowed: every voxel"),
    "a gap": (but("finedensity.vdb", grid_file(MOVED, at=np.pad(FULL, ((1, 0), (0, 0), (0, 0))))),
              "finedensity.vdb: the grid is active at 210 voxels from (1, 0, 0)"),
    "no voxels": (but("finedensity.vdb", grid_file(DENSITY, at=~FULL)), "finedensity.vdb: the grid has no voxels"),
    "far away": (but("finedensity.vdb", grid_file(np.zeros((1, 1, 4097, 1)))), "to (0, 0, 4096); allowed: from"),
    "other nodes": (but("finecolor.vdb", grid_file(COLOURS[0], COLOURS[1][:4])),
                    "finecolor.vdb: grid [1] has (4, 6, 7) nodes; allowed: (5, 6, 7), as finedensity.vdb"),
    "a NaN": (but("finedensity.vdb", grid_file(changed(DENSITY, (0, 0, 0), np.nan))), "density[0] is nan"),
    "too thin": (lambda files: files.update(plenvdb_folder(plenvdb(shape=(1, 3, 4)))), "links has shape (1, 3, 4)"),
}  # fmt: skip
EACH_ONCE = f"allowed: one node for each of {N} rows; float32 can represent row numbers up to 16,777,216"
MERGED_LIES: dict[str, tuple[Callable[[Files], None], str]] = {
    "no rows": (without("mergedidxs.vdb"), "mergedidxs.vdb is missing" ),
    "no table": (without("mergeddata.npz"), "mergeddata.npz is missing"),
    "no mask": (but("fine_last.tar", model_without("mask_cache.mask")), "has no mask_cache.mask; allowed: the mask"),
    "no den": (but("mergeddata.npz", archive({"col": np.zeros((3, 6))})), "mergeddata.npz: npz has no den"),
    "an empty den": (but("mergeddata.npz", archive({"den": np.zeros(0), "col": np.zeros((0, 6))})), "den has no rows"),
    "whole numbers": (but("mergeddata.npz", archive({"den": np.zeros(3, int), "col": np.zeros((3, 6))})), "den has dt"),
    "a narrow col": (but("mergeddata.npz", archive({"den": np.zeros(3), "col": np.zeros((3, 5))})), "col has dtype"),
    "fewer rows": (but("mergeddata.npz", archive({"den": np.zeros(N), "col": np.zeros((N, 6))})),
                   f"points to row {N}; allowed: whole numbers from 1 to {N - 1}, the last row of mergeddata.npz"),
    "more rows": (but("mergeddata.npz", archive({"den": np.zeros(N + 2), "col": np.zeros((N + 2, 6))})),
                  f"mergedidxs.vdb: the grid points from {N} nodes to {N} rows; allowed: one node for each of {N + 1}"),
    "half a row": (but("mergedidxs.vdb", grid_file(ROWS + 0.5, at=MASK)), "mergedidxs.vdb: the grid points to row 1.5"),
    "row 0": (but("mergedidxs.vdb", grid_file(ROWS - 1, at=MASK)), "the grid points to row 0"),
    "row NaN": (but("mergedidxs.vdb", grid_file(ROWS * np.nan, at=MASK)), "the grid points to row nan"),
    "a signalling NaN": (but("mergedidxs.vdb", grid_file(np.full_like(ROWS, 0x7FA00000, np.uint32).view(np.float32),
                                                         at=MASK)), "the grid points to row nan"),
    "a row twice": (but("mergedidxs.vdb", grid_file(np.maximum(ROWS, 2), at=MASK)), EACH_ONCE),
    "another mask": (but("mergedidxs.vdb", grid_file(ROWS[::-1], at=MASK[::-1])),
                     "mergedidxs.vdb: the grid has nodes other than those where mask_cache.mask is true; allowed: the "
                     "same nodes; above 256^3 nodes"),
    "below 0": (lambda files: files.update({"mergedidxs.vdb": _moved_down()}), "the grid has nodes other than"),
    "beyond": (but("mergedidxs.vdb", grid_file(np.pad(ROWS, ((9, 0), (0, 0), (0, 0), (0, 0))),
                                               at=np.pad(MASK, ((9, 0), (0, 0), (0, 0))))), "has nodes other than"),
}  # fmt: skip


def _moved_down() -> bytes:
    """Eight voxels down along y, where NumPy would take the last ones."""
    below = (0, 0), (4096, 0), (0, 0)
    data = grid_file(np.pad(ROWS, (*below, (0, 0))), at=np.pad(MASK, below))
    volume = openvdb.decode(memoryview(data))
    (tree,) = volume.grids
    assert isinstance(tree, VdbTree)
    low = tree.topology.root_origin - np.array([0, 8192, 0], np.int32)
    moved = replace(tree, topology=replace(tree.topology, root_origin=low))
    return b"".join(openvdb.encode(replace(volume, grids=(moved,))))


def refused(folder: Path, files: Files, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that check prints of a folder, and that svo says of it."""
    written(folder, files)
    assert run(["check", str(folder)]) == 1
    capsys.readouterr()
    assert run(["svo", str(folder), str(folder.with_name("out.svo.pb")), "-q"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {folder}: ")
    assert not folder.with_name("out.svo.pb").exists()
    return line


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_folder_is_refused(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, expected = LIES[lie]
    files = plenvdb_folder(CHECKPOINT)
    change(files)
    assert expected in refused(tmp_path / "bad", files, capsys)


@pytest.mark.parametrize("lie", MERGED_LIES)
def test_a_lying_merged_folder_is_refused(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, expected = MERGED_LIES[lie]
    files = merged_folder(CHECKPOINT)
    change(files)
    assert expected in refused(tmp_path / "bad", files, capsys)


def test_its_checkpoint_alone_is_told_where_its_grids_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "fine_last.tar").write_bytes(model_file(CHECKPOINT))
    assert run(["info", str(tmp_path / "fine_last.tar")]) == 1
    said = "has density_type VDBGrid: a PlenVDB model, whose grids are in other files of its folder; allowed:"
    assert said in capsys.readouterr().err
