"""The project's aims for the figures of its benchmarks. Both sides of a ratio are from the same run."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from typing import Any, NamedTuple

from nerfbake.bench.report import Table

OPERATORS = {"at most": operator.le, "below": operator.lt, "at least": operator.ge}


class Aim(NamedTuple):
    """A bound. word: one of OPERATORS, as in reports."""

    word: str
    bound: float

    def __str__(self) -> str:
        return f"{self.word} {self.bound:g}"

    def holds(self, figure: float) -> bool:
        return bool(OPERATORS[self.word](figure, self.bound))


# formats: ratios of times and sizes to those of `raw`, the bytes of both arrays
BULK_ENCODE = Aim("at most", 2)
BULK_DECODE = Aim("at most", 0.2)
PROTOBUF_SIZE = Aim("below", 1)
FASTER_THAN = {
    ("svo.json report", "json.dumps"): Aim("at least", 20),
    ("svo.fb report", "flatbuffers, by element"): Aim("at least", 50),
}

# access: ratio of a read on the surface to NanoVDB's
SURFACE_READ = Aim("at most", 0.6)

# vdb: ratio of nerfbake's time to that of OpenVDB's program
NANOVDB_BUILD_AND_WRITE = Aim("at most", 1)
OPENVDB_WRITE = Aim("at most", 1)

# fit, by preset or minutes: seconds on two cores, and PSNR in dB from the written file; MB of the process
FIT = {
    "fast": (Aim("at most", 40), Aim("at least", 34.8)),
    "1": (Aim("at most", 60), Aim("at least", 35.8)),
    "balanced": (Aim("at most", 100), Aim("at least", 36.1)),
    "best": (Aim("at most", 180), Aim("at least", 36.5)),
}
FIT_ONE_RAY = (Aim("at most", 100), Aim("at least", 35.0))  # "balanced" with one ray a pixel
FIT_MEMORY = Aim("below", 2000)
REFIT = Aim("at least", 1.0)  # gain in dB of an octree of 128^3

# papers: the chair at 800x800, by preset: seconds on two cores, PSNR in dB and MB of the file; MB of the process
PAPERS = {
    "fast": {"s": Aim("at most", 120), "PSNR dB": Aim("at least", 34.0), "MB": Aim("at most", 80)},
    "balanced": {"s": Aim("at most", 300), "PSNR dB": Aim("at least", 35.0), "MB": Aim("at most", 120)},
    "best": {"s": Aim("at most", 600), "PSNR dB": Aim("at least", 35.8), "MB": Aim("at most", 150)},
}
PAPERS_MEMORY = Aim("at most", 3000)

# captures, by row: seconds on two cores, and PSNR in dB of the written file on held-out views. The first version that
# fitted scenery had 25.9 dB on plush.
CAPTURES = {
    "plush 504x378, fast": (Aim("at most", 60), Aim("at least", 26.9)),
    "plush 504x378, balanced": (Aim("at most", 120), Aim("at least", 26.9)),
    "plush 504x378, best": (Aim("at most", 300), Aim("at least", 26.9)),
    "mug 432x432, masks, fast": (Aim("at most", 60), Aim("at least", 27)),
    "room 200x200, fast": (Aim("at most", 60), Aim("at least", 26)),
}
CAPTURE_MEMORY, CAPTURE_LEAVES = Aim("at most", 2000), Aim("at most", 3)  # of each fit: MB of the process, millions
POSES = {"s": Aim("at most", 90), "largest error, % of the capture": Aim("at most", 1)}
PHOTOGRAPHS_TO_PAGE = Aim("at most", 300)  # seconds on two cores

# mesh, by row: PSNR in dB on held-out photographs without and with highlights, MB of the .glb, CPU seconds
MESH = {
    "diffuse dB": Aim("at least", 30.5),
    "dB": Aim("at least", 33.0),
    "worst view dB": Aim("at least", 31),
    "MB of the .glb": Aim("at most", 1.2),
    "CPU s": Aim("at most", 90),
    "peak MB": Aim("at most", 2000),
}

# render: milliseconds a frame of 400x400, and seconds of a process that renders one picture
FRAME = {"chair_sh9.npz": Aim("at most", 80), "chair_sh9_128.npz": Aim("at most", 60)}
FIRST_PICTURE = Aim("below", 1.5)

# compress: the real chair at a predicted loss of 0.1 dB
COMPRESS = {
    "range: MB": Aim("at most", 1.9),
    "deflate: MB": Aim("at most", 2.3),
    "measured dB": Aim("at most", 0.1),
    "encode s": Aim("at most", 20),
    "decode s": Aim("at most", 1),
    "encoding's peak, x the octree": Aim("at most", 4),
}

# compress: how much of a promised loss is measured, on the scene with most of it
COMPRESS_PROMISES = Aim("at most", 1)

# view: pages of the real chair at 256^3. Frame times are ratios to those of an octree that is traversed from its root;
# those of the MLP, with its weights in textures, are ratios to those of the kmeans atlas
VIEW = {
    "compressed: MB": Aim("at most", 2.9),
    "exact: MB": Aim("at most", 36),
    "baking, compressed: s more than `compress`": Aim("at most", 3),
    "baking, exact: s more than `svo`": Aim("at most", 3),
    "first picture, compressed, SwiftShader: s": Aim("below", 5),
    "decoding in the script: x Python's": Aim("at most", 3),
    "frames, SwiftShader: x octree": Aim("at most", 0.7),
    "frames, llvmpipe: x octree": Aim("at most", 0.7),
    "frames of the MLP, SwiftShader: x atlas": Aim("at least", 4),
    "frames of the MLP, llvmpipe: x atlas": Aim("at least", 4),
}

# inputs: whole commands on two cores, including their reports
INPUTS = {
    ("ckpt.npz", "s"): Aim("at most", 30),
    ("fine_last.tar", "s"): Aim("at most", 120),
    ("fine_last.tar", "peak MB"): Aim("below", 2000),
}
# inputs: the chair as 64^3 nodes of Plenoxels: PSNR in dB of its voxels, by voxels an axis for each node
FINER = {2: Aim("at least", 42), 3: Aim("at least", 48)}

# splats: CPU seconds to read biker.spz, and to draw it; by voxels along the longest edge, CPU seconds with the pictures
# that they are fitted to, and PSNR in dB on ten others
SPLAT_READ, SPLAT_PICTURE = Aim("at most", 0.2), Aim("at most", 0.25)
SPLAT_OCTREES = {
    256: (Aim("at most", 40), Aim("at least", 35.5)),
    512: (Aim("at most", 70), Aim("at least", 37.5)),
}
# splats: .spz of at most 150,000 splats of the real chair, by what they are fitted to
SPLAT_FILES = {
    "pictures of the field": {"s": Aim("at most", 150), "PSNR dB": Aim("at least", 34.2)},
    "photographs": {"MB": Aim("at most", 5), "PSNR dB": Aim("at least", 35.1)},
}


def aims_table(rows: Iterable[tuple[str, Aim, float | None]]) -> Table:
    """Return the table of aims and figures; rows: (label, aim, figure or None if nothing was measured)."""
    cells: list[list[Any]] = [
        [what, str(aim), figure, figure is not None and aim.holds(figure)] for what, aim, figure in rows
    ]
    return Table("Aims", ["aim", "allowed", "measured", "holds"], cells)
