"""Octahedral atlas and the MLP it replaces -> how far apart they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.cluster import colours
from nerfbake.kernels.surface import mlp
from nerfbake.kernels.surface.mlp import Shown
from nerfbake.kernels.surface.octahedron import TexelLookup
from nerfbake.scene.atlas import OctahedralAtlas
from nerfbake.scene.specular import SpecularField

_TEXEL_BYTES = 32  # a used texel, while those of one error are counted (23 to 35 measured)
_COLOUR_BYTES = 180  # a distinct combination of colour, label and feature (64 to 179 measured)
_SHOWN_BYTES = 16  # a channel of a map in a direction (16 measured)


class AtlasError(NamedTuple):
    """Differences in 0..255, mean over the used texels, the directions and the three channels."""

    mae: float  # of whole numbers, as 8-bit pictures hold them
    mse: float
    mae_float: float  # before rounding
    mse_float: float
    texels: int
    colours: int  # distinct combinations of colour, label and feature


def measure_atlas_error(
    atlas: OctahedralAtlas,
    field: SpecularField,
    *,
    directions: npt.NDArray[np.float64],
    lookup: TexelLookup = "bilinear",
    thesis_fault: bool = False,
) -> AtlasError:
    """The error of an atlas over every used texel and N unit directions (N, 3).

    lookup: kernels.surface.octahedron.read_maps() says which there are; `thesis` also truncates colours where others
    round, and evaluates the MLP in float64. thesis_fault: the published evaluation divides its table of directions by
    their L1 norm in place, so that it asks the MLP at non-unit directions for all but the first colour that it meets
    (the texture is read by columns from the bottom left). Raises InvalidScene if the textures differ in size, and
    MemoryLimit.
    Source: docs/formats/atlas.md, "What the published code gets wrong".

    >>> import numpy as np
    >>> from nerfbake import bake_atlas, measure_atlas_error, sample_stage1
    >>> field = sample_stage1(resolution=16).fields[0]
    >>> atlas = bake_atlas(field, clusters=4, map_size=8)
    >>> 0 < measure_atlas_error(atlas, field, directions=np.eye(3)).mae < 64
    True
    """
    if atlas.labels.shape != field.features.shape[:2]:
        found, allowed = (f"{shape[1]}x{shape[0]}" for shape in (atlas.labels.shape, field.features.shape))
        raise InvalidScene(Problem("labels", f"have {found} texels", f"{allowed} as the feature texture has"))
    shown_channels = 3 * len(atlas.tiles) * len(directions)
    memory.require("the texture's texels", int(field.used.sum()) * _TEXEL_BYTES)
    memory.require(f"{len(atlas.tiles):,} maps in {len(directions):,} directions", shown_channels * _SHOWN_BYTES)
    keys, counts = np.unique(_keys(atlas, field), return_counts=True)
    memory.require(f"{len(keys):,} colours", len(keys) * _COLOUR_BYTES)
    codes = (keys >> 40).astype(np.uint32)
    features = colours.colours_of((keys & 0xFFFFFF).astype(np.uint32))
    index, weight = atlas.terms((keys >> 24 & 0xFFFF).astype(np.uint16), features)
    table = atlas.show(directions, lookup).transpose(0, 2, 1).reshape(len(atlas.tiles), -1)
    shown = Shown(table, index, weight)
    asked = directions / np.abs(directions).sum(axis=1, keepdims=True) if thesis_fault else directions
    sums = _sums(field, codes, shown, asked, lookup)
    if thesis_fault:
        first = codes == colours.codes_of(_first_met(field))
        met = Shown(table, index[first], weight[first])
        sums[first] = _sums(field, codes[first], met, directions, lookup)
    means = (counts[:, None] * sums).sum(axis=0) / (counts.sum() * table.shape[1])
    mae, mse, mae_float, mse_float = means.tolist()
    return AtlasError(mae, mse, mae_float, mse_float, int(counts.sum()), len(keys))


def _keys(atlas: OctahedralAtlas, field: SpecularField) -> npt.NDArray[np.uint64]:
    """Everything that a used texel's error depends on, in 64 bits: colour code, label, feature code."""
    keys = colours.codes_of(field.features[field.used]).astype(np.uint64) << np.uint64(40)
    keys |= atlas.labels[field.used].astype(np.uint64) << np.uint64(24)
    if atlas.features is not None:
        keys |= colours.codes_of(atlas.features[field.used])
    return keys


def _first_met(field: SpecularField) -> npt.NDArray[np.uint8]:
    column = int(np.argmax(field.used.any(axis=0)))
    row = int(np.flatnonzero(field.used[:, column])[-1])
    first: npt.NDArray[np.uint8] = field.features[row, column]
    return first


def _sums(
    field: SpecularField,
    codes: npt.NDArray[np.uint32],
    shown: Shown,
    directions: npt.NDArray[np.float64],
    lookup: TexelLookup,
) -> npt.NDArray[np.float64]:
    """(m, 4) the differences of m texels, kernels.mlp.differences."""
    features = colours.colours_of(codes) / 255
    if lookup == "thesis":
        return mlp.exact_differences(features, directions, field.w0, field.w1, shown)
    return mlp.differences(features, mlp.split_layers(directions, field.w0, field.w1), shown)
