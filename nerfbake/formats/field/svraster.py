"""Read SVRaster's checkpoints (.pt): voxels at mixed levels with a density at each corner and SH of each voxel.

    scene_center, scene_extent, inside_extent   centre and edge of the cube, and of the inner cube
    octpath, octlevel                           48 bits, a triple a level from the top, x highest; 1 to 16
    _geo_grid_pts                               raw densities of the corners of all voxels, once each, sorted by x, y, z
    _sh0, _shs                                  SH of the voxels, coefficient by coefficient, red green blue inside
    active_sh_degree, quantized                 bands that are shown; numbers are bytes with a codebook

What no voxel covers is empty. Each voxel becomes a leaf. The density of a leaf is the mean over 8 points: the raw
corners are interpolated, then activated. The coefficients are fitted to the logits of the colours max(0, SH + 1/2).
A cube larger than the inner one has shells.

Source: NVlabs/svraster (src/sparse_voxel_model.py, src/utils/octree_utils.py), read, not run.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field.torch_model import as_singles
from nerfbake.formats.wire.torch import TorchReader, mentions
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import cast, exp, fibonacci
from nerfbake.scene.n3tree import MAX_SHELLS, N3Tree

Longs = npt.NDArray[np.int64]
_LEVELS = 16
_PER_WORLD_UNIT = 100.0  # of the activated density
_BEND, _SLOPE, _SHIFT = 1.1, 0.909090909, -0.904689820  # of the activation: x above the bend, else e^(slope x + shift)
_DIRECTIONS = 100  # in which colours are fitted
_LARGEST = 1e15  # of raw numbers
_NOTES = (
    "the density of a voxel is the mean of 8 points, where SVRaster interpolates between its corners",
    "colours are fitted behind a sigmoid, and seen along each ray, where SVRaster looks at the centre of the voxel",
)
_CORNERS = np.array([(k >> 2 & 1, k >> 1 & 1, k & 1) for k in range(8)])  # x highest


def recognise(view: memoryview) -> bool:
    """Return True for a torch file with SVRaster's voxels."""
    return mentions(view, b"octpath", b"_geo_grid_pts")


def decode(view: memoryview) -> N3Tree:
    """Return the voxels as a tree, with a note on what is resampled. Raises InvalidFile, MemoryLimit."""
    model = _Model(view)
    paths = model.whole("octpath", np.int64)
    levels = model.whole("octlevel", np.int8).astype(np.int64)
    if len(levels) != len(paths):
        raise InvalidFile(Problem("octlevel", f"has {len(levels):,} rows", f"{len(paths):,}, as octpath"))
    order = _sorted(paths, levels)
    degree = model.root.get("active_sh_degree")
    if type(degree) is not int or not 0 <= degree <= 3:
        raise InvalidFile(Problem("active_sh_degree", f"is {str(degree)[:40]}", "0 to 3"))
    B = (degree + 1) ** 2
    sigma = _densities(paths, levels, model.numbers("_geo_grid_pts", 1)[:, 0])
    values = np.concatenate([_logits(model, len(paths), B)[order], sigma[order, None]], axis=1)
    child, data = _tree(paths[order], levels[order], values)
    extent, inside = (float(model.floats(key, 1)[0]) for key in ("scene_extent", "inside_extent"))
    centre = model.floats("scene_center", 3)
    return N3Tree(
        child=child,
        data=data,
        offset=0.5 - centre / extent,
        invradius=np.full(3, 1 / extent),
        data_format=f"SH{B}",
        dialect="SVRaster",
        shells=_shells(extent, inside, int(levels.max())),
        notes=(*_NOTES, *model.file.notes),
    )


class _Model:
    """The arrays of a checkpoint. Each is checked when it is accessed."""

    def __init__(self, view: memoryview) -> None:
        self.file = TorchReader(view)
        if not isinstance(self.file.root, dict) or "octpath" not in self.file.root:
            raise InvalidFile(Problem("data.pkl", "has no octpath", "a checkpoint of SVRaster"))
        self.root: dict[Any, Any] = self.file.root
        self._coded = self.root.get("quantized") is True

    def whole(self, key: str, dtype: type[np.integer[Any]]) -> npt.NDArray[Any]:
        """(n,) whole numbers, stored as (n, 1)."""
        array = self.file.array(self.root.get(key), key)
        if array.dtype != dtype or array.ndim != 2 or array.shape[1] != 1:
            found = f"has shape {array.shape}, dtype {array.dtype}"
            raise InvalidFile(Problem(key, found, f"(n, 1) {np.dtype(dtype)}"))
        return np.ascontiguousarray(array[:, 0])

    def floats(self, key: str, count: int) -> Floats:
        """(count,) finite numbers; extents are above 0."""
        found = as_singles(self.file.array(self.root.get(key), key), key).reshape(-1)
        least = -_LARGEST if count > 1 else 1 / _LARGEST
        if len(found) != count or not ((found >= least) & (found <= _LARGEST)).all():
            raise InvalidFile(Problem(key, f"is {found[:3]}", f"{count} numbers from {least:g} to {_LARGEST:g}"))
        return cast(found, np.float64)

    def numbers(self, key: str, columns: int) -> Singles:
        """(n, columns) numbers, from a codebook if the file is quantised."""
        return self._decoded(self.root.get(key), key, (columns,))

    def coefficients(self, key: str, rows: int, count: int) -> Singles:
        """(rows, count, 3): the first SH coefficients. In a quantised file they are a list."""
        value = self.root.get(key)
        if not self._coded and key == "_sh0":
            tables = [self._decoded(value, key, (3,))]
        elif not self._coded:
            tables = [self._decoded(value, key, (None, 3))[:, :count]]
        elif isinstance(value, list) and len(value) >= (3 if key == "_sh0" else count):
            parts = value[:3] if key == "_sh0" else value[:count]
            tables = [self._decoded(part, key, (1,) if key == "_sh0" else (1, 3)) for part in parts]
        else:
            raise InvalidFile(Problem(key, "is not a list of codes", f"{count} of them, as 'quantized' says"))
        if wrong := [len(table) for table in tables if len(table) != rows]:
            raise InvalidFile(Problem(key, f"has {wrong[0]:,} rows", f"{rows:,}, as octpath"))
        found = np.concatenate(tables, axis=1)
        if found.size != rows * count * 3:
            allowed = f"({rows}, {count}, 3)"
            raise InvalidFile(Problem(key, f"has {found.size:,} numbers", f"{rows * count * 3:,}, of shape {allowed}"))
        return found.reshape(rows, count, 3)

    def _decoded(self, value: Any, key: str, shape: tuple[int | None, ...]) -> Singles:
        if self._coded:
            if not isinstance(value, dict):
                raise InvalidFile(Problem(key, "has no codebook", "index and codebook, as 'quantized' says"))
            codes = self.file.array(value.get("index"), f"{key}.index")
            book = as_singles(self.file.array(value.get("codebook"), f"{key}.codebook"), key).reshape(-1)
            if codes.dtype != np.uint8 or not codes.size or int(codes.max()) >= len(book):
                found = f"has {codes.dtype} up to {codes.max(initial=0)}"
                raise InvalidFile(Problem(f"{key}.index", found, f"uint8 below {len(book)}, the codebook's"))
            memory.hold(key, 4 * codes.size)
            array = book[codes]
        else:
            array = as_singles(self.file.array(value, key), key)
        if array.ndim != 1 + len(shape) or any(a not in (None, b) for a, b in zip(shape, array.shape[1:], strict=True)):
            allowed = f"(n, {', '.join('any' if edge is None else str(edge) for edge in shape)})"
            raise InvalidFile(Problem(key, f"has shape {array.shape}", allowed))
        if not (np.abs(array) <= _LARGEST).all():
            raise InvalidFile(Problem(key, "has numbers that are not finite", f"numbers up to {_LARGEST:g}"))
        return np.asarray(array, np.float32)


def _sorted(paths: Longs, levels: Longs) -> Longs:
    """Return the order of the voxels along the curve. Raises InvalidFile unless they are voxels without overlap."""
    memory.hold("the voxels", 48 * len(paths))
    if int(levels.min()) < 1 or int(levels.max()) > _LEVELS:
        raise InvalidFile(Problem("octlevel", f"is {levels.min()} to {levels.max()}", f"1 to {_LEVELS}"))
    sizes = np.left_shift(1, 3 * (_LEVELS - levels))
    if int(paths.min()) < 0 or int(paths.max()) >= 1 << 3 * _LEVELS or (paths & (sizes - 1)).any():
        allowed = f"0 to 2^{3 * _LEVELS} - 1, with zeros below the voxel's level"
        raise InvalidFile(Problem("octpath", "has numbers that are no voxels", allowed))
    order = np.argsort(paths, kind="stable")
    if (paths[order][1:] < (paths + sizes)[order][:-1]).any():
        raise InvalidFile(Problem("octpath", "has voxels inside others", "voxels without overlap"))
    return order


def _densities(paths: Longs, levels: Longs, raw: Singles) -> Singles:
    """(n,) 1/world unit: the mean of the activated density at the centres of the eighths of each voxel."""
    n = len(paths)
    memory.hold("the corners", 8 * n * (3 * 8 + 3 * 8))
    low = np.zeros((n, 3), np.int64)
    for level in range(1, _LEVELS + 1):
        triple = paths >> 3 * (_LEVELS - level)
        for axis in range(3):
            low[:, axis] |= (triple >> (2 - axis) & 1) << (_LEVELS - level)
    edges = np.left_shift(1, _LEVELS - levels)
    keys = np.empty((8, n), np.int64)
    for k, corner in enumerate(_CORNERS):
        x, y, z = (low[:, axis] + edges * corner[axis] for axis in range(3))
        keys[k] = x << 34 | y << 17 | z
    known, rows = np.unique(keys, return_inverse=True)
    if len(known) != len(raw):
        raise InvalidFile(
            Problem("_geo_grid_pts", f"has {len(raw):,} rows", f"{len(known):,}, the corners of the voxels")
        )
    corners = raw[rows.reshape(8, n)].astype(np.float64)
    total = np.zeros(n)
    for eighth in _CORNERS:
        shares = np.where(eighth == _CORNERS, 0.75, 0.25).prod(axis=1)
        between = np.zeros(n)
        for k in range(8):
            between += shares[k] * corners[k]
        total += np.where(between > _BEND, between, exp(np.minimum(between, _BEND) * _SLOPE + _SHIFT))
    return np.asarray(cast(total / 8 * _PER_WORLD_UNIT, np.float32))


def _logits(model: _Model, n: int, B: int) -> Singles:
    """(n, 3 B) coefficients behind a sigmoid, all of red, of green, then of blue."""
    # Imported here, because only colours need numba.
    from nerfbake.kernels.lattice.harmonics import inverse_of, refit_coefficients

    memory.hold("the colours", 3 * 4 * n * 3 * B)
    sh = model.coefficients("_sh0", n, 1)
    if B > 1:
        # As many as the model may have at most: 15, unless it was trained with a lower degree.
        sh = np.concatenate([sh, model.coefficients("_shs", n, B - 1)], axis=1)
    features = np.ascontiguousarray(sh.swapaxes(1, 2)).reshape(n, 3 * B)
    directions = fibonacci(_DIRECTIONS)
    basis, inverse = sh_basis(directions, B, np.float32), inverse_of(sh_basis(directions, B))
    return np.asarray(refit_coefficients(features, basis, inverse))


def _tree(paths: Longs, levels: Longs, values: Singles) -> tuple[npt.NDArray[np.int32], Singles]:
    """Return child (nodes, 2, 2, 2) and data (nodes, 2, 2, 2, D) of voxels in the order of their paths."""
    nodes = []  # by depth, the paths of the nodes down to that depth, ascending
    for depth in range(int(levels.max())):
        own = paths[levels > depth] >> 3 * (_LEVELS - depth)
        nodes.append(own[np.concatenate([[True], own[1:] != own[:-1]])])
    starts = np.concatenate([[0], np.cumsum([len(own) for own in nodes])])
    count = int(starts[-1])
    memory.hold("the tree", count * 8 * (4 + 4 * values.shape[1]))
    child = np.zeros((count, 8), np.int32)
    for depth in range(1, len(nodes)):
        above = starts[depth - 1] + np.searchsorted(nodes[depth - 1], nodes[depth] >> 3)
        child[above, nodes[depth] & 7] = starts[depth] + np.arange(len(nodes[depth])) - above
    data = np.zeros((count, 8, values.shape[1]), np.float32)
    for depth in range(len(nodes)):
        own = levels == depth + 1
        prefix = paths[own] >> 3 * (_LEVELS - depth - 1)
        data[starts[depth] + np.searchsorted(nodes[depth], prefix >> 3), prefix & 7] = values[own]
    return child.reshape(-1, 2, 2, 2), data.reshape(-1, 2, 2, 2, values.shape[1])


def _shells(extent: float, inside: float, levels: int) -> int:
    """The shells with the inner cube; 1 if the inner cube is the whole one, or has no level of its own."""
    ratio = extent / inside
    shells = next((k for k in range(1, MAX_SHELLS + 1) if abs(ratio / 2.0 ** (k - 1) - 1) < 1e-3), 0)
    if not shells:
        allowed = f"scene_extent / 2^k, k from 0 to {MAX_SHELLS - 1}"
        raise InvalidFile(Problem("inside_extent", f"is {inside:g} of {extent:g}", allowed))
    return shells if shells < max(levels, 2) else 1
