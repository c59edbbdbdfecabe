"""`nerfbake info` of files and folders of every kind."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import pytest

from nerfbake import Meshes, save
from nerfbake.cli.main import run
from tests.cli.telling import told
from tests.conformance.case import HOME
from tests.conftest import Shell
from tests.support.atlas_scenes import stage1_folder
from tests.support.meshes import cube, sphere


def test_info_and_check_of_a_mesh(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path / "a.glb", Meshes((cube(), sphere())))
    facts = told(["info", str(tmp_path / "a.glb")], capsys)
    assert (facts["kind"], facts["format"], facts["meshes"]) == ("triangle mesh", "glb", 2)
    assert facts["world_box"] == [[-1, -1, -1], [1, 1, 1]]
    assert run(["check", str(tmp_path / "a.glb")]) == 0
    save(tmp_path / "a.obj", Meshes((cube(),)))

    class Stdin:
        buffer = io.BytesIO((tmp_path / "a.obj").read_bytes())

    monkeypatch.setattr(sys, "stdin", Stdin)
    assert told(["info", "-"], capsys)["triangles"] == 12


def test_folders_say_what_they_are(sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(sample / "out")]) == 0
    assert run(["svo", str(sample / "in"), str(tmp_path / "a.svo.pb")]) == 1
    assert "holds a stage-1 folder (`nerfbake atlas` bakes it); allowed: a PlenOctree" in capsys.readouterr().err
    assert run(["compare", str(tmp_path), str(sample / "in")]) == 1
    assert "is a folder of unknown kind; allowed: a file, or a folder with mlp.json" in capsys.readouterr().err


def test_info_and_check_of_folders_and_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = stage1_folder(tmp_path / "in"), tmp_path / "out"
    assert run(["atlas", str(folder), str(out), "--clusters", "3", "--map-size", "8"]) == 0
    written = json.loads((out / "atlas.json").read_text())["errors"][0]
    for path in (folder, out, out / "atlas_0.png"):
        assert run(["check", str(path)]) == 0
        assert run(["info", str(path)]) == 0
    said = capsys.readouterr().out
    assert "cascade 0" in said
    assert "hidden units        8" in said
    assert run(["info", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["bytes_on_disk"] == sum(path.stat().st_size for path in out.iterdir())
    assert told["cascades"]["0"]["errors"] == written
    (out / "labels_0.png").unlink()
    assert run(["check", str(out)]) == 1
    assert "labels_0.png is missing" in capsys.readouterr().out


@pytest.mark.usefixtures("tree_file")
def test_a_page_is_nothing_to_read(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("<!DOCTYPE html>")
    done = shell("info", "page.html")
    assert done.returncode == 1
    assert done.stderr.startswith(b"error: page.html: starts with 3c 21 44 4f 43 54 59 50, which is no known format")


@pytest.mark.parametrize("coding", ["range", "deflate"])
def test_info_of_a_compressed_octree_tells_parts_that_make_up_the_file(
    coding: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = HOME / "compressed" / f"sh4_{coding}.svoq"
    expected = json.loads(path.with_name("sh4.expected.json").read_text())
    facts = told(["info", str(path)], capsys)
    assert (facts["format"], facts["coding"], facts["basis_size"]) == ("svoq", coding, 4)
    assert facts["colour_step"] == expected["colour_step"]
    assert sum(facts["bytes_of_parts"].values()) == facts["bytes_on_disk"] == path.stat().st_size
    assert sum(facts["percent_of_parts"].values()) == pytest.approx(100, abs=0.2)
    assert run(["info", str(path)]) == 0
    assert f"topology {facts['bytes_of_parts']['topology']:,}" in capsys.readouterr().out


def test_a_folder_of_photographs_is_told_what_takes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a.JPG", "b.png"):
        (tmp_path / name).touch()
    assert run(["info", str(tmp_path)]) == 1
    assert "holds pictures alone (`nerfbake fit` takes them, and `nerfbake poses` finds" in capsys.readouterr().err
    (tmp_path / "notes.txt").touch()
    assert run(["info", str(tmp_path)]) == 1
    assert "is a folder of unknown kind" in capsys.readouterr().err
