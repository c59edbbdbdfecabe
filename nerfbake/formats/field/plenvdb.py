"""Read and write PlenVDB folders: a DirectVoxGO checkpoint with its grids in .vdb files.

| file | content |
|---|---|
| fine_last.tar | the checkpoint that dvgo.py reads: the box, the activation, the mask, the MLP |
| finedensity.vdb | one grid of floats: the raw density at every node; voxel (i, j, k) is node (i, j, k) |
| finecolor.vdb | grids of three floats without names, in the order of their numbers: features 0 to 2, 3 to 5, ... |
| mergedidxs.vdb | merged: one grid of floats, the row number (from 1) of each node where the mask is true |
| mergeddata.npz | merged: den (n + 1,) and col (n + 1, C), float16 or float32; row 0 is zeros, for all other nodes |

If a folder contains both, the grids that are not merged are read, because they have full precision.

A grid that PlenVDB has trained is active at every node, in leaves of 8^3 voxels. When PlenVDB reads a grid, it merges
leaves of equal voxels into tiles, and it would write them as tiles. nerfbake writes a block in which no node has a row
as a tile of zeros from the start. An empty lattice then takes kilobytes instead of 4 bytes for each channel and node.

PlenVDB creates its model from `model_kwargs`, before it reads the grids. It accepts `model_state_dict` only if it has
the same keys as that model: the entries that dvgo.py reads, the corners of the grids and the scale of the mask. PlenVDB
computes the number of nodes along an axis from the box and `num_voxels`: edge of the box / v, rounded down, where v^3
is the box's volume / num_voxels. Keys: docs/formats/checkpoints.md. Source: PlenVDB (Yan et al., 2023), and the files
that its program writes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem, within
from nerfbake.formats.field.dvgo import DvgoModel, colour_of
from nerfbake.formats.field.torch_model import every_node
from nerfbake.formats.volume import openvdb
from nerfbake.formats.volume.openvdb import file_of
from nerfbake.formats.wire.npz import NpzReader, write_npz
from nerfbake.formats.wire.torch_writer import numpy_array, ordered, torch_file
from nerfbake.kernels.arrays import Bits, Floats, Singles
from nerfbake.kernels.maths.elementary import cast, exp, power
from nerfbake.kernels.vdb.bitmask import bits_kept, origins_of, words_of
from nerfbake.scene.lattice_field import MAX_EDGE, Colour, LatticeField, MlpColour, RgbColour
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.vdb_topology import VdbTiles, VdbTopology, topology_of, topology_of_leaves
from nerfbake.scene.volume import Transform

_IDENTITY = np.eye(4)[:3]
_LEAF = 8  # voxels along an edge
Links = npt.NDArray[np.int32]
Pieces = Iterator[bytes | memoryview]


class LatticeNodes(NamedTuple):
    """The nodes of a lattice as voxels and tiles of a VDB tree.

    rows (count,): the lattice row of each grid value, -1 for nodes without a row
    """

    topology: VdbTopology
    rows: Links


def nodes_of(links: Links) -> LatticeNodes:
    """Return the VDB tree over the nodes of links (X, Y, Z). Raises MemoryLimit."""
    blocks = tuple(-(-edge // _LEAF) for edge in links.shape)
    whole = [(0, blocks[axis] * _LEAF - links.shape[axis]) for axis in range(3)]
    memory.hold("the nodes as voxels", 2 * links.size)
    inside = _blocks(np.pad(np.ones(links.shape, bool), whole))
    linked = _blocks(np.pad(links >= 0, whole))
    low = np.stack(np.unravel_index(np.arange(len(inside)), blocks), axis=1) * _LEAF
    topology, order = topology_of_leaves(low, words_of(inside))
    # Blocks become leaves if they have a node with a row or extend beyond the box, otherwise tiles.
    leaf: Bits = np.asarray(linked.any(axis=1) | ~inside.all(axis=1))[order]
    none = np.zeros_like(topology.upper_mask), np.zeros((0, 3), np.int32)
    tiles = VdbTiles(bits_kept(topology.lower_mask, ~leaf), *none)
    masks = topology.upper_mask, bits_kept(topology.lower_mask, leaf), topology.leaf_mask[leaf]
    topology = VdbTopology(topology.root_origin, *masks, tiles)
    memory.hold("the nodes as voxels", 20 * topology.m)
    rows = np.full(topology.count, -1, np.int32)
    rows[: topology.m] = links[tuple(topology.coords.T)]
    return LatticeNodes(topology, rows)


def _blocks(nodes: Bits) -> Bits:
    """Split an array whose edges are multiples of 8 into blocks of 8^3 voxels, (b, 512)."""
    x, y, z = (edge // _LEAF for edge in nodes.shape)
    return nodes.reshape(x, _LEAF, y, _LEAF, z, _LEAF).transpose(0, 2, 4, 1, 3, 5).reshape(x * y * z, -1)


def grids_file(
    nodes: LatticeNodes, channels: int, count: int, columns: Callable[[int], npt.NDArray[np.generic]]
) -> Pieces:
    """Write a file of `count` grids of 1 or 3 channels.

    columns(k) returns the values (n, channels) of grid k. It is called when grid k is written.
    """

    def trees() -> Iterator[tuple[VdbTree, Transform]]:
        linked = nodes.rows >= 0
        for k in range(count):
            with memory.lent("a grid's values", 4 * channels * len(nodes.rows)):
                values = np.zeros((len(nodes.rows), channels), np.float32)
                values[linked] = columns(k)[nodes.rows[linked]]
                yield _unnamed(k, nodes.topology, values), _IDENTITY

    return file_of(trees(), count)


def rows_file(mask: Bits) -> Pieces:
    """Write mergedidxs.vdb: the row numbers of all nodes where the mask is true, from 1, x-major."""
    coords = np.argwhere(mask)
    topology, order = topology_of(coords)
    values = (order[:, None] + 1).astype(np.float32)
    return file_of([(_unnamed(0, topology, values), _IDENTITY)], 1)


def _unnamed(k: int, topology: VdbTopology, values: Singles) -> VdbTree:
    """Return a grid without a name. OpenVDB stores its number after a byte that cannot occur in names."""
    return VdbTree(f"\x1e{k}", topology, values, np.zeros(values.shape[1], np.float32), "unknown")


_TOLERANCE = 1e-9  # relative tolerance when a number of voxels is rounded to an integer
_CLEAR = 1e-4  # in nodes: distance to the next integer, so that PlenVDB's rounding errors cannot change the count

Dictionary = dict[str, Any]


def model_file(lattice: LatticeField) -> bytes:
    """Encode fine_last.tar. Raises InvalidScene for a lattice that PlenVDB cannot represent."""
    _require(lattice)
    low, high = lattice.box.astype(np.float32)
    mask = np.ones(lattice.shape, bool) if lattice.occupied is None else np.ascontiguousarray(lattice.occupied)
    scale = (np.array(mask.shape, np.float32) - 1) / (high - low)
    settings, layers = _colour(lattice.colour)
    state: Dictionary = {
        "xyz_min": low,
        "xyz_max": high,
        "act_shift": np.array([lattice.activation.shift], np.float32),
        "density.xyz_min": low,
        "density.xyz_max": high,
        "k0.xyz_min": low,
        "k0.xyz_max": high,
        **layers,
        "mask_cache.mask": mask,
        "mask_cache.xyz2ijk_scale": scale,
        "mask_cache.xyz2ijk_shift": -low * scale,
    }
    root = {
        "global_step": 0,
        "model_kwargs": {**_grids(lattice), **settings, "mask_cache_world_size": list(mask.shape)},
        "model_state_dict": ordered(state),
        "optimizer_state_dict": None,
        "time_recoder": [],
    }
    return torch_file(root, prefix="fine_last")


def _require(lattice: LatticeField) -> None:
    colour = lattice.colour
    if not isinstance(colour, MlpColour | RgbColour) or (isinstance(colour, MlpColour) and colour.encoded):
        raise InvalidScene(
            Problem("the lattice", f"has colours of {colour}", "RGB, or an MLP of features and directions")
        )
    if colour.features % 3:
        raise InvalidScene(Problem("the lattice", f"has {colour.features} features", "a multiple of 3"))
    if lattice.activation.kind != "softplus" or not lattice.at_corners or lattice.mask_box is not None:
        found = f"is from {lattice.dialect or 'another program'}"
        raise InvalidScene(
            Problem(
                "the lattice",
                found,
                "softplus of raw densities, nodes at the corners of the box, the mask on the same box",
            )
        )


def _grids(lattice: LatticeField) -> Dictionary:
    """Return the settings that define the positions of the nodes and the scale of the densities."""
    low, high = lattice.box.astype(np.float32)
    edges = high.astype(np.float64) - low
    volume, scale = float(np.prod(edges)), lattice.activation.scale
    base, count = volume * scale**3, _count(edges, lattice.shape)
    whole = round(base)
    return {
        "xyz_min": numpy_array(low),
        "xyz_max": numpy_array(high),
        "num_voxels": count,
        "num_voxels_base": whole if abs(base - whole) <= _TOLERANCE * base else base,
        "alpha_init": float(1 - 1 / (1 + exp(lattice.activation.shift))),
        "voxel_size_ratio": np.float32(float(power(volume / count, 1 / 3)) * scale),
        "mask_cache_path": None,
        "mask_cache_thres": 1e-3,
        "fast_color_thres": float(lattice.least),
        "density_type": "VDBGrid",
        "k0_type": "VDBGrid",
        "density_config": {},
        "k0_config": {},
    }


def _count(edges: Floats, shape: tuple[int, int, int]) -> int:
    """Return a num_voxels in the middle of the range that results in this number of nodes along each axis."""
    nodes = np.array(shape)
    v = np.sqrt(float((edges / (nodes + 1)).max()) * float((edges / nodes).min()))
    count = max(round(float(np.prod(edges)) / float(v) ** 3), 1)
    found = edges / float(power(float(np.prod(edges)) / count, 1 / 3))
    if not ((found >= nodes + _CLEAR) & (found <= nodes + 1 - _CLEAR)).all():
        counts, box = "x".join(map(str, shape)), " x ".join(f"{edge:g}" for edge in edges)
        allowed = "the same node spacing on each axis, no edge half as long as another"
        raise InvalidScene(Problem("the lattice", f"has {counts} nodes over {box}", allowed))
    return count


def _colour(colour: Colour) -> tuple[Dictionary, Dictionary]:
    """Return the settings and the state of the MLP.

    torch numbers the layers 0, 2, 3, ...; the middle ones have a second number: 2.0, 3.0, ...
    """
    if not isinstance(colour, MlpColour):
        return {"rgbnet_dim": 0}, {}
    depth = len(colour.middle) + 2
    settings = {
        "rgbnet_dim": colour.features,
        "rgbnet_direct": colour.direct,
        "rgbnet_full_implicit": False,
        "rgbnet_depth": depth,
        "rgbnet_width": len(colour.first),
        "viewbase_pe": len(colour.frequencies),
    }
    between = zip(colour.middle, colour.middle_bias, strict=True)
    layers = {"0": (colour.first, colour.first_bias)}
    layers |= {f"{number}.0": pair for number, pair in enumerate(between, 2)}
    layers[str(depth)] = colour.last, colour.last_bias
    state: Dictionary = {"viewfreq": np.array(colour.frequencies, np.float32)}
    for name, (weight, bias) in layers.items():
        state |= {f"rgbnet.{name}.weight": weight, f"rgbnet.{name}.bias": bias}
    return settings, state


_MODEL = "fine_last.tar"
_DENSITY, _COLOURS = "finedensity.vdb", "finecolor.vdb"
_ROWS, _TABLE = "mergedidxs.vdb", "mergeddata.npz"
FILES = re.compile("|".join(map(re.escape, (_MODEL, _DENSITY, _COLOURS, _ROWS, _TABLE))))
_LEAVES = 64  # leaves whose voxels are scattered at once: 2 MB of indices
_EXACT = 1 << 24  # float32 represents all integers up to this one
_ALLOWED = f"{_MODEL}, and {_DENSITY} with {_COLOURS} or {_ROWS} with {_TABLE}"

Shape = tuple[int, int, int]
Files = Iterator[tuple[str, Iterable[bytes | memoryview]]]


def recognise(files: Mapping[str, memoryview]) -> bool:
    return any(one in files or other in files for one, other in ((_DENSITY, _COLOURS), (_ROWS, _TABLE)))


def decode(files: Mapping[str, memoryview]) -> LatticeField:
    """Return the lattice of a folder. Raises InvalidFile with the name of a missing or wrong file, MemoryLimit."""
    plain = [name in files for name in (_DENSITY, _COLOURS)]
    merged = not any(plain) or (not all(plain) and _ROWS in files and _TABLE in files)
    for name in (_MODEL, *((_ROWS, _TABLE) if merged else (_DENSITY, _COLOURS))):
        if name not in files:
            raise InvalidFile(Problem(name, "is missing", _ALLOWED))
    with within(_MODEL):
        model = DvgoModel(files[_MODEL])
        colour = colour_of(model)
    return _merged(files, model, colour) if merged else _plain(files, model, colour)


def encode(lattice: LatticeField, *, merged: bool = False) -> Files:
    """Encode a folder.

    merged: write float16 rows for the nodes where the mask is true, instead of float32 values for all nodes.
    Raises InvalidScene for a lattice that PlenVDB cannot represent, and for values beyond the range of float16.
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
        raise InvalidScene(Problem("the mask", f"has {mask.shape} nodes", f"{lattice.shape}, as the lattice"))
    rows = lattice.links[mask]
    if len(rows) > _EXACT:
        found = f"has {len(rows):,} nodes where the mask is true"
        raise InvalidScene(
            Problem("the lattice", found, f"{_EXACT:,}, the row numbers that float32 can represent, or not merged")
        )
    memory.hold("the rows", 2 * (len(rows) + 1) * (1 + lattice.features.shape[1]))
    den, col = _in_rows(lattice.density, rows), _in_rows(lattice.features, rows)
    yield _ROWS, rows_file(mask)
    yield _TABLE, write_npz({"den": den, "col": col})


def _in_rows(values: npt.NDArray[Any], rows: npt.NDArray[np.int32]) -> npt.NDArray[np.float16]:
    """Gather rows as float16 after a row 0 of zeros; rows below 0 become zeros. Raises InvalidScene."""
    linked = rows >= 0
    out = np.zeros((len(rows) + 1, *values.shape[1:]), np.float16)
    out[1:][linked] = cast(values[rows[linked]], np.float16)
    if not np.isfinite(out).all():
        raise InvalidScene(
            Problem("the lattice", "contains values above 65504", "values that float16 can represent, or not merged")
        )
    return out


def _plain(files: Mapping[str, memoryview], model: DvgoModel, colour: Colour) -> LatticeField:
    density_file, colour_file = (
        files[_DENSITY],
        files[_COLOURS],
    )  # these count towards the memory limit while the folder is in memory
    with within(_DENSITY), memory.scope():
        (tree,) = _trees(density_file, channels=1, one=True)
        shape = _filled_shape(tree, "the grid")
        density = _zeros(1, shape)
        _scatter(tree, density)
        del tree  # the memory of the scope
    memory.hold("density", density.nbytes)
    with within(_COLOURS), memory.scope():
        trees = _trees(colour_file, channels=3)
        if 3 * len(trees) != colour.features:
            found = f"has {len(trees)} grids of 3 channels"
            raise InvalidFile(Problem("the file", found, f"{colour.features} channels, as the model"))
        features = _zeros(colour.features, shape)
        for number, tree in enumerate(trees):
            if (found_shape := _filled_shape(tree, f"grid [{number}]")) != shape:
                raise InvalidFile(Problem(f"grid [{number}]", f"has {found_shape} nodes", f"{shape}, as {_DENSITY}"))
            _scatter(tree, features[3 * number : 3 * number + 3])
        del tree, trees
    memory.hold("colours", features.nbytes)
    rows = features.reshape(colour.features, -1).T  # each channel is contiguous, as in DirectVoxGO's checkpoint
    links = every_node(shape)
    with within(_MODEL):
        return model.lattice(links, density.reshape(-1), rows, colour, "PlenVDB")


def _merged(files: Mapping[str, memoryview], model: DvgoModel, colour: Colour) -> LatticeField:
    """Read a merged folder. Only nodes where the mask is true have rows.

    The values at all other nodes are zero, and samples nearest to these nodes do not count.
    """
    with within(_MODEL):
        mask = model.mask()
        if mask is None:
            raise InvalidFile(Problem("model_state_dict", "has no mask_cache.mask", f"the mask that {_ROWS} refers to"))
    with within(_TABLE):
        table = NpzReader(files[_TABLE])
        den = table.shaped("den", "f", (None,))
        if not len(den):
            raise InvalidFile(Problem("den", "has no rows", "one or more; the first is zeros"))
        col = table.shaped("col", "f", (len(den), colour.features))
        memory.hold("den", 4 * len(den))
        density = cast(den, np.float32)
        if col.dtype != np.float16:
            memory.hold("col", 4 * col.size)
            col = cast(col, np.float32)
    with within(_ROWS):
        links = _links(files[_ROWS], mask, len(den) - 1)
    with within(_MODEL):
        return model.lattice(links, density, col, colour, "PlenVDB, merged")


def _links(view: memoryview, mask: Bits, n: int) -> npt.NDArray[np.int32]:
    """Read the links (X, Y, Z): rows 1 to n, each once, where the mask is true; -1 elsewhere."""
    shape = _shape_of(mask)
    memory.hold("links", 4 * mask.size)
    with memory.scope():
        (tree,) = _trees(view, channels=1, one=True)
        memory.hold("the rows", 32 * len(tree.values))
        rows = cast(tree.active_values[:, 0], np.float64)
        sound = (rows >= 1) & (rows <= n) & (rows == np.floor(rows))
        if not sound.all():
            found = f"points to row {rows[int(np.argmin(sound))]:g}"
            raise InvalidFile(Problem("the grid", found, f"whole numbers from 1 to {n:,}, the last row of {_TABLE}"))
        used = np.zeros(n + 1, bool)
        used[rows.astype(np.int64)] = True
        count = tree.active_topology.voxel_count
        if count != n or not used[1:].all():
            found = f"points from {count:,} nodes to {np.count_nonzero(used):,} rows"
            allowed = f"one node for each of {n:,} rows; float32 can represent row numbers up to {_EXACT:,}"
            raise InvalidFile(Problem("the grid", found, allowed))
        box = tree.active_topology.box
        inside = box is None or (
            min(box[0]) >= 0 and all(high < edge for high, edge in zip(box[1], shape, strict=True))
        )
        grid = _zeros(1, shape)
        if inside:
            _scatter(tree, grid)
        if not inside or not np.array_equal(grid[0] > 0, mask):
            found = "has nodes other than those where mask_cache.mask is true"
            allowed = "the same nodes; above 256^3 nodes PlenVDB's masks are smaller than the lattice"
            raise InvalidFile(Problem("the grid", found, allowed))
        links: npt.NDArray[np.int32] = grid[0].astype(np.int32)
        links[links == 0] = -1
    return links


# -- grids -----------------------------------------------------------------------------------------------------
def _trees(view: memoryview, *, channels: int, one: bool = False) -> list[VdbTree]:
    """Read all grids of a file; grids without names are in the order of their numbers."""
    volume = openvdb.decode(view)
    for problem in volume.unread:
        raise InvalidFile(problem)
    trees = [grid for grid in volume.grids if isinstance(grid, VdbTree) and grid.values.shape[1] == channels]
    if len(trees) != len(volume.grids) or (one and len(trees) > 1):
        channel_counts = ", ".join(str(grid.values.shape[1]) for grid in volume.grids[:20])
        found = f"has {len(volume.grids)} grids, of {channel_counts} channels"
        raise InvalidFile(Problem("the file", found, f"{'one' if one else 'grids'} of {channels}"))
    return trees


def _filled_shape(tree: VdbTree, what: str) -> Shape:
    """Return the shape of a grid. Raises InvalidFile unless all voxels from (0, 0, 0) to the last one are active."""
    topology = tree.active_topology
    box = topology.box
    if box is None or max(map(abs, (*box[0], box[1].max()))) >= MAX_EDGE:
        found = "has no voxels" if box is None else f"extends from {_text(box[0])} to {_text(box[1])}"
        raise InvalidFile(Problem(what, found, f"from (0, 0, 0), up to {MAX_EDGE:,} along an axis"))
    x, y, z = (int(high) + 1 for high in box[1])
    if box[0].any() or topology.voxel_count != x * y * z:
        found = f"is active at {topology.voxel_count:,} voxels from {_text(box[0])} to {_text(box[1])}"
        raise InvalidFile(Problem(what, found, "every voxel from (0, 0, 0) to the last one"))
    return x, y, z


def _zeros(channels: int, shape: Shape) -> Singles:
    x, y, z = shape
    memory.hold("the lattice", 4 * channels * x * y * z)
    return np.zeros((channels, x, y, z), np.float32)


def _scatter(tree: VdbTree, grid: Singles) -> None:
    """Scatter all active voxels and tiles into a grid (C, X, Y, Z), which must contain them."""
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
            chunk = values[begin + first : begin + first + len(x)].T[:, :, None, None, None]
            grid[:, x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]] = chunk
        begin += len(low)


def _shape_of(mask: Bits) -> Shape:
    x, y, z = mask.shape
    return x, y, z


def _text(place: Any) -> str:
    return f"({', '.join(str(int(each)) for each in place)})"
