#!/usr/bin/env bash
# wgpu-py 0.32.0: the queue's promise that submitted work is done cannot be had, on any adapter.
#
# WebGPU's queue.onSubmittedWorkDone() is the way to wait for a card without reading anything back. wgpu-py offers it as
# on_submitted_work_done_async(), but declares its callback without the message that wgpu-native's header has: each call
# raises a TypeError before anything is waited for. So a time limit for a submit needs a buffer that is mapped and read.
# nerfbake reads a buffer after each submit, which it needs anyway.
# Needs a Vulkan adapter; Mesa's lavapipe (Debian: mesa-vulkan-drivers) is one.
#
# Seen on 2026-11-28:
#   TypeError: initializer for ctype 'void(*)(WGPUQueueWorkDoneStatus, WGPUStringView, void *, void *)' must be a pointer
#   to same type, not cdata 'void(*)(WGPUQueueWorkDoneStatus, void *, void *)'
#   a buffer of the same queue: [1, 2, 3]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check wgpu==0.32.0
export XDG_RUNTIME_DIR=$folder
venv/bin/python - <<'PYTHON'
import wgpu

device = wgpu.gpu.enumerate_adapters_sync()[0].request_device_sync()
buffer = device.create_buffer_with_data(data=bytes((1, 2, 3, 0)), usage=wgpu.BufferUsage.COPY_SRC)
try:
    device.queue.on_submitted_work_done_async()
    raise SystemExit("the promise is there: nothing was raised")
except TypeError as error:
    print(f"TypeError: {error}")
    assert "WGPUStringView" in str(error)
read = list(device.queue.read_buffer(buffer))[:3]
print("a buffer of the same queue:", read)
assert read == [1, 2, 3]
PYTHON
