"""Run the whole suite or selected benchmarks, and rewrite their files in benchmarks/results.

    python -m benchmarks                   all benchmarks: hours
    python -m benchmarks svo atlas         these two

The environment variable NERFBAKE_DATA sets the folder of the real scenes; the default is ../shared/data.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmarks.scenes import DATA, Scenes
from benchmarks.suite import RESULTS, SUITE, run
from nerfbake.errors import NerfbakeError


def main(names: Sequence[str]) -> int:
    """Run the benchmarks and return the exit code. Each benchmark writes all of its files when it ends, or none."""
    known = [benchmark.name for benchmark in SUITE]
    if unknown := [name for name in names if name not in known]:
        print(f"error: no benchmark is called {unknown[0]!r}; allowed: {', '.join(known)}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="nerfbake-bench-") as folder:
        scenes = Scenes(DATA, Path(folder))
        for benchmark in SUITE:
            if names and benchmark.name not in names:
                continue
            try:
                files = run(benchmark, scenes)
            except NerfbakeError as error:
                print(f"error: {benchmark.name}: {error}", file=sys.stderr)
                return 1
            for name, content in files.items():
                (RESULTS / name).write_bytes(content)
                print(f"benchmarks/results/{name}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
