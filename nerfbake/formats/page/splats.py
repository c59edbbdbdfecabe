"""Pack the splats of a page into one zlib stream of planes of bytes.

Each array of PageSplats is stored column by column, each column as the lowest bytes of all rows, then the next ones:

    places    3 columns of 4 bytes: the difference from the row before it, zigzag: 0, -1, 1, -2, 2, ... are 0, 1, 2, ...
    scales    3 columns of 2 bytes
    turns     4 columns of 1 byte
    opacity   1 column of 1 byte
    colours   3 columns of 2 bytes, zigzag
    rest      3 (B - 1) columns of 1 byte, zigzag: red, green and blue of the second coefficient, then of the third, ...

nerfbake/shaders/page/splats.js reads the stream.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.page.triangles import ball_of, package_text
from nerfbake.formats.wire.deflate import deflate_whole, inflate
from nerfbake.kernels.maths.affine import rotate
from nerfbake.scene.page_splats import PageSplats
from nerfbake.scene.splats import BASES, UPS, up_axes

_SHADERS = ("splats_project.glsl", "splats_vertex.glsl", "splats.glsl", "splats_close.glsl", "splats_shown.glsl")
_MOST = 1 << 26  # splats of a page that is read back
_BYTES = 200  # a splat, while it is read back


def pack_splats(splats: PageSplats) -> bytes:
    """Return the zlib stream."""
    return deflate_whole(_planes(splats))


def splat_facts(splats: PageSplats) -> dict[str, Any]:
    """Return the facts about splats for the page's script, in place of those of a field, and their shaders.

    place: the matrix from the world to the box, 0 to 1 along right, forward and up.
    """
    axes = up_axes(splats.up or "-y")
    corners = rotate(splats.box, axes)
    low, size = corners.min(axis=0), np.abs(corners[1] - corners[0])
    centre, radius = ball_of(splats.box)
    return {
        "kind": "splats",
        "modes": ["colour", "first", "depth"],
        "place": np.concatenate([axes / size[:, None], -(low / size)[:, None]], axis=1).tolist(),
        "axes": axes.tolist(),
        "box": [[0, 0, 0], [1, 1, 1]],
        "up": axes[2].tolist(),
        "centre": centre.tolist(),
        "radius": radius,
        "splats": splats.n,
        "functions": splats.B,
        "low": splats.box[0].tolist(),
        "high": splats.box[1].tolist(),
        "step": splats.step,
        "antialiased": splats.antialiased,
        "stated": splats.up,
        "origin": splats.origin.tolist(),
        "size": _size(splats.n, splats.B),
        "shaders": [*map(package_text, _SHADERS), package_text("harmonics.glsl", "shaders/glsl")],
    }


def unpack_splats(packed: memoryview, facts: dict[str, Any]) -> PageSplats:
    """Return the splats of a page's data and facts. Raises InvalidFile, MemoryLimit."""
    n, B, up = facts["splats"], facts["functions"], facts["stated"]
    if not (0 < n <= _MOST and B in BASES and up in (None, *UPS)):
        found = f"declares {n} splats, {B} coefficients and {up} as up"
        raise InvalidFile(Problem("the page", found, f"1 to {_MOST:,} splats that `nerfbake view` wrote"))
    memory.hold("the page's splats", _BYTES * n + 9 * _size(n, B))
    raw = np.frombuffer(inflate(packed, _size(n, B), "the page's data"), np.uint8).reshape(-1, n)
    at = 0

    def columns(count: int, width: int) -> npt.NDArray[np.int64]:
        nonlocal at
        planes = raw[at : at + count * width].reshape(count, width, n).astype(np.int64)
        at += count * width
        return sum((planes[:, k] << 8 * k for k in range(width)), np.zeros((count, n), np.int64)).T

    places = np.cumsum(_signed(columns(3, 4)), axis=0)
    scales, turns, opacity = columns(3, 2), columns(4, 1), columns(1, 1)[:, 0]
    colours, rest = _signed(columns(3, 2)), _signed(columns(3 * (B - 1), 1)).reshape(n, B - 1, 3)
    return PageSplats(
        places.astype(np.int32),
        scales.astype(np.uint16),
        turns.astype(np.uint8),
        opacity.astype(np.uint8),
        colours.astype(np.int16),
        rest.astype(np.int8),
        np.array([facts["low"], facts["high"]], np.float64),
        float(facts["step"]),
        bool(facts["antialiased"]),
        up,
        np.array(facts["origin"], np.float64),
    )


def _size(n: int, B: int) -> int:
    return n * (12 + 6 + 4 + 1 + 6 + 3 * (B - 1))


def _planes(splats: PageSplats) -> Iterator[bytes]:
    places = splats.places.astype(np.int64)
    steps = places - np.concatenate([np.zeros((1, 3), np.int64), places[:-1]])
    yield from _columns(_zigzag(steps), 4)
    yield from _columns(splats.scales, 2)
    yield from _columns(splats.turns, 1)
    yield from _columns(splats.opacity[:, None], 1)
    yield from _columns(_zigzag(splats.colours.astype(np.int64)), 2)
    yield from _columns(_zigzag(splats.rest.reshape(splats.n, -1).astype(np.int64)), 1)


def _columns(array: npt.NDArray[Any], width: int) -> Iterator[bytes]:
    for column in array.T:
        for k in range(width):
            yield (column >> 8 * k & 255).astype(np.uint8).tobytes()


def _zigzag(values: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return values << 1 ^ values >> 63


def _signed(values: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return values >> 1 ^ -(values & 1)
