"""The unit sphere unfolded into a square: mapping, inverse, texels, gutter and lookups.

    p = d / (|x| + |y| + |z|)         y is up: the upper half is the inner diamond, the lower half the four corners
    y >= 0   (u, v) = (p.x, p.z)
    y <  0   (u, v) = ((1 - |p.z|) sgn p.x, (1 - |p.x|) sgn p.z)          sgn 0 = 1
    uv / 2 + 1/2 in [0, 1]

A map is R x R texels, map[row, column] with u along columns and v down the rows; texel (i, j) is the colour at its
centre, u = (i + 1/2) / R, v = (j + 1/2) / R.
Source: docs/formats/atlas.md, "Octahedral maps".
"""

from __future__ import annotations

from math import ceil, sqrt
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.surface.texture import blend

TexelLookup = Literal["bilinear", "nearest", "thesis"]


def uv_of(directions: npt.NDArray[Any]) -> Floats:
    """(..., 3) directions of any length above 0 -> (..., 2) in [0, 1]."""
    d = np.asarray(directions, np.float64)
    p = d / np.abs(d).sum(axis=-1, keepdims=True)
    flat = p[..., [0, 2]]
    folded = (1 - np.abs(flat[..., ::-1])) * _sign(flat)
    return np.asarray(np.where(p[..., 1:2] >= 0, flat, folded) / 2 + 0.5)


def directions_of(uv: npt.NDArray[Any]) -> Floats:
    """(..., 2) in [0, 1] -> (..., 3) unit directions: the inverse of uv_of()."""
    flat = np.asarray(uv, np.float64) * 2 - 1
    y = 1 - np.abs(flat).sum(axis=-1, keepdims=True)
    flat = np.where(y >= 0, flat, (1 - np.abs(flat[..., ::-1])) * _sign(flat))
    d = np.concatenate([flat[..., :1], y, flat[..., 1:]], axis=-1)
    return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))


def _sign(values: Floats) -> Floats:
    return np.where(values < 0, -1.0, 1.0)


def texel_directions(R: int) -> Floats:
    """(R * R, 3) unit directions of the texel centres, row by row."""
    centre = (np.arange(R) + 0.5) / R
    v, u = np.meshgrid(centre, centre, indexing="ij")
    return directions_of(np.stack([u, v], axis=-1).reshape(-1, 2))


def with_gutter(maps: npt.NDArray[Any], border: int) -> npt.NDArray[Any]:
    """Frame maps with their own texels from across the fold: (K, R, R, ...) -> (K, R + 2 border, R + 2 border, ...).

    A path that leaves the square over an edge returns over the same edge, mirrored about its middle. A bilinear lookup
    at the edge then reads the texels beyond it on the sphere, and never the neighbour in the atlas.
    """
    R = maps.shape[1]
    steps = np.arange(-border, R + border)
    row, column = np.meshgrid(steps, steps, indexing="ij")
    for _ in range(2):  # a corner is outside along both axes: it is folded twice
        out = (column < 0) | (column >= R)
        row = np.where(out, R - 1 - row, row)
        column = np.where(column < 0, -1 - column, np.where(column >= R, 2 * R - 1 - column, column))
        row, column = column, row
    return maps[:, row, column]


def read_maps(
    maps: npt.NDArray[Any], directions: npt.NDArray[Any], how: TexelLookup, tiles: Any = slice(None)
) -> npt.NDArray[np.float32]:
    """Look up (K, R, R, C) maps in (n, 3) directions -> (K, n, C) float32.

    bilinear: between texel centres, across the fold at the edges. nearest: the texel that contains the point,
    floor(uv R). thesis: texel int(uv (R - 1)), as in the published metric. tiles: instead of all maps, the number (...)
    of one map for each direction (..., 3) -> (..., C).
    """
    R = maps.shape[1]
    uv = uv_of(directions)
    if how != "bilinear":
        at = np.minimum((uv * (R - 1 if how == "thesis" else R)).astype(np.int64), R - 1)
        return np.asarray(maps[tiles, at[..., 1], at[..., 0]], np.float32)
    framed = with_gutter(maps, 1)
    return blend(lambda y, x: framed[tiles, y, x], uv * R + 0.5)  # in texel centres of the framed map


def tiles_per_row(K: int) -> int:
    return ceil(sqrt(K))


def pack(maps: npt.NDArray[np.uint8], border: int) -> npt.NDArray[np.uint8]:
    """Pack (K, R, R, 3) maps into the atlas, an image of ceil(sqrt K) framed maps per row; unused places are black."""
    K = len(maps)
    per_row = tiles_per_row(K)
    rows = ceil(K / per_row)
    edge = maps.shape[1] + 2 * border
    image = np.zeros((rows, edge, per_row, edge, 3), np.uint8)
    for row in range(rows):
        framed = with_gutter(maps[row * per_row : (row + 1) * per_row], border)
        image[row, :, : len(framed)] = framed.transpose(1, 0, 2, 3)
    return image.reshape(rows * edge, per_row * edge, 3)


def unpack(image: npt.NDArray[np.uint8], K: int, R: int, border: int) -> npt.NDArray[np.uint8]:
    """The maps of an atlas, without their frames: the inverse of pack()."""
    edge, per_row = R + 2 * border, tiles_per_row(K)
    framed = image.reshape(-1, edge, per_row, edge, 3).transpose(0, 2, 1, 3, 4).reshape(-1, edge, edge, 3)[:K]
    return np.ascontiguousarray(framed[:, border : border + R, border : border + R])
