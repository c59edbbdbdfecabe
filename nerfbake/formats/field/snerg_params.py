"""SNeRG's scene_params.json: how large the grid, its blocks and the atlas are, where the grid stands, and the MLP."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.torch_model import layers_of
from nerfbake.formats.wire.json import number, parse_object, table, whole
from nerfbake.kernels.arrays import Points, Singles
from nerfbake.scene.lattice_colour import DeferredColour, MlpColour
from nerfbake.scene.lattice_field import MAX_EDGE

PARAMS = "scene_params.json"
_MAX_BLOCK, _MAX_ATLAS = 254, 4096
_FREQUENCIES = (1.0, 2.0, 4.0, 8.0)
_LAYERS, _COLOURS, _OTHERS = 3, 3, 4
# What other programs' folders with such a file are told by.
_REFUSED = {
    "triplane_resolution": "of MERF, whose planes and contracted space are no lattice of the world",
    "scene_scale_factor": "of SMERF, a field of many MLPs",
    "ranges": "of SMERF, a field of many MLPs",
}
_ALLOWED = "a folder of SNeRG"


class Params(NamedTuple):
    """block voxels an edge; blocks of the grid along x, y, z; atlas (W, H, D) voxels and its whole blocks; a voxel's
    edge in world units.

    The grid's lowest corner is `low`, in axes of its own: the world's axis i is its axis axes[i] times signs[i], plus
    move[i].
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


def decode_params(view: memoryview) -> Params:
    """Raises InvalidFile for what is missing or wrong, and for other programs' files of this name."""
    fields = parse_object(view, PARAMS)
    for key, what in _REFUSED.items():
        if key in fields:
            raise InvalidFile(Problem(PARAMS, f"has {key}: {what}", _ALLOWED))
    if fields.get("ndc", False) is not False:
        found = "has ndc: a forward-facing scene, whose lattice is no box of the world"
        raise InvalidFile(Problem(PARAMS, found, "a bounded scene of SNeRG"))
    if fields.get("format", "png") != "png":
        raise InvalidFile(Problem(f"{PARAMS}: format", "is another", "png"))
    block = whole(fields, "block_size", PARAMS, low=1, high=_MAX_BLOCK)
    grid = _sizes(fields, "grid", MAX_EDGE - 2)
    atlas = _sizes(fields, "atlas", _MAX_ATLAS)
    if min(atlas) < block + 2:
        raise InvalidFile(Problem(f"{PARAMS}: atlas_width, ...", f"are {atlas}", f"{block + 2} or more, for a block"))
    axes, signs, move = _turn(fields)
    return Params(
        block,
        _each(-(-edge // block) for edge in grid),
        atlas,
        _each(edge // (block + 2) for edge in atlas),
        number(fields, "voxel_size", PARAMS, low=1e-9, high=1e9),
        np.array([number(fields, f"min_{axis}", PARAMS) for axis in "xyz"]),
        axes,
        signs,
        move,
        DeferredColour(None if fields.get("diffuse") is True else _mlp(fields)),
    )


def _each(numbers: Any) -> tuple[int, int, int]:
    x, y, z = numbers
    return x, y, z


def _sizes(fields: dict[str, Any], what: str, most: int) -> tuple[int, int, int]:
    names = (f"{what}_{edge}" for edge in ("width", "height", "depth"))
    return _each(whole(fields, name, PARAMS, low=1, high=most) for name in names)


def _turn(fields: dict[str, Any]) -> tuple[tuple[int, int, int], tuple[int, int, int], Points]:
    """worldspace_T_opengl, which may swap axes, turn them around, and move."""
    place = f"{PARAMS}: worldspace_T_opengl"
    matrix = table(fields.get("worldspace_T_opengl"), place, (4, 4))
    turn = matrix[:3, :3]
    ones = np.abs(turn) == 1
    if not (ones.sum(axis=0) == 1).all() or np.count_nonzero(turn) != 3 or (matrix[3] != (0, 0, 0, 1)).any():
        raise InvalidFile(Problem(place, "is another turn", "rows and columns with one 1 or -1 each, then a shift"))
    axes = _each(int(axis) for axis in ones.argmax(axis=1))
    signs = _each(int(turn[i, axis]) for i, axis in enumerate(axes))
    return axes, signs, matrix[:3, 3]


def _mlp(fields: dict[str, Any]) -> MlpColour:
    """Of d with its sines, a colour and four features, in this order; here the direction comes last."""
    weights: dict[str, Singles] = {}
    biases: dict[str, Singles] = {}
    for layer in range(_LAYERS):
        name = f"{PARAMS}: {layer}_weights"
        weights[name] = table(fields.get(f"{layer}_weights"), name, (None, None)).T.astype(np.float32)
        biases[name] = table(fields.get(f"{layer}_bias"), f"{PARAMS}: {layer}_bias", (None,)).astype(np.float32)
    layers = layers_of(weights, biases)
    count = len(_FREQUENCIES)
    code = 3 + 6 * count
    if layers.first.shape[1] != code + _COLOURS + _OTHERS:
        found = f"takes {layers.first.shape[1]} inputs"
        raise InvalidFile(Problem(next(iter(weights)), found, f"{code + _COLOURS + _OTHERS}"))
    # Sines there: of x, y, z times the first frequency, then times the second; here all of x first, then all of y.
    sines = 3 + np.arange(3 * count).reshape(count, 3).T.reshape(-1)
    order = np.concatenate([np.arange(code, code + _COLOURS + _OTHERS), np.arange(3), sines, sines + 3 * count])
    first = np.ascontiguousarray(layers.first[:, order])
    return MlpColour(*layers._replace(first=first), frequencies=_FREQUENCIES)
