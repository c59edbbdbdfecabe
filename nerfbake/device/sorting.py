"""Running sums and stable sorts on a graphics device. The shaders are shaders/sort/*.wgsl.

All sums are of integers, and equal keys keep their order, so results do not depend on the device. The work is made once
for some buffers, and can be submitted many times.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.device.gpu import Bound, Buffer, Dispatch, Gpu
from nerfbake.device.shader_files import read_wgsl

ENTRY = 8  # bytes: key and value, uint32
_PART = 2048  # numbers of a workgroup of a scan, and entries of one of a sort
_BITS = 4  # that a pass sorts by
_JOB = np.dtype([(name, "<u4") for name in ("count", "shift", "blocks", "at", "room")])  # the record `Job` of job.wgsl


class Sort(NamedTuple):
    """The work that sorts up to `room` entries by so many bits of their keys, from `source` into `sorted`.

    What `source` has is lost.
    """

    room: int
    bits: int
    source: Buffer
    sorted: Buffer
    work: list[Dispatch]


def scan_on(gpu: Gpu, data: Buffer, count: int) -> list[Dispatch]:
    """Return the work that replaces each of `count` uint32 by the sum of those before it. Raises DeviceError."""
    jobs = gpu.upload_records(np.array([(count, 0, 0, 0, 0)], _JOB))
    return _scan(gpu, data, jobs, count, 0)


def sort_on(gpu: Gpu, extent: Buffer, at: int, *, room: int, bits: int) -> Sort:
    """Return a sort of at most `room` entries, by the lowest bits of their keys. Raises DeviceError.

    extent: a buffer whose uint32 number `at` is how many entries there are. If it is above `room`, so many are sorted.
    """
    what = f"{room:,} entries to sort"
    blocks = _parts(room)
    count = blocks << _BITS
    source, target = gpu.empty(ENTRY * room, what), gpu.empty(ENTRY * room, what)
    places, first, work = gpu.empty(4 * count, what), source, list[Dispatch]()
    jobs = gpu.upload_records(np.array([(count, shift, blocks, at, room) for shift in range(0, bits, _BITS)], _JOB))
    totals = gpu.empty(4 * _parts(count))
    for number in range(-(-bits // _BITS)):
        own = {"job": jobs, "extent": extent, "places": places, "entries": source, "sorted": target}
        work.append(Dispatch(_bound(gpu, "sortCount", own), blocks, number))
        work += _scan(gpu, places, jobs, count, number, totals)
        work.append(Dispatch(_bound(gpu, "sortMove", own), blocks, number))
        source, target = target, source
    return Sort(room, bits, first, source, work)


def _scan(
    gpu: Gpu, data: Buffer, jobs: Buffer, count: int, number: int, totals: Buffer | None = None
) -> list[Dispatch]:
    """Return the passes of a scan. jobs, number: the record that has the count. totals: a buffer of the parts' sums."""
    parts = _parts(count)
    buffers = {"job": jobs, "data": data, "totals": totals or gpu.empty(4 * parts)}
    passes = ("scanParts", parts), ("scanTotals", 1), ("scanWhole", parts)
    return [Dispatch(_bound(gpu, entry, buffers), groups, number) for entry, groups in passes]


def _bound(gpu: Gpu, entry: str, buffers: dict[str, Buffer]) -> Bound:
    file = "sort/scan" if entry.startswith("scan") else "sort/radix"
    return gpu.bind(gpu.pipeline(read_wgsl("sort/job", file), entry), buffers)


def _parts(count: int) -> int:
    return max(-(-count // _PART), 1)
