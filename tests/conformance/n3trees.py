"""PlenOctrees as svox stores them, and voxels as SVRaster does."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import product
from pathlib import Path

import numpy as np

from nerfbake import load
from nerfbake.scene.n3tree import N3Tree
from tests.conformance.case import Case, Facts, Frozen, floats, form_named
from tests.support.svraster import mean_density, svraster_file, voxels

OUTSIDE = [(-0.25, 0.5, 0.5), (0.5, 1.125, 0.5), (7.0, 8.0, 9.0)]  # in the tree's own cube, [0, 1)^3


def scenes() -> dict[str, N3Tree]:
    """halves: three levels, an empty leaf, and a freed row (2) that nobody reaches. lobes: N = 3 and two SG lobes."""
    child = np.zeros((4, 2, 2, 2), np.int32)
    child[0, 1, 0, 1], child[1, 0, 1, 1] = 1, 2
    child[2] = -1
    data = ((np.arange(4 * 8 * 4).reshape(4, 2, 2, 2, 4) % 37) - 11) / 16
    data[..., 3] = 1 + np.arange(32).reshape(4, 2, 2, 2) / 4
    data[0, 0, 0, 0, 3] = 0
    halves = N3Tree(
        child, data.astype(np.float16), np.array([0.5, 0.25, 0.5]), np.array([0.25, 0.125, 0.5]), data_format="SH1"
    )
    child = np.zeros((2, 3, 3, 3), np.int32)
    child[0, 2, 1, 0] = 1
    data = ((np.arange(2 * 27 * 7).reshape(2, 3, 3, 3, 7) % 29) - 13) / 8
    data[..., 6] = 0.5 + np.arange(54).reshape(2, 3, 3, 3) / 8
    lobes = np.array([[1, 0.5, -0.25, 2], [0.125, -1, 0.75, 3]], np.float32)
    thirds = N3Tree(child, data.astype(np.float32), np.full(3, 0.5), np.full(3, 0.5), "SG2", extra_data=lobes)
    return {"halves_float16": halves, "thirds_float32": thirds}


def cases() -> Iterator[Case]:
    for name, tree in scenes().items():
        about = f"A PlenOctree with {tree.child.shape[1]} cells an axis and node, {tree.data.dtype}."
        files = {f"n3tree/{name}.npz": Frozen(form_named("npz"), tree)}
        yield Case(f"n3tree/{name}", about, files, _facts(tree), answer)
    scene = voxels(depth=3, outside=1, degree=0)
    points = scene.middles.tolist()
    densities = [mean_density(scene, voxel) for voxel in range(len(points))]
    seen = [{"point": point, "density": density} for point, density in zip(points, densities, strict=True)]
    facts = {"data_format": "SH1", "shells": 2, "lookups": seen}
    about = "A checkpoint as SVRaster writes it: voxels at mixed levels, raw densities at their corners."
    files = {"n3tree/voxels.pt": Frozen(form_named("pt"), None, data=svraster_file(scene))}
    yield Case("n3tree/voxels", about, files, facts, densities_in, computed=1e-5)


def densities_in(path: Path, expected: Facts) -> Facts:
    tree = load(path, N3Tree)
    points = [each["point"] for each in expected["lookups"]]
    found = tree.sample(np.array(points))[:, -1].tolist()
    seen = [{"point": point, "density": density} for point, density in zip(points, found, strict=True)]
    return {"data_format": tree.data_format, "shells": tree.shells, "lookups": seen}


def _facts(tree: N3Tree) -> Facts:
    inside = [tuple(map(float, centre)) for centre, _ in _leaves(tree, 0, (Fraction(0),) * 3, Fraction(1))]
    values = [values for _, values in _leaves(tree, 0, (Fraction(0),) * 3, Fraction(1))]
    zeros = [0.0] * tree.data.shape[-1]
    rows = [row if row[-1] > 0 else zeros for row in values] + [zeros] * len(OUTSIDE)
    return {
        "N": tree.child.shape[1],
        "data_format": tree.data_format,
        "data_dim": tree.data.shape[-1],
        "dtype": str(tree.data.dtype),
        "offset": floats(tree.offset),
        "invradius": floats(tree.invradius),
        "child": floats(tree.child),
        "extra_data": floats(tree.extra_data),
        "samples": [
            {"point": _world(tree, place), "values": row} for place, row in zip([*inside, *OUTSIDE], rows, strict=True)
        ],
    }


def _leaves(
    tree: N3Tree, row: int, low: tuple[Fraction, ...], edge: Fraction
) -> Iterator[tuple[tuple[Fraction, ...], list[float]]]:
    """The centre of each leaf in the cube [0, 1)^3, and its values: by the definition of the child offsets."""
    N = tree.child.shape[1]
    for cell in product(range(N), repeat=3):
        corner = tuple(start + c * edge / N for start, c in zip(low, cell, strict=True))
        if offset := int(tree.child[(row, *cell)]):
            yield from _leaves(tree, row + offset, corner, edge / N)
        else:
            yield tuple(c + edge / N / 2 for c in corner), tree.data[(row, *cell)].tolist()


def _world(tree: N3Tree, place: tuple[float, ...]) -> list[float]:
    return [(p - float(o)) / float(r) for p, o, r in zip(place, tree.offset, tree.invradius, strict=True)]


def answer(path: Path, expected: Facts) -> Facts:
    tree = load(path, N3Tree)
    points = np.array([each["point"] for each in expected["samples"]])
    rows = tree.sample(points).tolist()
    return {
        "N": tree.N,
        "data_format": tree.data_format,
        "data_dim": tree.data_dim,
        "dtype": str(tree.data.dtype),
        "offset": floats(tree.offset),
        "invradius": floats(tree.invradius),
        "child": floats(tree.child),
        "extra_data": floats(tree.extra_data),
        "samples": [{"point": p, "values": row} for p, row in zip(points.tolist(), rows, strict=True)],
    }
