"""Read and write levels of detail of Gaussian splats as PlayCanvas' "streamed SOG".

    lod-meta.json                       the tree of parts of space, and the names of the files
    LEVEL_NUMBER/meta.json and pictures  splats of one level, as in the folder of a .sog; level 0 is the finest

    {"version": 1, "count": of all levels, "counts": of each level, "lodLevels": their number,
     "filenames": ["0_0/meta.json", ...],
     "tree": {"bound": {"min": [x, y, z], "max": [x, y, z]}, "children": [two such nodes]}}

A leaf of the tree has in place of children `"lods": {"0": {"file": 0, "offset": 0, "count": 9}, ...}`: for each level
that has splats there, the index of a file name, and the rows of that file. A viewer loads and shows one level of a
leaf, by its distance and its bound.

Written: space is halved at the median of the centres of all levels, along the longest edge of their box, until a part
has at most 2^15. A bound encloses the ellipsoids of one standard deviation. A file has at most 2^19 splats, or one
part more than that. In each part splats are in Morton order.

Source: playcanvas/splat-transform (write-lod, read-lod).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from nerfbake.formats.splat.sog import KEEPS_ORIGIN as KEEPS_ORIGIN
from nerfbake.formats.splat.sog import KEEPS_UP as KEEPS_UP
from nerfbake.formats.splat.sog import LOD, META, levels_in
from nerfbake.formats.splat.sog_writer import MOST_DEGREE as MOST_DEGREE
from nerfbake.formats.splat.sog_writer import files_of, morton_order
from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.scene.splat_levels import SplatLevels

FILES = re.compile(
    r"lod-meta\.json|[0-9]+_[0-9]+/(meta\.json|(means_l|means_u|scales|quats|sh0|shN_centroids|shN_labels)\.webp)"
)
_LEAF = 1 << 15  # splats of all levels
_FILE = 1 << 19  # splats
_DIGITS = 8  # of a bound, which is wider by its last digit


def recognise(files: Mapping[str, memoryview]) -> bool:
    """Return True for a folder with lod-meta.json, unless it is that of a .sog."""
    return LOD in files and META not in files


def encode(scene: SplatLevels) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the files by name. Raises InvalidScene, MemoryLimit."""
    scene.require_usable()
    levels = scene.levels
    level_of = np.repeat(np.arange(len(levels)), [level.n for level in levels])
    row_of = np.concatenate([np.arange(level.n) for level in levels])
    centres = np.concatenate([level.means.astype(np.float64) for level in levels])
    reach = np.concatenate([level.reach() for level in levels])
    names: list[str] = []
    contents: list[tuple[int, list[Ints]]] = []  # of each file: its level, and the rows of each part
    open_file: dict[int, int] = {}

    def leaf_of(rows: Ints) -> dict[str, Any]:
        lods = {}
        for level in np.unique(level_of[rows]).tolist():
            own = row_of[rows[level_of[rows] == level]]
            own = own[morton_order(levels[level].means[own])]
            file = open_file.get(level)
            if file is None:
                file = open_file[level] = len(names)
                names.append(f"{level}_{sum(each == level for each, _ in contents)}/{META}")
                contents.append((level, []))
            parts = contents[file][1]
            lods[str(level)] = {"file": file, "offset": sum(map(len, parts)), "count": len(own)}
            parts.append(own)
            if sum(map(len, parts)) > _FILE:
                del open_file[level]
        return {"lods": lods}

    def node_of(rows: Ints) -> dict[str, Any]:
        places = centres[rows]
        low, high = places.min(axis=0), places.max(axis=0)
        low_bound, high_bound = (places - reach[rows]).min(axis=0), (places + reach[rows]).max(axis=0)
        bound = {"min": _rounded(low_bound, -1), "max": _rounded(high_bound, 1)}
        if len(rows) <= _LEAF or not (high > low).any():
            return {"bound": bound, **leaf_of(rows)}
        order = rows[np.argsort(places[:, int(np.argmax(high - low))], kind="stable")]
        middle = len(order) // 2
        return {"bound": bound, "children": [node_of(order[:middle]), node_of(order[middle:])]}

    tree = node_of(np.arange(len(centres)))
    counts = [level.n for level in levels]
    meta = {
        "version": 1,
        "asset": {"generator": "nerfbake"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(levels),
        "filenames": names,
        "tree": tree,
    }
    yield LOD, [json.dumps(meta).encode()]
    for name, (level, parts) in zip(names, contents, strict=True):
        folder = name.removesuffix(META)
        for path, data in files_of(levels[level].take(np.concatenate(parts)), ordered=True).items():
            yield folder + path, [data]


def decode(files: Mapping[str, memoryview], *, member: str | None = None) -> SplatLevels:
    """Parse all levels, each with the environment, if there is one. `member`, one of these files, changes nothing.

    Raises InvalidFile, InvalidScene, MemoryLimit.
    """
    return SplatLevels(tuple(levels_in(files)))


def _rounded(point: Floats, sign: int) -> list[float]:
    """Numbers with few digits, rounded away from the bound's inside."""
    return [float(f"{value + sign * 10.0**-_DIGITS * abs(value):.{_DIGITS}g}") for value in point.tolist()]
