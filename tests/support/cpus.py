"""Check that all CPUs write the same bytes: run every command on a small scene and hash its outputs.

    python -m tests.support.cpus write build/cpus/here.json
    python -m tests.support.cpus as old python -m tests.support.cpus write build/cpus/old.json
    python -m tests.support.cpus compare build/cpus/here.json build/cpus/old.json ...

`as` runs a command as on another CPU: Numba compiles for that CPU, with a separate cache, and NumPy, OpenBLAS and the C
library use the code paths of that CPU. `make test-cpus` runs all of these commands.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

COMMANDS = """
sample octree scene.npz --resolution 64 --basis SH16
sample nerf2mesh mesh --resolution 96
sample capture room --room --frames 2 --edge 64
svo scene.npz full.svo.pb
svo scene.npz mean.svo.npz --resolution 40x30x20 --layout compact
svo scene.npz half.svo.npz --resolution 32 --dtype float16
svo scene.npz nearest.svo.pb --resolution 32 --resample nearest --sigma-min 2
lod full.svo.pb level.svo.npz --level 4
convert mean.svo.npz mean.svo.json
convert mean.svo.npz mean.svo.bson
convert mean.svo.npz mean.svo.fb
convert mean.svo.npz mean.svo.capnp
convert mean.svo.npz mean.svo.pb.zst
vdb scene.npz colour.vdb
vdb scene.npz half.vdb --half --up y --sigma-min 1
vdb full.svo.pb sh.vdb --grids density,sh
vdb scene.npz density.nvdb --grids density --up y
vdb scene.npz index.nvdb --grids index
vdb scene.npz colour.vdb.npz
render scene.npz --out scene.png --size 120x100 --depth --alpha
render scene.npz --samples 3 --out fine.png --size 60x50 --depth
render full.svo.pb --lookup trilinear --out smooth.png --size 120x100
render full.svo.pb --lod 4 --turntable 3 --out turn.gif --size 60x50
render colour.vdb --out volume.png --size 120x100
render scene.npz --mesh mesh/mesh_0.obj --out both.png --size 120x100
splats scene.npz few.ply --count 2000 --frames 6 --edge 48 --epochs 2
render few.ply --out splats.png --size 120x100 --depth
svo few.ply few.svo.npz --resolution 32 --epochs 1
mesh scene.npz small.glb --frames 8 --edge 64 --triangles 500 --texture 128 --image png
mesh scene.npz small_stage1 --frames 8 --edge 64 --triangles 500 --texture 128
sample capture photographs --frames 16 --edge 48
fit photographs fitted.npz --resolution 32 --preset fast
hull fitted.npz hull.glb
compress fitted.npz fitted.svoq --max-loss 0.5
refit level.svo.npz better.svo.npz --like scene.npz --frames 6 --edge 48 --epochs 1
compare scene.npz mean.svo.npz --size 60x60 --sheet scenes.png
lattice scene.npz lattice --resolution 32 --rounds 40
lattice full.svo.pb merged --rounds 2 --merged
atlas mesh kmeans --clusters 24 --map-size 16
atlas mesh mean --clusters 24 --map-size 16 --centres mean
atlas mesh affine --method affine --clusters 12 --map-size 16
atlas mesh grid --method grid --nodes 4 --map-size 16
compare mesh affine --size 100x100 --sheet atlases.png
"""


# CPU features beyond baseline x86-64: none on the old CPU, no AVX-512 on Haswell. The names are those of Numba's LLVM,
# NumPy, OpenBLAS and the C library.
AVX512 = ("AVX512F", "AVX512VL", "AVX512BW", "AVX512DQ")
CPUS: dict[str, dict[str, Any]] = {
    "old": {"llvm": "generic", "blas": "Prescott", "keeps": (), "lacks": ("AVX2", "FMA", "FMA4", *AVX512)},
    "haswell": {"llvm": "haswell", "blas": "Haswell", "keeps": ("X86_V3", "AVX2", "FMA3"), "lacks": AVX512},
}


def run_as(cpu: str, *command: str) -> None:
    """Replace this process with the command, run as on the given CPU."""
    wanted = CPUS[cpu]
    # NumPy refuses to disable features that this machine does not have.
    dropped = [name for name in simd() if name not in wanted["keeps"]]
    simulated = {
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=" + ",".join(f"-{name}" for name in wanted["lacks"]),
        "NPY_DISABLE_CPU_FEATURES": ",".join(dropped),
        "NUMBA_CACHE_DIR": str(Path("build", "cpus", cpu).absolute()),  # the commands run in another folder
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CPU_NAME": wanted["llvm"],
        "OPENBLAS_CORETYPE": wanted["blas"],
    }
    os.execvpe(command[0], command, os.environ | simulated)


def write(target: Path) -> None:
    """Run all commands and write {name: hash} of their outputs and the CPU name to a JSON file."""
    from llvmlite.binding import get_host_cpu_name

    from nerfbake.cli.main import run

    with tempfile.TemporaryDirectory() as folder:
        before = Path.cwd()
        os.chdir(folder)
        try:
            for line in COMMANDS.split("\n"):
                if line and run([*shlex.split(line), "-q"]):
                    sys.exit(f"failed: {line}")
            made = sorted(path for path in Path().rglob("*") if path.is_file())
            found = {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in made}
        finally:
            os.chdir(before)
    cpu = os.environ.get("NUMBA_CPU_NAME") or get_host_cpu_name()
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(json.dumps({"cpu": cpu, "numpy": simd(), "files": found}, indent=1) + "\n")


def simd() -> list[str]:
    """The CPU features that NumPy uses beyond the baseline of its x86-64 wheels."""
    from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__  # type: ignore[import-not-found]

    return [name for name in __cpu_dispatch__ if __cpu_features__.get(name)]


def compare(*paths: Path) -> None:
    """Compare result files. Exits with code 1 if outputs differ. Prints a note if two files come from the same CPU."""
    first, *others = (json.loads(path.read_text()) for path in paths)
    for other in others:
        if (other["cpu"], other["numpy"]) == (first["cpu"], first["numpy"]):
            print(f"note: {first['cpu']} is compared with itself")
        names = sorted(first["files"].keys() | other["files"].keys())
        differ = [name for name in names if first["files"].get(name) != other["files"].get(name)]
        print(f"{first['cpu']} and {other['cpu']}: {len(names) - len(differ)} of {len(names)} files are the same")
        for name in differ:
            print(f"  {name} differs")
        if differ:
            sys.exit(1)


if __name__ == "__main__":
    if sys.argv[1] == "as":
        run_as(*sys.argv[2:])
    does: dict[str, Callable[..., None]] = {"write": write, "compare": compare}
    does[sys.argv[1]](*map(Path, sys.argv[2:]))
