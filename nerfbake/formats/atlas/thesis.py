"""What the thesis' own code leaves behind: octahedron_maps.png, labels_map.png, perhaps results.json. Read only.

Its arrays are indexed [x][y]: an image with its rows flipped and its axes swapped. Tile of label l, W = ceil(sqrt K):
x = l // W, y = l % W. Texel (i, j) of a map stands for uv = (i, j) / R, a corner, its colour cut to 8 bits; that is for
the lookup to know (`thesis`), the texels are given as they are. Labels: red + 256 green + 65536 blue.
Source: "Using K-Means clustering to export a NeRF" (docs/sources.md); docs/formats/atlas.md, "The thesis' files".
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import parse_object, whole
from nerfbake.formats.wire.texture import decode_texture
from nerfbake.kernels.surface.octahedron import tiles_per_row
from nerfbake.scene.atlas import MAX_MAP_SIZE, MAX_TILES, BakedAtlas, OctahedralAtlas

_PICTURES = ("octahedron_maps.png", "labels_map.png")
_SIZES = {"final_clusters": MAX_TILES, "mapping_resolution": MAX_MAP_SIZE}


def recognise(files: Mapping[str, memoryview]) -> bool:
    return "octahedron_maps.png" in files


def decode(files: Mapping[str, memoryview]) -> BakedAtlas:
    for name in _PICTURES:
        if name not in files:
            raise InvalidFile(Problem(name, "is missing", " and ".join(_PICTURES)))
    image, texels = (decode_texture(files[name], name) for name in _PICTURES)
    labels = (texels[..., 0] | texels[..., 1].astype(np.uint16) << 8).astype(np.uint16)
    K, R = _sizes(files, image.shape, int(labels.max()) + 1)
    if texels[..., 2].any():
        raise InvalidFile(Problem("labels_map.png", "has labels above 65,535", f"0 to {K - 1}"))
    W = tiles_per_row(K)
    if image.shape != (W * R, W * R, 3):
        found = f"has {image.shape[1]}x{image.shape[0]} texels"
        raise InvalidFile(Problem("octahedron_maps.png", found, f"{W * R}x{W * R} for {K} maps of {R} texels"))
    # [x][y] of the thesis: tile column, then texel column, then tile row, then texel row.
    maps = image[::-1].swapaxes(0, 1).reshape(W, R, W, R, 3)
    tiles = maps.transpose(0, 2, 3, 1, 4).reshape(W * W, R, R, 3)[:K]
    atlas = OctahedralAtlas("kmeans", np.ascontiguousarray(tiles), labels, border=0)
    return BakedAtlas((atlas,), (None,), {}, {})


def _sizes(files: Mapping[str, memoryview], shape: tuple[int, ...], used: int) -> tuple[int, int]:
    """K and R: as results.json has them; without one, from the labels that are used and the edge of the maps' image."""
    if "results.json" in files:
        results = parse_object(files["results.json"], "results.json")
        K, R = (whole(results, key, "results.json", low=1, high=high) for key, high in _SIZES.items())
        return K, R
    W = tiles_per_row(used)
    if shape[0] != shape[1] or shape[0] % W or not 2 * W <= shape[0] <= MAX_MAP_SIZE * W:
        found = f"has {shape[1]}x{shape[0]} texels"
        raise InvalidFile(Problem("octahedron_maps.png", found, f"{W}x{W} maps for {used:,} labels, or a results.json"))
    return used, shape[0] // W
