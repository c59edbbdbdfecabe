"""An octree fitted anew: nearer to what it is to look like, and not a node more."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import (
    SparseVoxelOctree,
    build_field,
    build_n3tree,
    build_octree,
    load,
    measure_views,
    sample_n3tree,
    save,
)
from nerfbake.errors import InvalidScene, MemoryLimit, NerfbakeError, OutputError, UsageError
from nerfbake.jobs import ReadingOptions, RefitOptions, RefitReference, Source, bake_octree, refit_file
from nerfbake.jobs.photographs import read_photographs
from nerfbake.jobs.reading_options import Part
from nerfbake.jobs.steps import SILENT
from tests.jobs.listener import Listener
from tests.support.brick_fields import some_shelled_field
from tests.support.photographs import write_scene
from tests.support.scenes import n3tree

LIKE = RefitReference(like="fine.npz", frames=12, edge=48)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """fine.npz, a scene of 32^3; coarse.svo.npz, its octree of 8^3 with leaves of several sizes."""
    monkeypatch.chdir(tmp_path)
    tree = sample_n3tree(resolution=32, basis="SH4")
    save("fine.npz", tree)
    save("coarse.svo.npz", build_octree(tree, resolution=8))
    return tmp_path


def octree(name: str) -> SparseVoxelOctree:
    return load(name, SparseVoxelOctree)


def test_an_octree_that_cannot_be_measured_gets_no_name(monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[object] = []

    def fail(*arguments: object, **options: object) -> tuple[object, ...]:
        measured.append(arguments)
        if len(measured) == 2:  # the first one is IN
            raise MemoryLimit("the pictures", 2, 1)
        return ()

    monkeypatch.setattr("nerfbake.jobs.refits.measure_views", fail)
    like, options = RefitReference(like="fine.npz", frames=2, edge=8), RefitOptions(epochs=1, samples=1)
    with pytest.raises(MemoryLimit, match=r"^out\.svo\.npz: the pictures"):
        refit_file("coarse.svo.npz", "out.svo.npz", like, options=options)
    assert sorted(path.name for path in Path().iterdir()) == ["coarse.svo.npz", "fine.npz"]


def test_it_comes_nearer_to_the_finer_scene_with_the_same_nodes(listener: Listener) -> None:
    found = refit_file("coarse.svo.npz", "out.svo.npz", LIKE, options=RefitOptions(samples=1), steps=listener)
    before, after = found.psnr
    assert after > before + 1
    assert len(found.before) == len(found.after) == 8
    assert_array_equal(octree("out.svo.npz").node_children, octree("coarse.svo.npz").node_children)
    assert found.bytes == Path("out.svo.npz").stat().st_size
    assert listener.said[-1].startswith(
        f"out.svo.npz: {after:.2f} dB on 8 pictures with alpha, where coarse.svo.npz has"
    )
    assert listener.shares[-1][0] <= 1
    assert found.worked > 0


def test_it_comes_nearer_to_photographs_and_is_judged_by_others(tmp_path: Path) -> None:
    capture = write_scene(tmp_path / "capture")
    save("coarse.npz", sample_n3tree(resolution=8, basis="SH1"))
    found = refit_file("coarse.npz", "out.svo.pb", RefitReference(views=str(capture)), options=RefitOptions(epochs=3))
    assert found.psnr[1] > found.psnr[0] + 0.5
    held_out = read_photographs(SILENT, Source(str(capture))).held_out
    assert found.after == measure_views(build_field(octree("out.svo.pb")), held_out, samples=2)


@pytest.mark.parametrize(("box", "inner"), [("inner", True), ("all", False)])
def test_pictures_of_scenery_show_what_the_octree_contains(box: Part, inner: bool, listener: Listener) -> None:
    save("s.npz", build_n3tree(some_shelled_field(basis=4)))
    bake_octree("s.npz", "exact.svo.npz", options=ReadingOptions(box=box))
    reference, options = RefitReference(like="s.npz", frames=4, edge=24), RefitOptions(epochs=1, samples=1)
    before, _ = refit_file("exact.svo.npz", "out.svo.npz", reference, options=options, steps=listener).psnr
    assert before > 60  # the octree has the same values
    assert ("s.npz: uses the inner cube of 64^3 and leaves out the scenery around it" in listener.said) == inner


def test_the_same_seed_gives_the_same_bytes() -> None:
    for name, seed in (("a.svo.npz", 0), ("b.svo.npz", 0), ("c.svo.npz", 1)):
        refit_file("coarse.svo.npz", name, LIKE, options=RefitOptions(epochs=1, samples=1, seed=seed))
    a, b, c = (Path(name).read_bytes() for name in ("a.svo.npz", "b.svo.npz", "c.svo.npz"))
    assert a == b != c


def test_halves_and_the_layout_stay() -> None:
    tree = sample_n3tree(resolution=16, basis="SH1")
    save("half.svo.npz", build_octree(tree, resolution=8, dtype="float16", layout="compact"))
    refit_file("half.svo.npz", "out.svo.npz", LIKE, options=RefitOptions(epochs=1, samples=1))
    assert octree("out.svo.npz").node_data.dtype == np.float16
    assert octree("out.svo.npz").layout == "compact"


@pytest.mark.parametrize(
    ("model", "target", "error", "message"),
    [
        (
            RefitReference(),
            "a.svo.npz",
            UsageError,
            "`like` and `views`: neither is given; allowed: one",
        ),
        (
            RefitReference(like="fine.npz", views="capture"),
            "a.svo.npz",
            UsageError,
            "`like` and `views`: both are given",
        ),
        (LIKE, "-", UsageError, "refit measures the file that it wrote"),
        (LIKE, "a.png", UsageError, "'a.png' has no file extension for an octree"),
        (LIKE, "coarse.svo.npz", OutputError, "coarse.svo.npz"),
        (RefitReference(like="none.npz"), "a.svo.npz", NerfbakeError, "none.npz: No such file or directory"),
    ],
)
def test_what_is_refused_writes_nothing(
    model: RefitReference, target: str, error: type[Exception], message: str, folder: Path
) -> None:
    there = sorted(folder.iterdir())
    with pytest.raises(error, match=message):
        refit_file("coarse.svo.npz", target, model)
    assert sorted(folder.iterdir()) == there


def test_an_octree_of_another_basis_is_named() -> None:
    save("grey.svo.npz", build_octree(n3tree(data_format="RGBA")))
    with pytest.raises(InvalidScene, match=r"grey.svo.npz: basis is RGBA; allowed: SH1"):
        refit_file("grey.svo.npz", "a.svo.npz", LIKE)
