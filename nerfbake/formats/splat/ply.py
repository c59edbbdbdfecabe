r"""Read Gaussian splats from .ply files (3DGS, 2DGS, Mip-Splatting, PlayCanvas' compressed kind); write 3DGS.

3DGS: element `vertex` with x y z, f_dc_0..2, f_rest_0.. (all red, all green, all blue), opacity (logit), scale_0..2
(natural logarithm), rot_0..3 (w first, of any length), found by name in any order. CloudCompare writes scalar_ before
all names but x y z; nerfstudio can write uchar red green blue for f_dc_0..2 (--ply-color-mode rgb). ply_dialects.py has
what such files say beyond this.

Compressed: element `chunk` with the bounds of 256 splats each, `vertex` with four uint, `sh` with bytes.

    packed_position, packed_scale  31 [x 11 | y 10 | z 11] 0, between the chunk's bounds; scales are logarithms
    packed_rotation                31 [which 2 | a 10 | b 10 | c 10] 0, the largest of w x y z is left out
    packed_color                   31 [r 8 | g 8 | b 8 | opacity 8] 0

formats/wire/ply.py describes the container.
Source: graphdeco-inria/gaussian-splatting (save_ply); playcanvas/splat-transform (read-ply, decompress-ply).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.splat.ply_dialects import movement_of, stated_up, vertical_axis, with_halves
from nerfbake.formats.wire import ply as wire
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import exp, log, sigmoid
from nerfbake.scene.base import MAX_WORLD
from nerfbake.scene.basis import SH0
from nerfbake.scene.origin import choose_origin
from nerfbake.scene.splats import BASES, Splats, splats_of_rows

MOST_DEGREE = 3
KEEPS_ORIGIN = True
KEEPS_UP = False
_END = b"end_header\n"
_REST = tuple(3 * (B - 1) for B in BASES)  # numbers of f_rest at degree 0 to 4
_CHUNK = 256  # splats
_ROWS = 1 << 16  # written at a time
_LEAST, _MOST = 1e-30, 1 - 2.0**-24  # opacities and scales as they are written: their logits and logarithms are finite
_LARGEST = MAX_WORLD / 1.000005  # scale as it is written: the rounding of its logarithm does not exceed MAX_WORLD
_FLAT = 100  # a splat of 2DGS is 1/100 as thick as its smaller axis
_BOUNDS = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
_SCALE_BOUNDS = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
_COLOUR_BOUNDS = [f"{end}_{axis}" for end in ("min", "max") for axis in "rgb"]
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_DC, _RGB = ["f_dc_0", "f_dc_1", "f_dc_2"], ["red", "green", "blue"]
_NEEDED = ["x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3"]
_PREFIX = "scalar_"


def recognise(view: memoryview) -> bool:
    """Return True for the first line of a .ply."""
    return wire.recognise(view)


def decode(view: memoryview) -> Splats:
    """Parse splats. Raises InvalidFile, InvalidScene, MemoryLimit.

    2DGS has two scales; the third becomes 1/100 of the smaller one. Mip-Splatting's filter is applied.
    """
    properties, comments, tables = wire.parse(view, "chunk", "vertex", "sh")
    names = properties.get("vertex", [])
    if f"{_PREFIX}f_dc_0" in names:
        tables["vertex"] = _without_prefix(tables["vertex"])
        names = list(tables["vertex"].dtype.names or ())
    if "octlevel" in names:
        allowed = "Gaussian splats; of SVRaster, the checkpoint .pt"
        raise InvalidFile(Problem("the .ply", "holds SVRaster's voxels", allowed))
    coloured = {*_RGB, "opacity", "scale_0"} <= {*names} and tables["vertex"].dtype["red"] == np.uint8
    if not coloured and not {*names} & {*_PACKED, "f_dc_0"}:
        kind = "a mesh" if "face" in properties else "a point cloud"
        raise InvalidFile(Problem("the .ply", f"is {kind}", "Gaussian splats, with f_dc_0 and opacity"))
    rows = tables["vertex"]
    B = BASES[-1] if "f_rest_45" in names else BASES[MOST_DEGREE]
    memory.require("the splats", len(rows) * 2 * 8 * (12 + 3 * B))
    antialiased = any(comment in ("SplatRenderMode: mip", "antialiased 1") for comment in comments)
    movement, (up, notes) = movement_of({**properties, "vertex": names}), stated_up(comments)
    if "packed_position" in names:
        found = _unpacked(tables, antialiased)
    else:
        rows, halves = with_halves(rows)
        found, notes = _plain(rows, antialiased), (*halves, *notes)
    return replace(found, up=up, left_out=movement.left_out, notes=(*found.notes, *movement.notes, *notes))


def _without_prefix(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The same rows with CloudCompare's prefix removed from the names, unless there is such a name already."""
    names = rows.dtype.names or ()
    short = [name if (bare := name.removeprefix(_PREFIX)) in names else bare for name in names]
    return rows.view(np.dtype([(new, rows.dtype[name]) for new, name in zip(short, names, strict=True)]))


def _columns(rows: npt.NDArray[Any], names: list[str], where: str) -> Floats:
    """Return the properties of these names, (rows, names). Raises InvalidFile."""
    known = rows.dtype.names or ()
    if missing := [name for name in names if name not in known]:
        raise InvalidFile(Problem(f"element {where}", f"has no property {missing[0]}", ", ".join(names)))
    columns = np.empty((len(rows), len(names)), np.float64)
    with np.errstate(invalid="ignore"):  # a signalling NaN is a number that is not finite, as any other
        for k, name in enumerate(names):
            columns[:, k] = rows[name]
    return columns


def _rest(rows: npt.NDArray[Any], where: str) -> tuple[list[str], int]:
    """Return the names of the higher coefficients, and how many there are of each colour. Raises InvalidFile."""
    count = sum(name.startswith("f_rest_") for name in rows.dtype.names or ())
    if count not in _REST:
        found = f"has {count} properties f_rest"
        raise InvalidFile(Problem(f"element {where}", found, ", ".join(map(str, _REST))))
    return [f"f_rest_{k}" for k in range(count)], count // 3


def _with_rest(dc: Floats, rest: Floats, each: int) -> Floats:
    """Return the coefficients (n, B, 3) of the first (n, 3) and the higher ones, which are stored colour by colour."""
    return np.concatenate([dc[:, None], rest.reshape(len(dc), 3, each).swapaxes(1, 2)], axis=1)


def _plain(rows: npt.NDArray[Any], antialiased: bool) -> Splats:
    found = _columns(rows, _NEEDED, "vertex")
    means, origin = _centred(found[:, :3])
    logits, scales, quats = found[:, 3], exp_or_nan(found[:, 4:6]), found[:, 6:]
    known = rows.dtype.names or ()
    dc = _columns(rows, _DC, "vertex") if _DC[0] in known else (_columns(rows, _RGB, "vertex") / 255 - 0.5) / SH0
    if "scale_2" in known:
        third = exp_or_nan(_columns(rows, ["scale_2"], "vertex"))
    else:
        third = scales.min(axis=1, keepdims=True) / _FLAT
    scales = np.concatenate([scales, third], axis=1)
    opacity = sigmoid_or_nan(logits)
    if "filter_3D" in known:
        width = _columns(rows, ["filter_3D"], "vertex")
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            grown = np.sqrt(scales * scales + width * width)
            opacity = opacity * (scales / grown).prod(axis=1)
        scales = grown
    names, each = _rest(rows, "vertex")
    sh = _with_rest(dc, _columns(rows, names, "vertex"), each)
    return splats_of_rows(means, scales, quats, opacity, sh, antialiased=antialiased, origin=origin)


def _centred(means: Floats) -> tuple[Floats, Floats]:
    """Return the means relative to the origin that they need, and that origin."""
    origin = choose_origin([means])
    with np.errstate(invalid="ignore"):
        return (means - origin if origin.any() else means), origin


def exp_or_nan(logarithms: Floats) -> Floats:
    """e^x, 0 for minus infinity, and NaN for infinity: a row with a number that is not finite is dropped."""
    return np.where(logarithms < np.inf, exp(logarithms), np.nan)


def sigmoid_or_nan(logits: Floats) -> Floats:
    """1 / (1 + e^-x), 0 and 1 for infinite x: the logits that Niantic and PlayCanvas write for such opacities."""
    return np.where(np.isnan(logits), np.nan, sigmoid(logits))


def _unpacked(tables: dict[str, npt.NDArray[Any]], antialiased: bool) -> Splats:
    rows, chunks = tables["vertex"], tables.get("chunk")
    n = len(rows)
    if any(name not in (rows.dtype.names or ()) or rows.dtype[name].kind != "u" for name in _PACKED):
        raise InvalidFile(Problem("element vertex", "lacks a packed property", "uint " + ", ".join(_PACKED)))
    if chunks is None or len(chunks) != -(-n // _CHUNK):
        found = f"has {0 if chunks is None else len(chunks):,} rows"
        raise InvalidFile(Problem("element chunk", found, f"{-(-n // _CHUNK):,}, one for {_CHUNK} splats"))
    position, rotation, scale, colour = (rows[name].astype(np.uint32) for name in _PACKED)
    of = np.arange(n) // _CHUNK

    def between(names: list[str], shares: Floats) -> Floats:
        bounds = _columns(chunks, names, "chunk")[of]
        low, high = bounds[:, :3], bounds[:, 3:]
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(low + (high - low) * shares)

    shares = _shares(colour, (24, 16, 8, 0), (8, 8, 8, 8))
    rgb, opacity = shares[:, :3], shares[:, 3]
    if "min_r" in (chunks.dtype.names or ()):
        rgb = between(_COLOUR_BOUNDS, rgb)
    rest, each = np.empty((n, 0)), 0
    if (coded := tables.get("sh")) is not None:
        names, each = _rest(coded, "sh")
        codes = _columns(coded, names, "sh")
        if len(coded) != n or any(coded.dtype[name] != np.uint8 for name in names):
            raise InvalidFile(Problem("element sh", f"has {len(coded):,} rows", f"{n:,} rows of uchar"))
        rest = np.where(codes == 0, -4.0, np.where(codes == 255, 4.0, ((codes + 0.5) / 256 - 0.5) * 8))
    means, origin = _centred(between(_BOUNDS, _shares(position, (21, 11, 0), (11, 10, 11))))
    return splats_of_rows(
        means,
        exp_or_nan(between(_SCALE_BOUNDS, _shares(scale, (21, 11, 0), (11, 10, 11)))),
        _rotations(rotation),
        opacity,
        _with_rest((rgb - 0.5) / SH0, rest, each),
        antialiased=antialiased,
        origin=origin,
    )


def _shares(words: npt.NDArray[np.uint32], shifts: tuple[int, ...], bits: tuple[int, ...]) -> Floats:
    """Return the fields of each word as 0..1, (n, fields)."""
    parts = [(words >> shift & (1 << b) - 1) / ((1 << b) - 1) for shift, b in zip(shifts, bits, strict=True)]
    return np.stack(parts, axis=1)


def _rotations(words: npt.NDArray[np.uint32]) -> Floats:
    """Return the quaternions (n, 4), w first."""
    three = (_shares(words, (20, 10, 0), (10, 10, 10)) - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (three * three).sum(axis=1)))
    return with_largest(three, largest, (words >> 30).astype(np.int64))


def with_largest(three: Floats, largest: Floats, which: npt.NDArray[np.int64]) -> Floats:
    """Return (n, 4): the three components in their order, with the largest one inserted at the index `which`."""
    quats = np.empty((len(three), 4))
    rows = np.arange(len(three))
    for k in range(3):
        quats[rows, k + (k >= which)] = three[:, k]
    quats[rows, which] = largest
    return quats


def encode(scene: Splats) -> Iterator[bytes]:
    """Encode splats as 3DGS: float, little endian. Raises InvalidScene for SH of degree 4.

    x y z are doubles if the splats have an origin. A comment names the up axis if it is known and not -y. Opacities
    below 1e-30 or above 1 - 2^-24, and scales below 1e-30, become these, and scales above _LARGEST, too.
    """
    if scene.degree > MOST_DEGREE:
        raise InvalidScene(Problem("sh", f"has degree {scene.degree}", f"0 to {MOST_DEGREE} in a .ply"))
    scene.require_usable()
    each = scene.B - 1
    far = bool(scene.origin.any())
    columns = [(name, "<f8" if far else "<f4") for name in "xyz"]
    names = ["nx", "ny", "nz", *_DC, *(f"f_rest_{k}" for k in range(3 * each)), "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    columns += [(name, "<f4") for name in names]
    comments = "comment SplatRenderMode: mip\n" if scene.antialiased else ""
    if scene.up is not None and scene.up != "-y":
        comments += f"comment {vertical_axis(scene.up)}\n"
    head = f"ply\nformat binary_little_endian 1.0\n{comments}element vertex {scene.n}\n"
    kinds = {"<f4": "float", "<f8": "double"}
    yield (head + "".join(f"property {kinds[kind]} {name}\n" for name, kind in columns)).encode() + _END
    for start in range(0, scene.n, _ROWS):
        part = slice(start, start + _ROWS)
        opacity = np.clip(scene.opacity[part].astype(np.float64), _LEAST, _MOST)
        means, sh = scene.means[part], scene.sh[part]
        values = np.concatenate(
            (
                means + scene.origin if far else means,
                np.zeros_like(means),
                sh[:, 0],
                sh[:, 1:].swapaxes(1, 2).reshape(len(sh), 3 * each),
                (log(opacity) - log(1 - opacity))[:, None],
                log(np.clip(scene.scales[part].astype(np.float64), _LEAST, _LARGEST)),
                scene.quats[part],
            ),
            axis=1,
        )
        if not far:
            yield values.astype("<f4").tobytes()
            continue
        rows = np.empty(len(values), columns)
        for k, (name, _) in enumerate(columns):
            rows[name] = values[:, k]
        yield rows.tobytes()
