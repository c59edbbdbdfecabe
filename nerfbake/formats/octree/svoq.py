"""The compressed octree (.svoq): whole numbers of a transform, range-coded or deflated. schemas/svoq.md has every byte.

A file is written from a QuantisedOctree and read as the octree that it stands for. The parts:

    basis         mixing (3B, 3B) int16, then row 0 of the coefficients (3B + 1,) int32
    topology      the masks                                          kernels.coding.topology, or a zlib stream
    coefficients  the other rows, in streams of some channels each   kernels.coding.coefficients, or a zlib stream
    padding       zeros, only where an octree is so regular that it would have more leaves a byte than a reader believes
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.octree.svoq_deflate import deflated, inflate_values, inflated_masks
from nerfbake.formats.wire.svoq import (
    BASIS,
    COEFFICIENTS,
    HEADER,
    MAGIC,
    NAMES,
    PADDING,
    TOPOLOGY,
    Part,
    file_size,
    read_file,
    write_file,
)
from nerfbake.kernels.coding import coefficients, topology
from nerfbake.kernels.coding.pairs import pairs_of
from nerfbake.scene.basis import SH_SIZES
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.quantised_octree import MAX_VALUE, QuantisedOctree

Coding = Literal["range", "deflate"]
CODINGS: tuple[Coding, ...] = ("range", "deflate")

STEPS = ("mixing_scale", "colour_step", "density_step", "density_scale")
LEAVES_PER_BYTE = 256  # that a reader believes; the chair has 0.3
NODES_PER_LEAF = 13  # with masks: one a level
_PAIR_BYTES, _MASK_BYTES = 17, 81  # that decoding takes for each leaf and each mask, beside what it gives
_FEW = 8  # channels: no more streams than one


def recognise(view: memoryview) -> bool:
    """True for the first bytes of a .svoq of any version."""
    return bytes(view[: len(MAGIC)]) == MAGIC


def encode(octree: QuantisedOctree, *, coding: Coding = "range") -> Iterator[bytes | memoryview]:
    """The file in pieces. Raises InvalidScene if the octree is not sound, or a coefficient is too large."""
    return write_file(_header(octree, coding), _parts(octree, coding))


def coded_size(octree: QuantisedOctree, *, coding: Coding = "range") -> int:
    """Bytes of the file that encode() gives."""
    return file_size(_parts(octree, coding))


def decode(view: memoryview) -> SparseVoxelOctree:
    """The octree that the file stands for."""
    return decode_quantised(view).restored()


def describe_packing(view: memoryview) -> dict[str, Any]:
    """How the whole numbers are coded, and their steps; bytes, and the share of the file, of each kind of part, and of
    the header with the table of parts and the checksum."""
    header, parts = read_file(view)
    sizes = {"header": file_size(parts) - sum(len(part.data) for part in parts)}
    for part in parts:
        name = NAMES[part.kind] if part.kind < len(NAMES) else f"kind {part.kind}"
        sizes[name] = sizes.get(name, 0) + len(part.data)
    coding = int(header["coding"])
    return {
        "coding": CODINGS[coding] if coding < len(CODINGS) else f"kind {coding}",
        "colour_step": float(header["colour_step"]),
        "density_step": float(header["density_step"]),
        "density_scale": float(header["density_scale"]),
        "bytes_of_parts": sizes,
        "percent_of_parts": {name: round(100 * size / len(view), 1) for name, size in sizes.items()},
    }


# -- writing ---------------------------------------------------------------------------------------------------
def _header(octree: QuantisedOctree, coding: Coding) -> np.void:
    header: np.void = np.zeros(1, HEADER)[0]
    header["coding"] = CODINGS.index(coding)
    header["basis"] = 0 if octree.data_format == "RGBA" else octree.basis.size
    header["masks"], header["leaves"] = len(octree.masks), octree.m
    for name in ("size", "origin", "voxel_size", *STEPS):
        header[name] = getattr(octree, name)
    return header


def _parts(octree: QuantisedOctree, coding: Coding) -> list[Part]:
    for problem in octree.problems():
        raise InvalidScene(problem)
    first = octree.mixing.astype("<i2").tobytes() + octree.values[0].astype("<i4").tobytes()
    parts = [Part(BASIS, 0, memoryview(first))]
    if coding == "deflate":
        parts += deflated(octree.masks, octree.values)
    else:
        ends = _stream_ends(octree.values.shape[1])
        streams = coefficients.encode_values(octree.values, pairs_of(octree.masks, octree.m), ends)
        parts.append(Part(TOPOLOGY, 0, topology.encode_masks(octree.masks).data))
        parts += [Part(COEFFICIENTS, end, stream.data) for end, stream in zip(ends, streams, strict=True)]
    if (missing := -(-octree.m // LEAVES_PER_BYTE) - file_size(parts)) > 0:
        parts.append(Part(PADDING, 0, memoryview(bytes(missing))))
    return parts


def _stream_ends(C: int) -> list[int]:
    """Two streams of about as many bytes, which two cores decode; no group of channels in both."""
    first = C // 4
    groups = max(0, first - coefficients.FIRST_GROUP) // coefficients.GROUP
    if first > coefficients.FIRST_GROUP:
        first = coefficients.FIRST_GROUP + groups * coefficients.GROUP
    return [first, C] if C >= _FEW else [C]


# -- reading ---------------------------------------------------------------------------------------------------
def decode_quantised(view: memoryview) -> QuantisedOctree:
    """The whole numbers in a file. Raises InvalidFile, MemoryLimit; before it allocates anything for it."""
    header, parts = read_file(view)
    if header["basis"] not in (0, *SH_SIZES):
        raise InvalidFile(Problem("basis", f"is {header['basis']}", f"0 (RGBA), {', '.join(map(str, SH_SIZES))}"))
    if header["coding"] >= len(CODINGS):
        raise InvalidFile(Problem("coding", f"is {header['coding']}", "0 (range), 1 (deflate)"))
    packed, size = CODINGS[header["coding"]] == "deflate", header["size"].tolist()
    c, m, C = int(header["masks"]), int(header["leaves"]), 3 * max(1, int(header["basis"])) + 1
    _require_believable(c, m, len(view))
    first, tree, streams = _arranged(parts, C, packed=packed)
    mixing, total = _basis(first, C)
    memory.hold("the compressed octree", c + 4 * m * C)
    memory.require("decoding the octree", _PAIR_BYTES * m + _MASK_BYTES * c)
    levels = max(max(size) - 1, 0).bit_length()
    masks = inflated_masks(tree, c) if packed else _decoded_masks(tree, c, levels)
    octree = QuantisedOctree(
        size=(size[0], size[1], size[2]),
        masks=masks,
        values=np.zeros((m, C), np.int32),
        mixing=mixing,
        **{name: float(header[name]) for name in STEPS},
        data_format=f"SH{header['basis']}" if header["basis"] else "RGBA",
        origin=header["origin"],
        voxel_size=header["voxel_size"],
    )
    octree.require_sound()
    if packed:
        inflate_values(streams[0], octree.values)
    else:
        _decode_streams(streams, octree)
    octree.values[0] = total
    for problem in octree.value_problems():
        raise InvalidFile(problem)
    return octree


def _require_believable(c: int, m: int, size: int) -> None:
    """What a file declares is held against its bytes before anything is made of it."""
    if not 1 <= m <= LEAVES_PER_BYTE * size:
        allowed = f"1 to {LEAVES_PER_BYTE * size:,}, {LEAVES_PER_BYTE} for each byte of the file"
        raise InvalidFile(Problem("leaves", f"are {m:,}", allowed))
    if c > NODES_PER_LEAF * m:
        raise InvalidFile(
            Problem("masks", f"are {c:,}", f"up to {NODES_PER_LEAF * m:,}, {NODES_PER_LEAF} for each leaf")
        )


def _arranged(parts: Sequence[Part], C: int, *, packed: bool) -> tuple[Part, Part, list[Part]]:
    """The basis, the topology and the coefficients' streams, which must stand in this order."""
    padding = [part for part in parts[3:] if part.kind == PADDING]
    kinds, ends = [part.kind for part in parts], [part.end for part in parts[2 : len(parts) - len(padding)]]
    streams = [COEFFICIENTS] * len(ends)
    if kinds != [BASIS, TOPOLOGY, *streams, *[PADDING] * len(padding)] or len(padding) > 1 or not streams:
        raise InvalidFile(Problem("parts", f"are of kinds {kinds[:16]}", "0, 1, 2 (as often as need be), 3 (or none)"))
    rising = all(one < other for one, other in zip([0, *ends], ends, strict=False))
    if ends[-1] != C or not rising or (packed and len(ends) > 1):
        allowed = f"rising up to {C}, the number of channels" if not packed else f"{C}, the number of channels"
        raise InvalidFile(Problem("coefficients", f"end at channels {ends[:16]}", allowed))
    if padding and any(padding[0].data):
        raise InvalidFile(Problem("padding", "holds something", "zeros"))
    return parts[0], parts[1], list(parts[2 : 2 + len(ends)])


def _basis(part: Part, C: int) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.int32]]:
    """(3B, 3B) mixing and (C,) row 0."""
    mixing = 2 * (C - 1) ** 2
    if len(part.data) != mixing + 4 * C:
        raise InvalidFile(Problem("basis", f"has {len(part.data):,} bytes", f"{mixing + 4 * C:,}"))
    matrix = np.frombuffer(part.data[:mixing], "<i2").astype(np.int16).reshape(C - 1, C - 1)
    return matrix, np.frombuffer(part.data[mixing:], "<i4").astype(np.int32)


def _decoded_masks(part: Part, c: int, levels: int) -> npt.NDArray[np.uint8]:
    masks, found, used = topology.decode_masks(np.frombuffer(part.data, np.uint8), c, levels)
    if found == topology.ORPHAN:
        raise InvalidFile(
            Problem("topology", f"declares {c:,} masks", "as many as there are nodes above single voxels")
        )
    if found == topology.DEEP:
        raise InvalidFile(Problem("topology", "has nodes below single voxels", f"masks in {levels} levels"))
    if used != len(part.data):
        raise InvalidFile(Problem("topology", f"has {len(part.data):,} bytes", "as many as its masks take"))
    return masks


def _decode_streams(streams: Sequence[Part], octree: QuantisedOctree) -> None:
    """Fills the values, all but row 0."""
    data = [np.frombuffer(part.data, np.uint8) for part in streams]
    pairs = pairs_of(octree.masks, octree.m)
    found, used = coefficients.decode_values(data, octree.values, pairs, [part.end for part in streams])
    if found == coefficients.TOO_LARGE:
        raise InvalidFile(Problem("coefficients", "hold a number that is too large", f"{MAX_VALUE:,}"))
    sizes = [len(part) for part in data]
    if found == coefficients.TOO_SHORT or used != sizes:
        raise InvalidFile(Problem("coefficients", f"have {sizes} bytes", "as many as their numbers take"))
