"""A fitted field in every structure that PlenVDB's table 4 compares: its file's size, what it shows, and how fast."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import nerfbake
from nerfbake import io
from nerfbake.bench.measure import Statistics, measure
from nerfbake.bench.progress import Progress
from nerfbake.bench.render import rendering
from nerfbake.errors import NerfbakeError
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.views import Views

EDGE = 400  # pixels of the frames that are timed, one ray each
FRAMES = 4  # of the cameras that judge
COLUMNS = ["structure", "R", "MB", "PSNR dB", "change dB", "ms a frame", "frames a second"]
NOTES = [
    "Grids of their own: the density and the coefficients of each basis function, a tree for each, as OpenVDB has "
    "them. Merged: one tree of indices, and a table with all values of a voxel. Compressed: NanoVDB's zip.",
    "R: the finest lattice, where nothing is lost and a wide cell is eight voxels; then the wide cells' own lattice, "
    "where the cells that were split are means. change: of the PSNR, against the file that fit wrote.",
    f"ms a frame: {EDGE}x{EDGE}, one ray a pixel, from the written file; median [min..max] over rounds.",
]


class Structure(NamedTuple):
    """A way to write the voxels: grids and half as build_vdb() has them."""

    name: str
    ending: str
    grids: tuple[str, ...]
    half: bool = False
    codec: str = "none"


STRUCTURES = (
    Structure("grids of their own", ".vdb", ("density", "sh")),
    Structure("merged", ".nvdb", ("index",)),
    Structure("merged, float16", ".nvdb", ("index",), half=True),
    Structure("merged, float16, compressed", ".nvdb", ("index",), half=True, codec="zip"),
)


class Judges(NamedTuple):
    """views: what judges, in pictures of samples x samples rays a pixel; cameras: the file of those that are timed."""

    views: Views
    samples: int
    cameras: str

    def psnr(self, path: Path) -> float:
        """dB, the mean over the views, of a scene as it was written."""
        errors = nerfbake.measure_views(nerfbake.build_field(io.load(path)), self.views, samples=self.samples)
        return sum(error.psnr for error in errors) / len(errors)


def structure_rows(fitted: Path, judges: Judges, folder: Path, *, rounds: int, progress: Progress) -> list[list[Any]]:
    """A row for each structure and resolution of a PlenOctree that fit wrote; one that does not fit says so."""
    with progress(f"judging {fitted.name}"):
        octree = nerfbake.build_octree(io.load(fitted, nerfbake.N3Tree))
        edge, own = max(octree.size), judges.psnr(fitted)
        rows = [["PlenOctree, as fit wrote it", edge, *_figures(fitted, fitted.stat().st_size, own, judges, rounds)]]
    coarse = nerfbake.cut_octree(octree, level=octree.grid_level - 1)
    for tree in (octree, coarse):
        for structure in STRUCTURES:
            path, edge = folder / f"structure{structure.ending}", max(tree.size)
            with progress(f"{structure.name}, R = {edge}"):
                try:
                    size = _written(structure, tree, path)
                    rows.append([structure.name, edge, *_figures(path, size, own, judges, rounds)])
                except NerfbakeError as error:
                    rows.append([f"{structure.name}: {error.line}", edge, *[None] * (len(COLUMNS) - 2)])
    return rows


def _written(structure: Structure, octree: SparseVoxelOctree, path: Path) -> int:
    """The file's size in bytes."""
    volume = nerfbake.build_vdb(octree, grids=structure.grids, half=structure.half)
    return io.save(path, volume, force=True, codec=structure.codec)


def _figures(path: Path, size: int, own: float, judges: Judges, rounds: int) -> list[Any]:
    """What stands behind the resolution of a file; own: dB of what fit wrote."""
    seen = judges.psnr(path)
    return [size / 1e6, f"{seen:.2f}", f"{seen - own:.2f}", *_frames(path, judges, rounds)]


def _frames(path: Path, judges: Judges, rounds: int) -> list[Any]:
    """Milliseconds a frame and frames a second, in a process of its own."""
    arguments = {"path": str(path), "cameras": judges.cameras, "edge": EDGE, "lookup": "nearest"}
    found = [measure(rendering, truth=f"{path}.frames.npy", **arguments) for _ in range(rounds)]
    if found[0].error:
        return [found[0].error, None]
    frame = Statistics.of([1e3 * result.seconds / result.facts["frames"] for result in found])
    return [frame, 1e3 / frame.median]
