"""Read the sparse points of a COLMAP model, and where its images show them.

points3D.bin  u64 count, each: u64 id, f64 x y z, 3 bytes of colour, f64 error, u64 length, 8 bytes for each image
points3D.txt  lines: id x y z r g b error, then two numbers for each image

An image lists its places: x, y and the id of their point, -1 without one. These are the observations.
Source: COLMAP's documentation, "Output format".
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.base import MAX_WORLD
from nerfbake.scene.sparse_points import SparsePoints

PLACE = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])  # of an image in images.bin
Places = npt.NDArray[np.void]  # of PLACE
Positions = dict[int, tuple[float, float, float]]  # by id
_COUNT = struct.Struct("<Q")
_HEAD = struct.Struct("<Q3d3BdQ")  # little-endian, without padding
_TRACK = 8  # bytes of an image in the track of a point
_POINT_BYTES = 300  # memory of a point while it is read
_MAX_POINTS = 20_000_000
_HEADED = 8  # numbers of a line before the track


def decode_binary_points(view: memoryview, name: str) -> Positions:
    """Parse the points; their tracks are skipped, because the images hold the same."""
    if len(view) < _COUNT.size:
        raise InvalidFile(Problem(name, f"has {len(view):,} bytes", f"{_COUNT.size} or more"))
    (count,) = _COUNT.unpack_from(view, 0)
    if count > (len(view) - _COUNT.size) // _HEAD.size:
        raise InvalidFile(Problem(name, f"counts {count:,} in {len(view):,} bytes", f"{_HEAD.size} bytes for each"))
    _hold(count, name)
    found: Positions = {}
    at = _COUNT.size
    for _ in range(count):
        if at + _HEAD.size > len(view):
            raise InvalidFile(Problem(name, f"ends after {len(view):,} bytes", "all points that it counts"))
        number, x, y, z, *_, length = _HEAD.unpack_from(view, at)
        at += _HEAD.size + _TRACK * length
        found[number] = x, y, z
    if at > len(view):
        raise InvalidFile(Problem(name, f"ends after {len(view):,} bytes", f"{at:,}, according to its counts"))
    return _checked(found, count, name)


def decode_text_points(view: memoryview, name: str) -> Positions:
    """Parse the points; their tracks are skipped, because the images hold the same."""
    found: Positions = {}
    count = 0
    memory.hold(f"the lines of {name}", 2 * len(view))
    for number, line in enumerate(bytes(view).split(b"\n"), start=1):
        parts = line.split(maxsplit=_HEADED)
        if not parts or parts[0].startswith(b"#"):
            continue
        try:
            key, x, y, z = int(parts[0]), *map(float, parts[1:4])
        except ValueError:
            text = line[:60].decode(errors="replace").strip()
            raise InvalidFile(Problem(f"{name}: line {number:,}", f"is {text}", "id x y z of a point")) from None
        count += 1
        _hold(1, name)
        found[key] = x, y, z
    return _checked(found, count, name)


def text_places(line: bytes, number: int, name: str) -> Places:
    """Parse the places of an image in images.txt: x y id of each."""
    parts = line.split()
    memory.hold(f"the places of {name}", _POINT_BYTES // 3 * len(parts))
    try:
        values = np.array(parts, np.float64).reshape(-1, 3)
        if not (np.abs(values[:, 2]) < 2.0**53).all():
            raise ValueError(line)
    except ValueError:
        raise InvalidFile(Problem(f"{name}: line {number:,}", "is not places of points", "x y id of each")) from None
    places = np.empty(len(values), PLACE)
    places["pixel"], places["point"] = values[:, :2], values[:, 2]
    return places


def sparse_points(positions: Positions, images: Sequence[Places], name: str) -> SparsePoints | None:
    """Return the points, in the order of their ids, and what each image shows of them; None without points.

    images: the places of each image, in the order of the cameras. Places of points that the file lacks are left out.
    """
    if not positions:
        return None
    ids = np.array(sorted(positions), np.int64)
    camera, point, pixel = [], [], []
    for number, places in enumerate(images):
        at = np.searchsorted(ids, places["point"]).clip(0, len(ids) - 1)
        held = (ids[at] == places["point"]) & np.isfinite(places["pixel"]).all(axis=1)
        memory.hold(f"the observations of {name}", 32 * int(held.sum()))
        camera.append(np.full(int(held.sum()), number, np.int64))
        point.append(at[held].astype(np.int64))
        pixel.append(places["pixel"][held])
    places_of: Floats = np.concatenate(pixel).astype(np.float64)
    values = np.array([positions[key] for key in ids.tolist()], np.float64)
    return SparsePoints(values, np.concatenate(camera), np.concatenate(point), places_of)


def _hold(count: int, name: str) -> None:
    memory.hold(f"the points of {name}", _POINT_BYTES * count)


def _checked(found: Positions, count: int, name: str) -> Positions:
    if len(found) != count:
        raise InvalidFile(Problem(name, f"has {count - len(found):,} ids twice", "each once"))
    if len(found) > _MAX_POINTS or any(key >= 1 << 63 for key in found):
        raise InvalidFile(Problem(name, f"has {len(found):,} points", f"up to {_MAX_POINTS:,}, with ids below 2^63"))
    if not all(abs(value) <= MAX_WORLD for position in found.values() for value in position):
        raise InvalidFile(Problem(name, "holds a position that is not finite", f"up to {MAX_WORLD:g}"))
    return found
