"""Published figures of NeRF-Synthetic at 800x800: 100 training views, all 200 test views, white background.

The sources have no common hardware and no common way to measure time and memory, so each method states its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from nerfbake.bench.report import Table

SCENES = ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship")
TABLE_2 = "PlenVDB, table 2"
NERFBASELINES = "NerfBaselines"

ByScene = Mapping[str, str]
_UNKNOWN: ByScene = MappingProxyType({})


class PublishedMethod(NamedTuple):
    """The figures of a method by scene, as they were printed; a scene without a figure is missing.

    source    where the figures were published, see docs/sources.md
    hardware  what it was trained on
    psnr      mean over the test views, in dB
    training  min:s
    size      MB of the trained model
    frames    frames a second
    """

    name: str
    source: str
    hardware: str
    psnr: ByScene
    training: ByScene = _UNKNOWN
    size: ByScene = _UNKNOWN
    frames: ByScene = _UNKNOWN

    def decibels(self, scene: str) -> float | None:
        """PSNR in dB; None if it is not known."""
        return float(self.psnr[scene]) if scene in self.psnr else None

    def minutes(self, scene: str) -> float | None:
        """Minutes of training; None if they are not known."""
        if scene not in self.training:
            return None
        minutes, _, seconds = self.training[scene].partition(":")
        return int(minutes) + int(seconds) / 60

    def megabytes(self, scene: str) -> float | None:
        """MB of the trained model; None if they are not known."""
        return float(self.size[scene]) if scene in self.size else None


def _all(figures: str) -> ByScene:
    return dict(zip(SCENES, figures.split(), strict=True))


PUBLISHED = (
    PublishedMethod(
        "PlenOctrees",
        TABLE_2,
        "V100",
        psnr=_all("32.46 24.67 29.91 31.21 35.78 29.06 32.61 28.92"),
        size=_all("147 290 240 347 417 318 138 983"),
    ),
    PublishedMethod(
        "Plenoxels",
        TABLE_2,
        "V100",
        psnr=_all("33.97 25.35 31.83 36.43 34.09 29.14 33.27 29.61"),
        training=_all("10:35 10:20 9:37 12:40 12:01 11:07 9:20 17:50"),
        size=_all("703 677 622 813 814 712 595 1331"),
    ),
    PublishedMethod(
        "DVGO",
        TABLE_2,
        "V100",
        psnr=_all("34.06 25.40 32.59 36.77 34.65 29.58 33.18 29.04"),
        training=_all("4:03 4:07 4:03 4:47 4:31 5:05 3:43 6:04"),
        size=_all("206 206 206 206 206 207 205 205"),
        frames=_all("5 4 5 4 4 4 5 3"),
    ),
    PublishedMethod(
        "PlenVDB",
        TABLE_2,
        "V100",
        psnr=_all("34.07 25.40 32.56 36.77 34.66 29.58 33.16 29.02"),
        training=_all("11:37 11:22 11:29 14:05 12:33 13:19 9:16 15:50"),
        size=_all("23 14 17 41 31 34 8 29"),
        frames=_all("30 20 25 14 18 11 42 6"),
    ),
    PublishedMethod(
        "instant-ngp",
        NERFBASELINES,
        "one GPU",
        psnr=_all("35.07 24.57 30.29 37.02 35.65 28.96 35.41 30.61"),
        training=_all("2:49 2:06 1:58 2:33 2:41 2:11 2:25 2:24"),
    ),
    PublishedMethod(
        "TensoRF",
        NERFBASELINES,
        "one GPU",
        psnr=_all("35.72 26.01 34.06 37.49 36.49 30.08 34.85 30.69"),
        training=_all("8:56 8:56 10:45 11:18 10:01 14:55 8:08 13:19"),
    ),
    PublishedMethod(
        "3DGS",
        NERFBASELINES,
        "one GPU",
        psnr=_all("35.84 26.15 34.79 37.64 35.70 30.01 35.49 30.85"),
        training=_all("5:45 6:03 5:22 5:49 5:59 5:28 6:11 8:13"),
    ),
    PublishedMethod("3DGS-MCMC", NERFBASELINES, "one GPU", psnr={"chair": "36.32", "lego": "35.75"}),
)


def plenvdb_table() -> Table:
    """Return PlenVDB's table 2 as it was printed, with a row for each figure of each method."""
    methods = [method for method in PUBLISHED if method.source == TABLE_2]
    rows: list[list[str | int]] = []
    for what, figures in (
        ("training min:s", "training"),
        ("frames a second", "frames"),
        ("MB", "size"),
        ("PSNR dB", "psnr"),
    ):
        for method in methods:
            if by_scene := getattr(method, figures):
                rows.append([f"{what}, {method.name}", *_cells([by_scene[scene] for scene in SCENES])])
    return Table("PlenVDB, table 2, as context: on a V100, pictures of 800x800", ["", *SCENES], rows)


def _cells(figures: Sequence[str]) -> list[str | int]:
    return [int(figure) if figure.isdecimal() else figure for figure in figures]
