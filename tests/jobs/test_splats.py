"""Splats of a file: Ctrl-C keeps what there is, and a missed limit is reported."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from nerfbake import Splats, load
from nerfbake.errors import BudgetMissed, MemoryLimit, Stopped, UsageError
from nerfbake.jobs import SplatsOptions, SplatsResult, SplatsViews, bake_splats
from nerfbake.stages import views_to_splats
from tests.jobs.listener import Listener

PICTURES, OPTIONS = SplatsViews(frames=4, edge=32), SplatsOptions(splats=200, epochs=2)


def test_ctrl_c_writes_the_current_splats(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = views_to_splats.fit_splats
    seen: list[float] = []

    def interrupted(*args: Any, **options: Any) -> Iterator[Any]:
        for state in whole(*args, **options):
            if len(seen) == 2:
                os.kill(os.getpid(), signal.SIGINT)
            seen.append(state.error)
            yield state

    monkeypatch.setattr(views_to_splats, "fit_splats", interrupted)
    with pytest.raises(Stopped, match=r"a\.ply\.partial has the current state"):
        bake_splats("a.npz", "a.ply", PICTURES, options=OPTIONS)
    assert len(seen) == 3
    assert load("a.ply.partial", Splats).n > 10
    assert not (folder / "a.ply").exists()


@pytest.mark.usefixtures("folder")
def test_splats_that_cannot_be_measured_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise MemoryLimit("the pictures", 2, 1)

    monkeypatch.setattr("nerfbake.jobs.splats.measure_views", fail)
    with pytest.raises(MemoryLimit, match=r"^a\.ply: the pictures"):
        bake_splats("a.npz", "a.ply", PICTURES, options=OPTIONS)
    assert not Path("a.ply").exists()
    assert load("a.ply.partial", Splats).n > 10


def test_a_missed_limit_is_reported_and_nothing_takes_the_name(folder: Path, listener: Listener) -> None:
    found: list[SplatsResult] = []
    missed = r"a\.spz: the splats have a mean PSNR of .* dB on 8 pictures with alpha; allowed: `min_psnr=99`"
    with pytest.raises(BudgetMissed, match=missed):
        bake_splats("a.npz", "a.spz", PICTURES, options=OPTIONS, min_psnr=99, steps=listener, report=found.append)
    assert found[0].psnr < 99
    assert (folder / "a.spz.rejected").exists()
    with pytest.raises(UsageError, match="has no file extension for Gaussian splats"):
        bake_splats("a.npz", "a.npz", PICTURES)
