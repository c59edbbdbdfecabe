"""MERF's folder (baked/): an atlas of blocks of nodes, slice by slice in PNGs, three planes, and a small MLP.

    sparse_grid_block_indices.png          RGB: of each block of the grid its block in the atlas; red 255: an empty one
    sparse_grid_rgb_and_density_000.png .. a slice of the atlas each: colour, density
    sparse_grid_features_000.png ...       the same of four features
    plane_rgb_and_density_0.png ...        planes 0 to 2, across the grid's axes 1 and 2, 0 and 2, 0 and 1
    plane_features_0.png ...

A block of b cells has (b + 1)^3 nodes in the atlas. The grid's axes are the world's x, from 2 down to -2, z and y. Only
the inner cube, from -1 to 1, is not contracted: that much is read. Sources: MERF (Reiser et al., 2023), and the files
that its program writes and its viewer reads; docs/formats/checkpoints.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import floor
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.baked_folder import EMPTY, FEATURES, PARAMS, Bytes, indices_of, picture_of
from nerfbake.formats.field.merf_params import WORLD, Params, Range, decode_params
from nerfbake.kernels.arrays import Points, Singles
from nerfbake.scene.lattice_blocks import Blocks, Planes
from nerfbake.scene.lattice_field import STEP, Activation, LatticeField

_INDICES = "sparse_grid_block_indices.png"
_GRID, _PLANE = ("sparse_grid_rgb_and_density", "sparse_grid_features"), ("plane_rgb_and_density", "plane_features")
_ALLOWED = f"{PARAMS}, {_INDICES}, and all pictures of the grid and of the planes"
_CHANNELS = 4 + FEATURES
_DENSITY, _LOOKS = 3, (0, 1, 2, *range(4, _CHANNELS))  # which of them are what
_SKIPPED = 0.5 / 255  # opacity of a step, as long as a cell of the planes, up to which MERF's viewer passes it over
_NOTE = "only MERF's inner cube, from -1 to 1 along each axis, is read; what it holds outside, contracted, is left out"

Ints32 = npt.NDArray[np.int32]


class _Held(NamedTuple):
    """The blocks of the inner cube, along the world's axes: rows (X, Y, Z) of nodes, below 0 for empty ones; their
    leads (n, 3) into the atlas; box (2, 3) in the world."""

    rows: Ints32
    leads: npt.NDArray[np.int64]
    box: Points


def recognise(files: Mapping[str, memoryview]) -> bool:
    return any(name in files for name in (_INDICES, f"{_PLANE[0]}_0.png"))


def decode(files: Mapping[str, memoryview], *, member: str = PARAMS) -> LatticeField:
    """The lattice of a folder's inner cube; `member` stands for all of it.

    Raises InvalidFile naming the file, MemoryLimit.
    """
    params = decode_params(files)
    blocks = _held(files, params)
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
def _held(files: Mapping[str, memoryview], params: Params) -> _Held:
    """Block k is from node k b to node (k + 1) b, and node i at WORLD (i + 1/2) / grid from the end of an axis."""
    b, count = params.block, params.blocks
    cell = WORLD / params.grid
    first, last = (floor((params.grid * share - 0.5) / b) for share in (0.25, 0.75))
    indices = indices_of(files, _INDICES, (count,) * 3, params.atlas_blocks, _ALLOWED)
    inner = indices[(slice(first, last + 1),) * 3]
    inner = inner[::-1].transpose(0, 2, 1, 3)  # along the world's axes
    held = inner[..., 0] != EMPTY
    if not held.any():
        raise InvalidFile(Problem(_INDICES, "has no block in the inner cube that holds anything", "one or more"))
    leads = inner[held].astype(np.int64)
    if len(leads) * (b + 1) ** 3 >= 1 << 31:
        raise InvalidFile(Problem(_INDICES, f"has {len(leads):,} blocks of {(b + 1) ** 3:,} nodes", "2^31 nodes"))
    rows = np.full(held.shape, -1, np.int32)
    rows[held] = np.arange(len(leads)) * (b + 1) ** 3
    ends = -WORLD / 2 + cell * (0.5 + b * np.array([first, last + 1]))
    box = np.stack([-ends[::-1], ends, ends], axis=1)
    return _Held(rows, leads, box)


def _nodes(files: Mapping[str, memoryview], params: Params, blocks: _Held) -> Bytes:
    """(n, b + 1, b + 1, b + 1, 8) of each held block its nodes, along the world's axes."""
    side = params.block + 1
    n = len(blocks.leads)
    memory.hold("the nodes", n * side**3 * (_CHANNELS + 4 * _CHANNELS))  # as bytes, and as floats
    nodes = np.empty((n, side, side, side, _CHANNELS), np.uint8)
    W, H, _ = params.atlas
    width, height, _ = params.atlas_blocks
    for layer in range(params.atlas_blocks[2]):
        own = np.flatnonzero(blocks.leads[:, 2] == layer)
        for depth in range(side) if len(own) else ():
            for part, prefix in enumerate(_GRID):
                name = f"{prefix}_{layer * side + depth:03d}.png"
                found = picture_of(files, name, "RGBA", (W, H), _ALLOWED)[: height * side, : width * side]
                tiles = found.reshape(height, side, width, side, 4)
                tiles = tiles[blocks.leads[own, 1], :, blocks.leads[own, 0]]  # (k, y, x, 4) of the atlas
                # Mirrored along x; y there is the world's z, and the depth its y.
                nodes[own, :, depth, :, 4 * part : 4 * part + 4] = tiles[:, :, ::-1].transpose(0, 2, 1, 3)
    return nodes


def _values(nodes: Bytes, params: Params) -> tuple[Singles, Singles]:
    """(n,) densities and (n, 7) colours and features, raw."""
    density = _meanings(params.density)[nodes[:, _DENSITY]]
    features = np.empty((len(nodes), len(_LOOKS)), np.float32)
    for column, channel in enumerate(_LOOKS):
        features[:, column] = _meanings(params.features)[nodes[:, channel]]
    return density, features


def _meanings(span: Range) -> Singles:
    """(256,) what each byte stands for."""
    return (span.low + (span.high - span.low) * np.arange(256) / 255).astype(np.float32)


# -- planes ----------------------------------------------------------------------------------------------------
def _planes(files: Mapping[str, memoryview], params: Params) -> Planes:
    """The part of them that lies in the inner cube, and one node more beside it."""
    R = params.planes
    low = R / 4 - 0.5  # where the inner cube starts, in nodes from either end
    first = floor(low)
    P = R - 2 * first
    memory.hold("the planes", 3 * P * P * 4 * _CHANNELS)
    density, features = np.empty((3, P, P), np.float32), np.empty((3, P, P, len(_LOOKS)), np.float32)
    for number in range(3):
        names = [f"{prefix}_{number}.png" for prefix in _PLANE]
        parts = [picture_of(files, name, "RGBA", (R, R), _ALLOWED) for name in names]
        whole = np.concatenate([part[first : R - first, first : R - first] for part in parts], axis=2)
        # Rows are the later axis of the grid. Plane 0: rows y, columns z; 1: y and x; 2: z and x, which is mirrored.
        where = (0, 2, 1)[number]
        turned = whole if number == 0 else whole[:, ::-1].transpose(1, 0, 2)
        flat = _values(turned.reshape(-1, _CHANNELS), params)
        density[where], features[where] = flat[0].reshape(P, P), flat[1].reshape(P, P, -1)
    return Planes(density, features, low - first, R / 2)
