"""`nerfbake view` of folders with triangles, as a shell sees it."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import Stage1, bake_stage1, load, sample_n3tree, save
from nerfbake.cli.main import run
from nerfbake.io import save_folder
from tests.conftest import Shell
from tests.support.atlas_scenes import stage1_folder
from tests.support.meshes import painted


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    stage1 = load(stage1_folder(tmp_path / "stage1"), Stage1)
    save_folder(tmp_path / "atlas", bake_stage1(stage1, clusters=4, map_size=8))
    return tmp_path


@pytest.mark.usefixtures("folders")
def test_folders_become_pages(shell: Shell, tmp_path: Path) -> None:
    for arguments, highlights in (
        (["stage1", "a.html"], '["mlp_constants", "mlp_textures", "none"]'),
        (["atlas", "b.html"], '["kmeans", "none"]'),
        (["atlas", "c.html", "--stage1", "stage1"], '["kmeans", "mlp_constants", "mlp_textures", "none"]'),
    ):
        done = shell("view", *arguments)
        assert done.returncode == 0, done.stderr
        assert "page of 1 triangle, " in done.stderr.decode()
        page = (tmp_path / arguments[1]).read_text()
        assert f'"highlights": {highlights}' in page
        assert f"<title>{arguments[0]}</title>" in page
    first = (tmp_path / "c.html").read_bytes()
    assert shell("view", "atlas", "c.html", "--stage1", "stage1", "--force").returncode == 0
    assert (tmp_path / "c.html").read_bytes() == first


@pytest.mark.usefixtures("folders")
def test_what_does_not_go_with_triangles(shell: Shell, tmp_path: Path) -> None:
    for arguments, code, line in (
        (["stage1", "--stage1", "stage1"], 2, "--stage1 needs an atlas, and stage1 is not one"),
        (["atlas", "--max-size", "1MB"], 2, "atlas contains triangles, for which a goal"),
        (["stage1", "--mesh", "stage1/mesh_0.obj"], 2, "stage1 contains triangles"),
        (["atlas", "--composite", "ztest"], 2, "--composite has no effect without a mesh"),
        (["atlas", "--max-memory", "100kB"], 1, "(--max-memory)"),
    ):
        done = shell("view", arguments[0], "a.html", *arguments[1:])
        assert done.returncode == code, done.stderr
        assert line in done.stderr.decode()
        assert len(done.stderr.decode().strip().splitlines()) <= 3
    (tmp_path / "stage1" / "mesh_0.obj").unlink()
    done = shell("view", "stage1", "a.html")
    assert (done.returncode, done.stderr.decode()) == (
        1,
        "error: stage1: mesh_0.obj is missing; allowed: a mesh and its diffuse texture, to render pictures\n",
    )
    assert not (tmp_path / "a.html").exists()


@pytest.mark.usefixtures("fewer_rays")
def test_a_mesh_beside_a_field(shell: Shell, tmp_path: Path) -> None:
    save(tmp_path / "a.npz", sample_n3tree(resolution=8, basis="SH1"))
    save(tmp_path / "m.glb", painted())
    options = ("--mesh", "m.glb", "--mesh-up", "z", "--composite", "ztest", "--min-psnr", "20")
    done = shell("view", "a.npz", "a.html", *options)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "a.html").read_text()
    assert '"composites": ["ztest", "stop", "cutout"]' in page
    assert page.count('"vertices": ') == 3
    done = shell("view", "a.npz", "b.html", "--mesh", "m.glb", "--max-memory", "400kB", "--data", "exact")
    assert (done.returncode, done.stderr.decode().count("\n")) == (1, 1)
    assert "(--max-memory)" in done.stderr.decode()
    done = shell("view", "a.npz", "b.html", "--mesh", "none.glb", "--data", "exact")
    assert (done.returncode, done.stderr.decode()) == (1, "error: none.glb: No such file or directory\n")
    assert not (tmp_path / "b.html").exists()


def test_a_mesh_becomes_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save("a.glb", painted(), quantised=True, image="webp")
    for name in ("b.html", "c.html"):
        assert run(["view", "a.glb", name]) == 0
    page = Path("b.html").read_text()
    assert '"highlights": ["none"]' in page
    assert "All of the scene is in this file: 26 triangles." in page
    assert Path("c.html").read_text() == page
