"""Compiles every kernel into numba's cache, two processes side by side: `python -m tests.support.warm`.

A test process that finds a kernel in no cache compiles it, and two that need it at the same time both do. Run before
the tests, this compiles each one once. Where all are in the cache it only loads them.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile

from tests.conftest import REPOSITORY

# Together they reach every kernel, none of those that take long from both sides.
COMMANDS = {
    "views": """
sample octree scene.npz --resolution 8
sample nerf2mesh mesh --resolution 16
render scene.npz --out nearest.png --size 8x8
render scene.npz --out smooth.png --size 8x8 --lookup trilinear
render scene.npz --out turn.gif --size 8x8 --turntable 2
render scene.npz --out both.png --size 8x8 --mesh mesh/mesh_0.obj
""",
    "atlases": """
sample nerf2mesh mesh --resolution 16
atlas mesh snapped --clusters 4 --map-size 4
atlas mesh means --clusters 4 --map-size 4 --centres mean
atlas mesh affine --clusters 4 --map-size 4 --method affine
atlas mesh grid --nodes 2 --map-size 4 --method grid
compare mesh affine --size 8x8
""",
}


def compile_by(name: str) -> None:
    """Runs the commands of one list in a folder that is gone afterwards."""
    from nerfbake.cli.main import run

    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for line in COMMANDS[name].strip().split("\n"):
            if run([*shlex.split(line), "-q"]):
                sys.exit(f"failed: {line}")
        os.chdir(REPOSITORY)


def main() -> None:
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-m", "tests.support.warm"]
    at_work = [subprocess.Popen([*command, name], env=environment, stdout=subprocess.DEVNULL) for name in COMMANDS]
    sys.exit(max([process.wait() for process in at_work]))


if __name__ == "__main__":
    if len(sys.argv) > 1:
        compile_by(sys.argv[1])
    else:
        main()
