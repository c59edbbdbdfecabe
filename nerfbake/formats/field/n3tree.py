"""Read and write svox N3Tree archives (.npz): svox, legacy and quantised. Keys: docs/formats/n3tree.md."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, NerfbakeError, Problem
from nerfbake.formats.camera import transforms
from nerfbake.formats.wire.npz import NpzReader, write_npz
from nerfbake.formats.wire.zip_reader import npz_keys
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.parallel import over_chunks
from nerfbake.scene.basis import guess_data_format, parse_basis
from nerfbake.scene.held_out import MAX_EVERY, HeldOut, thinned_size
from nerfbake.scene.n3tree import N3Tree

_KEYS = {"child", "data_dim", "invradius", "invradius3"}
_HELD_OUT, _SHELLS = "held_out", "shells"  # nerfbake's additional keys, which svox ignores
_CHUNK = 1 << 13  # cells dequantised at a time, few enough that their coefficients stay in the CPU cache


def recognise(view: memoryview) -> bool:
    """Return True for an archive with at least one key that only N3Tree archives have."""
    return not _KEYS.isdisjoint(npz_keys(view))


def decode(view: memoryview, *, companion: bool = False) -> N3Tree:
    """Return the tree of an archive.

    companion: there is a _poses_bounds.npy next to the file, which marks a forward-facing scene.
    """
    npz = NpzReader(view)
    quantised = "quant_map" in npz and "data" not in npz
    radius = "invradius3" if "invradius3" in npz or "invradius" not in npz else "invradius"
    npz.require("child", "offset", radius, *(("quant_colors", "quant_map", "sigma") if quantised else ("data",)))
    child = npz.array("child")
    if child.dtype.kind != "i" or child.ndim != 4:
        raise InvalidFile(Problem("child", f"has dtype {child.dtype}, shape {child.shape}", "int32 (n, N, N, N)"))
    if child.size and max(abs(int(child.min())), abs(int(child.max()))) >= 1 << 31:
        raise InvalidFile(Problem("child", "contains numbers beyond 32 bits", "offsets within the table"))
    if child.dtype != np.int32:
        memory.hold("child", 4 * child.size)
        child = child.astype(np.int32)
    data = _dequantise(npz, child) if quantised else npz.array("data")
    data_dim = data.shape[-1] if data.ndim else 0
    if "data_dim" in npz and (declared := npz.scalar("data_dim")) != data_dim:
        raise InvalidFile(Problem("data_dim", f"is {declared}", f"{data_dim}, the number of values per cell"))
    dialect = "svox" if radius == "invradius3" else "legacy"
    if quantised:
        dialect = "quantised+retained" if "data_retained" in npz else "quantised"
    extra = npz.single("extra_data") if "extra_data" in npz else None
    return N3Tree(
        child=child,
        data=data,
        offset=_world(npz, "offset"),
        invradius=_world(npz, radius),
        data_format=str(npz.scalar("data_format")) if "data_format" in npz else _guess(data_dim),
        # svox writes an empty array if there are no lobes.
        extra_data=extra if extra is not None and extra.size else None,
        dialect=dialect,
        ndc=companion,
        held_out=_held_out(npz),
        shells=_shells(npz),
    )


def encode(tree: N3Tree, *, packing: Literal["stored", "deflated"] = "stored") -> Iterator[bytes | memoryview]:
    """Encode the archive as svox writes it. `quantised` and `legacy` trees become plain svox trees.

    packing: svox itself writes "deflated"; "stored" is larger, and faster to write and to read.
    """
    parent_depth = np.zeros((tree.n, 2), np.int32)
    for depth, (rows, cells) in enumerate(zip(tree.levels, tree.parent_cells, strict=True)):
        parent_depth[rows, 0] = np.maximum(cells, 0)
        parent_depth[rows, 1] = depth
    arrays: dict[str, npt.ArrayLike] = {
        "data_dim": np.int64(tree.data_dim),
        "child": tree.child,
        "parent_depth": parent_depth,
        "n_internal": np.int64(tree.n),
        "n_free": np.int64(tree.n - sum(map(len, tree.levels))),
        "invradius3": tree.invradius.astype(np.float32),
        "offset": tree.offset.astype(np.float32),
        "depth_limit": np.int64(len(tree.levels) - 1),
        "geom_resize_fact": np.float64(1),
        "data": tree.data,
        "data_format": np.array(tree.data_format),
    }
    if tree.extra_data is not None:
        arrays["extra_data"] = tree.extra_data
    if tree.shells > 1:
        arrays[_SHELLS] = np.int64(tree.shells)
    if tree.held_out is not None:
        arrays |= _held_out_arrays(tree.held_out)
    yield from write_npz(arrays, deflated=packing == "deflated")


def _guess(data_dim: int) -> str:
    if guess := guess_data_format(data_dim):
        return guess
    raise InvalidScene(
        Problem("data", f"has {data_dim} values per cell and no data_format", "4 (RGBA), or 3 k + 1 (SHk)")
    )


def _held_out_arrays(held_out: HeldOut) -> dict[str, npt.ArrayLike]:
    return {
        f"{_HELD_OUT}_cameras": np.frombuffer(b"".join(transforms.encode(held_out.cameras)), np.uint8),
        f"{_HELD_OUT}_pixels": np.concatenate([pixels.reshape(-1, 3) for pixels in held_out.pixels]),
        f"{_HELD_OUT}_every": np.int64(held_out.every),
        f"{_HELD_OUT}_background": np.array(held_out.background),
    }


def _shells(npz: NpzReader) -> int:
    if _SHELLS not in npz:
        return 1
    shells = npz.scalar(_SHELLS)
    if not isinstance(shells, int):
        raise InvalidFile(Problem(_SHELLS, f"is {str(shells)[:40]}", "a number of shells"))
    return int(shells)


def _held_out(npz: NpzReader) -> HeldOut | None:
    names = [f"{_HELD_OUT}_{part}" for part in ("cameras", "pixels", "every", "background")]
    if names[0] not in npz:
        return None
    npz.require(*names)
    text, pixels, every = npz.array(names[0]), npz.array(names[1]), npz.scalar(names[2])
    if text.dtype != np.uint8 or text.ndim != 1:
        raise InvalidFile(Problem(names[0], f"has dtype {text.dtype}, shape {text.shape}", "uint8 (bytes,)"))
    try:
        cameras = transforms.decode(memoryview(text.tobytes()))
    except NerfbakeError as error:
        error.what = error.problem._replace(place=f"{names[0]}: {error.problem.place}")
        raise
    if not isinstance(every, int) or not 1 <= every <= MAX_EVERY:
        raise InvalidFile(Problem(names[2], f"is {every}", f"1 to {MAX_EVERY:,}"))
    sizes = [thinned_size(camera, int(every)) for camera in cameras.cameras]
    ends = np.cumsum([height * width for height, width in sizes])
    if pixels.dtype != np.uint8 or pixels.shape != (ends[-1], 3):
        raise InvalidFile(
            Problem(names[1], f"has dtype {pixels.dtype}, shape {pixels.shape}", f"uint8 ({ends[-1]}, 3)")
        )
    parts = [part.reshape(*size, 3) for part, size in zip(np.split(pixels, ends[:-1]), sizes, strict=True)]
    background = _floats(npz, names[3])
    if background.shape != (3,) or not ((background >= 0) & (background <= 1)).all():
        raise InvalidFile(Problem(names[3], f"is {background.tolist()!r:.60}", "three numbers, 0 to 1"))
    return HeldOut(cameras, tuple(parts), int(every), tuple(background.tolist()))


def _floats(npz: NpzReader, key: str) -> npt.NDArray[Any]:
    array = npz.array(key)
    if array.dtype.kind != "f":
        raise InvalidFile(Problem(key, f"has dtype {array.dtype}", "float16, float32 or float64"))
    return array


def _world(npz: NpzReader, key: str) -> npt.NDArray[np.float64]:
    array = _floats(npz, key)
    if array.size not in (1, 3):
        raise InvalidFile(Problem(key, f"has shape {array.shape}", "(3,)" + " or one value" * (key == "invradius")))
    # svox computes in float32; legacy files store the same number as float64. Values beyond float32 become infinite,
    # which the tree's value_problems() report.
    return np.broadcast_to(cast(cast(array.reshape(-1), np.float32), np.float64), 3).copy()


def _dequantise(npz: NpzReader, child: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Decode the values of a compressed PlenOctree: each coefficient's (R, G, B) is a row of its codebook.

    quant_colors (b, K, 3), quant_map (b, n, N, N, N), sigma (n, N, N, N), data_retained (r, n, N, N, N, 3):
    the r retained coefficients come first, and b + r = B.
    """
    colors, codes, sigma = _floats(npz, "quant_colors"), npz.array("quant_map"), _floats(npz, "sigma")
    retained = _floats(npz, "data_retained") if "data_retained" in npz else np.empty((0, *child.shape, 3), sigma.dtype)
    if colors.ndim != 3 or colors.shape[2] != 3 or not colors.shape[1]:
        raise InvalidFile(Problem("quant_colors", f"has shape {colors.shape}", "(b, K, 3)"))
    b, codebook, _ = colors.shape
    for key, array, shape in (
        ("quant_map", codes, (b, *child.shape)),
        ("sigma", sigma, child.shape),
        ("data_retained", retained, (*retained.shape[:1], *child.shape, 3)),
    ):
        if array.shape != shape:
            raise InvalidFile(Problem(key, f"has shape {array.shape}", f"{shape}"))
    if codes.dtype.kind != "u":
        raise InvalidFile(Problem("quant_map", f"has dtype {codes.dtype}", "uint16"))
    if codes.size and codes.max() >= codebook:
        index = np.unravel_index(int(np.argmax(codes >= codebook)), codes.shape)
        where = f"quant_map[{', '.join(map(str, index))}]"
        raise InvalidFile(Problem(where, f"is {codes[index]}", f"0 to {codebook - 1}, the rows of quant_colors"))
    r = len(retained)
    basis = parse_basis(f"SH{b + r}") if "data_format" not in npz else parse_basis(str(npz.scalar("data_format")))
    if basis.size != b + r:
        raise InvalidFile(
            Problem("quant_colors", f"has {b} codebooks, and {r} coefficients are retained", f"{basis.size} in total")
        )
    dtype = np.float16 if sigma.dtype == colors.dtype == retained.dtype == np.float16 else np.float32
    cells = sigma.size
    memory.hold("the decoded data", cells * basis.data_dim * np.dtype(dtype).itemsize)
    data = np.empty((cells, basis.data_dim), dtype)
    sigma, codes, retained = sigma.reshape(-1), codes.reshape(b, cells), retained.reshape(r, cells, 3)

    columns = np.ascontiguousarray(colors.transpose(0, 2, 1))

    def fill(begin: int, end: int) -> None:
        chunk, rows = slice(begin, end), data[begin:end]
        rows[:, -1] = sigma[chunk]
        for i, channel in product(range(basis.size), range(3)):
            column = retained[i, chunk, channel] if i < r else columns[i - r, channel].take(codes[i - r, chunk])
            rows[:, channel * basis.size + i] = column

    over_chunks(fill, cells, _CHUNK)
    return data.reshape(*child.shape, basis.data_dim)
