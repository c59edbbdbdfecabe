"""PlenVDB's folder: DirectVoxGO's checkpoint, whose grids stand beside it in .vdb files.

| file | content |
|---|---|
| fine_last.tar | what dvgo_model.py says: the box, the activation, the mask, the MLP |
| finedensity.vdb | one grid of floats: the raw density at every node, voxel (i, j, k) being node (i, j, k) |
| finecolor.vdb | grids of three floats without names, in the order of their numbers: features 0 to 2, 3 to 5, ... |
| mergedidxs.vdb | merged: one grid of floats, of each node where the mask is true the number of its row, from 1 |
| mergeddata.npz | merged: den (n + 1,) and col (n + 1, C), float16 or float32; row 0 zeros, all other nodes' |

Where both are there, the grids that were not merged are read: they have all digits. Source: PlenVDB (Yan et al., 2023)
and the files that its program writes; docs/formats/checkpoints.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.field.dvgo_model import Model, colour_of
from nerfbake.formats.field.plenvdb_grids import grids_file, nodes_of, rows_file
from nerfbake.formats.field.plenvdb_model import model_file
from nerfbake.formats.field.torch_model import every_node
from nerfbake.formats.volume import openvdb
from nerfbake.formats.wire.npz_reader import NpzReader
from nerfbake.formats.wire.npz_writer import write_npz
from nerfbake.kernels.arrays import Bits, Singles
from nerfbake.kernels.maths.casting import cast
from nerfbake.kernels.vdb.slots import origins_of
from nerfbake.scene.lattice_field import MAX_EDGE, Colour, LatticeField
from nerfbake.scene.vdb import VdbTree

_MODEL = "fine_last.tar"
_DENSITY, _COLOURS = "finedensity.vdb", "finecolor.vdb"
_ROWS, _TABLE = "mergedidxs.vdb", "mergeddata.npz"
_LEAVES = 1 << 10  # whose voxels are placed at a time
_EXACT = 1 << 24  # the last whole number up to which float32 has all of them
_WHOLE = f"{_MODEL}, and {_DENSITY} with {_COLOURS} or {_ROWS} with {_TABLE}"

Shape = tuple[int, int, int]
Files = Iterator[tuple[str, Iterable[bytes | memoryview]]]


def recognise(files: Mapping[str, memoryview]) -> bool:
    return any(one in files or other in files for one, other in ((_DENSITY, _COLOURS), (_ROWS, _TABLE)))


def decode(files: Mapping[str, memoryview]) -> LatticeField:
    """The lattice of a folder. Raises InvalidFile naming the file that is missing or wrong, MemoryLimit."""
    plain = [name in files for name in (_DENSITY, _COLOURS)]
    merged = not any(plain) or (not all(plain) and _ROWS in files and _TABLE in files)
    for name in (_MODEL, *((_ROWS, _TABLE) if merged else (_DENSITY, _COLOURS))):
        if name not in files:
            raise InvalidFile(Problem(name, "is missing", _WHOLE))
    with _within(_MODEL):
        model = Model(files[_MODEL])
        colour = colour_of(model)
    return _merged(files, model, colour) if merged else _plain(files, model, colour)


def encode(lattice: LatticeField, *, merged: bool = False) -> Files:
    """The folder. merged: values in float16, as rows for the nodes where the mask is true; else float32 for all nodes.

    Raises InvalidScene for a lattice that is none of PlenVDB's, and for values that float16 cannot hold.
    """
    yield _MODEL, [model_file(lattice)]
    with memory.scope():
        yield from _merged_files(lattice) if merged else _plain_files(lattice)


def _plain_files(lattice: LatticeField) -> Files:
    nodes, features = nodes_of(lattice.links), lattice.features
    yield _DENSITY, grids_file(nodes, 1, 1, lambda _: lattice.density[:, None])
    yield _COLOURS, grids_file(nodes, 3, features.shape[1] // 3, lambda k: features[:, 3 * k : 3 * k + 3])


def _merged_files(lattice: LatticeField) -> Files:
    mask = lattice.links >= 0 if lattice.occupied is None else lattice.occupied
    if mask.shape != lattice.shape:
        raise InvalidScene(Problem("the mask", f"has {mask.shape} nodes", f"{lattice.shape}, as the lattice has"))
    rows = lattice.links[mask]
    if len(rows) > _EXACT:
        found = f"has {len(rows):,} nodes where the mask is true"
        raise InvalidScene(Problem("the lattice", found, f"{_EXACT:,}, as float32 tells rows apart; or not merged"))
    memory.hold("the rows", 2 * (len(rows) + 1) * (1 + lattice.features.shape[1]))
    den, col = _in_rows(lattice.density, rows), _in_rows(lattice.features, rows)
    yield _ROWS, rows_file(mask)
    yield _TABLE, write_npz({"den": den, "col": col})


def _in_rows(values: npt.NDArray[Any], rows: npt.NDArray[np.int32]) -> npt.NDArray[np.float16]:
    """Row 0 zeros, then the values of these rows; zeros for one below 0. Raises InvalidScene."""
    held = rows >= 0
    out = np.zeros((len(rows) + 1, *values.shape[1:]), np.float16)
    out[1:][held] = cast(values[rows[held]], np.float16)
    if not np.isfinite(out).all():
        raise InvalidScene(Problem("the lattice", "holds values above 65504", "what float16 can hold, or not merged"))
    return out


def _plain(files: Mapping[str, memoryview], model: Model, colour: Colour) -> LatticeField:
    density_file, colour_file = files[_DENSITY], files[_COLOURS]  # which count for as long as the folder is held
    with _within(_DENSITY), memory.scope():
        (tree,) = _trees(density_file, channels=1, one=True)
        shape = _filled_shape(tree, "the grid")
        density = _room(1, shape)
        _scatter(tree, density)
    memory.hold("density", density.nbytes)
    with _within(_COLOURS), memory.scope():
        trees = _trees(colour_file, channels=3)
        if 3 * len(trees) != colour.features:
            found = f"has {len(trees)} grids of 3 channels"
            raise InvalidFile(Problem("the file", found, f"{colour.features} channels, as the model has"))
        features = _room(colour.features, shape)
        for number, tree in enumerate(trees):
            if (own := _filled_shape(tree, f"grid [{number}]")) != shape:
                raise InvalidFile(Problem(f"grid [{number}]", f"has {own} nodes", f"{shape}, as {_DENSITY} has"))
            _scatter(tree, features[3 * number : 3 * number + 3])
    memory.hold("colours", features.nbytes)
    rows = features.reshape(colour.features, -1).T  # each channel lies together, as in DirectVoxGO's own file
    links = every_node(shape)
    with _within(_MODEL):
        return model.lattice(links, density.reshape(-1), rows, colour, "PlenVDB")


def _merged(files: Mapping[str, memoryview], model: Model, colour: Colour) -> LatticeField:
    """Only nodes where the mask is true have rows: beside them are zeros, and nothing that is nearest to another."""
    with _within(_MODEL):
        mask = model.mask()
        if mask is None:
            raise InvalidFile(Problem("model_state_dict", "has no mask_cache.mask", f"the one that {_ROWS} is made by"))
    with _within(_TABLE):
        table = NpzReader(files[_TABLE])
        den = table.shaped("den", "f", (None,))
        if not len(den):
            raise InvalidFile(Problem("den", "has no rows", "one or more, the first of them zeros"))
        col = table.shaped("col", "f", (len(den), colour.features))
        memory.hold("den", 4 * len(den))
        density = cast(den, np.float32)
        if col.dtype != np.float16:
            memory.hold("col", 4 * col.size)
            col = cast(col, np.float32)
    with _within(_ROWS):
        links = _links(files[_ROWS], mask, len(den) - 1)
    with _within(_MODEL):
        return model.lattice(links, density, col, colour, "PlenVDB, merged")


def _links(view: memoryview, mask: Bits, n: int) -> npt.NDArray[np.int32]:
    """(X, Y, Z) to rows 1 to n, each once, where the mask is true; -1 elsewhere."""
    shape = _shape_of(mask)
    memory.hold("links", 4 * mask.size)
    with memory.scope():
        (tree,) = _trees(view, channels=1, one=True)
        memory.hold("the rows", 8 * len(tree.values))
        rows = cast(tree.active_values[:, 0], np.float64)
        sound = (rows >= 1) & (rows <= n) & (rows == np.floor(rows))
        if not sound.all():
            found = f"leads to row {rows[int(np.argmin(sound))]:g}"
            raise InvalidFile(Problem("the grid", found, f"whole numbers from 1 to {n:,}, the last row of {_TABLE}"))
        used = np.zeros(n + 1, bool)
        used[rows.astype(np.int64)] = True
        count = tree.active_topology.voxel_count
        if count != n or not used[1:].all():
            found = f"leads from {count:,} nodes to {np.count_nonzero(used):,} rows"
            allowed = f"to each of {n:,} rows from one node; float32 tells rows apart up to {_EXACT:,}"
            raise InvalidFile(Problem("the grid", found, allowed))
        box = tree.active_topology.box
        inside = box is None or (
            min(box[0]) >= 0 and all(high < edge for high, edge in zip(box[1], shape, strict=True))
        )
        grid = _room(1, shape)
        if inside:
            _scatter(tree, grid)
        if not inside or not np.array_equal(grid[0] > 0, mask):
            found = "has other nodes than those where mask_cache.mask is true"
            allowed = "the same ones; of lattices above 256^3 nodes PlenVDB's masks are smaller than they are"
            raise InvalidFile(Problem("the grid", found, allowed))
        links: npt.NDArray[np.int32] = grid[0].astype(np.int32)
        links[links == 0] = -1
    return links


# -- grids -----------------------------------------------------------------------------------------------------
def _trees(view: memoryview, *, channels: int, one: bool = False) -> list[VdbTree]:
    """All grids of a file, those without names in the order of their numbers."""
    volume = openvdb.decode(view)
    for problem in volume.unread:
        raise InvalidFile(problem)
    trees = [grid for grid in volume.grids if isinstance(grid, VdbTree) and grid.values.shape[1] == channels]
    if len(trees) != len(volume.grids) or (one and len(trees) > 1):
        held = ", ".join(str(grid.values.shape[1]) for grid in volume.grids[:20])
        found = f"has {len(volume.grids)} grids, of {held} channels"
        raise InvalidFile(Problem("the file", found, f"{'one' if one else 'grids'} of {channels}"))
    return trees


def _filled_shape(tree: VdbTree, what: str) -> Shape:
    """Of a grid that is active at every voxel from (0, 0, 0) to its last one."""
    topology = tree.active_topology
    box = topology.box
    if box is None or max(map(abs, (*box[0], box[1].max()))) >= MAX_EDGE:
        found = "has no voxels" if box is None else f"goes from {_text(box[0])} to {_text(box[1])}"
        raise InvalidFile(Problem(what, found, f"from (0, 0, 0), up to {MAX_EDGE:,} along an axis"))
    x, y, z = (int(high) + 1 for high in box[1])
    if box[0].any() or topology.voxel_count != x * y * z:
        found = f"is active at {topology.voxel_count:,} voxels from {_text(box[0])} to {_text(box[1])}"
        raise InvalidFile(Problem(what, found, "every voxel from (0, 0, 0) on"))
    return x, y, z


def _room(channels: int, shape: Shape) -> Singles:
    x, y, z = shape
    memory.hold("the lattice", 4 * channels * x * y * z)
    return np.zeros((channels, x, y, z), np.float32)


def _scatter(tree: VdbTree, grid: Singles) -> None:
    """Writes all active voxels and tiles, which must lie inside of it, into a grid (C, X, Y, Z)."""
    topology, values = tree.active_topology, tree.active_values
    origin, mask, begin = topology.leaf_origin, topology.leaf_mask, 0
    for first in range(0, len(mask), _LEAVES):
        at = origins_of(origin[first : first + _LEAVES], mask[first : first + _LEAVES], 3, 1)
        grid[:, at[:, 0], at[:, 1], at[:, 2]] = values[begin : begin + len(at)].T
        begin += len(at)
    for low, edge in topology.tile_cubes:
        step = max(1, (1 << 15) // edge**3)
        for first in range(0, len(low), step):
            x, y, z = (low[first : first + step, axis, None] + np.arange(edge) for axis in range(3))
            own = values[begin + first : begin + first + len(x)].T[:, :, None, None, None]
            grid[:, x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]] = own
        begin += len(low)


def _shape_of(mask: Bits) -> Shape:
    x, y, z = mask.shape
    return x, y, z


def _text(place: Any) -> str:
    return f"({', '.join(str(int(each)) for each in place)})"


@contextmanager
def _within(name: str) -> Iterator[None]:
    """Names the file in what is wrong with it."""
    try:
        yield
    except InvalidFile as error:
        if error.source is None:
            error.what = error.problem._replace(place=f"{name}: {error.problem.place}")
        raise
