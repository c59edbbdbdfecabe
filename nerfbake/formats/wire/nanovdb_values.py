"""What the nodes of a NanoVDB file hold: values, or codes between each leaf's least and greatest one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import MemoryLimit
from nerfbake.formats.wire import nanovdb_nodes as nano
from nerfbake.formats.wire.vdb_held import Held, differs, joined
from nerfbake.kernels.arrays import Bits, Ints
from nerfbake.kernels.maths.casting import cast
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import bits_of, words_of

_CHUNK = 256  # leaves at a time by each core
Nodes = npt.NDArray[Any]


class Codes(NamedTuple):
    """Where each leaf starts, and of FpN its bits a code; 0 where the leaf's struct has all that it holds."""

    at: Ints
    bits: Ints


class Room:
    """How much values may take, as they come: other threads do not know what this one may."""

    def __init__(self, most: int) -> None:
        self._most, self._taken = most, 0

    def take(self, size: int) -> None:
        self._taken += size
        if self._taken > self._most:
            raise MemoryLimit("the grid", self._taken, self._most)


def root_tiles_of(entries: Nodes, background: npt.NDArray[np.float32]) -> Held:
    values, active = _floats(entries["value"]), entries["state"] != 0
    own = active | differs(values, background)
    return Held(own.astype(np.uint64), values[own], active[own])


def tiles_of(nodes: Nodes, layout: nano.Layout, background: npt.NDArray[np.float32], room: Room) -> Held:
    """One node after the other: a table is up to half a megabyte."""
    mask = np.zeros(nodes["tiles"].shape, np.uint64)
    values, active = [np.zeros((0, layout.channels), np.float32)], [np.zeros(0, bool)]
    for row, node in enumerate(nodes):
        table = _floats(node["table"].view(layout.value)[:, : layout.channels])
        is_active = bits_of(node["tiles"])
        own = (is_active | differs(table, background)) & ~bits_of(node["children"])
        if own.any():
            mask[row] = words_of(own)
            values.append(table[own])
            active.append(is_active[own])
            room.take(values[-1].nbytes)
    return Held(mask, np.concatenate(values), np.concatenate(active))


def voxels_of(
    view: memoryview,
    leaf: Nodes,
    codes: Codes,
    layout: nano.Layout,
    background: npt.NDArray[np.float32],
    room: Room,
    *,
    signed: bool,
) -> Held:
    chunks: list[Any] = [None] * -(-len(leaf) // _CHUNK)
    quantised = "quantum" in (layout.leaf.names or ())

    def work(begin: int, end: int) -> None:
        own = leaf[begin:end]
        active = bits_of(own["mask"])
        if quantised:
            bits = codes.bits[begin:end] if layout is nano.FPN else np.full(len(own), nano.BITS[layout.name])
            dense = _decoded(view, own, codes.at[begin:end] + nano.FPN.leaf.itemsize, bits, background, active, signed)
        else:
            dense = _floats(own["values"])
        held = active | differs(dense, background)
        room.take(int(np.count_nonzero(held)) * 4 * layout.channels)
        chunks[begin // _CHUNK] = Held(words_of(held), dense[held], active[held])

    over_chunks(work, len(leaf), _CHUNK)
    nothing = Held(np.zeros((0, 8), np.uint64), np.zeros((0, layout.channels), np.float32), np.zeros(0, bool))
    return joined([nothing, *chunks])


def _decoded(
    view: memoryview,
    leaf: Nodes,
    at: Ints,
    bits: Ints,
    background: npt.NDArray[np.float32],
    active: Bits,
    signed: bool,
) -> npt.NDArray[np.float32]:
    """(q, 512, 1) least + code * quantum; an inactive voxel a quantum from the background is that."""
    octets, code = np.frombuffer(view, np.uint8), np.empty((len(leaf), 512), np.uint16)
    for width in np.unique(bits).tolist():
        own = np.flatnonzero(bits == width)
        code[own] = _codes(octets[at[own, None] + np.arange(64 * width)], width)
    with np.errstate(all="ignore"):  # broken files: infinite or NaN values are reported as such
        quantum = leaf["quantum"][:, None]
        dense = leaf["least"][:, None] + quantum * code.astype(np.float32)
        for known in (background, -background) if signed else (background,):
            np.copyto(dense, known, where=~active & (np.abs(dense - known) <= np.abs(quantum)))
    decoded: npt.NDArray[np.float32] = dense[..., None]
    return decoded


def _codes(octets: npt.NDArray[np.uint8], width: int) -> npt.NDArray[np.uint16]:
    """(q, 64 width) bytes -> (q, 512) codes, lowest bits first."""
    if width >= 8:
        return octets.view(f"<u{width // 8}").astype(np.uint16)
    shifts = np.arange(0, 8, width, dtype=np.uint8)
    return ((octets[:, :, None] >> shifts) & ((1 << width) - 1)).reshape(len(octets), 512).astype(np.uint16)


def _floats(values: Nodes) -> npt.NDArray[np.float32]:
    return cast(values, np.float32)
