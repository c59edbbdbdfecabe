"""The receipt: a row says whether its file is there and was judged, and nothing more."""

from __future__ import annotations

import numpy as np

from nerfbake import Image
from nerfbake.scene.shipment import Judgement, ReadingProgram, SharedStep, Shipment, ShippedFile

READERS = (ReadingProgram("a", "1", "all", "ran"), ReadingProgram("b", "", "", "not run"))
EMPTY = ShippedFile("x.ply", ("web",), "splats", READERS, 0, 0.0, 0.0, None, "no memory")


def picture(grey: float) -> Image:
    whole = np.ones((4, 6), np.float32)
    return Image(np.full((4, 6, 3), grey, np.float32), whole, whole)


JUDGED = Judgement(31.5, 0.25, "front", 30.5, "read back by hand", (picture(0.2), picture(0.4), picture(0.9)))
THERE = EMPTY._replace(bytes=1_230_000, seconds=1.5, cpu_seconds=2.5, reason="")
ALL = Shipment(
    "a.npz",
    "a tree",
    ("web",),
    (EMPTY, THERE._replace(reason="no library"), THERE._replace(judged=JUDGED)),
    (SharedStep("splats", 3.5, 4.5),),
    "8 views",
)


def test_a_row_has_no_figures_that_were_not_measured() -> None:
    failed, unjudged, judged = ALL.facts["files"]
    assert (failed["status"], unjudged["status"], judged["status"]) == ("failed", "not judged", "judged")
    assert [failed[key] for key in ("bytes", "seconds", "cpu_seconds", "psnr", "worst", "judged_by")] == [None] * 6
    assert [unjudged[key] for key in ("psnr", "max_error", "worst", "judged_by")] == [None] * 4
    assert (unjudged["bytes"], unjudged["reason"], judged["reason"]) == (1_230_000, "no library", None)
    assert judged["worst"] == {"view": "front", "psnr": 30.5}
    assert judged["readers"][1] == {"program": "b", "version": None, "reads": None, "known": "not run"}
    assert ALL.failed == (EMPTY,)
    assert str(ALL) == "3 files of a.npz for web"
