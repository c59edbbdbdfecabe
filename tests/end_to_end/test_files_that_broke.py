"""Every file that broke an earlier version: read without a word, or refused in one line, soon."""

from __future__ import annotations

from contextlib import chdir
from pathlib import Path
from typing import Any

import pytest

from nerfbake import Cameras, Meshes, build_field, build_octree, build_vdb, catalog, load, orbit_cameras, save
from nerfbake.cli.main import run
from nerfbake.errors import NerfbakeError
from nerfbake.memory import memory_limit
from tests.conftest import DATA
from tests.support.hostile import complaint
from tests.support.meshes import cube
from tests.support.scenes import n3tree

HOSTILE = DATA / "hostile"
FILES = sorted(path for path in HOSTILE.glob("*") if path.name != "README.md")
OCTREES = tuple(form.suffix for form in catalog.FORMATS if form.scene == "SparseVoxelOctree" and not form.written)
VOLUMES = tuple(form.suffix for form in catalog.FORMATS if form.scene == "Volume" and form.readable)


def commands(path: Path, tmp_path: Path) -> list[list[str]]:
    """What people would try with a file of this name."""
    source, small, name = str(path), ["--size", "16x16"], path.name.removesuffix(".zst")
    picture = ["--out", str(tmp_path / "out.png"), *small]
    tried = [["check", source], ["info", source]]
    if name.endswith(OCTREES + VOLUMES):
        tried += [["convert", source, str(tmp_path / f"out{suffix}")] for suffix in OCTREES]
        tried += [["render", source, *picture]]
    if name.endswith(OCTREES) or (name.endswith(".npz") and not name.endswith(VOLUMES)):
        tried += [["vdb", source, str(tmp_path / f"out{suffix}")] for suffix in VOLUMES]
        tried += [["vdb", source, str(tmp_path / "index.nvdb"), "--grids", "index", "--half"]]
    if name.endswith(".npz") and not name.endswith(OCTREES + VOLUMES):
        tried += [["svo", source, str(tmp_path / "out.svo.npz")], ["render", source, *picture]]
        tried += [["svo", source, str(tmp_path / "out.svo.pb"), "--resolution", "3"]]
    scene = str(tmp_path / "scene.svo.npz")
    if name.endswith((".obj", ".glb")):
        tried += [["render", scene, "--mesh", source, *picture]]
    if name.endswith(".json") and not name.endswith(OCTREES):
        tried += [["render", scene, "--cameras", source, "--all", "--out", str(tmp_path / "views"), *small]]
        tried += [["render", scene, "--cameras", source, "--out", str(tmp_path / "view.png"), *small]]
    return [[*arguments, "--max-memory", "64MiB"] for arguments in tried]


@pytest.fixture(scope="module")
def sound_files_went_through(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What is imported and compiled on first use counts for no hostile file; each command is one that can succeed."""
    tree = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4")
    octree = build_octree(tree)
    sound: dict[str, Any] = {
        "a.npz": tree,
        "a.svo.pb": octree,
        "a.vdb": build_vdb(octree, grids=("density", "sh")),
        "a.nvdb": build_vdb(octree, grids=("index",)),
        "a.json": orbit_cameras(build_field(tree), frames=2, width=16, height=16),
        "a.obj": Meshes((cube(),)),
        "a.glb": Meshes((cube(),)),
    }
    for name, scene in sound.items():
        with chdir(folder := tmp_path_factory.mktemp("sound")):
            save("scene.svo.npz", octree)
            save(name, scene)
            for arguments in commands(folder / name, folder):
                assert run(arguments) == 0, arguments


@pytest.mark.data
@pytest.mark.usefixtures("sound_files_went_through")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_file_that_broke_an_earlier_version(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # whatever a name in a file may lead to
    save("scene.svo.npz", build_octree(n3tree(splits=[(0, (1, 0, 1))])))
    found = {" ".join(each): complaint(each, None) for each in commands(path, tmp_path)}
    assert {command: said for command, said in found.items() if said} == {}


@pytest.mark.data
@pytest.mark.parametrize("path", [path for path in FILES if path.is_file()], ids=lambda path: path.name)
def test_what_it_holds_is_written_in_every_format_and_read_again(path: Path, tmp_path: Path) -> None:
    try:
        with memory_limit(64 << 20):
            scene: Any = load(path)
    except NerfbakeError:
        return
    for form in catalog.formats_of(type(scene).__name__):
        try:
            save(tmp_path / f"out{form.suffix}", scene)
        except NerfbakeError:
            continue
        told = [str(each) for each in (load(tmp_path / f"out{form.suffix}", type(scene)), scene)]
        if isinstance(scene, Cameras):  # which name the program that wrote them
            told = [text.partition(" (")[0] for text in told]
        assert told[0] == told[1]
