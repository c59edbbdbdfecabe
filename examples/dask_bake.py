"""Every PlenOctree in scenes as an octree in baked, on Dask's workers: python dask_bake.py.

Dask keeps no record of what is done: scenes whose octree is there are left out here. What a worker raises comes back as
it is, so that one broken scene costs itself alone.
"""

from __future__ import annotations

import sys
from pathlib import Path

from distributed import Client, as_completed

from nerfbake import NerfbakeError
from nerfbake.jobs import bake_octree


def bake(source: str, target: str) -> str:
    """What came of one scene, in a line."""
    try:
        return f"{target}: {bake_octree(source, target)}"
    except NerfbakeError as error:
        return f"error: {error}"


def main() -> int:
    Path("baked").mkdir(exist_ok=True)
    scenes = {path: Path("baked") / f"{path.stem}.svo.pb" for path in sorted(Path("scenes").glob("*.npz"))}
    left = {str(source): str(target) for source, target in scenes.items() if not target.exists()}
    with Client(n_workers=2, threads_per_worker=1, dashboard_address=None) as client:
        lines = [future.result() for future in as_completed(client.map(bake, list(left), list(left.values())))]
    print(*sorted(lines), sep="\n")
    return int(any(line.startswith("error: ") for line in lines))


if __name__ == "__main__":
    sys.exit(main())
