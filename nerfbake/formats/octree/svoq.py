"""Read and write compressed octrees (.svoq): integer transform coefficients, range-coded or deflated.

schemas/svoq.md specifies every byte. encode() writes a QuantisedOctree; decode() returns the restored octree. The parts
of a file:

    basis         mixing (3B, 3B) int16, then row 0 of the coefficients (3B + 1,) int32
    topology      the masks                                          kernels.coding.topology, or a zlib stream
    coefficients  the other rows, in streams of some channels each   kernels.coding.coefficients, or a zlib stream
    padding       zeros; present only if the file would otherwise exceed the reader's limit of leaves for each byte

The coding `deflate` needs no range decoder. Its zlib streams contain:

    topology       the masks, a byte each
    coefficients   for each of the rows 1, 2, ... a byte: its length, the number of colour channels before its trailing
                   zeros. Then the values channel by channel: colour channel k for the rows with a length above k,
                   density for all rows. A value v is a byte: 2v, or -2v - 1 if v is below 0. The byte 255 marks a
                   number of 255 or more; these numbers follow all other values as u32, in the same order
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.wire.deflate import deflate_best, inflate
from nerfbake.formats.wire.svoq import (
    BASIS,
    COEFFICIENTS,
    HEADER,
    MAGIC,
    NAMES,
    PADDING,
    TOPOLOGY,
    SvoqPart,
    file_size,
    read_file,
    write_file,
)
from nerfbake.kernels.coding import coefficients, topology
from nerfbake.kernels.coding.pairs import pairs_of
from nerfbake.scene.basis import SH_SIZES
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.quantised_octree import MAX_VALUE, QuantisedOctree

_LARGE = 255


def deflated(masks: npt.NDArray[np.uint8], values: npt.NDArray[np.int32]) -> list[SvoqPart]:
    """Pack masks (c,) and values (m, C) except row 0 as zlib streams."""
    rows, C = values[1:], values.shape[1]
    filled = rows[:, :-1] != 0
    lengths = ((C - 1 - filled[:, ::-1].argmax(axis=1)) * filled.any(axis=1)).astype(np.uint8)
    pieces, large = [lengths], [np.zeros(0, np.uint32)]
    for channel in range(C):
        some = (rows[:, channel] if channel == C - 1 else rows[lengths > channel, channel]).astype(np.int64)
        unsigned = np.where(some < 0, -2 * some - 1, 2 * some).astype(np.uint32)
        pieces.append(np.minimum(unsigned, _LARGE).astype(np.uint8))
        large.append(unsigned[unsigned >= _LARGE])
    whole = b"".join(piece.tobytes() for piece in pieces) + np.concatenate(large).astype("<u4").tobytes()
    return [_part(TOPOLOGY, 0, masks.tobytes()), _part(COEFFICIENTS, C, whole)]


def inflated_masks(part: SvoqPart, c: int) -> npt.NDArray[np.uint8]:
    """Return the (c,) masks of a zlib stream. Raises InvalidFile, MemoryLimit."""
    if part.unpacked != c:
        raise InvalidFile(Problem("topology", f"unpacks to {part.unpacked:,} bytes", f"{c:,}, one for each mask"))
    return np.frombuffer(inflate(part.data, c, "topology"), np.uint8).copy()


def inflate_values(part: SvoqPart, values: npt.NDArray[np.int32]) -> None:
    """Fill values (m, C) except row 0 from a zlib stream. Raises InvalidFile, MemoryLimit."""
    rows, C = values[1:], values.shape[1]
    if part.unpacked > 5 * rows.size + len(rows):
        found = f"unpack to {part.unpacked:,} bytes"
        raise InvalidFile(Problem("coefficients", found, f"up to {5 * rows.size + len(rows):,} for {len(rows):,} rows"))
    memory.require("the coefficients", part.unpacked + 13 * len(rows))
    data = np.frombuffer(inflate(part.data, part.unpacked, "coefficients"), np.uint8)
    lengths = data[: len(rows)]
    counts = [*(int(np.count_nonzero(lengths > channel)) for channel in range(C - 1)), len(rows)]
    end = len(rows) + sum(counts)
    large = data[end:]
    if (
        end > len(data)
        or int(lengths.max(initial=0)) > C - 1
        or 4 * int(np.count_nonzero(data[len(rows) : end] == _LARGE)) != len(large)
    ):
        raise InvalidFile(Problem("coefficients", f"unpack to {len(data):,} bytes", "the size by its row lengths"))
    numbers, begin, used = large.view("<u4") if len(large) % 4 == 0 else large, len(rows), 0
    for channel, count in enumerate(counts):
        unsigned = data[begin : begin + count].astype(np.int64)
        escaped = np.flatnonzero(unsigned == _LARGE)
        unsigned[escaped] = numbers[used : used + len(escaped)]
        begin, used = begin + count, used + len(escaped)
        if int(unsigned.max(initial=0)) > 2 * MAX_VALUE:
            raise InvalidFile(Problem("coefficients", f"hold {int(unsigned.max()):,}", f"{2 * MAX_VALUE:,} (unsigned)"))
        signed = np.where(unsigned & 1, -(unsigned + 1 >> 1), unsigned >> 1)
        if channel == C - 1:
            rows[:, channel] = signed
        else:
            rows[lengths > channel, channel] = signed


def _part(kind: int, end: int, data: bytes) -> SvoqPart:
    return SvoqPart(kind, end, memoryview(deflate_best(data)), len(data))


Coding = Literal["range", "deflate"]
CODINGS: tuple[Coding, ...] = ("range", "deflate")

STEPS = ("mixing_scale", "colour_step", "density_step", "density_scale")
LEAVES_PER_BYTE = 256  # limit of the reader; the chair has 0.3
NODES_PER_LEAF = 13  # limit of masks for each leaf: one a level
_PAIR_BYTES, _MASK_BYTES = 17, 81  # working memory of decoding for each leaf and each mask
_FEW = 8  # channels; fewer go into a single stream


def recognise(view: memoryview) -> bool:
    """True for the first bytes of a .svoq of any version."""
    return bytes(view[: len(MAGIC)]) == MAGIC


def encode(octree: QuantisedOctree, *, coding: Coding = "range") -> Iterator[bytes | memoryview]:
    """Yield the file in pieces. Raises InvalidScene if the octree is invalid or a coefficient is too large."""
    return write_file(_header(octree, coding), _parts(octree, coding))


def coded_size(octree: QuantisedOctree, *, coding: Coding = "range") -> int:
    """The size in bytes of the file that encode() returns."""
    return file_size(_parts(octree, coding))


def decode(view: memoryview) -> SparseVoxelOctree:
    """Read a file and restore its octree."""
    return decode_quantised(view).restored()


def describe_packing(view: memoryview) -> dict[str, Any]:
    """Describe the coding of a file: its name, the quantisation steps, and the sizes of the parts.

    Sizes are in bytes and in percent of the file, for each kind of part. "header" includes the table of parts and the
    checksum.
    """
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


# The last parts of each octree in memory: a search asks for their size, and then the file is written.
_coded: WeakKeyDictionary[QuantisedOctree, tuple[Coding, list[SvoqPart]]] = WeakKeyDictionary()


def _parts(octree: QuantisedOctree, coding: Coding) -> list[SvoqPart]:
    known = _coded.get(octree)
    if known is None or known[0] != coding:
        known = _coded[octree] = coding, _code(octree, coding)
    return known[1]


def _code(octree: QuantisedOctree, coding: Coding) -> list[SvoqPart]:
    for problem in octree.problems():
        raise InvalidScene(problem)
    first = octree.mixing.astype("<i2").tobytes() + octree.values[0].astype("<i4").tobytes()
    parts = [SvoqPart(BASIS, 0, memoryview(first))]
    if coding == "deflate":
        parts += deflated(octree.masks, octree.values)
    else:
        ends = _stream_ends(octree.values.shape[1])
        streams = coefficients.encode_values(octree.values, pairs_of(octree.masks, octree.m), ends)
        parts.append(SvoqPart(TOPOLOGY, 0, topology.encode_masks(octree.masks).data))
        parts += [SvoqPart(COEFFICIENTS, end, stream.data) for end, stream in zip(ends, streams, strict=True)]
    if (missing := -(-octree.m // LEAVES_PER_BYTE) - file_size(parts)) > 0:
        parts.append(SvoqPart(PADDING, 0, memoryview(bytes(missing))))
    return parts


def _stream_ends(C: int) -> list[int]:
    """Split the channels into two streams of similar size, so that two cores can decode them.

    A group of channels is never split.
    """
    first, single = C // 4, coefficients.FIRST_GROUP
    if 3 * single < C:
        first = single + max(0, first - single) // coefficients.GROUP * coefficients.GROUP
    return [first, C] if C >= _FEW else [C]


# -- reading ---------------------------------------------------------------------------------------------------
def decode_quantised(view: memoryview) -> QuantisedOctree:
    """Read the quantised octree of a file. Raises InvalidFile or MemoryLimit before it allocates memory."""
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
    """Check the declared counts against the file's size, before anything is allocated."""
    if not 1 <= m <= LEAVES_PER_BYTE * size:
        allowed = f"1 to {LEAVES_PER_BYTE * size:,}, {LEAVES_PER_BYTE} for each byte of the file"
        raise InvalidFile(Problem("leaves", f"are {m:,}", allowed))
    if c > NODES_PER_LEAF * m:
        raise InvalidFile(
            Problem("masks", f"are {c:,}", f"up to {NODES_PER_LEAF * m:,}, {NODES_PER_LEAF} for each leaf")
        )


def _arranged(parts: Sequence[SvoqPart], C: int, *, packed: bool) -> tuple[SvoqPart, SvoqPart, list[SvoqPart]]:
    """Return the basis, the topology and the coefficient streams, which must be in this order."""
    padding = [part for part in parts[3:] if part.kind == PADDING]
    kinds, ends = [part.kind for part in parts], [part.end for part in parts[2 : len(parts) - len(padding)]]
    streams = [COEFFICIENTS] * len(ends)
    if kinds != [BASIS, TOPOLOGY, *streams, *[PADDING] * len(padding)] or len(padding) > 1 or not streams:
        raise InvalidFile(Problem("parts", f"are of kinds {kinds[:16]}", "0, 1, 2 (one or more), 3 (at most one)"))
    rising = all(one < other for one, other in zip([0, *ends], ends, strict=False))
    if ends[-1] != C or not rising or (packed and len(ends) > 1):
        allowed = f"rising up to {C}, the number of channels" if not packed else f"{C}, the number of channels"
        raise InvalidFile(Problem("coefficients", f"end at channels {ends[:16]}", allowed))
    if padding and any(padding[0].data):
        raise InvalidFile(Problem("padding", "has non-zero bytes", "zeros"))
    return parts[0], parts[1], list(parts[2 : 2 + len(ends)])


def _basis(part: SvoqPart, C: int) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.int32]]:
    """(3B, 3B) mixing and (C,) row 0."""
    mixing = 2 * (C - 1) ** 2
    if len(part.data) != mixing + 4 * C:
        raise InvalidFile(Problem("basis", f"has {len(part.data):,} bytes", f"{mixing + 4 * C:,}"))
    matrix = np.frombuffer(part.data[:mixing], "<i2").astype(np.int16).reshape(C - 1, C - 1)
    return matrix, np.frombuffer(part.data[mixing:], "<i4").astype(np.int32)


def _decoded_masks(part: SvoqPart, c: int, levels: int) -> npt.NDArray[np.uint8]:
    masks, found, used = topology.decode_masks(np.frombuffer(part.data, np.uint8), c, levels)
    if found == topology.ORPHAN:
        raise InvalidFile(
            Problem("topology", f"declares {c:,} masks", "one for each node above the level of single voxels")
        )
    if found == topology.DEEP:
        raise InvalidFile(Problem("topology", "has nodes below single voxels", f"masks in {levels} levels only"))
    if used != len(part.data):
        raise InvalidFile(Problem("topology", f"has {len(part.data):,} bytes", "the size that its masks need"))
    return masks


def _decode_streams(streams: Sequence[SvoqPart], octree: QuantisedOctree) -> None:
    """Fill the values except row 0."""
    data = [np.frombuffer(part.data, np.uint8) for part in streams]
    pairs = pairs_of(octree.masks, octree.m)
    found, used = coefficients.decode_values(data, octree.values, pairs, [part.end for part in streams])
    if found == coefficients.TOO_LARGE:
        raise InvalidFile(Problem("coefficients", "hold a number that is too large", f"{MAX_VALUE:,}"))
    sizes = [len(part) for part in data]
    if found == coefficients.TOO_SHORT or used != sizes:
        raise InvalidFile(Problem("coefficients", f"have {sizes} bytes", "the sizes that their values need"))
