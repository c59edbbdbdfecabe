"""`nerfbake hull`, as a shell sees it and as trimesh reads what it writes."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from nerfbake import N3Tree, build_field, build_hull, build_octree, build_vdb, load, save
from nerfbake.cli.main import run
from tests.conftest import Shell

pytestmark = pytest.mark.usefixtures("tree_file")


def read(path: Path) -> Any:
    """The one mesh of a file, as it stands in its scene."""
    return trimesh.load(path, force="mesh", process=False)


def test_hulls_as_glb_and_obj_stand_where_the_scene_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tree = load("a.npz", N3Tree)
    (wanted,) = build_hull(build_field(tree), level=1).meshes
    for name, options in (("a.glb", ()), ("a.obj", ()), ("z.glb", ("--in-up", "z"))):
        assert run(["hull", "a.npz", name, "--level", "1", *options, "-q"]) == 0
        found = read(tmp_path / name)
        turned = found.vertices @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]] if options else found.vertices
        np.testing.assert_allclose(turned, wanted.positions, atol=1e-6)
        assert found.is_volume
        np.testing.assert_allclose(found.volume, 1.0, rtol=1e-5)


def test_octrees_and_volumes_have_the_same_hull(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    octree = build_octree(load("a.npz", N3Tree))
    save("a.svo.pb", octree)
    save("a.nvdb", build_vdb(octree, grids=("index",)))
    found = []
    for name in ("a.npz", "a.svo.pb", "a.nvdb"):
        assert run(["hull", name, f"{name}.obj", "-q"]) == 0
        found.append(read(tmp_path / f"{name}.obj"))
    for other in found[1:]:
        np.testing.assert_allclose(other.vertices, found[0].vertices, atol=1e-6)
        np.testing.assert_array_equal(other.faces, found[0].faces)


def test_a_hull_goes_through_pipes(shell: Shell, tmp_path: Path) -> None:
    done = shell("hull", "-", "-", "--to", "glb", "-q", stdin=(tmp_path / "a.npz").read_bytes())
    assert (done.returncode, done.stderr) == (0, b"")
    found: Any = trimesh.load(io.BytesIO(done.stdout), file_type="glb", force="mesh")
    assert found.is_volume


@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        (
            "hull a.npz a.stl",
            2,
            "'a.stl' has no file extension for a mesh; allowed: .obj, .glb, .ply, .usda, .usdc, .usdz, or --to",
        ),
        ("hull a.npz a.obj --in-up z", 2, "--in-up has no effect on .obj; allowed: with .glb"),
        ("hull a.npz a.glb --level 13", 2, "'--level'"),
        ("hull empty.npz a.glb", 1, "empty.npz: the field has no leaf with a density; allowed: at least one"),
        ("hull gone.npz a.glb", 1, "gone.npz"),
    ],
)
def test_what_cannot_be_is_refused(
    line: str, code: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    tree = load("a.npz", N3Tree)
    save("empty.npz", replace(tree, data=np.zeros_like(tree.data)))
    assert run(line.split()) == code
    (error,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert said in error
    assert list(tmp_path.glob("*.glb")) + list(tmp_path.glob("*.obj")) == []
