"""What jobs read and write."""

from __future__ import annotations

import weakref
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from nerfbake import N3Tree, Stage1, build_octree, load, sample_n3tree
from nerfbake.errors import InvalidFile, InvalidScene, UsageError
from nerfbake.jobs import (
    Source,
    Stage1Source,
    Target,
    compare_files,
    render_views,
    view_file,
    write_sample_stage1,
    write_shaders,
)
from nerfbake.jobs.comparisons import ComparedViews
from nerfbake.jobs.files import as_source, as_target
from nerfbake.jobs.pictures import PlacedMesh, ViewSelection
from nerfbake.jobs.steps import SILENT
from nerfbake.memory import left, memory_limit
from tests.jobs.listener import Listener


def test_a_path_is_enough() -> None:
    assert as_source(Path("a.npz")) == as_source("a.npz") == Source("a.npz")
    assert as_source(Source("-")).name == "stdin"
    assert as_target("a.svo.pb") == Target("a.svo.pb", to=None, force=False)
    assert as_target(Target("a", to="svo.pb")).to == "svo.pb"
    assert (Target("a.svo.pb").name, Target("-").name) == ("a.svo.pb", "stdout")


def test_the_ending_of_a_target_is_that_of_its_format() -> None:
    assert Target("a.npz").ending == "a.npz"
    assert Target("a.npz", to="svo.pb").ending == Target("-", to=".svo.pb").ending == ".svo.pb"


def test_stdout_is_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for write in (write_shaders, write_sample_stage1):
        with pytest.raises(UsageError, match=r"^stdout takes one file; allowed: a folder$"):
            write("-")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["freed.npz", "freed.svo.pb.zst"])
def test_what_is_written_may_be_freed_before_it_is_measured(name: str, tmp_path: Path) -> None:
    scene: Any = sample_n3tree(resolution=8) if name == "freed.npz" else build_octree(sample_n3tree(resolution=8))
    alive = weakref.ref(scene)
    with ExitStack() as output:
        output.enter_context(as_target(str(tmp_path / name)).writing(SILENT, scene))
        del scene
        assert alive() is None


@pytest.mark.usefixtures("folder")
def test_a_source_tells_its_step_and_is_blamed(listener: Listener) -> None:
    found = Source("a.npz").read_with_format(listener, N3Tree)
    assert (found.form.name, found.size, found.packing) == ("npz", Path("a.npz").stat().st_size, {})
    assert listener.phases == ["reading a.npz"]
    assert isinstance(found.scene, N3Tree)
    with pytest.raises(InvalidScene, match=r"^a.npz: too much"), Source("a.npz").blamed(listener, "working"):
        raise InvalidScene("too much")
    with pytest.raises(InvalidFile, match="holds an octree"):
        Source("a.svo.pb").read(SILENT, N3Tree)


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("how", ["beside a field", "alone", "on a page", "compared"])
def test_what_a_mesh_lacks_is_printed_by_everything_that_shows_it(how: str, listener: Listener) -> None:
    Path("mesh.obj").write_text("mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    shot = ViewSelection(size=(8, 8))
    match how:
        case "beside a field":
            render_views("a.npz", "a.png", shot, mesh=PlacedMesh(path="mesh.obj"), steps=listener)
        case "alone":
            render_views("mesh.obj", "a.png", shot, steps=listener)
        case "on a page":
            view_file("a.npz", "a.html", data="exact", mesh=PlacedMesh(path="mesh.obj"), steps=listener)
        case _:
            compare_files("mesh.obj", "mesh.obj", seen=ComparedViews(size=(8, 8)), steps=listener)
    assert {line for line in listener.said if "gone.mtl" in line} == {
        "mesh.obj: mtllib 'gone.mtl' is not in the folder of the .obj, so that its materials are not known"
    }


def test_parts_from_anywhere_are_a_stage1_folder(stage1: Path) -> None:
    parts = Stage1Source("", (str(stage1 / "feat1_0.png"),), str(stage1 / "mlp.json"))
    read = parts.read(SILENT)
    assert (read.fields[0].features == load(stage1, Stage1).fields[0].features).all()
    assert parts.name == str(stage1 / "feat1_0.png")


def test_what_a_stage1_folder_was_read_from_is_given_back(stage1: Path) -> None:
    parts = Stage1Source("", (str(stage1 / "feat1_0.png"),), str(stage1 / "mlp.json"))
    with memory_limit(1 << 28):
        before = left()
        read = parts.read(SILENT)
        assert left() < before
        del read
        assert left() == before
