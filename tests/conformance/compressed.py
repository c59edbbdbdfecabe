"""Compressed octrees: whole numbers that are written here, in both codings, and the leaves that they stand for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nerfbake.formats.octree.svoq import decode_quantised
from nerfbake.scene.quantised_octree import QuantisedOctree
from tests.conformance.case import Case, Facts, Frozen, floats, form_named
from tests.support.svoq_reference import leaves_of

LEAVES_APART = 12  # of whose leaves the JSON tells
NUMBERS = ("mixing_scale", "colour_step", "density_step", "density_scale")


def scenes() -> dict[str, QuantisedOctree]:
    """sh4: five levels of a 9 x 16 x 12 grid, leaves on the last four, numbers of every length; two streams, and groups
    of channels. rgba: one voxel."""
    masks = [0b10010110, 0b10000001, 0, 0b11111111, 0b01100110, *(i * 37 % 256 for i in range(14))]
    masks += [i * 91 % 200 for i in range(sum(mask.bit_count() for mask in masks[5:]))]
    m = 1 + sum(mask.bit_count() for mask in masks) - sum(mask != 0 for mask in masks)
    k, row = np.arange(13), np.arange(m)[:, None]
    values = ((row * 7919 + k * 104729) % 1009 - 504) // (1 + row * (1 + k) // 8)
    values[0] = 3 * 7 ** np.minimum(k, 8) * (-1) ** k
    values[1, :3] = [(1 << 30) - 1, -(1 << 30) + 1, 1 << 20]
    values[m // 2 :, 9:12] = 0
    values[:, 12] = values[:, 12] % 23 - 9
    values[0, 12] = 700
    return {
        "sh4": _quantised((9, 16, 12), masks, values, "SH4"),
        "rgba": _quantised((1, 1, 1), [], np.array([[1, -2, 3, 40]]), "RGBA"),
    }


def _quantised(size: tuple[int, int, int], masks: list[int], values: object, data_format: str) -> QuantisedOctree:
    numbers = np.array(values, np.int32)
    C = numbers.shape[1] - 1
    mixing = (np.arange(C * C).reshape(C, C) * 7919 % 65521 - 32760).astype(np.int16)
    origin, voxel_size = np.array([-1.0, 0.5, 0.25]), np.array([0.25, 0.125, 0.5])
    own = np.array(masks, np.uint8)
    return QuantisedOctree(size, own, numbers, mixing, 2.0**-15, 0.0625, 0.125, 20.0, data_format, origin, voxel_size)


def cases() -> Iterator[Case]:
    for name, octree in scenes().items():
        files = {
            f"compressed/{name}_{coding}.svoq": Frozen(form_named("svoq"), octree, {"coding": coding})
            for coding in ("range", "deflate")
        }
        about = f"A compressed octree, {octree.data_format}, {octree.m:,} leaves."
        yield Case(f"compressed/{name}", about, files, _facts(octree), answer)


def _facts(octree: QuantisedOctree) -> Facts:
    facts = _stored(octree)
    leaves = leaves_of(facts)
    return facts | {"lookups": [{"leaf": i, "values": leaves[i]} for i in range(0, octree.m, LEAVES_APART)]}


def _stored(octree: QuantisedOctree) -> Facts:
    return {
        "size": list(octree.size),
        "data_format": octree.data_format,
        "origin": floats(octree.origin),
        "voxel_size": floats(octree.voxel_size),
        **{name: getattr(octree, name) for name in NUMBERS},
        **{name: floats(getattr(octree, name)) for name in ("mixing", "masks", "values")},
    }


def answer(path: Path, expected: Facts) -> Facts:
    octree = decode_quantised(memoryview(path.read_bytes()))
    leaves = octree.leaf_values()
    found = [{"leaf": each["leaf"], "values": floats(leaves[each["leaf"]])} for each in expected["lookups"]]
    return _stored(octree) | {"lookups": found}
