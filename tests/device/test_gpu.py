"""A device computes what a shader says, on all its numbers, and fails in one line."""

from __future__ import annotations

import numpy as np
import pytest

from nerfbake.device.gpu import Dispatch, Gpu
from nerfbake.errors import DeviceError
from tests.support.device import opened

TIMES = """
struct View { shift: u32 }
override FACTOR: u32 = 1u;
@group(0) @binding(0) var<storage, read> numbers: array<u32>;
@group(0) @binding(1) var<storage, read_write> out: array<u32>;
@group(1) @binding(0) var<uniform> view: View;
@compute @workgroup_size(1) fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) count: vec3u) {
    let i = group.x + group.y * count.x;
    if i < arrayLength(&out) { out[i] = numbers[i] * FACTOR + view.shift; }
}"""


@pytest.mark.parametrize("count", [1, 65_535, 65_536, 70_001])
def test_every_workgroup_runs_with_its_record_and_its_constant(gpu: Gpu, count: int) -> None:
    numbers = np.random.default_rng(0).integers(0, 1 << 20, count, dtype=np.uint32)
    out = gpu.empty(4 * count)
    records = gpu.upload_records(np.array([[5], [7]], np.uint32))
    pipeline = gpu.pipeline(TIMES, "main", {"FACTOR": 3})
    bound = gpu.bind(pipeline, {"numbers": gpu.upload(numbers), "out": out, "view": records})
    gpu.submit([Dispatch(bound, count, record=1)])
    np.testing.assert_array_equal(gpu.read(out, np.uint32, count), 3 * numbers + 7)


def test_a_dispatch_sees_what_the_one_before_it_wrote(gpu: Gpu) -> None:
    a, b = gpu.upload(np.arange(8, dtype=np.uint32)), gpu.empty(32)
    records, pipeline = gpu.upload_records(np.array([[1]], np.uint32)), gpu.pipeline(TIMES, "main", {"FACTOR": 2})
    forth = gpu.bind(pipeline, {"numbers": a, "out": b, "view": records})
    back = gpu.bind(pipeline, {"numbers": b, "out": a, "view": records})
    gpu.submit([Dispatch(forth, 8), Dispatch(back, 8), Dispatch(forth, 8)])
    np.testing.assert_array_equal(gpu.read(b, np.uint32, 8), 8 * np.arange(8) + 7)


def test_a_part_of_a_buffer_is_written_and_read(gpu: Gpu) -> None:
    buffer = gpu.upload(np.arange(10, dtype=np.float32))
    gpu.write(buffer, np.array([40, 50], np.float32), offset=16)
    np.testing.assert_array_equal(gpu.read(buffer, np.float32, 4, offset=12), [3, 40, 50, 6])


def test_what_was_copied_for_reading_does_not_change(gpu: Gpu) -> None:
    buffer = gpu.upload(np.arange(4, dtype=np.float32))
    first = gpu.read_later(buffer, np.float32, 4)
    gpu.write(buffer, np.zeros(4, np.float32))
    second = gpu.read_later(buffer, np.float32, 4)
    np.testing.assert_array_equal(second.take(), np.zeros(4))
    np.testing.assert_array_equal(first.take(), np.arange(4))


def test_a_new_buffer_is_zero(gpu: Gpu) -> None:
    assert not gpu.read(gpu.empty(4096), np.uint8, 4096).any()


def test_a_shader_that_does_not_compile_is_one_line(gpu: Gpu) -> None:
    for text, entry in (("fn main( {", "main"), (TIMES, "none")):
        with pytest.raises(DeviceError, match=f"the shader {entry}: ") as raised:
            gpu.pipeline(text, entry)
        assert "\n" not in str(raised.value)


def test_a_buffer_above_the_limit_is_refused_before_it_is_made(gpu: Gpu) -> None:
    with pytest.raises(DeviceError, match=r"the values needs a buffer of 1\.0 TiB; allowed: .* on "):
        gpu.empty(1 << 40, "the values")


def test_a_lost_device_is_one_line_in_every_call(capfd: pytest.CaptureFixture[str]) -> None:
    gpu = opened()
    buffer = gpu.empty(16)
    bound = gpu.bind(
        gpu.pipeline("@group(0) @binding(0) var<storage, read_write> out: array<u32>;" + EMPTY, "main"), {"out": buffer}
    )
    waiting = gpu.read_later(buffer, np.uint32, 4)
    gpu.close()
    for call in (
        waiting.take,
        lambda: gpu.empty(16),
        lambda: gpu.write(buffer, np.zeros(4, np.uint32)),
        lambda: gpu.read(buffer, np.uint32, 4),
        lambda: gpu.pipeline(EMPTY, "main"),
        lambda: gpu.submit([Dispatch(bound, 1)]),
        gpu.finish,
    ):
        with pytest.raises(DeviceError, match="lost"):
            call()
    assert capfd.readouterr() == ("", "")


EMPTY = "@compute @workgroup_size(1) fn main() {}"


def test_a_driver_that_hangs_is_not_waited_for(gpu: Gpu, monkeypatch: pytest.MonkeyPatch) -> None:
    class Never:
        def sync_wait(self) -> None:
            from threading import Event

            Event().wait()

    monkeypatch.setattr("nerfbake.device.gpu._PATIENCE", 0.01)
    with pytest.raises(DeviceError, match="has not finished its work"):
        gpu.wait_for(Never())
