"""File size and image quality of each output: the chair in every structure that nerfbake writes, read from the files.

Five held-out views at 400x400. PSNR against pictures of the PlenOctree measures the loss of the conversion; PSNR
against the photographs measures the effect of this loss.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.processes import announced
from benchmarks.scenes import Scenes
from nerfbake import Cameras, Image, N3Tree, build_field, compare_scenes, load
from nerfbake.bench.environment import environment
from nerfbake.bench.report import Report, Table

# Each file, the command that creates it from the files above, and the information that is lost.
OUTPUTS = (
    ("full.svo.pb", "svo chair_sh9.npz full.svo.pb", "nothing"),
    ("full.svo.npz", "svo chair_sh9.npz full.svo.npz", "nothing"),
    ("compact.svo.npz", "svo chair_sh9.npz compact.svo.npz --layout compact", "nothing"),
    ("half.svo.npz", "svo chair_sh9.npz half.svo.npz --layout compact --dtype float16", "nothing: the tree is float16"),
    ("half.svo.npz.zst", "convert half.svo.npz half.svo.npz.zst", "nothing: the tree is float16"),
    ("128.svo.npz", "svo chair_sh9.npz 128.svo.npz --resolution 128 --layout compact", "voxels twice as wide"),
    (
        "nearest.svo.npz",
        "svo chair_sh9.npz nearest.svo.npz --resolution 128 --layout compact --resample nearest",
        "seven of eight voxels",
    ),
    ("level7.svo.npz", "lod compact.svo.npz level7.svo.npz --level 7", "the last level"),
    ("level6.svo.npz", "lod compact.svo.npz level6.svo.npz --level 6", "two levels"),
    ("level5.svo.npz", "lod compact.svo.npz level5.svo.npz --level 5", "three levels"),
    ("index.nvdb", "vdb chair_sh9.npz index.nvdb --grids index", "nothing"),
    ("index_half.nvdb", "vdb chair_sh9.npz index_half.nvdb --grids index --half", "nothing: the tree is float16"),
    ("sh.vdb", "vdb chair_sh9.npz sh.vdb --grids density,sh --half", "nothing: the tree is float16"),
    ("colour.vdb", "vdb chair_sh9.npz colour.vdb", "colour's dependence on the view"),
    ("colour_half.vdb", "vdb chair_sh9.npz colour_half.vdb --half", "that, and digits"),
    ("thin.svo.npz", "svo chair_sh9.npz thin.svo.npz --layout compact --dtype float16 --sigma-min 1", "thin fog"),
    (
        "quantised.svo.npz",
        "svo chair_sh9_128_quant.npz quantised.svo.npz --layout compact",
        "its source: 128^3, quantised",
    ),
)
COLUMNS = ["nerfbake ...", "MB", "PSNR to the tree", "PSNR to the photographs", "change dB", "what is lost"]
NOTES = [
    "PSNR in dB, mean over the views, from the written file; 100 stands for equal pictures.",
    "change: difference between the PSNR to the photographs and that of the tree.",
]


def reports(scenes: Scenes, *, rounds: int = 1) -> dict[str, list[Report]]:
    """Measure bytes and pictures in a single round, since there are no times."""
    if rounds != 1:
        raise ValueError("pictures and bytes are the same in every round")
    with tempfile.TemporaryDirectory() as folder:
        table = Table("Outputs", COLUMNS, _rows(scenes, Path(folder)))
    chair = scenes.chair
    head = {"scene": f"{chair.name}, {chair.stat().st_size / 1e6:.1f} MB, five views of 400x400"}
    return {"outputs": [Report("What each output costs", {**head, **environment("numpy", "numba")}, [table], NOTES)]}


def _rows(scenes: Scenes, folder: Path) -> list[list[Any]]:
    cameras = load(scenes.views / "transforms.json", Cameras)
    truth = [load(scenes.views / f"{camera.name}.png", Image) for camera in cameras.cameras]
    field = build_field(load(scenes.chair, N3Tree))
    found: list[list[Any]] = []
    for name, command, lost in OUTPUTS:
        words = [str(scenes.chairs / word) if word.startswith("chair") else word for word in shlex.split(command)]
        with announced(f"nerfbake {command}"):
            subprocess.run([sys.executable, "-m", "nerfbake", *words, "-q"], cwd=folder, check=True)
            means = compare_scenes(field, load(folder / name), cameras, truth=truth, keep_pictures=False).means
        size = (folder / name).stat().st_size
        against = means["b_truth"]["psnr"]
        decibels = [means["a_b"]["psnr"], against, against - means["a_truth"]["psnr"]]
        found.append([f"`{command}`", size / 1e6, *(f"{value:.2f}" for value in decibels), lost])
    return found
