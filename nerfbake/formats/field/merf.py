"""Read MERF folders (baked/): an atlas of node blocks, slice by slice in PNGs, three planes, and a small MLP.

    sparse_grid_block_indices.png          RGB: position in the atlas of each block of the grid; red 255: empty
    sparse_grid_rgb_and_density_000.png .. one slice of the atlas each: colour, density
    sparse_grid_features_000.png ...       the same layout for four features
    plane_rgb_and_density_0.png ...        planes 0 to 2, across the grid's axes 1 and 2, 0 and 2, 0 and 1
    plane_features_0.png ...

scene_params.json contains the resolutions of the planes and of the grid, the value ranges of the bytes, and the MLP.

A block of b cells has (b + 1)^3 nodes in the atlas. The grid's axes are the world's x, from 2 down to -2, z and y. Only
the inner cube, from -1 to 1, is not contracted, and only this cube is read. Sources: MERF (Reiser et al., 2023), and
the files that its program writes and its viewer reads; docs/formats/checkpoints.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import floor
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.baked_folder import (
    EMPTY,
    FEATURES,
    PARAMS,
    SMERF,
    Bytes,
    Three,
    atlas_of,
    deferred_mlp,
    indices_of,
    params_of,
    picture_of,
)
from nerfbake.formats.wire.json import number, table, whole
from nerfbake.kernels.arrays import Points, Singles
from nerfbake.scene.lattice_field import MAX_BLOCK, STEP, Activation, Blocks, DeferredColour, LatticeField, Planes

WORLD = 4.0  # edge of the cube that the world is contracted to, from -2 to 2 along each axis
_LEAST, _MOST = 4, 16384  # nodes along an edge of this cube
# Limits of raw values: e to the power of four such densities is far below the largest float32.
_MOST_DENSITY, _MOST_FEATURE = 20.0, 1000.0
_CLOSE = 1e-4  # relative tolerance of a voxel size, because of decimal digits in the JSON file
_ALLOWED_FOLDER = "a folder of google-research's MERF"


class ByteRange(NamedTuple):
    """The values of the bytes 0 and 255."""

    low: float
    high: float


class MerfParams(NamedTuple):
    """The contents of scene_params.json.

    planes: nodes along an edge of the three planes, 0 if there are none
    grid: nodes along an edge of the grid
    block: cells along an edge of a block
    atlas, atlas_blocks: (W, H, D) of the atlas in nodes, and in whole blocks
    density, features: value ranges
    """

    planes: int
    grid: int
    block: int
    atlas: Three
    atlas_blocks: Three
    density: ByteRange
    features: ByteRange
    colour: DeferredColour

    @property
    def blocks(self) -> int:
        """The number of blocks along an edge of the grid."""
        return -(-self.grid // self.block)


def decode_params(files: Mapping[str, memoryview]) -> MerfParams:
    """Parse scene_params.json. Raises InvalidFile for missing or wrong entries, and for files of other programs."""
    fields = params_of(files, SMERF, _ALLOWED_FOLDER)
    planes, grid = _resolution(fields, "triplane"), _resolution(fields, "sparse_grid")
    if not grid:
        found = "has no sparse grid, whose blocks define the occupied space"
        raise InvalidFile(Problem(PARAMS, found, "a sparse_grid_resolution above 0"))
    block = whole(fields, "data_block_size", PARAMS, low=1, high=MAX_BLOCK)
    whole(fields, "slice_depth", PARAMS, default=1, low=1, high=1)
    atlas, atlas_blocks = atlas_of(fields, block + 1)
    density, features = (
        _range(fields, f"range_{what}", most)
        for what, most in (("density", _MOST_DENSITY), ("features", _MOST_FEATURE))
    )
    colour = DeferredColour(deferred_mlp(fields, direction_first=False), squashed=True)
    return MerfParams(planes, grid, block, atlas, atlas_blocks, density, features, colour)


def _resolution(fields: dict[str, Any], what: str) -> int:
    """Return the nodes along an edge; 0 if the file declares that there are none."""
    count = whole(fields, f"{what}_resolution", PARAMS, low=-1, high=_MOST)
    if count <= 0:
        return 0
    if count < _LEAST:
        raise InvalidFile(Problem(f"{PARAMS}: {what}_resolution", f"is {count}", f"{_LEAST} to {_MOST:,}, or -1"))
    size = number(fields, f"{what}_voxel_size", PARAMS)
    if abs(size * count - WORLD) > _CLOSE * WORLD:
        found = f"is {size:g}: another world size than MERF's, as in torch-merf"
        raise InvalidFile(Problem(f"{PARAMS}: {what}_voxel_size", found, f"4 / {count}"))
    return count


def _range(fields: dict[str, Any], name: str, most: float) -> ByteRange:
    low, high = table(fields.get(name), f"{PARAMS}: {name}", (2,)).tolist()
    if not -most <= low < high <= most:
        raise InvalidFile(
            Problem(f"{PARAMS}: {name}", f"is {low:g} to {high:g}", f"two increasing numbers, {-most:g} to {most:g}")
        )
    return ByteRange(low, high)


_INDICES = "sparse_grid_block_indices.png"
_GRID, _PLANE = ("sparse_grid_rgb_and_density", "sparse_grid_features"), ("plane_rgb_and_density", "plane_features")
_ALLOWED = f"{PARAMS}, {_INDICES}, and all pictures of the grid and of the planes"
_CHANNELS = 4 + FEATURES
_DENSITY, _LOOKS = 3, (0, 1, 2, *range(4, _CHANNELS))  # the channels of the density, and of colours and features
_SKIPPED = 0.5 / 255  # MERF's viewer skips samples up to this opacity over one cell of the planes
_NOTE = "only MERF's inner cube, from -1 to 1 along each axis, is read; the contracted surroundings are left out"

Ints32 = npt.NDArray[np.int32]


class _InnerBlocks(NamedTuple):
    """The blocks of the inner cube, along the world's axes.

    rows (X, Y, Z): first node row of each block, below 0 for empty blocks
    atlas_index (n, 3): position in the atlas of each occupied block
    box (2, 3): in world units
    """

    rows: Ints32
    atlas_index: npt.NDArray[np.int64]
    box: Points


def recognise(files: Mapping[str, memoryview]) -> bool:
    return any(name in files for name in (_INDICES, f"{_PLANE[0]}_0.png"))


def decode(files: Mapping[str, memoryview], *, member: str = PARAMS) -> LatticeField:
    """Read the inner cube of a folder as a lattice. `member` is the file that stands for the folder.

    Raises InvalidFile with the name of the file, MemoryLimit.
    """
    params = decode_params(files)
    blocks = _inner_blocks(files, params)
    nodes = _nodes(files, params, blocks)
    density, features = _values(nodes.reshape(-1, _CHANNELS), params)
    planes = _planes(files, params) if params.planes else None
    return LatticeField(
        links=blocks.rows,
        density=density,
        features=features,
        activation=Activation("exponential", -1.0, 1.0),
        colour=params.colour,
        box=np.array([[-1.0] * 3, [1.0] * 3]),
        least=1 - (1 - _SKIPPED) ** STEP,
        dialect="MERF",
        notes=(_NOTE,),
        blocks=Blocks(params.block, blocks.box),
        planes=planes,
    )


# -- blocks ----------------------------------------------------------------------------------------------------
def _inner_blocks(files: Mapping[str, memoryview], params: MerfParams) -> _InnerBlocks:
    """Find the occupied blocks of the inner cube.

    Block k extends from node k b to node (k + 1) b. Node i is WORLD (i + 1/2) / grid from the end of its axis.
    """
    b, count = params.block, params.blocks
    cell = WORLD / params.grid
    first, last = (floor((params.grid * share - 0.5) / b) for share in (0.25, 0.75))
    indices = indices_of(files, _INDICES, (count,) * 3, params.atlas_blocks, _ALLOWED)
    inner = indices[(slice(first, last + 1),) * 3]
    inner = inner[::-1].transpose(0, 2, 1, 3)  # along the world's axes
    occupied = inner[..., 0] != EMPTY
    if not occupied.any():
        raise InvalidFile(Problem(_INDICES, "has no occupied block in the inner cube", "one or more"))
    atlas_index = inner[occupied].astype(np.int64)
    if len(atlas_index) * (b + 1) ** 3 >= 1 << 31:
        raise InvalidFile(Problem(_INDICES, f"has {len(atlas_index):,} blocks of {(b + 1) ** 3:,} nodes", "2^31 nodes"))
    rows = np.full(occupied.shape, -1, np.int32)
    rows[occupied] = np.arange(len(atlas_index)) * (b + 1) ** 3
    ends = -WORLD / 2 + cell * (0.5 + b * np.array([first, last + 1]))
    box = np.stack([-ends[::-1], ends, ends], axis=1)
    return _InnerBlocks(rows, atlas_index, box)


def _nodes(files: Mapping[str, memoryview], params: MerfParams, blocks: _InnerBlocks) -> Bytes:
    """Read the nodes of each occupied block, (n, b + 1, b + 1, b + 1, 8), along the world's axes."""
    side = params.block + 1
    n = len(blocks.atlas_index)
    memory.hold("the nodes", n * side**3 * (_CHANNELS + 4 * _CHANNELS))  # as bytes and as floats
    nodes = np.empty((n, side, side, side, _CHANNELS), np.uint8)
    W, H, _ = params.atlas
    width, height, _ = params.atlas_blocks
    for layer in range(params.atlas_blocks[2]):
        chosen = np.flatnonzero(blocks.atlas_index[:, 2] == layer)
        for depth in range(side) if len(chosen) else ():
            for part, prefix in enumerate(_GRID):
                name = f"{prefix}_{layer * side + depth:03d}.png"
                found = picture_of(files, name, "RGBA", (W, H), _ALLOWED)[: height * side, : width * side]
                tiles = found.reshape(height, side, width, side, 4)
                tiles = tiles[
                    blocks.atlas_index[chosen, 1], :, blocks.atlas_index[chosen, 0]
                ]  # (k, y, x, 4) of the atlas
                # The atlas is mirrored along x; its y is the world's z, and its depth the world's y.
                nodes[chosen, :, depth, :, 4 * part : 4 * part + 4] = tiles[:, :, ::-1].transpose(0, 2, 1, 3)
    return nodes


def _values(nodes: Bytes, params: MerfParams) -> tuple[Singles, Singles]:
    """Return raw densities (n,), and raw colours and features (n, 7)."""
    density = _byte_values(params.density)[nodes[:, _DENSITY]]
    features = np.empty((len(nodes), len(_LOOKS)), np.float32)
    for column, channel in enumerate(_LOOKS):
        features[:, column] = _byte_values(params.features)[nodes[:, channel]]
    return density, features


def _byte_values(span: ByteRange) -> Singles:
    """Return the value of each byte, (256,)."""
    return (span.low + (span.high - span.low) * np.arange(256) / 255).astype(np.float32)


# -- planes ----------------------------------------------------------------------------------------------------
def _planes(files: Mapping[str, memoryview], params: MerfParams) -> Planes:
    """Read the part of the planes inside the inner cube, plus one node on each side."""
    R = params.planes
    low = R / 4 - 0.5  # start of the inner cube, in nodes from either end
    first = floor(low)
    P = R - 2 * first
    memory.hold("the planes", 3 * P * P * 4 * _CHANNELS)
    memory.require("a plane", 2 * _CHANNELS * R * R + 8 * _CHANNELS * P * P)
    density, features = np.empty((3, P, P), np.float32), np.empty((3, P, P, len(_LOOKS)), np.float32)
    for plane in range(3):
        names = [f"{prefix}_{plane}.png" for prefix in _PLANE]
        parts = [picture_of(files, name, "RGBA", (R, R), _ALLOWED) for name in names]
        whole = np.concatenate([part[first : R - first, first : R - first] for part in parts], axis=2)
        # Rows are the later axis of the grid. World axes of rows and columns: y, z (plane 0); y, x (1); z, x (2).
        # x is mirrored.
        where = (0, 2, 1)[plane]
        turned = whole if plane == 0 else whole[:, ::-1].transpose(1, 0, 2)
        flat = _values(turned.reshape(-1, _CHANNELS), params)
        density[where], features[where] = flat[0].reshape(P, P), flat[1].reshape(P, P, -1)
        del parts, whole, turned, flat  # before the next plane is decoded
    return Planes(density, features, low - first, R / 2)
