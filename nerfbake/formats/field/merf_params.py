"""MERF's scene_params.json: how fine its planes and its grid of blocks are, what its bytes stand for, and the MLP."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.baked_folder import PARAMS, SMERF, Three, atlas_of, deferred_mlp, params_of
from nerfbake.formats.wire.json import number, table, whole
from nerfbake.scene.lattice_blocks import MAX_BLOCK
from nerfbake.scene.lattice_colour import DeferredColour

WORLD = 4.0  # edge of the cube that all of the world is contracted to, from -2 to 2 along each axis
_LEAST, _MOST = 4, 16384  # nodes along an edge of this cube
# Of a raw value: e to the power of four such densities is far from the last number that float32 has.
_MOST_DENSITY, _MOST_FEATURE = 20.0, 1000.0
_CLOSE = 1e-4  # of a node's width: what digits in a JSON file may lose
_ALLOWED = "a folder of google-research's MERF"


class Range(NamedTuple):
    """What the bytes 0 and 255 stand for."""

    low: float
    high: float


class Params(NamedTuple):
    """planes: nodes along an edge of the three planes, 0 where there are none; grid: nodes along an edge of the grid,
    of which those of a block are `block` apart from the next one's; atlas (W, H, D) in nodes and in whole blocks."""

    planes: int
    grid: int
    block: int
    atlas: Three
    atlas_blocks: Three
    density: Range
    features: Range
    colour: DeferredColour

    @property
    def blocks(self) -> int:
        """Along an edge of the grid."""
        return -(-self.grid // self.block)


def decode_params(files: Mapping[str, memoryview]) -> Params:
    """Raises InvalidFile for what is missing or wrong, and for other programs' files of this name."""
    fields = params_of(files, SMERF, _ALLOWED)
    planes, grid = _resolution(fields, "triplane"), _resolution(fields, "sparse_grid")
    if not grid:
        found = "has no sparse grid, whose blocks say where anything is"
        raise InvalidFile(Problem(PARAMS, found, "a sparse_grid_resolution above 0"))
    block = whole(fields, "data_block_size", PARAMS, low=1, high=MAX_BLOCK)
    whole(fields, "slice_depth", PARAMS, default=1, low=1, high=1)
    atlas, atlas_blocks = atlas_of(fields, block + 1)
    density, features = (
        _range(fields, f"range_{what}", most)
        for what, most in (("density", _MOST_DENSITY), ("features", _MOST_FEATURE))
    )
    colour = DeferredColour(deferred_mlp(fields, direction_first=False), squashed=True)
    return Params(planes, grid, block, atlas, atlas_blocks, density, features, colour)


def _resolution(fields: dict[str, Any], what: str) -> int:
    """Nodes along an edge; 0 where the file says that there are none."""
    count = whole(fields, f"{what}_resolution", PARAMS, low=-1, high=_MOST)
    if count <= 0:
        return 0
    if count < _LEAST:
        raise InvalidFile(Problem(f"{PARAMS}: {what}_resolution", f"is {count}", f"{_LEAST} to {_MOST:,}, or -1"))
    size = number(fields, f"{what}_voxel_size", PARAMS)
    if abs(size * count - WORLD) > _CLOSE * WORLD:
        found = f"is {size:g}: of another world than MERF's, as torch-merf's are"
        raise InvalidFile(Problem(f"{PARAMS}: {what}_voxel_size", found, f"4 / {count}"))
    return count


def _range(fields: dict[str, Any], name: str, most: float) -> Range:
    low, high = table(fields.get(name), f"{PARAMS}: {name}", (2,)).tolist()
    if not -most <= low < high <= most:
        raise InvalidFile(Problem(f"{PARAMS}: {name}", f"is {low:g} to {high:g}", f"two numbers, rising, to {most:g}"))
    return Range(low, high)
