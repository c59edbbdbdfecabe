"""Our .nvdb by NVIDIA's own header, in C and in HLSL: the same answers at the same points, PlenVDB's way to a phone."""

from __future__ import annotations

import shutil
import subprocess
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import IndexGrid, VdbTree, Volume
from nerfbake.formats.volume import nanovdb
from nerfbake.scene.vdb_topology import topology_of
from tests.support.places import COUNT, around, clouds
from tests.support.shaders import Hlsl, Points

OWN = files("nerfbake") / "shaders" / "pnanovdb"
C = """
#define PNANOVDB_CMATH
#include "nanovdb.h"
#include "nanovdb.h"
#include <stdio.h>
#include <stdlib.h>

static void* whole(const char* name, long* size) {
    FILE* file = fopen(name, "rb");
    fseek(file, 0, SEEK_END);
    *size = ftell(file);
    rewind(file);
    void* data = malloc(*size);
    if (fread(data, 1, *size, file) != (size_t)*size) exit(1);
    fclose(file);
    return data;
}

int main(int count, char** names) {
    long bytes, size;
    uint32_t* data = whole(names[1], &bytes);
    float* points = whole(names[2], &size);
    pnanovdb_buf_t buf = pnanovdb_make_buf(data, bytes / 4);
    nanovdb_grid_t grid = nanovdb_open(buf, atoi(names[4]));
    for (float* p = points; p < points + size / 4; p += 4) {
        float nearest = nanovdb_nearest(buf, grid, p[0], p[1], p[2], p[3]);
        p[1] = nanovdb_trilinear(buf, grid, p[0], p[1], p[2], p[3]);
        p[0] = nearest;
    }
    FILE* file = fopen(names[3], "wb");
    fwrite(points, 1, size, file);
    return fclose(file);
}
"""
# glslang knows no asuint() of a double, which PNanoVDB.h has and nothing calls.
HLSL = """
#define PNANOVDB_HLSL
#define NANOVDB_TYPE PNANOVDB_GRID_TYPE_NAME
void asuint(double value, out uint low, out uint high) { low = 0u; high = 0u; }
#include "nanovdb.h"
StructuredBuffer<uint> nvdb : register(t0);
StructuredBuffer<float4> points : register(t1);
RWStructuredBuffer<float4> result : register(u2);
float4 answer(float4 p) {
    nanovdb_grid_t grid = nanovdb_open(nvdb, CHANNELSu);
    float nearest = nanovdb_nearest(nvdb, grid, p.x, p.y, p.z, uint(p.w));
    return float4(nearest, nanovdb_trilinear(nvdb, grid, p.x, p.y, p.z, uint(p.w)), 0.0, 0.0);
}
"""


class Scene(NamedTuple):
    bytes: bytes  # of the grid, from its magic on
    channels: int
    points: Points
    nearest: npt.NDArray[np.float32]
    trilinear: npt.NDArray[np.float32]


def warps_header() -> Path:
    found = find_spec("warp")
    if found is None or found.origin is None:
        pytest.skip("no warp-lang, whose PNanoVDB.h knows index grids")
    return Path(found.origin).parent / "native"


def debians_header() -> Path:
    if not Path("/usr/include/nanovdb/PNanoVDB.h").is_file():
        pytest.skip("no PNanoVDB.h (Debian: libnanovdb-dev)")
    return Path("/usr/include")


HEADERS = {"Debian": debians_header, "Warp": warps_header}
KINDS = {"Float": ("Debian", "Warp"), "Fp16": ("Debian", "Warp"), "OnIndex": ("Warp",), "OnIndex, half": ("Warp",)}
CASES = [(kind, header) for kind, headers in KINDS.items() for header in headers]


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {kind: scene_of(kind) for kind in KINDS}


def scene_of(kind: str) -> Scene:
    topology, _ = topology_of(clouds())
    channels = 7 if "Index" in kind else 1
    table = np.random.default_rng(0).random((topology.m + 1, channels), np.float32)
    table[0] = 0
    if kind in ("Fp16", "OnIndex, half"):
        table = table.astype(np.float16)
    made: IndexGrid | VdbTree = IndexGrid("index", topology, table)
    if channels == 1:
        made = VdbTree("density", topology, table[1:], np.zeros(1, np.float32))
    head, *rest = nanovdb.encode(Volume((made,), np.eye(4)[:3]))
    (grid,) = nanovdb.decode(memoryview(b"".join([head, *rest]))).grids
    points = around(topology.coords, channels)
    at, k = points[:, :3].astype(np.float64), points[:, 3].astype(int)
    nearest, trilinear = (grid.sample(at, lookup=how)[np.arange(COUNT), k] for how in ("nearest", "trilinear"))
    return Scene(b"".join(rest), channels, points, nearest, trilinear)


def assert_same(kind: str, found: Points, scene: Scene) -> None:
    if kind == "Fp16":  # codes between the ends of a leaf: what they stand for is rounded as it is read
        np.testing.assert_allclose(found[:, 0], scene.nearest, atol=1e-6)
    else:
        assert np.flatnonzero(found[:, 0] != scene.nearest).tolist() == []
    np.testing.assert_allclose(found[:, 1], scene.trilinear, atol=1e-5)
    assert 0.1 < (scene.nearest == 0).mean() < 0.9


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The C program by each header, once it is made."""
    return {}


@pytest.mark.parametrize(("kind", "header"), CASES)
def test_nvidias_header_finds_the_same_in_c(
    kind: str, header: str, scenes: dict[str, Scene], programs: dict[str, Path], tmp_path: Path
) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc (Debian: gcc)")
    if header not in programs:
        (tmp_path / "read.c").write_text(C)
        include = [f"-I{HEADERS[header]() / 'nanovdb'}", f"-I{OWN}"]
        subprocess.run(["gcc", "-O1", *include, "read.c", "-o", "read", "-lm"], cwd=tmp_path, check=True)
        programs[header] = tmp_path / "read"
    scene = scenes[kind]
    (tmp_path / "grid").write_bytes(scene.bytes)
    (tmp_path / "points").write_bytes(scene.points.tobytes())
    subprocess.run([programs[header], "grid", "points", "out", str(scene.channels)], cwd=tmp_path, check=True)
    assert_same(kind, np.fromfile(tmp_path / "out", np.float32).reshape(-1, 4), scene)


@pytest.fixture(scope="module")
def hlsl(tmp_path_factory: pytest.TempPathFactory) -> Hlsl:
    return Hlsl(tmp_path_factory.mktemp("hlsl"))


@pytest.mark.parametrize(("kind", "header"), CASES)
def test_nvidias_header_finds_the_same_in_hlsl(
    kind: str, header: str, scenes: dict[str, Scene], hlsl: Hlsl, tmp_path: Path
) -> None:
    scene = scenes[kind]
    code = HLSL.replace("CHANNELS", str(scene.channels)).replace("NAME", kind.split(",")[0].upper()) + hlsl.main(COUNT)
    # glslang refuses a literal of 64 bits in a macro that nothing uses: C's preprocessor leaves none.
    (tmp_path / "code").write_text(code)
    command = ["gcc", "-E", "-P", "-x", "c", f"-I{HEADERS[header]() / 'nanovdb'}", f"-I{OWN}", "code"]
    plain = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    found = hlsl.wgpu.dispatch(*hlsl.compiled(plain), scene.points, {"nvdb": np.frombuffer(scene.bytes, np.uint32)})
    assert_same(kind, found, scene)
