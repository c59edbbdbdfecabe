"""What is published of training such fields, beside which our own figures stand: PlenVDB's tables 2 and 4.

The paper's title: docs/sources.md. Its machine: one V100, pictures of 800x800, the eight scenes of NeRF-Synthetic.
"""

from __future__ import annotations

from nerfbake.bench.report import Table

_SCENES = ["chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"]
PAPER = Table(
    "PlenVDB, table 2, as context: on a V100, pictures of 800x800",
    ["", *_SCENES],
    [
        ["training min:s, Plenoxels", "10:35", "10:20", "9:37", "12:40", "12:01", "11:07", "9:20", "17:50"],
        ["training min:s, DVGO", "4:03", "4:07", "4:03", "4:47", "4:31", "5:05", "3:43", "6:04"],
        ["training min:s, PlenVDB", "11:37", "11:22", "11:29", "14:05", "12:33", "13:19", "9:16", "15:50"],
        ["frames a second, DVGO", 5, 4, 5, 4, 4, 4, 5, 3],
        ["frames a second, PlenVDB", 30, 20, 25, 14, 18, 11, 42, 6],
        ["MB, PlenOctrees", 147, 290, 240, 347, 417, 318, 138, 983],
        ["MB, Plenoxels", 703, 677, 622, 813, 814, 712, 595, 1331],
        ["MB, DVGO", 206, 206, 206, 206, 206, 207, 205, 205],
        ["MB, PlenVDB", 23, 14, 17, 41, 31, 34, 8, 29],
        ["PSNR dB, PlenOctrees", "32.46", "24.67", "29.91", "31.21", "35.78", "29.06", "32.61", "28.92"],
        ["PSNR dB, Plenoxels", "33.97", "25.35", "31.83", "36.43", "34.09", "29.14", "33.27", "29.61"],
        ["PSNR dB, DVGO", "34.06", "25.40", "32.59", "36.77", "34.65", "29.58", "33.18", "29.04"],
        ["PSNR dB, PlenVDB", "34.07", "25.40", "32.56", "36.77", "34.66", "29.58", "33.16", "29.02"],
    ],
)
MERGING = Table(
    "PlenVDB, table 4, as context: chair at 160^3, on a V100",
    ["structure", "MB", "frames a second"],
    [
        ["as DVGO", None, 3],
        ["two VDBs, valid samples only", 108, 22],
        ["merged", 39, 30],
        ["merged, float16", 19, None],
    ],
)
