"""SNeRG's scene_params.json: how large the grid, its blocks and the atlas are, where the grid stands, and the MLP."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.baked_folder import PARAMS, SMERF, atlas_of, deferred_mlp, params_of, sizes_of, three
from nerfbake.formats.wire.json import number, table, whole
from nerfbake.kernels.arrays import Points
from nerfbake.scene.lattice_colour import DeferredColour
from nerfbake.scene.lattice_field import MAX_EDGE

_MAX_BLOCK = 254
# What other programs' folders with such a file are told by.
_REFUSED = SMERF | {"triplane_resolution": "of MERF, whose pictures have other names than SNeRG's"}
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


def decode_params(files: Mapping[str, memoryview]) -> Params:
    """Raises InvalidFile for what is missing or wrong, and for other programs' files of this name."""
    fields = params_of(files, _REFUSED, _ALLOWED)
    if fields.get("ndc", False) is not False:
        found = "has ndc: a forward-facing scene, whose lattice is no box of the world"
        raise InvalidFile(Problem(PARAMS, found, "a bounded scene of SNeRG"))
    if fields.get("format", "png") != "png":
        raise InvalidFile(Problem(f"{PARAMS}: format", "is another", "png"))
    block = whole(fields, "block_size", PARAMS, low=1, high=_MAX_BLOCK)
    grid = sizes_of(fields, "grid", MAX_EDGE - 2)
    atlas, atlas_blocks = atlas_of(fields, block + 2)
    axes, signs, move = _turn(fields)
    return Params(
        block,
        three(-(-edge // block) for edge in grid),
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
    """worldspace_T_opengl, which may swap axes, turn them around, and move."""
    place = f"{PARAMS}: worldspace_T_opengl"
    matrix = table(fields.get("worldspace_T_opengl"), place, (4, 4))
    turn = matrix[:3, :3]
    ones = np.abs(turn) == 1
    if not (ones.sum(axis=0) == 1).all() or np.count_nonzero(turn) != 3 or (matrix[3] != (0, 0, 0, 1)).any():
        raise InvalidFile(Problem(place, "is another turn", "rows and columns with one 1 or -1 each, then a shift"))
    axes = three(int(axis) for axis in ones.argmax(axis=1))
    signs = three(int(turn[i, axis]) for i, axis in enumerate(axes))
    return axes, signs, matrix[:3, 3]
