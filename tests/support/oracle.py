"""Reference resampling of PlenOctrees: one voxel at a time, in exact fractions. It is slow and easy to verify."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import numpy.typing as npt

from nerfbake.scene.n3tree import N3Tree

Box = list[tuple[Fraction, Fraction]]


def nearest(tree: N3Tree, size: tuple[int, int, int]) -> npt.NDArray[np.float32]:
    """(W, H, D, dim): the leaf at the centre of each voxel. On a boundary, the upper leaf."""
    out = np.zeros((*size, tree.data_dim), np.float32)
    for voxel in product(*map(range, size)):
        p = [Fraction(2 * v + 1, 2 * edge) for v, edge in zip(voxel, size, strict=True)]
        row = 0
        while True:
            cell = [int(q * tree.N) for q in p]
            offset = tree.child[(row, *cell)]
            if not offset:
                break
            row += offset
            p = [q * tree.N - c for q, c in zip(p, cell, strict=True)]
        values = tree.data[(row, *cell)].astype(np.float32)
        out[voxel] = values if values[-1] > 0 else 0
    return out


def mean(tree: N3Tree, size: tuple[int, int, int]) -> npt.NDArray[np.float64]:
    """(W, H, D, dim): mean density weighted by volume; coefficients weighted by volume times the opacity
    of a finest cell.
    """
    deepest = max(_depths(tree, 0, 1))
    width = float(np.prod(1 / tree.invradius) ** (1 / 3)) / tree.N**deepest
    out = np.zeros((*size, tree.data_dim))
    for voxel in product(*map(range, size)):
        box = [(Fraction(v, edge), Fraction(v + 1, edge)) for v, edge in zip(voxel, size, strict=True)]
        total, weight = np.zeros(tree.data_dim), 0.0
        for share, values in _pieces(tree, 0, [(Fraction(0), Fraction(1))] * 3, box):
            if values[-1] > 0:
                opacity = 1 - np.exp(-values[-1] * width)
                total[:-1] += share * opacity * values[:-1]
                total[-1] += share * values[-1]
                weight += share * opacity
        if weight:
            total[:-1] /= weight
        out[voxel] = total
    return out


def _depths(tree: N3Tree, row: int, depth: int) -> list[int]:
    below = [row + offset for offset in tree.child[row].ravel() if offset]
    return [depth, *(d for r in below for d in _depths(tree, r, depth + 1))]


def _pieces(tree: N3Tree, row: int, cube: Box, box: Box) -> list[tuple[float, npt.NDArray[np.float64]]]:
    """(fraction of the box, values) of every leaf below this node that overlaps the box."""
    found = []
    for cell in product(range(tree.N), repeat=3):
        part, share = [], Fraction(1)
        for c, (low, high), (a, b) in zip(cell, cube, box, strict=True):
            step = (high - low) / tree.N
            part.append((low + c * step, low + (c + 1) * step))
            share *= max(Fraction(0), min(b, part[-1][1]) - max(a, part[-1][0])) / (b - a)
        if share and (offset := tree.child[(row, *cell)]):
            found += _pieces(tree, row + offset, part, box)
        elif share:
            found.append((float(share), tree.data[(row, *cell)].astype(np.float64)))
    return found
