"""Read and write Gaussian splats as PlayCanvas' .sog: a zip archive of meta.json and lossless WebP pictures.

In most pictures a pixel stands for a splat.

    means_l, means_u   16 bits: t = min + (max - min) (low + 256 high) / 65535, x = sign(t) (e^|t| - 1)
    quats              red green blue: (v / 255 * 2 - 1) / sqrt 2; alpha 252 to 255: which of w x y z is left out
    scales             e^codebook[v]
    sh0                red green blue: codebook[v]; alpha: the opacity
    shN_labels         red + 256 green: the entry of the palette
    shN_centroids      the palette, 64 entries a row, each 3, 8 or 15 pixels wide: codebook[v]

Version 1 has no `version`. It has a minimum and a maximum in place of each codebook, and alpha of sh0 is a logit.
Splats are antialiased if meta.json has "antialias": true (older) or "model": "antialiased".

A scene of several levels is a lod-meta.json with a tree; its leaves name ranges of rows in folders with a meta.json
each, by level. Level 0 is the finest. sog_levels.py draws it.

sog_writer.py writes version 2.

Source: playcanvas/splat-transform (read-sog, read-sog-v1, read-lod).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.splat.ply import exp_or_nan, sigmoid_or_nan, with_largest
from nerfbake.formats.splat.sog_writer import MOST_DEGREE as MOST_DEGREE
from nerfbake.formats.splat.sog_writer import archive_of
from nerfbake.formats.splat.sog_writer import in_order as in_order
from nerfbake.formats.wire.json import key_place, kind_of, parse_object, shorten, table, whole
from nerfbake.formats.wire.picture import decode_lossless_webp
from nerfbake.formats.wire.zip_reader import ZipFolder, npz_keys, own_names
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import expm1
from nerfbake.kernels.soundness import plural
from nerfbake.scene.splats import SplatRows, Splats, join_splats, splats_in_blocks, splats_size

Bytes = npt.NDArray[np.uint8]
META, LOD = "meta.json", "lod-meta.json"
KEEPS_ORIGIN = False
KEEPS_UP = False
_WIDTHS = (0, 3, 8, 15)  # pixels of an entry of the palette, by degree
_A_ROW = 64  # entries of the palette
_PALETTE = 1 << 16  # entries at most: a label has 16 bits
_MOST = 1 << 32  # splats
_MODELS = (None, "default", "antialiased", "2dgs")
_FIRST_TAG = 252
_MOST_PER_BYTE = 256  # splats
_LEVELS = 32
_SPARE = 1 << 14  # pixels of a picture beyond four for each splat
_NAME = re.compile(r"[^/\\:\0]{1,200}")


def recognise(view: memoryview) -> bool:
    """Return True for an archive with a meta.json, at its top or in a folder."""
    return any(name.rpartition("/")[2] in (META, LOD) for name in own_names(npz_keys(view)))


def encode(scene: Splats) -> Iterator[bytes]:
    """Encode splats in version 2, in another order, with codebooks that are fitted to them. Raises InvalidScene."""
    yield archive_of(scene)


def decode(view: memoryview) -> Splats:
    """Parse splats. Raises InvalidFile, InvalidScene, MemoryLimit.

    An archive may contain the folder instead of its files, as the Finder packs it.
    """
    files = ZipFolder(view, "a .sog")
    return splats_in(files.below(_folder(files)))


def _folder(files: Iterable[str]) -> str:
    """Return the folder of the only lod-meta.json or else meta.json; '' for the top. Raises InvalidFile."""
    places = {key: [name.removesuffix(key) for name in files if name.rpartition("/")[2] == key] for key in (LOD, META)}
    if "" in (both := places[LOD] + places[META]) or not both:
        return ""
    found = places[LOD] or places[META]
    if len(found) > 1:
        names = ", ".join(found[:3])
        raise InvalidFile(Problem("the archive", f"has {len(found):,} scenes, in {names[:100]}", "one scene"))
    return found[0]


def splats_in(files: Mapping[str, memoryview]) -> Splats:
    """Return the splats in these files, of several levels the finest. Raises InvalidFile, InvalidScene, MemoryLimit."""
    if META in files:
        return _scene(files, META)
    if LOD not in files:
        raise InvalidFile(Problem(META, "is missing", "a .sog, or its folder, with it"))
    return _finest(files)


def _finest(files: Mapping[str, memoryview]) -> Splats:
    """Return the splats that the leaves of the tree have in their finest levels."""
    root = parse_object(files[LOD], LOD)
    found = _rows_of(files, root, [levels[min(levels)] for levels in _leaves(root)])
    return replace(found, notes=(*found.notes, f"of the levels of {LOD}, only the finest is read"))


def levels_in(files: Mapping[str, memoryview]) -> list[Splats]:
    """Return the splats of each level, the finest first. Raises InvalidFile, InvalidScene, MemoryLimit."""
    if LOD not in files:
        raise InvalidFile(Problem(LOD, "is missing", "a folder with it"))
    root = parse_object(files[LOD], LOD)
    leaves = _leaves(root)
    known = sorted({level for leaf in leaves for level in leaf})
    if len(known) > _LEVELS:
        raise InvalidFile(Problem(LOD, f"has {len(known)} levels", f"at most {_LEVELS}"))
    if not known:
        raise InvalidScene(Problem("the splats", "have no rows", "at least one splat"))
    return [_rows_of(files, root, [leaf[level] for leaf in leaves if level in leaf]) for level in known]


def _leaves(root: dict[str, Any]) -> list[dict[int, tuple[str, int, int]]]:
    """Return for each leaf of the tree its levels: the path of a meta.json, its first row, and the number of rows."""
    names = _list(root, "filenames", LOD)
    leaves = []
    waiting = [root.get("tree")]
    while waiting:
        node = waiting.pop()
        if not isinstance(node, dict):
            raise InvalidFile(Problem(f"{LOD}: tree", f"has {kind_of(node)}", "objects with 'children' or 'lods'"))
        waiting += reversed(_list(node, "children", "tree"))
        levels = node.get("lods", {})
        if not isinstance(levels, dict) or not all(re.fullmatch("[0-9]{1,3}", level) for level in levels):
            raise InvalidFile(Problem(f"{LOD}: lods", "are no levels", "an object with whole numbers as names"))
        if levels:
            leaves.append({int(level): _range(each, names) for level, each in levels.items()})
    return leaves


def _range(level: Any, names: list[Any]) -> tuple[str, int, int]:
    if not isinstance(level, dict):
        raise InvalidFile(Problem(f"{LOD}: lods", f"have {kind_of(level)}", "objects"))
    file = whole(level, "file", "lods", high=len(names) - 1)
    start, count = (whole(level, key, "lods", high=_MOST) for key in ("offset", "count"))
    return _path(names[file], "filenames"), start, count


def _rows_of(files: Mapping[str, memoryview], root: dict[str, Any], ranges: Iterable[tuple[str, int, int]]) -> Splats:
    """Return the splats of these ranges of files, and those of the environment."""
    places: dict[str, list[tuple[int, int]]] = {}
    for path, start, count in ranges:
        places.setdefault(path, []).append((start, count))
    if root.get("environment") is not None:
        places.setdefault(_path(root["environment"], "environment"), []).append((0, -1))
    parts = []
    for path, rows in places.items():
        part = _scene(files, path)
        for start, count in rows:
            end = part.n + part.dropped if count < 0 else start + count
            if end > part.n + part.dropped:
                found = f"has rows up to {end:,} of {part.n:,} in {path}"
                raise InvalidFile(Problem(f"{LOD}: lods", found, "rows that the file has"))
            if part.dropped:
                raise InvalidScene(Problem(path, "has rows that cannot be drawn", "finite numbers"))
            if end > start:
                parts.append(part.take(slice(start, end)))
    if not parts:
        raise InvalidScene(Problem("the splats", "have no rows", "at least one splat"))
    memory.hold("the splats of a level", splats_size(sum(part.n for part in parts), max(part.B for part in parts)))
    return join_splats(parts)


def _path(value: Any, place: str) -> str:
    """Return the path of a meta.json below the folder. Raises InvalidFile."""
    parts = value.split("/") if isinstance(value, str) else []
    if not 1 < len(parts) <= 9 or parts[-1] != META or not all(_is_name(part) for part in parts):
        raise InvalidFile(Problem(f"{LOD}: {place}", f"has {shorten(value)!r}", f"FOLDER/{META} below this folder"))
    return str(value)


def _is_name(text: str) -> bool:
    return bool(_NAME.fullmatch(text)) and text not in (".", "..")


def _list(fields: Mapping[str, Any], key: str, place: str) -> list[Any]:
    value = fields.get(key, [])
    if not isinstance(value, list):
        raise InvalidFile(Problem(key_place(place, key), f"is {kind_of(value)}", "a list"))
    return value


class _Part:
    """One of the attributes in meta.json, with its pictures. Each check names its place."""

    def __init__(self, files: Mapping[str, memoryview], meta: Mapping[str, Any], key: str, place: str) -> None:
        self._files, self._folder, self.place = files, place.removesuffix(META), f"{place}: {key}"
        value = meta.get(key)
        if not isinstance(value, dict):
            raise InvalidFile(Problem(self.place, f"is {kind_of(value)}", "an object"))
        self.fields: dict[str, Any] = value

    def picture(self, index: int, pixels: int, most: int) -> Bytes:
        """(pixels, 4) the first pixels of a picture, which must have from `pixels` to `most` of them."""
        image = self.image(index, most)
        found = image.reshape(-1, 4)
        if len(found) < pixels:
            raise InvalidFile(Problem(f"{self.place}.files[{index}]", f"has {len(found):,} pixels", f"{pixels:,}"))
        return found[:pixels]

    def image(self, index: int, most: int) -> Bytes:
        """(H, W, 4)."""
        path, data = self.file(index)
        return decode_lossless_webp(data, path, most)

    def file(self, index: int) -> tuple[str, memoryview]:
        """Path and bytes of a picture."""
        names = _list(self.fields, "files", self.place)
        place = f"{self.place}.files[{index}]"
        name = names[index] if index < len(names) else None
        if not isinstance(name, str) or not _is_name(name):
            raise InvalidFile(Problem(place, f"is {shorten(name)!r}", "the name of a file beside meta.json"))
        path = self._folder + name
        if path not in self._files:
            raise InvalidFile(Problem(path, "is missing", f"a picture, which {self.place} names"))
        return path, self._files[path]

    def numbers(self, key: str, *shape: int) -> Floats:
        return table(self.fields.get(key), f"{self.place}.{key}", shape)

    def decoder(self, codes: Bytes, *, columns: bool = True) -> Callable[[Bytes], Floats]:
        """Return what decodes some of these bytes: a codebook, or in version 1 minimum and maximum (of each column)."""
        if "codebook" in self.fields:
            return self._codebook(int(codes.max(initial=0))).__getitem__
        low, high = (self.numbers(key, *codes.shape[1:2]) if columns else self.numbers(key) for key in ("mins", "maxs"))
        return lambda some: np.asarray(low + (high - low) * (some / 255))

    def _codebook(self, last: int) -> Floats:
        """The numbers of a codebook, up to the entry `last` or more: 256, or fewer for few splats.

        PlayCanvas' older writers have null for the first, the logarithm of 0. Their engine extrapolates it in this way.
        """
        place, values = f"{self.place}.codebook", self.fields["codebook"]
        null = isinstance(values, list) and values[:1] == [None]
        numbers = table(values[1:] if null else values, place, (None,))
        if len(numbers) + null <= max(last, null):
            raise InvalidFile(
                Problem(place, f"has {plural(len(numbers) + null, 'number')}", f"{last + 1}, as its picture names")
            )
        return np.append(numbers[0] + (numbers[0] - numbers[-1]) / 255, numbers) if null else numbers


def _scene(files: Mapping[str, memoryview], path: str) -> Splats:
    """Return the splats of a meta.json at this path, with its pictures beside it."""
    if path not in files:
        raise InvalidFile(Problem(path, "is missing", f"the files that {LOD} names"))
    meta = parse_object(files[path], path)
    version = meta.get("version")
    if version not in (None, 2) or isinstance(version, float):
        raise InvalidFile(Problem(f"{path}: version", f"is {shorten(version)}", "2, or no version"))
    means, quats, scales, sh0 = (_Part(files, meta, key, path) for key in ("means", "quats", "scales", "sh0"))
    if version is None:
        n = whole({"shape[0]": next(iter(_list(means.fields, "shape", path)), None)}, "shape[0]", path, high=_MOST)
    else:
        n = whole(meta, "count", path, high=_MOST)
    if not n:
        raise InvalidScene(Problem("the splats", "have no rows", "at least one splat"))
    # Low bytes of coordinates are noise, so that a real picture of them has a byte or more for each splat.
    picture, packed = means.file(0)
    if n > _MOST_PER_BYTE * len(packed):
        found = f"has {len(packed):,} bytes for {n:,} splats"
        raise InvalidFile(Problem(picture, found, f"{_MOST_PER_BYTE} splats a byte at most"))
    most = 4 * n + _SPARE
    low, high = (means.picture(k, n, most)[:, :3] for k in (0, 1))
    least, largest = means.numbers("mins", 3), means.numbers("maxs", 3)
    colours = sh0.picture(0, n, most)
    sizes, turns = scales.picture(0, n, most)[:, :3], quats.picture(0, n, most)
    size_of, colour_of = scales.decoder(sizes), sh0.decoder(colours if version is None else colours[:, :3])
    higher = _Higher(_Part(files, meta, "shN", path), n, version) if meta.get("shN") is not None else None

    def rows(block: slice) -> SplatRows:
        t = least + (largest - least) * ((low[block] + 256.0 * high[block]) / 65535)
        with np.errstate(over="ignore"):
            places = np.copysign(expm1(np.abs(t)), t)
        if version is None:
            both = colour_of(colours[block])
            dc, opacity = both[:, :3], sigmoid_or_nan(both[:, 3])
        else:
            dc, opacity = colour_of(colours[block, :3]), colours[block, 3] / 255
        sh = dc[:, None] if higher is None else np.concatenate([dc[:, None], higher.rows(block)], axis=1)
        return SplatRows(places, exp_or_nan(size_of(sizes[block])), _rotations(turns[block]), opacity, sh)

    model = meta.get("model")
    notes = () if model in _MODELS else (f"its model is {shorten(model)!r}, which is read as 'default'",)
    antialiased = meta.get("antialias") is True or model == "antialiased"
    B = 1 if higher is None else 1 + higher.width
    return splats_in_blocks(n, B, rows, antialiased=antialiased, notes=notes)


def _rotations(pixels: Bytes) -> Floats:
    """(n, 4) w first. Without a valid alpha, a quaternion is 0, so that its row is dropped."""
    three = (pixels[:, :3] / 255 * 2 - 1) / np.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (three * three).sum(axis=1)))
    known = pixels[:, 3] >= _FIRST_TAG
    quats = with_largest(three, largest, np.where(known, pixels[:, 3].astype(np.int64) - _FIRST_TAG, 0))
    return np.where(known[:, None], quats, 0)


class _Higher:
    """The coefficients above the first: a palette, and an entry of it for each splat."""

    def __init__(self, part: _Part, n: int, version: int | None) -> None:
        centroids = part.image(0, _WIDTHS[-1] * _PALETTE)
        rows, width = centroids.shape[:2]
        if version is None:
            degree = next((degree for degree in (1, 2, 3) if width == _A_ROW * _WIDTHS[degree]), 0)
            count = rows * _A_ROW
        else:
            degree = whole(part.fields, "bands", part.place, low=1, high=3)
            count = whole(part.fields, "count", part.place, low=1, high=_PALETTE)
        if width != _A_ROW * _WIDTHS[degree] or not degree or count > rows * _A_ROW:
            found = f"has {width:,}x{rows:,} pixels"
            allowed = f"{_A_ROW} entries of 3, 8 or 15 pixels in a row, and a row for {_A_ROW} entries"
            raise InvalidFile(Problem(f"{part.place}.files[0]", found, allowed))
        pixels = part.picture(1, n, 4 * n + _SPARE)
        memory.hold("the labels", 4 * n)
        self._labels = pixels[:, 0] | pixels[:, 1].astype(np.int32) << 8
        if (top := int(self._labels.max())) >= count:
            found = f"names entry {top:,}"
            raise InvalidFile(Problem(f"{part.place}.files[1]", found, f"below {count:,}, the palette's"))
        self._codes = centroids[..., :3].reshape(rows * _A_ROW, _WIDTHS[degree], 3)
        self.width = _WIDTHS[degree]
        self._decoded = part.decoder(self._codes, columns=False)

    def rows(self, block: slice) -> Floats:
        """The coefficients (rows, 3 | 8 | 15, 3)."""
        return self._decoded(self._codes[self._labels[block]])
