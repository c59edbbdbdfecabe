#!/usr/bin/env bash
# wgpu-py 0.32.0 on Mesa's lavapipe 22.3.6: a workgroup's variables do not begin at 0.
#
# WGSL defines that every variable of the workgroup address space is 0 when a workgroup starts, and shaders that count
# in one rely on it. Here they often begin with what a thread left there: after a shader that wrote 7 everywhere,
# another one reads 7 from an array that it never wrote. So it is with atomic counters. Whether it happens depends on
# the thread that runs a workgroup. Writing the variables first, and a barrier, help.
# Needs lavapipe (Debian 12: mesa-vulkan-drivers).
#
# Seen on 2026-11-28 (what was read, and how many of 16,384 values are not 0):
#   Mesa 22.3.6 (LLVM 15.0.6)
#   plain [7] 16384
#   atomic [7] 16384
#
# nerfbake's shaders write such variables before they read them.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6 wgpu==0.32.0
export XDG_RUNTIME_DIR=$folder
venv/bin/python - <<'PYTHON'
import numpy as np
import wgpu

adapter = next(each for each in wgpu.gpu.enumerate_adapters_sync() if "llvmpipe" in each.info["device"])
print(adapter.info["description"])
device = adapter.request_device_sync()
GROUPS = 64  # each may run on a thread of its own, with memory of its own
HEAD = """
var<workgroup> held: array<KIND, 256>;
@group(0) @binding(0) var<storage, read_write> out: array<u32>;
@compute @workgroup_size(256) fn main(
    @builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3u) {
    let place = 256u * group.x + lane;
"""
WRITES = HEAD.replace("KIND", "u32") + "held[lane] = 7u; workgroupBarrier(); out[place] = held[255u - lane]; }"
READS = {
    "plain": HEAD.replace("KIND", "u32") + "out[place] = held[lane]; }",
    "atomic": HEAD.replace("KIND", "atomic<u32>") + "out[place] = atomicLoad(&held[lane]); }",
}


def run(code):
    module = device.create_shader_module(code=code)
    pipeline = device.create_compute_pipeline(layout="auto", compute={"module": module, "entry_point": "main"})
    out = device.create_buffer(size=1024 * GROUPS, usage=wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.COPY_SRC)
    entry = {"binding": 0, "resource": {"buffer": out, "offset": 0, "size": 1024 * GROUPS}}
    group = device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=[entry])
    encoder = device.create_command_encoder()
    work = encoder.begin_compute_pass()
    work.set_pipeline(pipeline)
    work.set_bind_group(0, group)
    work.dispatch_workgroups(GROUPS)
    work.end()
    device.queue.submit([encoder.finish()])
    return np.frombuffer(device.queue.read_buffer(out), np.uint32)


for name, code in READS.items():
    for _ in range(200):  # until a thread meets memory that it wrote
        run(WRITES)
        found = run(code)
        if found.any():
            break
    print(name, np.unique(found), np.count_nonzero(found))
    assert found.any(), "workgroup memory begins at 0 now"
PYTHON
