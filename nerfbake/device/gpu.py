"""A device that runs compute shaders: buffers, pipelines, and the submission of work.

Shaders are WGSL. All bindings of a shader are found by their names in its text:

    @group(0) @binding(0) var<storage, read> values: array<f32>;
    @group(0) @binding(1) var<storage, read_write> out: array<vec4f>;
    @group(0) @binding(2) var<uniform> view: View;

A uniform is one record of an array of records (upload_records()); each dispatch chooses one by its number.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.device import library
from nerfbake.errors import DeviceError, Problem, format_size

_PART = 1 << 26  # bytes that are uploaded at a time: the driver holds a copy of each part
_PATIENCE = 60.0  # seconds in which submitted work must end
_HIGHEST = (  # limits that are asked for: a device has WebGPU's smallest ones otherwise
    "max-buffer-size",
    "max-storage-buffer-binding-size",
    "max-storage-buffers-per-shader-stage",
    "max-compute-workgroup-storage-size",
    "max-compute-invocations-per-workgroup",
    "max-compute-workgroup-size-x",
    "max-compute-workgroups-per-dimension",
)
_BINDING = re.compile(r"@group\((\d+)\) @binding\((\d+)\) var<(\w+)(?:, *(\w+))?> *(\w+) *:")


class Limits(NamedTuple):
    """Limits of a device: bytes of a buffer, bytes of a buffer that a shader reads, storage buffers of a shader."""

    buffer: int
    binding: int
    storage_buffers: int


@dataclass(eq=False)
class Buffer:
    """Memory on the device. size: bytes; stride: bytes between the records of a uniform, else 0."""

    size: int
    handle: Any
    stride: int = 0


@dataclass(eq=False)
class Pipeline:
    """A compiled entry point. names: group, binding and kind of each binding."""

    handle: Any
    layouts: list[Any]
    names: dict[str, tuple[int, int, str]]


class Bound(NamedTuple):
    """A pipeline with its buffers. uniform: the buffer of its records, or None; dynamic: the group of that buffer."""

    pipeline: Pipeline
    groups: list[Any]
    uniform: Buffer | None
    dynamic: int


class Dispatch(NamedTuple):
    """One run of a pipeline. groups: the number of workgroups; record: the number of the uniform's record.

    Above 65,535 workgroups a dispatch has two axes. The shader then computes its workgroup's number as
    `group.x + group.y * count.x` of workgroup_id and num_workgroups, and ignores numbers above its work.
    """

    bound: Bound
    groups: int
    record: int = 0


@dataclass(eq=False)
class Download:
    """An array on its way from the device. take() or mapped() waits for it. Call one of them, once."""

    gpu: Gpu
    staging: Any
    promise: Any
    dtype: np.dtype[Any]

    def take(self) -> npt.NDArray[Any]:
        """Return the array (n,), once the work that was submitted before is done. Raises DeviceError."""
        with self.mapped() as found:
            return found.copy()

    @contextmanager
    def mapped(self) -> Iterator[npt.NDArray[Any]]:
        """Yield the array (n,) in the driver's memory, which must not be read after the block. Raises DeviceError."""
        self.gpu.wait_for(self.promise)
        with library.quiet(f"{self.gpu.name}: reading"):
            found = np.frombuffer(self.staging.read_mapped(copy=False), self.dtype)
        yield found
        with library.quiet(f"{self.gpu.name}: reading"):
            self.staging.unmap()
        self.gpu.spare.append(self.staging)


@dataclass(eq=False)
class Gpu:
    """A graphics card, or a software adapter. All its errors are DeviceError; after one, do not use the device again.

    name    of the adapter
    limits  the highest that the adapter has
    spare   buffers that have been read and can be used again
    """

    name: str
    _adapter: Any = field(repr=False)
    limits: Limits = field(init=False)
    _device: Any = field(init=False, repr=False)
    _usage: Any = field(init=False, repr=False)
    _axis: int = field(init=False, repr=False)
    _alignment: int = field(init=False, repr=False)
    _little: Buffer = field(init=False, repr=False)
    _closed: bool = field(default=False, init=False, repr=False)
    spare: list[Any] = field(default_factory=list, init=False, repr=False)
    _pipelines: dict[tuple[object, ...], Pipeline] = field(default_factory=dict, init=False, repr=False)
    _layouts: dict[tuple[tuple[int, str], ...], Any] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        wgpu, own = library.load(), self._adapter.limits
        with library.quiet(f"{self.name}: opening the device"):
            asked = {limit: own[limit] for limit in _HIGHEST if limit in own}
            self._device = self._adapter.request_device_sync(required_limits=asked)
        found, self._usage = self._device.limits, wgpu.BufferUsage
        largest = found["max-buffer-size"]
        binding = min(largest, found["max-storage-buffer-binding-size"]) // 4 * 4
        self.limits = Limits(largest, binding, found["max-storage-buffers-per-shader-stage"])
        self._axis = found["max-compute-workgroups-per-dimension"]
        self._alignment = found["min-uniform-buffer-offset-alignment"]
        self._little = self.empty(4)

    # -- buffers -------------------------------------------------------------------------------------------------
    def empty(self, size: int, what: str = "a buffer") -> Buffer:
        """Return a buffer of at least `size` bytes, all zero. what: its contents, for errors. Raises DeviceError."""
        size = max(-(-size // 4) * 4, 16)
        if size > self.limits.binding:
            allowed = f"{format_size(self.limits.binding)} on {self.name}"
            raise DeviceError(Problem(what, f"needs a buffer of {format_size(size)}", allowed))
        usage = self._usage.STORAGE | self._usage.COPY_SRC | self._usage.COPY_DST
        return Buffer(size, self._buffer(size, usage, what))

    def upload(self, array: npt.NDArray[Any], what: str = "a buffer") -> Buffer:
        """Return a buffer with the bytes of an array. Raises DeviceError."""
        buffer = self.empty(array.nbytes, what)
        self.write(buffer, array)
        return buffer

    def upload_records(self, records: npt.NDArray[Any]) -> Buffer:
        """Return a buffer for a uniform with records (n, ...), each a multiple of 4 bytes, in the layout of WGSL."""
        flat = np.ascontiguousarray(records).reshape(len(records), -1).view(np.uint8)
        stride = -(-flat.shape[1] // self._alignment) * self._alignment
        padded = np.zeros((len(flat), stride), np.uint8)
        padded[:, : flat.shape[1]] = flat
        usage = self._usage.UNIFORM | self._usage.COPY_DST
        buffer = Buffer(padded.size, self._buffer(padded.size, usage, "the records"), stride)
        self.write(buffer, padded)
        return buffer

    def write(self, buffer: Buffer, array: npt.NDArray[Any], offset: int = 0) -> None:
        """Copy an array into a buffer, before the work that is submitted next. Bytes and offset are multiples of 4."""
        data = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        with library.quiet(f"{self.name}: writing"):
            for first in range(0, len(data), _PART):
                self._device.queue.write_buffer(buffer.handle, offset + first, data[first : first + _PART])
                if len(data) > _PART:
                    self._device.queue.submit([])

    def read(self, buffer: Buffer, dtype: npt.DTypeLike, count: int, offset: int = 0) -> npt.NDArray[Any]:
        """Return `count` numbers of a buffer from a byte on, once all submitted work is done. Raises DeviceError."""
        return self.read_later(buffer, dtype, count, offset).take()

    def read_later(self, buffer: Buffer, dtype: npt.DTypeLike, count: int, offset: int = 0) -> Download:
        """Copy `count` numbers of a buffer after the work submitted so far, without waiting. Raises DeviceError."""
        kind = np.dtype(dtype)
        size = count * kind.itemsize
        staging = self._staging(size)
        with library.quiet(f"{self.name}: reading"):
            encoder = self._device.create_command_encoder()
            encoder.copy_buffer_to_buffer(buffer.handle, offset, staging, 0, size)
            self._device.queue.submit([encoder.finish()])
            return Download(self, staging, staging.map_async("READ"), kind)

    def _staging(self, size: int) -> Any:
        """A buffer to read from: a spare one of this size, which saves the driver's work of a new one, or a new one."""
        while self.spare:
            if (spare := self.spare.pop()).size == size:
                return spare
            spare.destroy()
        return self._buffer(size, self._usage.MAP_READ | self._usage.COPY_DST, "a buffer to read")

    def _buffer(self, size: int, usage: int, what: str) -> Any:
        with library.quiet(f"{self.name}: {what} of {format_size(size)}"):
            return self._device.create_buffer(size=size, usage=usage)

    # -- work ----------------------------------------------------------------------------------------------------
    def pipeline(self, wgsl: str, entry: str, constants: Mapping[str, float] | None = None) -> Pipeline:
        """Return a compiled entry point of a shader, compiled once. Raises DeviceError.

        constants: the values of its `override` constants. All bindings in the text become part of the pipeline, so a
        text has only those that its entry points use.
        """
        own = tuple(sorted((constants or {}).items()))
        if (wgsl, entry, own) not in self._pipelines:
            self._pipelines[wgsl, entry, own] = self._compiled(wgsl, entry, dict(own))
        return self._pipelines[wgsl, entry, own]

    def _compiled(self, wgsl: str, entry: str, constants: dict[str, float]) -> Pipeline:
        names = {
            name: (int(group), int(binding), _kind(space, access))
            for group, binding, space, access, name in _BINDING.findall(wgsl)
        }
        with library.quiet(f"{self.name}: the shader {entry}"):
            module = self._device.create_shader_module(code=wgsl)
            layouts = [
                self._layout(_of_group(names, group))
                for group in range(1 + max((group for group, *_ in names.values()), default=-1))
            ]
            handle = self._device.create_compute_pipeline(
                layout=self._device.create_pipeline_layout(bind_group_layouts=layouts),
                compute={"module": module, "entry_point": entry, "constants": constants},
            )
        return Pipeline(handle, layouts, names)

    def _layout(self, entries: tuple[tuple[int, str], ...]) -> Any:
        """Return the layout of a group of bindings. Pipelines with the same one can have the same groups."""
        if entries not in self._layouts:
            made = self._device.create_bind_group_layout(entries=[_entry(*each) for each in entries])
            self._layouts[entries] = made
        return self._layouts[entries]

    def bind(self, pipeline: Pipeline, buffers: Mapping[str, Buffer], made: dict[Any, Any] | None = None) -> Bound:
        """Return the pipeline with its buffers, by name. Other names are ignored. Raises DeviceError.

        made: the groups of earlier calls, which are used again for the same buffers, and kept alive.
        """
        made = {} if made is None else made
        uniform, dynamic = None, -1
        for name, (group, _, kind) in pipeline.names.items():
            if kind == "uniform":
                uniform, dynamic = buffers[name], group
        groups = []
        for group, layout in enumerate(pipeline.layouts):
            held = {binding: buffers[name] for name, (own, binding, _) in pipeline.names.items() if own == group}
            key = layout, *held.items()
            if key not in made:
                entries = [{"binding": number, "resource": _window(buffer)} for number, buffer in held.items()]
                with library.quiet(f"{self.name}: binding buffers"):
                    made[key] = self._device.create_bind_group(layout=layout, entries=entries)
            groups.append(made[key])
        return Bound(pipeline, groups, uniform, dynamic)

    def submit(self, work: Sequence[Dispatch]) -> None:
        """Start these dispatches, one after the other: each sees what the ones before it wrote. Raises DeviceError."""
        with library.quiet(f"{self.name}: submitting work"):
            encoder = self._device.create_command_encoder()
            running = encoder.begin_compute_pass()
            there: dict[int, tuple[Any, list[int]]] = {}
            for bound, groups, record in work:
                running.set_pipeline(bound.pipeline.handle)
                for group, handle in enumerate(bound.groups):
                    own = [record * bound.uniform.stride] if bound.uniform and group == bound.dynamic else []
                    if there.get(group) != (handle, own):  # a call takes longer than many a pass
                        running.set_bind_group(group, handle, own)
                        there[group] = handle, own
                running.dispatch_workgroups(*self._axes(groups))
            running.end()
            self._device.queue.submit([encoder.finish()])

    def finish(self) -> None:
        """Wait until all submitted work is done. Raises DeviceError."""
        self.read(self._little, np.uint8, 4)  # on_submitted_work_done_async() of wgpu 0.32.0 raises TypeError

    def wait_for(self, promise: Any) -> None:
        """Wait for a promise of wgpu, at most _PATIENCE seconds: wgpu's own wait has no limit. Raises DeviceError."""
        if self._closed:  # wgpu would wait forever
            raise DeviceError(f"{self.name}: the device is lost")
        raised: list[BaseException] = []

        def wait() -> None:
            try:
                promise.sync_wait()
            except BaseException as error:
                raised.append(error)

        waiting = threading.Thread(target=wait, daemon=True)
        waiting.start()
        waiting.join(_PATIENCE)
        if waiting.is_alive():
            raise DeviceError(f"{self.name}: the driver has not finished its work in {_PATIENCE:.0f} seconds")
        with library.quiet(f"{self.name}: waiting"):
            if raised:
                raise raised[0]

    def _axes(self, groups: int) -> tuple[int, int]:
        rows = -(-groups // self._axis)
        return -(-groups // rows) if rows else 0, rows

    def close(self) -> None:
        """Free the device with all its buffers."""
        self._closed = True
        self._device.destroy()


def _kind(space: str, access: str) -> str:
    if space == "uniform":
        return "uniform"
    return "storage" if access == "read_write" else "read-only-storage"


def _of_group(names: Mapping[str, tuple[int, int, str]], group: int) -> tuple[tuple[int, str], ...]:
    return tuple((binding, kind) for own, binding, kind in names.values() if own == group)


def _entry(binding: int, kind: str) -> dict[str, Any]:
    compute = library.load().ShaderStage.COMPUTE
    buffer = {"type": kind, "has_dynamic_offset": kind == "uniform"}
    return {"binding": binding, "visibility": compute, "buffer": buffer}


def _window(buffer: Buffer) -> dict[str, Any]:
    return {"buffer": buffer.handle, "offset": 0, "size": buffer.stride or buffer.size}
