"""Read SNeRG folders (png/): an atlas of voxel blocks, slice by slice in PNGs, and a small MLP.

    scene_params.json   sizes of the grid, its blocks and the atlas; the grid's position in the world; the MLP
    atlas_indices.png   RGB: position in the atlas of each block of the grid; red 255: empty
    rgba_000.png ...    four slices each, one below the other: colour times opacity, opacity
    feature_000.png ... the same layout for four features times opacity

A block has b voxels along each edge. In the atlas it has one more on each side, copied from its neighbours. Sources:
SNeRG (Hedman et al., 2021), 4 and 5, and the files that its program writes; docs/formats/checkpoints.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.baked_folder import (
    EMPTY,
    PARAMS,
    SMERF,
    Bytes,
    atlas_of,
    deferred_mlp,
    indices_of,
    params_of,
    picture_of,
    read_three,
    sizes_of,
)
from nerfbake.formats.wire.json import number, table, whole
from nerfbake.kernels.arrays import Bits, Points
from nerfbake.scene.lattice_field import MAX_EDGE, Activation, DeferredColour, LatticeField

_MAX_BLOCK = 254
# Keys of other programs' scene_params.json, with a description for the error message.
_REFUSED = SMERF | {"triplane_resolution": "a key of MERF, whose pictures have other names than SNeRG's"}
_ALLOWED_FOLDER = "a folder of SNeRG"


class SnergParams(NamedTuple):
    """The contents of scene_params.json.

    block: voxels along an edge of a block
    blocks: blocks of the grid along x, y, z
    atlas, atlas_blocks: (W, H, D) of the atlas in voxels, and in whole blocks
    voxel: edge of a voxel in world units
    low: lowest corner of the grid, along the grid's axes
    axes, signs, move: the world's axis i is the grid's axis axes[i] times signs[i], plus move[i]
    """

    block: int
    blocks: tuple[int, int, int]
    atlas: tuple[int, int, int]
    atlas_blocks: tuple[int, int, int]
    voxel: float
    low: Points
    axes: tuple[int, int, int]
    signs: tuple[int, int, int]
    move: Points
    colour: DeferredColour


def decode_params(files: Mapping[str, memoryview]) -> SnergParams:
    """Parse scene_params.json. Raises InvalidFile for missing or wrong entries, and for files of other programs."""
    fields = params_of(files, _REFUSED, _ALLOWED_FOLDER)
    if fields.get("ndc", False) is not False:
        found = "has ndc: a forward-facing scene, whose lattice is not a box in world space"
        raise InvalidFile(Problem(PARAMS, found, "a bounded scene of SNeRG"))
    if fields.get("format", "png") != "png":
        raise InvalidFile(Problem(f"{PARAMS}: format", "is not supported", "png"))
    block = whole(fields, "block_size", PARAMS, low=1, high=_MAX_BLOCK)
    grid = sizes_of(fields, "grid", MAX_EDGE - 2)
    atlas, atlas_blocks = atlas_of(fields, block + 2)
    axes, signs, move = _turn(fields)
    return SnergParams(
        block,
        read_three(-(-edge // block) for edge in grid),
        atlas,
        atlas_blocks,
        number(fields, "voxel_size", PARAMS, low=1e-9, high=1e9),
        np.array([number(fields, f"min_{axis}", PARAMS) for axis in "xyz"]),
        axes,
        signs,
        move,
        DeferredColour(None if fields.get("diffuse") is True else deferred_mlp(fields, direction_first=True)),
    )


def _turn(fields: dict[str, Any]) -> tuple[tuple[int, int, int], tuple[int, int, int], Points]:
    """Parse worldspace_T_opengl, which may swap and mirror axes, and translate."""
    place = f"{PARAMS}: worldspace_T_opengl"
    matrix = table(fields.get("worldspace_T_opengl"), place, (4, 4))
    turn = matrix[:3, :3]
    ones = np.abs(turn) == 1
    if not (ones.sum(axis=0) == 1).all() or np.count_nonzero(turn) != 3 or (matrix[3] != (0, 0, 0, 1)).any():
        raise InvalidFile(
            Problem(place, "is not a swap of axes", "one 1 or -1 in each row and column, then a translation")
        )
    axes = read_three(int(axis) for axis in ones.argmax(axis=1))
    signs = read_three(int(turn[i, axis]) for i, axis in enumerate(axes))
    return axes, signs, matrix[:3, 3]


_INDICES = "atlas_indices.png"
_ALLOWED = f"{_INDICES}, and the rgba and feature pictures of all slices"
_SLICES = 4  # per picture
_CHANNELS = 8
_AT_ONCE = 1 << 18  # voxels
_VOXEL_BYTES = 110  # of a voxel while it is found
_ROW_BYTES = 3 * 4 + _CHANNELS + 2 * _CHANNELS + 4  # position and bytes of a voxel, then its features and opacity

Ints32 = npt.NDArray[np.int32]
Array = TypeVar("Array", bound=npt.NDArray[Any])


class _Voxels(NamedTuple):
    """Positions (n, 3) in the grid, -1 or more; bytes (n, 8): red, green, blue, four features, opacity."""

    places: Ints32
    values: Bytes


def recognise(files: Mapping[str, memoryview]) -> bool:
    return PARAMS in files


def decode(files: Mapping[str, memoryview], *, member: str = PARAMS) -> LatticeField:
    """Read a folder as a lattice in the world of the cameras. `member` is the file that stands for the folder.

    Raises InvalidFile with the name of the file, MemoryLimit.
    """
    params = decode_params(files)
    indices = indices_of(files, _INDICES, params.blocks, params.atlas_blocks, _ALLOWED)
    occupied = indices[..., 0] != EMPTY
    if not occupied.any():
        raise InvalidFile(Problem(_INDICES, "has no occupied block", "one or more"))
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
    """Return the first occupied block along each axis, and the one after the last."""
    filled = [np.flatnonzero(occupied.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    return np.array([each[0] for each in filled]), np.array([each[-1] + 1 for each in filled])


def _turned(array: Array, params: SnergParams) -> Array:
    """Transpose and mirror an array (x, y, z) from the grid's axes to the world's."""
    turned = array.transpose(params.axes)[tuple(slice(None, None, sign) for sign in params.signs)]
    return cast(Array, np.ascontiguousarray(turned))


def _moved(box: Points, params: SnergParams) -> Points:
    """Transform a box (2, 3) from the grid's axes to the world's."""
    ends = box[:, params.axes] * params.signs + params.move
    return np.sort(ends, axis=0)


# -- pictures --------------------------------------------------------------------------------------------------
def _layer(files: Mapping[str, memoryview], params: SnergParams, number: int) -> Bytes:
    """Read one layer of blocks of the atlas, (slices, H, W, 8)."""
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
def _voxels(files: Mapping[str, memoryview], params: SnergParams, indices: Bytes, occupied: Bits) -> _Voxels:
    """Return all voxels that are not empty, each once.

    The voxels inside the blocks come first, then the additional voxels around them that are in no occupied block.
    """
    inside: list[_Voxels] = []
    around: list[_Voxels] = []
    count = 0
    for inner, found in _blocks(files, params, indices):
        block = found.places // params.block
        free: Bits = np.asarray(((block < 0) | (block >= occupied.shape)).any(axis=1))
        free[~free] = ~occupied[tuple(block[~free].T)]
        for kept, where in ((inside, inner), (around, free)):
            kept.append(_Voxels(found.places[where], found.values[where]))
            count += int(np.count_nonzero(where))
        memory.require("the voxels", 4 * _ROW_BYTES * count)
    places = np.concatenate([each.places for each in inside + around])
    values = np.concatenate([each.values for each in inside + around])
    x, y, z = (places + 1).astype(np.int64).T
    once = np.sort(np.unique((x << 40) | (y << 20) | z, return_index=True)[1])
    return _Voxels(places[once], values[once])


def _blocks(files: Mapping[str, memoryview], params: SnergParams, indices: Bytes) -> Iterator[tuple[Bits, _Voxels]]:
    """Yield voxels that are not empty, a few blocks at a time, with a mask of those inside their block."""
    edge = params.block + 2
    blocks = np.argwhere(indices[..., 0] != EMPTY)
    atlas_index = indices[tuple(blocks.T)].astype(np.int64)
    step = max(1, _AT_ONCE // edge**3)
    given = 0
    for layer in range(params.atlas_blocks[2]):
        here = np.flatnonzero(atlas_index[:, 2] == layer)
        if not len(here):
            continue
        with memory.scope():
            atlas = _layer(files, params, layer)
            width, height = (edge * count for count in params.atlas_blocks[:2])
            parts = atlas[:, :height, :width].reshape(edge, height // edge, edge, width // edge, edge, _CHANNELS)
            for begin in range(0, len(here), step):
                chunk = here[begin : begin + step]
                memory.require("the voxels", _VOXEL_BYTES * len(chunk) * edge**3 + _ROW_BYTES * given)
                found = parts[:, atlas_index[chunk, 1], :, atlas_index[chunk, 0]]  # (k, z, y, x, 8)
                k, z, y, x = np.nonzero(found.any(axis=4))
                at = np.stack([x, y, z], axis=1)
                inner = np.asarray(((at >= 1) & (at <= params.block)).all(axis=1))
                places = blocks[chunk][k] * params.block + at - 1
                given += len(places)
                yield inner, _Voxels(places.astype(np.int32), found[k, z, y, x])
