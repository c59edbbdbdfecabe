"""atlas.json: what a shader has to know about an atlas, in words and in numbers."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import number, parse_object
from nerfbake.formats.wire.json import whole as whole_number
from nerfbake.kernels.surface.octahedron import tiles_per_row
from nerfbake.scene.atlas import MAX_MAP_SIZE, MAX_TILES, METHODS, Method, OctahedralAtlas

VERSION = 1
_NAME = "atlas.json"

CONVENTION = {
    "up_axis": "y, in the mesh's own coordinates",
    "direction": "unit, from the camera to the surface point",
    "octahedron": "p = d / (|d.x| + |d.y| + |d.z|); d.y >= 0: q = p.xz; else q = (1 - |p.zx|) * (p.xz < 0 ? -1 : 1); "
    "uv = q / 2 + 1/2",
    "map_texel": "texel (i, j) of a map holds the colour at its centre, uv = ((i + 1/2), (j + 1/2)) / map_size",
    "origin": "texel (0, 0) of every texture is the first of its PNG, the upper left one; v points down, as in glTF",
    "tile": "tile t starts at texel ((t % tiles_per_row), (t / tiles_per_row)) * (map_size + 2 border) + border",
    "gutter": "border texels around each tile, by octahedral wrap: (-1, j) = (0, map_size - 1 - j), "
    "(map_size, j) = (map_size - 1, map_size - 1 - j), rows likewise, corners both",
    "labels": "label = red + 256 green, 0..255 each",
    "filter": {"atlas": "linear, no mips", "labels": "nearest, no mips", "features": "nearest, no mips"},
    "colour_space": "all textures hold linear numbers: no sRGB decoding; colour = clamp(diffuse + specular, 0, 1), "
    "diffuse as the file's bytes / 255, the result being what a screen shows",
    "kmeans": "specular = tile[label]",
    "affine": "o = (255 features - 127) / 255; s = slope * labels.blue; specular = tile[4 label] + "
    "sum over i = 0..2 of s * o[i] * (255 tile[4 label + 1 + i] - 128) / 127",
    "grid": "p = features * (n - 1); low = min(floor(p), n - 2); f = p - low; from node low = (r n + g) n + b to its "
    "opposite corner, axes by decreasing f: weights 1 - f0, f0 - f1, f1 - f2, f2 of the four tiles met",
}


class Entry(NamedTuple):
    """One cascade, as parse() gives it back."""

    method: Method
    maps: int
    map_size: int
    border: int
    slope: float
    slopes: npt.NDArray[np.uint8] | None


def entry(atlas: OctahedralAtlas) -> dict[str, Any]:
    """What describes one cascade's atlas."""
    H, W = atlas.labels.shape
    numbers: dict[str, Any] = {
        "method": atlas.method,
        "maps": len(atlas.tiles),
        "clusters": atlas.K,
        "map_size": atlas.R,
        "border": atlas.border,
        "tiles_per_row": tiles_per_row(len(atlas.tiles)),
        "texture_size": [W, H],
    }
    if atlas.method == "grid":
        numbers["n"] = atlas.n
    if atlas.slopes is not None:
        numbers |= {"slope": atlas.slope, "slopes": atlas.slopes.tolist()}
    return numbers


def parse(view: memoryview) -> dict[str, Any]:
    """{'cascades': [Entry, ...], 'facts': everything else}. Raises InvalidFile for what no encoder wrote."""
    document = parse_object(view, _NAME)
    if document.get("nerfbake_atlas") != VERSION:
        raise InvalidFile(Problem(_NAME, "is no atlas description", f'an object with "nerfbake_atlas": {VERSION}'))
    cascades = document.pop("cascades", None)
    if not isinstance(cascades, list) or not cascades or not all(isinstance(one, dict) for one in cascades):
        raise InvalidFile(Problem(f"{_NAME}: cascades", "is no list of objects", "one object a cascade"))
    return {"cascades": [_entry(one, f"{_NAME}: cascades[{i}]") for i, one in enumerate(cascades)], "facts": document}


def _entry(numbers: dict[str, Any], place: str) -> Entry:
    def whole(key: str, low: int, high: int) -> int:
        return whole_number(numbers, key, place, low=low, high=high)

    method = numbers.get("method")
    if method not in METHODS:
        raise InvalidFile(Problem(f"{place}.method", f"is {str(method)[:40]}", ", ".join(METHODS)))
    slope, slopes = number(numbers, "slope", place, default=1.0), numbers.get("slopes")
    if slopes is not None and not (
        isinstance(slopes, list) and all(type(share) is int and 0 <= share <= 255 for share in slopes)
    ):
        raise InvalidFile(Problem(f"{place}.slopes", "is no list of bytes", "0 to 255 for each cluster"))
    return Entry(
        method,
        whole("maps", 1, MAX_TILES),
        whole("map_size", 2, MAX_MAP_SIZE),
        whole("border", 0, MAX_MAP_SIZE // 2),
        slope,
        None if slopes is None else np.array(slopes, np.uint8),
    )
