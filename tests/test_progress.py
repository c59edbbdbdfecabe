"""Shares of a step, from loops inside loops."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from nerfbake import bake_stage1, build_octree_from_lattice, load, progress, sample_stage1
from nerfbake.scene.atlas import METHODS, Method
from nerfbake.scene.lattice_field import LatticeField
from tests.support.lattices import svox2, svox2_file


def heard() -> tuple[list[tuple[float, str]], progress.Listener]:
    shares: list[tuple[float, str]] = []
    return shares, lambda share, detail: shares.append((share, detail))


def test_each_reports_after_every_item() -> None:
    shares, listener = heard()
    with progress.listening(listener):
        assert list(progress.each("abcd")) == list("abcd")
    assert [share for share, _ in shares] == [0.25, 0.5, 0.75, 1]


def test_a_loop_in_a_loop_reports_its_part_of_an_item() -> None:
    shares, listener = heard()
    with progress.listening(listener):
        for _ in progress.each(range(2)):
            progress.report(0.5, "half")
    assert shares == [(0.25, "half"), (0.5, ""), (0.75, "half"), (1, "")]


def test_a_part_of_a_part() -> None:
    shares, listener = heard()
    with progress.listening(listener), progress.part(0.5, 1), progress.part(0, 0.5):
        progress.report(0.5)
    assert [share for share, _ in shares] == [0.625, 0.75, 1]


def test_nobody_listens_by_default_and_inside_of_nothing() -> None:
    progress.report(0.5)
    shares, listener = heard()
    with progress.listening(listener):
        with progress.listening(None), progress.part(0, 1):
            assert list(progress.each([1, 2])) == [1, 2]
        progress.report(2)
    assert shares == [(1, "")]


def test_a_loop_that_ends_early_leaves_the_listener_as_it_was() -> None:
    shares, listener = heard()
    with progress.listening(listener):
        for number in progress.each(range(4)):
            if number:
                break
        progress.report(0.9)
    assert shares[-1] == (0.9, "")


def _sampled(folder: Path) -> None:
    (folder / "a.npz").write_bytes(svox2_file(svox2(plain=False)))
    build_octree_from_lattice(load(folder / "a.npz", LatticeField), resolution=(64, 64, 64), basis="SH1")


def _baked(folder: Path, method: Method) -> None:
    bake_stage1(sample_stage1(resolution=16), method=method, clusters=4, map_size=8, nodes=3, directions=20)


@pytest.mark.parametrize("work", [_sampled, *(partial(_baked, method=method) for method in METHODS)])
def test_shares_of_a_long_step_rise_to_its_end(
    work: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerfbake.stages.lattice_to_octree._TESTED", 1 << 14)
    monkeypatch.setattr("nerfbake.stages.lattice_to_octree._FITTED", 1 << 10)
    shares: list[float] = []
    with progress.listening(lambda share, _: shares.append(share)):
        work(tmp_path)
    assert len(set(shares)) > 4
    assert shares == sorted(shares)
    assert shares[-1] == 1
