"""Lattices with unequal sizes and values that differ along each axis, also as files of other programs."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.scene.lattice_field import Activation, LatticeField, RgbColour
from tests.support.n3trees import archive

SHAPE = (5, 6, 7)
RADIUS, CENTRE = np.array([1.0, 0.75, 0.625], np.float32), np.array([0.125, 0.25, -0.5], np.float32)
SLOPE = np.array([4.0, 8.0, -2.0])  # of the density along x, y and z: different on each axis
Y0 = 0.28209479177387814
RGB = (0.5, -0.25, 1.0)  # the first coefficient of each channel, exact in float16


def affine(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """A raw density that is linear in position, so that trilinear interpolation is exact."""
    return np.asarray(12 + (points * SLOPE).sum(axis=-1), np.float64)


def centres(shape: tuple[int, ...], low: Any, high: Any) -> npt.NDArray[np.float64]:
    """(n, 3) the cell centres of a lattice of this shape over a box, x-major."""
    shares = [(np.arange(edge) + 0.5) / edge for edge in shape]
    grid = np.stack(np.meshgrid(*shares, indexing="ij"), -1).reshape(-1, 3)
    return np.asarray(low + grid * (np.asarray(high) - low), np.float64)


def svox2(
    *, size: int = 9, empty: float = 0.0, seed: int = 0, plain: bool = True, raw: npt.NDArray[Any] | None = None
) -> dict[str, Any]:
    """The arrays of a svox2 checkpoint of SHAPE: shuffled rows, links below 0 for empty nodes, an unlinked NaN row.

    empty  fraction of nodes without a link
    plain  the same RGB in every direction and node; False: random coefficients
    raw    the densities of all nodes, x-major; None: affine()
    """
    random = np.random.default_rng(seed)
    n = int(np.prod(SHAPE))
    points = centres(SHAPE, CENTRE - RADIUS, CENTRE + RADIUS)
    density = np.asarray(affine(points) if raw is None else raw, np.float32)
    colours = np.zeros((n, 3 * size), np.float16)
    colours[:, ::size] = RGB
    if not plain:
        colours += random.normal(0, 0.3, colours.shape).astype(np.float16)
    held = random.random(n) >= empty
    rows = np.full(n, -1, np.int32)
    rows[~held] = random.choice([-1, -3, -1000], int((~held).sum()))
    rows[held] = random.permutation(int(held.sum()))
    values = np.full((int(held.sum()) + 1, 1), np.nan, np.float32)
    sh = np.full((len(values), 3 * size), np.nan, np.float16)
    values[rows[held], 0], sh[rows[held]] = density[held], colours[held]
    return {
        "radius": RADIUS,
        "center": CENTRE,
        "links": rows.reshape(SHAPE),
        "density_data": values,
        "sh_data": sh,
        "basis_type": np.int64(1),
    }


def svox2_file(arrays: dict[str, Any] | None = None, *, deflated: bool = False) -> bytes:
    return archive(svox2() if arrays is None else arrays, deflated=deflated)


def some_lattice(*, at_corners: bool = False, raw: float | None = None, **fields: Any) -> LatticeField:
    """A lattice of SHAPE over a box with unequal edges: a random RGB colour per node, rows in order.

    raw: the density of all nodes; None: affine().
    """
    box = np.stack([CENTRE - RADIUS, CENTRE + RADIUS]).astype(np.float64)
    shares = [np.arange(edge) / (edge - 1) if at_corners else (np.arange(edge) + 0.5) / edge for edge in SHAPE]
    points = box[0] + np.stack(np.meshgrid(*shares, indexing="ij"), -1).reshape(-1, 3) * (box[1] - box[0])
    n = len(points)
    features = np.random.default_rng(1).normal(0, 1, (n, 3)).astype(np.float32)
    known: dict[str, Any] = {
        "links": np.arange(n, dtype=np.int32).reshape(SHAPE),
        "density": np.full(n, raw, np.float32) if raw is not None else affine(points).astype(np.float32),
        "features": features,
        "activation": Activation(),
        "colour": RgbColour(),
        "box": box,
        "at_corners": at_corners,
    }
    return LatticeField(**(known | fields))
