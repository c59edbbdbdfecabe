"""Read the output of the thesis' code: octahedron_maps.png, labels_map.png, and optionally results.json. Read only.

The code's arrays are indexed [x][y]: an image with its rows flipped and its axes swapped. The tile of label l is
x = l // W, y = l % W, with W = ceil(sqrt K). Texel (i, j) of a map is the colour at uv = (i, j) / R, a corner,
truncated to 8 bits. Texels are returned unchanged; the lookup `thesis` takes this convention into account. Labels:
red + 256 green + 65536 blue.
Source: "Using K-Means clustering to export a NeRF" (docs/sources.md); docs/formats/atlas.md, "The thesis' files".
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import parse_object, whole
from nerfbake.formats.wire.picture import decode_texture
from nerfbake.kernels.surface.octahedron import tiles_per_row
from nerfbake.scene.atlas import MAX_MAP_SIZE, MAX_TILES, BakedAtlas, OctahedralAtlas

_PICTURES = ("octahedron_maps.png", "labels_map.png")
_LABEL = 6  # bytes of a label while it is put together
_SIZES = {"final_clusters": MAX_TILES, "mapping_resolution": MAX_MAP_SIZE}


def recognise(files: Mapping[str, memoryview]) -> bool:
    return "octahedron_maps.png" in files


def decode(files: Mapping[str, memoryview]) -> BakedAtlas:
    for name in _PICTURES:
        if name not in files:
            raise InvalidFile(Problem(name, "is missing", " and ".join(_PICTURES)))
    image, texels = (decode_texture(files[name], name) for name in _PICTURES)
    memory.hold("the atlas", image.nbytes + _LABEL * len(texels) * texels.shape[1])
    labels = (texels[..., 0] | texels[..., 1].astype(np.uint16) << 8).astype(np.uint16)
    K, R = _sizes(files, image.shape, int(labels.max()) + 1)
    if texels[..., 2].any():
        raise InvalidFile(Problem("labels_map.png", "has labels above 65,535", f"0 to {K - 1}"))
    W = tiles_per_row(K)
    if image.shape != (W * R, W * R, 3):
        found = f"has {image.shape[1]}x{image.shape[0]} texels"
        raise InvalidFile(Problem("octahedron_maps.png", found, f"{W * R}x{W * R} for {K} maps of {R} texels"))
    # The thesis' [x][y] order: tile column, texel column, tile row, texel row.
    maps = image[::-1].swapaxes(0, 1).reshape(W, R, W, R, 3)
    tiles = maps.transpose(0, 2, 3, 1, 4).reshape(W * W, R, R, 3)[:K]
    atlas = OctahedralAtlas("kmeans", np.ascontiguousarray(tiles), labels, border=0)
    return BakedAtlas((atlas,), (None,), {}, {})


def _sizes(files: Mapping[str, memoryview], shape: tuple[int, ...], used: int) -> tuple[int, int]:
    """Return K and R from results.json, or else from the labels in use and the size of octahedron_maps.png."""
    if "results.json" in files:
        results = parse_object(files["results.json"], "results.json")
        K, R = (whole(results, key, "results.json", low=1, high=high) for key, high in _SIZES.items())
        return K, R
    W = tiles_per_row(used)
    if shape[0] != shape[1] or shape[0] % W or not 2 * W <= shape[0] <= MAX_MAP_SIZE * W:
        found = f"has {shape[1]}x{shape[0]} texels"
        raise InvalidFile(Problem("octahedron_maps.png", found, f"{W}x{W} maps for {used:,} labels, or a results.json"))
    return used, shape[0] // W
