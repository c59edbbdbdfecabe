"""Write Gaussian splats as PlayCanvas' .sog, version 2; sog.py draws the files.

Splats are written along a Morton curve, so that neighbours in the pictures are neighbours in the scene. Codebooks of
256 numbers, and a palette of up to 65,536 entries for the higher coefficients, are fitted to the splats.
"""

from __future__ import annotations

import io
import json
import zipfile
from math import ceil, isqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.wire.picture import encode_lossless_webp
from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.kernels.cluster.codebook import fit_codebook, fit_palette, nearest_codes
from nerfbake.kernels.maths.elementary import log
from nerfbake.scene.splats import Splats

Bytes = npt.NDArray[np.uint8]
META = "meta.json"
MOST_DEGREE = 3
_PALETTE = 1 << 16  # entries, because labels have 16 bits
_A_ROW = 64  # entries of the palette in a row of its picture
_FEW = 1 << 10  # splats for an entry of a small palette: PlayCanvas' rule
_FIRST_TAG = 252
_LEAST = 1e-30  # scale whose logarithm is taken for 0
_BITS = 10  # of each coordinate on the Morton curve
_BYTES = 900  # a splat of degree 3, while its palette is fitted
_DATE = (1980, 1, 1, 0, 0, 0)


def in_order(scene: Splats) -> Splats:
    """Return the splats in the order in which they are written: along a Morton curve."""
    return scene.take(morton_order(scene.means))


def morton_order(means: npt.NDArray[np.float32]) -> Ints:
    """Return the order of points (n, 3) along a Morton curve through their box.

    Of each axis, the middle 98% of the points have at least a third of the cells: one far point would otherwise put all
    others into the same cell. Points beyond are in the outermost cells.
    """
    rare = len(means) // 100
    ends = [0, rare, -1 - rare, -1]
    least, low, high, most = np.partition(means, ends, axis=0)[ends].astype(np.float64)
    low, high = np.maximum(least, 2 * low - high), np.minimum(most, 2 * high - low)
    share = (means - low) / np.where(high > low, high - low, 1.0)
    cells = np.clip(share * (1 << _BITS), 0, (1 << _BITS) - 1).astype(np.int64)
    code = np.zeros(len(means), np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def archive_of(scene: Splats) -> bytes:
    """Return splats as a zip archive, whose files are stored. Raises InvalidScene, MemoryLimit."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in files_of(scene).items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), data)
    return file.getvalue()


def files_of(scene: Splats, *, ordered: bool = False) -> dict[str, bytes]:
    """Return the files of the archive, meta.json first. ordered: the splats keep their order.

    Raises InvalidScene, MemoryLimit.
    """
    scene.require_usable()
    if scene.degree > MOST_DEGREE:
        raise InvalidScene(Problem("sh", f"has degree {scene.degree}", f"0 to {MOST_DEGREE} in a .sog"))
    with memory.lent("the .sog", _BYTES * scene.n):
        return _files(scene if ordered else in_order(scene))


def _files(scene: Splats) -> dict[str, bytes]:
    n = scene.n
    width = ceil(max(isqrt(n - 1) + 1, 4) / 4) * 4

    def picture(*columns: npt.NDArray[Any]) -> bytes:
        """A pixel for each splat; alpha is 255 without a fourth column."""
        pixels = np.zeros((width * ceil(n / width), 4), np.uint8)
        pixels[:, 3] = 255
        for k, column in enumerate(columns):
            pixels[:n, k] = column
        return encode_lossless_webp(pixels.reshape(-1, width, 4))

    means = scene.means.astype(np.float64)
    t = np.copysign(log(1 + np.abs(means)), means)
    low, high = t.min(axis=0), t.max(axis=0)
    whole = np.rint((t - low) / np.where(high > low, high - low, 1.0) * 65535).astype(np.int64)
    sizes = log(np.maximum(scene.scales.astype(np.float64), _LEAST))
    size_book, colour_book = fit_codebook(sizes), fit_codebook(scene.sh[:, 0])
    opacity = np.rint(scene.opacity.astype(np.float64) * 255)
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "nerfbake"},
        "count": n,
        "antialias": scene.antialiased,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _listed(size_book), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _listed(colour_book), "files": ["sh0.webp"]},
    }
    pictures = {
        "means_l.webp": picture(*(whole % 256).T),
        "means_u.webp": picture(*(whole // 256).T),
        "scales.webp": picture(*nearest_codes(sizes, size_book).T),
        "quats.webp": picture(*_rotations(scene.quats.astype(np.float64)).T),
        "sh0.webp": picture(*nearest_codes(scene.sh[:, 0], colour_book).T, opacity),
    }
    if scene.degree:
        size = min(_PALETTE, max(_A_ROW, n // _FEW * _A_ROW)) if n > _PALETTE else _PALETTE
        palette, labels = fit_palette(scene.sh[:, 1:].reshape(n, -1), size)
        book = fit_codebook(palette)
        meta["shN"] = {
            "count": len(palette),
            "bands": scene.degree,
            "codebook": _listed(book),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
        pictures["shN_centroids.webp"] = encode_lossless_webp(_palette(nearest_codes(palette, book)))
        pictures["shN_labels.webp"] = picture(labels % 256, labels // 256)
    return {META: json.dumps(meta).encode(), **pictures}


def _listed(book: Floats) -> list[float]:
    return [float(value) for value in book.astype(np.float32)]


def _palette(codes: Bytes) -> Bytes:
    """(rows, 64 coefficients, 4): the picture of a palette, with 64 entries in a row."""
    K, each = len(codes), codes.shape[1] // 3
    rows = ceil(K / _A_ROW)
    pixels = np.zeros((rows * _A_ROW, each, 4), np.uint8)
    pixels[..., 3] = 255
    pixels[:K, :, :3] = codes.reshape(K, each, 3)
    return pixels.reshape(rows, _A_ROW * each, 4)


def _rotations(quats: Floats) -> Bytes:
    """(n, 4): three components as bytes, and which of w x y z is left out."""
    rows, which = np.arange(len(quats)), np.abs(quats).argmax(axis=1)
    quats = np.where(quats[rows, which] < 0, -1.0, 1.0)[:, None] * quats
    out = np.empty((len(quats), 4), np.uint8)
    for k in range(3):
        value = quats[rows, k + (k >= which)]
        out[:, k] = np.clip(np.rint((value * np.sqrt(2) + 1) / 2 * 255), 0, 255)
    out[:, 3] = _FIRST_TAG + which
    return out
