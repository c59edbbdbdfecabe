"""Meshes from .obj, and whatever is wrong with them in one line."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from nerfbake import Meshes, load, save
from nerfbake.errors import NerfbakeError
from nerfbake.formats.mesh import obj
from tests.support.hostile import damaged, refused_as_it_is
from tests.support.meshes import assert_same_mesh, cube, painted, square


def test_obj_there_and_back(tmp_path: Path) -> None:
    scenes = (Meshes((cube(0.25),)), Meshes((painted().meshes[1],)), Meshes((square(), cube())))
    for scene in scenes:
        save(tmp_path / "a.obj", scene, force=True)
        back = load(tmp_path / "a.obj", Meshes).meshes
        for one, other in zip(scene.meshes, sorted(back, key=lambda m: len(m.faces)), strict=True):
            assert_same_mesh(one, other, atol=0.5 / 255)  # trimesh has vertex colours as bytes
    with pytest.raises(NerfbakeError, match=r"has a texture; allowed: meshes without textures, or \.glb"):
        save(tmp_path / "b.obj", painted())
    assert not (tmp_path / "b.obj").exists()


LIES: dict[str, tuple[bytes, str]] = {
    "no faces": (b"v 0 0 0\nv 1 0 0\n", "has no faces; allowed: at least one triangle"),
    "only a line": (b"v 0 0 0\nv 1 0 0\nl 1 2\n", "has no faces"),
    "a corner too many": (b"v 0 0 0\nf 1 2 3\n", "cannot be read"),
    "NaN": (b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "mesh positions[0, 0] is nan"),
    "no numbers": (b"v a b c\nf 1 2 3\n", "cannot be read"),
    "bytes": (b"v 0 0 0\n\xff\xfe", "has no faces"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_obj_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, named = LIES[lie]
    assert named in refused_as_it_is(tmp_path / "bad.obj", content, capsys)


def test_a_damaged_obj_is_read_or_refused(tmp_path: Path) -> None:
    save(tmp_path / "a.obj", Meshes((square(),)))
    for _, broken in damaged((tmp_path / "a.obj").read_bytes(), flips=200):
        with contextlib.suppress(NerfbakeError):
            obj.decode(memoryview(broken))


def test_a_stream_is_known_by_its_first_bytes() -> None:
    assert obj.recognise(memoryview(b"# Blender\nmtllib a.mtl\nv 0 0 0\n"))
    assert not obj.recognise(memoryview(b'{"frames": [],\n"v": 1}'))
    assert not obj.recognise(memoryview(b"\0v 1 2 3\nv "))
