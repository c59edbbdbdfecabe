"""Octrees of every basis, whose files name the type of a voxel, too, and what colours they show from where."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerfbake import load
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.octree import SparseVoxelOctree
from tests.conformance import octrees
from tests.conformance.case import Case, Facts, Frozen, floats, form_named

STRUCT: Facts = {"voxel_type": "struct"}
OTHERS = ("svo.json", "svo.bson", "svo.fb", "svo.capnp")  # that name types, beside svo.pb


class Kind(NamedTuple):
    """further: of each further .svo.pb the end of its name, and its options."""

    data_format: str
    dtype: type
    layout: str
    further: dict[str, Facts]


KINDS = {
    "rgba_float32": Kind("RGBA", np.float32, "full", {}),
    "sh1_float32": Kind("SH1", np.float32, "compact", {}),
    "sh9_float16": Kind("SH9", np.float16, "compact", {"_minus1": {"no_child": -1}, "_bulk": {"profile": "bulk"}}),
    "sh9_full_float16": Kind("SH9", np.float16, "full", {"_minus1": {"no_child": -1}}),
    "sh16_float32": Kind("SH16", np.float32, "compact", {}),
    "sh25_float16": Kind("SH25", np.float16, "full", {}),
}
LEVEL_SIZES = [1, 2, 3]

# In voxels, and the direction in which each is seen; none nearer than 1/16 to a face or a centre plane.
LOOKS = [
    ((0.25, 0.75, 1.25), (2, 3, 6)),
    ((1.25, 1.125, 0.375), (-6, 2, -3)),
    ((3.75, 2.125, 3.25), (1, -4, 8)),
    ((2.125, 2.75, 2.625), (0, 0, -1)),
    ((2.25, 2.25, 3.875), (-4, -4, 7)),
    ((3.25, 0.75, 0.25), (0, 1, 0)),
    ((-0.25, 1.25, 2.25), (3, 6, -2)),
]


def scenes() -> dict[str, SparseVoxelOctree]:
    """Six nodes at three levels of a 4 x 3 x 4 grid: voxels of two sizes in a box that is no cube."""
    children = np.zeros((6, 8), np.int32)
    children[0, [0, 7]] = [1, 2]
    children[2, [0, 1, 4]] = [3, 4, 5]
    made = {}
    for name, kind in KINDS.items():
        D = parse_basis(kind.data_format).data_dim
        data = ((np.arange(6 * D).reshape(6, D) * 37 + D) % 101 - 50) / 32
        data[:, -1] = [3, 2, 4, 0.5, 8, 40]
        octree = SparseVoxelOctree(
            (4, 3, 4),
            children[: 6 if kind.layout == "full" else 3],
            data.astype(kind.dtype),
            kind.data_format,
            np.array([0.5, -1.25, 2.0]),
            np.array([0.5, 0.25, 0.125]),
        )
        made[name] = octree
    return made


def cases() -> Iterator[Case]:
    for name, octree in scenes().items():
        kind = KINDS[name]
        files = {f"octree/{name}{end}.svo.pb": Frozen(form_named("svo.pb"), octree, options) for end, options in
                 {"": {}, "_struct": STRUCT, **kind.further}.items()}  # fmt: skip
        files[f"octree/{name}.svo.npz"] = Frozen(form_named("svo.npz"), octree)
        if name == "sh9_float16":
            files |= {f"octree/{name}_struct.{form}": Frozen(form_named(form), octree, STRUCT) for form in OTHERS}
        about = f"A sparse voxel octree of {kind.data_format}, {octree.node_data.dtype}, {octree.layout} layout."
        yield Case(f"octree/{name}", about, files, facts_of(octree), answer)


def facts_of(octree: SparseVoxelOctree) -> Facts:
    lookups = []
    for place, towards in LOOKS:
        length = math.sqrt(sum(part * part for part in towards))
        direction = [part / length for part in towards]
        found = octrees.lookup_of(octree, place)
        empty = not any(found["nearest"])
        lookups.append(
            found
            | {
                "direction": direction,
                "colour": None if empty else colour_of(found["nearest"], octree.data_format, direction),
            }
        )
    return octrees.facts_of(octree, LEVEL_SIZES) | {"lookups": lookups}


def colour_of(values: list[float], data_format: str, direction: list[float]) -> list[float]:
    basis = [1.0] if data_format == "RGBA" else harmonics(int(data_format[2:]), direction)
    B = len(basis)
    sums = [sum(b * v for b, v in zip(basis, values[c * B : (c + 1) * B], strict=True)) for c in range(3)]
    return [1 / (1 + math.exp(-total)) for total in sums]


def harmonics(count: int, direction: list[float]) -> list[float]:
    """Real spherical harmonics by their definition: Legendre's functions with the phase (-1)^m, a cosine or a sine, and
    what makes the square's mean 1 / (4 pi)."""
    x, y, z = direction
    turn = math.atan2(y, x)
    found = []
    for degree in range(math.isqrt(count)):
        for order in range(-degree, degree + 1):
            m = abs(order)
            scale = (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m)
            around = 1.0 if order == 0 else math.sqrt(2) * (math.cos(m * turn) if order > 0 else math.sin(m * turn))
            found.append(math.sqrt(scale) * legendre(degree, m, z) * around)
    return found


def legendre(degree: int, m: int, z: float) -> float:
    """Legendre's associated function, by the usual recurrence in the degree."""
    below, here = 0.0, float((-1) ** m * math.prod(range(1, 2 * m, 2)) * (1 - z * z) ** (m / 2))
    for k in range(m + 1, degree + 1):
        below, here = here, ((2 * k - 1) * z * here - (k + m - 1) * below) / (k - m)
    return here


def answer(path: Path, expected: Facts) -> Facts:
    found = octrees.answer(path, expected)
    octree = load(path, SparseVoxelOctree)
    directions = np.array([each["direction"] for each in expected["lookups"]])
    B = parse_basis(octree.data_format).size
    basis = np.ones((len(directions), 1)) if octree.data_format == "RGBA" else sh_basis(directions, B)
    for i, each in enumerate(found["lookups"]):
        values = np.array(each["nearest"])
        sums = values[:-1].reshape(3, B) @ basis[i]
        each |= {
            "direction": floats(directions[i]),
            "colour": floats(1 / (1 + np.exp(-sums))) if values.any() else None,
        }
    return found
