"""Splats of a file: Ctrl-C keeps what there is, and a missed limit is reported."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from nerfbake import SplatLevels, Splats, load, merge_splats, save
from nerfbake.errors import BudgetMissed, MemoryLimit, Stopped, UsageError
from nerfbake.jobs import SplatsOptions, SplatsResult, SplatsViews, bake_splats, convert_file
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
    def fail(*arguments: Any, **options: Any) -> None:
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


@pytest.mark.usefixtures("folder")
def test_each_level_has_a_quarter_of_the_splats_and_is_measured(listener: Listener) -> None:
    options = SplatsOptions(splats=160, levels=3, epochs=1)
    found = bake_splats("a.npz", "web/lod-meta.json", PICTURES, options=options, steps=listener)
    assert [level.splats for level in found.levels] == [level.n for level in load("web", SplatLevels).levels]
    assert [level.splats for level in found.levels[1:]] == [-(-level.splats // 4) for level in found.levels[:2]]
    assert found.psnr == found.levels[0].psnr > found.levels[2].psnr
    said = [line for line in listener.said if f"level 2: {found.levels[2].splats} splats, " in line]
    assert len(said) == 1
    save("few.ply", load("web", Splats))
    plain = bake_splats("few.ply", "plain/lod-meta.json", PICTURES, options=SplatsOptions(levels=2, epochs=0))
    n = found.splats
    assert [level.splats for level in plain.levels] == [n, -(-n // 4)]
    merged = merge_splats(load("few.ply", Splats), count=-(-n // 4))
    assert sorted(load("plain", SplatLevels).levels[1].means[:, 0]) == pytest.approx(
        sorted(merged.means[:, 0]), abs=1e-3
    )


def test_levels_are_kept_after_ctrl_c_and_after_a_missed_limit(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, options = "web/lod-meta.json", SplatsOptions(splats=60, levels=3, epochs=1)
    with pytest.raises(BudgetMissed, match="the splats have a mean PSNR of"):
        bake_splats("a.npz", out, PICTURES, options=options, min_psnr=99)
    rejected = load("web.rejected", SplatLevels).levels
    assert len(rejected) == 3
    whole, runs = views_to_splats.fit_splats, [0]

    def interrupted(*args: Any, **rest: Any) -> Iterator[Any]:
        runs[0] += 1
        for state in whole(*args, **rest):
            if runs[0] == 2:
                os.kill(os.getpid(), signal.SIGINT)
            yield state

    monkeypatch.setattr(views_to_splats, "fit_splats", interrupted)
    with pytest.raises(Stopped, match=r"web\.partial has the current state"):
        bake_splats("a.npz", out, PICTURES, options=options)
    assert [level.n for level in load("web.partial", SplatLevels).levels] == [level.n for level in rejected[:2]]

    def fail(*arguments: Any, **options: Any) -> None:
        raise MemoryLimit("the pictures", 2, 1)

    monkeypatch.setattr(views_to_splats, "fit_splats", whole)
    monkeypatch.setattr("nerfbake.jobs.splats.measure_views", fail)
    with pytest.raises(MemoryLimit):
        bake_splats("a.npz", out, PICTURES, options=options)
    assert len(load("web.partial", SplatLevels).levels) == 3
    assert not (folder / "web").exists()


@pytest.mark.usefixtures("folder")
def test_levels_are_for_a_folder() -> None:
    with pytest.raises(UsageError, match=r"`levels` has no effect on a single file; allowed: with lod-meta\.json"):
        bake_splats("a.npz", "a.ply", PICTURES, options=SplatsOptions(levels=2))
    with pytest.raises(UsageError, match=r"lod-meta\.json holds levels of splats; allowed: `nerfbake splats`"):
        convert_file("a.npz", "b/lod-meta.json")
