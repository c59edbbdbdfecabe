"""Read the common parts of SNeRG and MERF folders: scene_params.json, PNGs, the blocks of an atlas, the deferred MLP.

Sources: the files that these programs write; docs/formats/checkpoints.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.torch_model import layers_of
from nerfbake.formats.wire.json import parse_object, table, whole
from nerfbake.formats.wire.picture import opened
from nerfbake.kernels.arrays import Singles
from nerfbake.scene.lattice_field import MlpColour
from nerfbake.scene.stage1 import MAX_WEIGHT

PARAMS = "scene_params.json"
EMPTY = 255  # red value of an empty block
FEATURES = 4  # inputs of the MLP, in addition to the colour and the direction
MAX_ATLAS = 4096  # voxels along an edge
_SMERF = "a key of SMERF, a field of many MLPs"
SMERF = dict.fromkeys(("scene_scale_factor", "ranges", "submodel_idx", "deferred_rendering_mode"), _SMERF)
_FREQUENCIES = (1.0, 2.0, 4.0, 8.0)
_LAYERS, _COLOURS = 3, 3

Bytes = npt.NDArray[np.uint8]
Three = tuple[int, int, int]


def params_of(files: Mapping[str, memoryview], refused: Mapping[str, str], allowed: str) -> dict[str, Any]:
    """Parse scene_params.json.

    refused: keys of other programs' files, with a description for the error message. Raises InvalidFile.
    """
    if PARAMS not in files:
        raise InvalidFile(Problem(PARAMS, "is missing", allowed))
    fields = parse_object(files[PARAMS], PARAMS)
    for key, what in refused.items():
        if key in fields:
            raise InvalidFile(Problem(PARAMS, f"has {key}: {what}", allowed))
    return fields


def read_three(numbers: Iterable[Any]) -> Three:
    x, y, z = numbers
    return x, y, z


def sizes_of(fields: Mapping[str, Any], what: str, most: int) -> Three:
    """Return width, height and depth in voxels."""
    names = (f"{what}_{edge}" for edge in ("width", "height", "depth"))
    return read_three(whole(fields, name, PARAMS, low=1, high=most) for name in names)


def atlas_of(fields: Mapping[str, Any], edge: int) -> tuple[Three, Three]:
    """Return the size of the atlas in voxels and in whole blocks, for blocks that are `edge` voxels wide."""
    atlas = sizes_of(fields, "atlas", MAX_ATLAS)
    if min(atlas) < edge:
        raise InvalidFile(Problem(f"{PARAMS}: atlas_width, ...", f"are {atlas}", f"{edge} or more, for a block"))
    return atlas, read_three(size // edge for size in atlas)


def picture_of(files: Mapping[str, memoryview], name: str, mode: str, size: tuple[int, int], allowed: str) -> Bytes:
    """Decode a PNG to (H, W, channels). Raises InvalidFile unless it has this mode and this (width, height).

    allowed: what the error message allows if the file is missing.
    """
    if name not in files:
        raise InvalidFile(Problem(name, "is missing", allowed))
    with opened(files[name], name, "PNG", bytes_per_pixel=2 * len(mode)) as picture:
        if picture.size != size or picture.mode != mode:
            found = f"has {picture.size[0]}x{picture.size[1]} pixels of {picture.mode}"
            raise InvalidFile(Problem(name, found, f"{size[0]}x{size[1]} of {mode}, as {PARAMS} declares"))
        return np.asarray(picture)


def indices_of(files: Mapping[str, memoryview], name: str, blocks: Three, atlas_blocks: Three, allowed: str) -> Bytes:
    """Read the position in the atlas of each block of the grid, (X, Y, Z, 3); red 255 marks an empty block."""
    X, Y, Z = blocks
    found = picture_of(files, name, "RGB", (X, Y * Z), allowed)
    indices = found.reshape(Z, Y, X, 3).transpose(2, 1, 0, 3)
    occupied = indices[..., 0] != EMPTY
    beyond = occupied & (indices >= np.array(atlas_blocks)).any(axis=3)
    if beyond.any():
        at = tuple(int(i) for i in np.argwhere(beyond)[0])
        target = tuple(int(i) for i in indices[at])
        allowed = f"below {atlas_blocks}, the block counts of the atlas"
        raise InvalidFile(Problem(f"{name}, block {at},", f"points to {target}", allowed))
    a, b, c = indices[occupied].astype(np.int64).T
    if len(np.unique((a << 16) | (b << 8) | c)) != len(a):
        raise InvalidFile(Problem(name, "points to a block of the atlas twice", "once at most"))
    return indices


def deferred_mlp(fields: Mapping[str, Any], *, direction_first: bool) -> MlpColour:
    """Return the MLP whose inputs are the colour, four features, and d with its sines and cosines.

    direction_first: the file's first weight matrix has d before the colour. In the result d always comes last.
    """
    weights: dict[str, Singles] = {}
    biases: dict[str, Singles] = {}
    for layer in range(_LAYERS):
        name = f"{PARAMS}: {layer}_weights"
        weights[name] = _numbers(fields.get(f"{layer}_weights"), name, (None, None)).T
        biases[name] = _numbers(fields.get(f"{layer}_bias"), f"{PARAMS}: {layer}_bias", (None,))
    layers = layers_of(weights, biases)
    count, values = len(_FREQUENCIES), _COLOURS + FEATURES
    code = 3 + 6 * count
    if layers.first.shape[1] != code + values:
        found = f"takes {layers.first.shape[1]} inputs"
        raise InvalidFile(Problem(next(iter(weights)), found, f"{code + values}"))
    # The file sorts sines by frequency first (x, y, z times the first frequency, ...), MlpColour by axis first.
    sines = 3 + np.arange(3 * count).reshape(count, 3).T.reshape(-1)
    encoded = np.concatenate([np.arange(3), sines, sines + 3 * count])
    order = [code + np.arange(values), encoded] if direction_first else [np.arange(values), values + encoded]
    first = np.ascontiguousarray(layers.first[:, np.concatenate(order)])
    return MlpColour(*layers._replace(first=first), frequencies=_FREQUENCIES)


def _numbers(value: Any, place: str, shape: tuple[int | None, ...]) -> Singles:
    """Return weights or biases as float32. Raises InvalidFile above MAX_WEIGHT, which MlpColour also checks."""
    found = table(value, place, shape)
    if found.size and (largest := float(np.abs(found).max())) > MAX_WEIGHT:
        raise InvalidFile(Problem(place, f"has a number as large as {largest:g}", f"up to {MAX_WEIGHT:g}"))
    return found.astype(np.float32)
