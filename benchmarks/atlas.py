"""`nerfbake bench atlas` on nerf2mesh's real texture, and what the command takes as a whole, cold and warm.

    python benchmarks/atlas.py          rewrites benchmarks/results/atlas.md and atlas.png

Cold: the first run after installing, which compiles the kernels; warm: every later one. Needs the real texture beside
the project.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
DATA = Path(os.environ.get("NERFBAKE_DATA", HERE.parents[1] / "shared" / "data"))
STAGE1 = DATA / "nerf2mesh" / "mesh_stage1"
RESULT = HERE / "results" / "atlas.md"
NERFBAKE = [sys.executable, "-m", "nerfbake"]


def whole(clusters: int, cache: str) -> float:
    """Seconds of `nerfbake atlas` as a process, errors measured and all files written."""
    with tempfile.TemporaryDirectory() as target:
        command = [*NERFBAKE, "atlas", str(STAGE1), f"{target}/out", "--clusters", str(clusters), "-q"]
        start = time.perf_counter()
        subprocess.run(command, check=True, env={**os.environ, "NUMBA_CACHE_DIR": cache})
        return time.perf_counter() - start


def main() -> None:
    bench = [*NERFBAKE, "bench", "atlas", str(STAGE1), "--plot", str(RESULT.with_suffix(".png")), "--force"]
    text = subprocess.run(bench, check=True, capture_output=True, text=True).stdout
    with tempfile.TemporaryDirectory() as cache:
        cold = whole(64, cache)
        warm = [(K, [whole(K, cache) for _ in range(3)]) for K in (64, 256, 2048)]
    lines = [f"| 64, cold | {cold:.1f} |"]
    lines += [f"| {K}, warm | {sorted(times)[1]:.1f} [{min(times):.1f}..{max(times):.1f}] |" for K, times in warm]
    table = "\n".join(["| clusters | s, median [min..max] |", "| --- | --- |", *lines])
    RESULT.write_text(f"{text}\n**`nerfbake atlas` as a whole: import, read, bake, measure, write**\n\n{table}\n")


if __name__ == "__main__":
    main()
