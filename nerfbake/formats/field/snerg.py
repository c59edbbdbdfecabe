"""SNeRG's folder (png/): an atlas of blocks of voxels, slice by slice in PNGs, and a small MLP in scene_params.json.

    atlas_indices.png   RGB: of each block of the grid its block in the atlas; red 255: an empty one
    rgba_000.png ...    four slices each, one below the other: colour times opacity, opacity
    feature_000.png ... the same of four features times opacity

A block has b voxels along each edge, in the atlas one more around it, which belong to its neighbours. Sources: SNeRG
(Hedman et al., 2021), 4 and 5, and the files that its program writes; docs/formats/checkpoints.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.baked_folder import EMPTY, PARAMS, Bytes, indices_of, picture_of
from nerfbake.formats.field.snerg_params import Params, decode_params
from nerfbake.kernels.arrays import Bits, Points
from nerfbake.scene.lattice_field import Activation, LatticeField

_INDICES = "atlas_indices.png"
_ALLOWED = f"{_INDICES}, and as many rgba and feature pictures as slices"
_SLICES = 4  # in a picture
_CHANNELS = 8
_AT_ONCE = 1 << 21  # voxels
_ROW_BYTES = 3 * 4 + _CHANNELS + 2 * _CHANNELS + 4  # a voxel's place and bytes, then its features and its opacity

Ints32 = npt.NDArray[np.int32]
Array = TypeVar("Array", bound=npt.NDArray[Any])


class _Voxels(NamedTuple):
    """Places (n, 3) in the grid, from -1 on; their bytes (n, 8): red, green, blue, four features, opacity."""

    places: Ints32
    values: Bytes


def recognise(files: Mapping[str, memoryview]) -> bool:
    return PARAMS in files


def decode(files: Mapping[str, memoryview], *, member: str = PARAMS) -> LatticeField:
    """The lattice of a folder, in the world of the cameras; `member` stands for all of it.

    Raises InvalidFile naming the file, MemoryLimit.
    """
    params = decode_params(files)
    indices = indices_of(files, _INDICES, params.blocks, params.atlas_blocks, _ALLOWED)
    occupied = indices[..., 0] != EMPTY
    if not occupied.any():
        raise InvalidFile(Problem(_INDICES, "has no block that holds anything", "one or more"))
    with memory.scope():
        voxels = _voxels(files, params, indices, occupied)
        count = len(voxels.places)
    memory.hold("the voxels", _ROW_BYTES * count)
    first, last = _ends(occupied)
    b = params.block
    low, shape = first * b - 1, tuple(int(edge) for edge in (last - first) * b + 2)
    memory.hold("links", 4 * shape[0] * shape[1] * shape[2])
    links = np.full(shape, -1, np.int32)
    links[tuple((voxels.places - low).T)] = np.arange(count, dtype=np.int32)
    box = params.low + params.voxel * np.stack([low, low + shape])
    blocks = params.low + params.voxel * b * np.stack([first, last])
    cells = occupied[tuple(slice(a, e) for a, e in zip(first, last, strict=True))]
    return LatticeField(
        links=_turned(links, params),
        density=(voxels.values[:, -1] / 255).astype(np.float32),
        features=voxels.values.astype(np.float16),  # whole numbers, exact
        activation=Activation("opacity", 0.0, 1 / params.voxel),
        colour=params.colour,
        box=_moved(box, params),
        occupied=_turned(cells, params),
        mask_box=_moved(blocks, params),
        dialect="SNeRG",
    )


def _ends(occupied: Bits) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The first block along each axis that holds something, and the one behind the last."""
    held = [np.flatnonzero(occupied.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    return np.array([each[0] for each in held]), np.array([each[-1] + 1 for each in held])


def _turned(array: Array, params: Params) -> Array:
    """An array (x, y, z) of the grid's axes, along the world's."""
    turned = array.transpose(params.axes)[tuple(slice(None, None, sign) for sign in params.signs)]
    return cast(Array, np.ascontiguousarray(turned))


def _moved(box: Points, params: Params) -> Points:
    """The same of a box (2, 3)."""
    ends = box[:, params.axes] * params.signs + params.move
    return np.sort(ends, axis=0)


# -- pictures --------------------------------------------------------------------------------------------------
def _layer(files: Mapping[str, memoryview], params: Params, number: int) -> Bytes:
    """(slices, H, W, 8) of one layer of the atlas' blocks."""
    W, H, _ = params.atlas
    edge = params.block + 2
    memory.hold("the atlas", edge * H * W * _CHANNELS)
    out = np.zeros((edge, H, W, _CHANNELS), np.uint8)
    for picture in range(number * edge // _SLICES, ((number + 1) * edge - 1) // _SLICES + 1):
        names = [f"rgba_{picture:03d}.png"] + [f"feature_{picture:03d}.png"] * (params.colour.mlp is not None)
        parts = [
            picture_of(files, name, "RGBA", (W, _SLICES * H), _ALLOWED).reshape(_SLICES, H, W, 4) for name in names
        ]
        first = max(picture * _SLICES, number * edge)
        for z in range(first, min((picture + 1) * _SLICES, (number + 1) * edge)):
            rgba = parts[0][z % _SLICES]
            out[z - number * edge, ..., :3], out[z - number * edge, ..., 7] = rgba[..., :3], rgba[..., 3]
            if len(parts) > 1:
                out[z - number * edge, ..., 3:7] = parts[1][z % _SLICES]
    return out


# -- voxels ----------------------------------------------------------------------------------------------------
def _voxels(files: Mapping[str, memoryview], params: Params, indices: Bytes, occupied: Bits) -> _Voxels:
    """All voxels that hold something: blocks' own, then those around them that are in no block, each once."""
    own: list[_Voxels] = []
    around: list[_Voxels] = []
    count = 0
    for inner, found in _blocks(files, params, indices):
        block = found.places // params.block
        free: Bits = np.asarray(((block < 0) | (block >= occupied.shape)).any(axis=1))
        free[~free] = ~occupied[tuple(block[~free].T)]
        for kept, where in ((own, inner), (around, free)):
            kept.append(_Voxels(found.places[where], found.values[where]))
            count += int(np.count_nonzero(where))
        memory.require("the voxels", 2 * _ROW_BYTES * count)
    places = np.concatenate([each.places for each in own + around])
    values = np.concatenate([each.values for each in own + around])
    x, y, z = (places + 1).astype(np.int64).T
    once = np.sort(np.unique((x << 40) | (y << 20) | z, return_index=True)[1])
    return _Voxels(places[once], values[once])


def _blocks(files: Mapping[str, memoryview], params: Params, indices: Bytes) -> Iterator[tuple[Bits, _Voxels]]:
    """Voxels that hold something, some blocks at a time, and which of them are the block's own."""
    edge = params.block + 2
    blocks = np.argwhere(indices[..., 0] != EMPTY)
    leads = indices[tuple(blocks.T)].astype(np.int64)
    step = max(1, _AT_ONCE // edge**3)
    for layer in range(params.atlas_blocks[2]):
        here = np.flatnonzero(leads[:, 2] == layer)
        if not len(here):
            continue
        with memory.scope():
            atlas = _layer(files, params, layer)
            width, height = (edge * count for count in params.atlas_blocks[:2])
            parts = atlas[:, :height, :width].reshape(edge, height // edge, edge, width // edge, edge, _CHANNELS)
            for begin in range(0, len(here), step):
                some = here[begin : begin + step]
                found = parts[:, leads[some, 1], :, leads[some, 0]]  # (k, z, y, x, 8)
                k, z, y, x = np.nonzero(found.any(axis=4))
                at = np.stack([x, y, z], axis=1)
                inner = np.asarray(((at >= 1) & (at <= params.block)).all(axis=1))
                places = blocks[some][k] * params.block + at - 1
                yield inner, _Voxels(places.astype(np.int32), found[k, z, y, x])
