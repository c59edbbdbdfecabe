"""Meshes from .ply, against trimesh and plyfile, and whatever is wrong with them in one line."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from nerfbake import Meshes, Splats, load, save
from nerfbake.errors import NerfbakeError
from nerfbake.formats.mesh import ply
from tests.support.hostile import refused_as_it_is
from tests.support.meshes import assert_same_mesh, cube, painted, polygon_ply, sphere, square
from tests.support.splats import splats

COLOURS = ("red", "green", "blue")
GRADIENT = np.linspace(0, 1, 24, dtype=np.float32).reshape(8, 3)
COLOURED = replace(cube(0.2), colours=GRADIENT)


def test_ply_there_and_back(tmp_path: Path) -> None:
    for scene in (Meshes((cube(0.25),)), Meshes((COLOURED,))):
        save(tmp_path / "a.ply", scene, force=True)
        (back,) = load(tmp_path / "a.ply", Meshes).meshes
        assert_same_mesh(scene.meshes[0], back, atol=0.5 / 255)


def test_another_program_reads_places_colours_and_corners(tmp_path: Path) -> None:
    save(tmp_path / "a.ply", Meshes((COLOURED, cube())))
    found: Any = trimesh.load(tmp_path / "a.ply", process=False)
    np.testing.assert_array_equal(found.vertices, np.concatenate([COLOURED.positions, cube().positions]))
    np.testing.assert_array_equal(found.faces, np.concatenate([COLOURED.faces, cube().faces + 8]))
    colours = np.concatenate([GRADIENT, np.full((8, 3), 0.75)])
    np.testing.assert_allclose(found.visual.vertex_colors[:, :3] / 255, colours, atol=0.5 / 255)


@pytest.mark.parametrize("options", [{}, {"byte_order": ">"}, {"text": True}], ids=["little", "big", "text"])
def test_another_programs_polygons_are_read_in_every_spelling(options: dict[str, Any]) -> None:
    plyfile = pytest.importorskip("plyfile")
    points = [(0, 0, 0, 1.5), (1, 0, 0, 1.5), (1, 1, 0, 1.5), (0, 1, 0, 1.5), (0, 0, 1, 1.5)]
    vertex = np.array(points, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("quality", "f4")])
    face = np.empty(3, [("flags", "u1"), ("vertex_index", "O"), ("texcoord", "O")])
    for row, corners in zip(face, ([0, 1, 2, 3], [0, 1, 4], [4, 3, 2, 1, 0]), strict=True):
        row["flags"], row["vertex_index"] = 1, np.array(corners, np.int16)
        row["texcoord"] = np.arange(2 * len(corners), dtype=np.float32)
    elements = [plyfile.PlyElement.describe(vertex, "vertex"), plyfile.PlyElement.describe(face, "face")]
    file = io.BytesIO()
    plyfile.PlyData(elements, **options).write(file)
    (found,) = ply.decode(memoryview(file.getvalue())).meshes
    np.testing.assert_array_equal(found.positions, np.array(points, np.float32)[:, :3])
    fans = [[0, 1, 2], [0, 2, 3], [0, 1, 4], [4, 3, 2], [4, 2, 1], [4, 1, 0]]
    np.testing.assert_array_equal(found.faces, fans)


def test_colours_in_text_are_bytes() -> None:
    (found,) = ply.decode(memoryview(polygon_ply([(0, 1, 2)]))).meshes
    wanted = np.array([[1, 0, 0], [0.2, 0.4, 0.8]])
    np.testing.assert_allclose(np.array(found.colours)[[0, 3]], wanted, atol=1e-7)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    ("kind", "stored", "white"),
    [("uchar", "u1", 255), ("uint8", "u1", 255), ("ushort", "u2", 65535), ("int", "i4", 255), ("float", "f4", 1)],
)
def test_the_type_of_colours_decides_what_white_is(form: str, kind: str, stored: str, white: int) -> None:
    order = ">" if "big" in form else "<"
    rows = np.zeros(3, [("place", f"{order}f4", 3), ("colour", order + stored, 3)])
    rows["place"], rows["colour"] = np.eye(3), [[1, 0, 0], [0, 1, 1], [0, 0, 1]]  # almost black unless floats
    face = np.array([(3, (0, 1, 2))], [("count", "u1"), ("corners", f"{order}i4", 3)])
    columns = [f"property float {axis}" for axis in "xyz"] + [f"property {kind} {name}" for name in COLOURS]
    head = ["ply", f"format {form} 1.0", "element vertex 3", *columns, "element face 1"]
    head += ["property list uchar int vertex_indices", "end_header", ""]
    text = "".join(" ".join(map(str, (*row["place"], *row["colour"]))) + "\n" for row in rows) + "3 0 1 2\n"
    body = text.encode() if form == "ascii" else rows.tobytes() + face.tobytes()
    (found,) = ply.decode(memoryview("\n".join(head).encode() + body)).meshes
    np.testing.assert_array_equal(found.colours, (rows["colour"].astype(float) / white).astype(np.float32))


def test_the_content_tells_meshes_from_splats(tmp_path: Path) -> None:
    save(tmp_path / "mesh.ply", Meshes((sphere(),)))
    save(tmp_path / "splats.ply", splats(3))
    assert isinstance(load(tmp_path / "mesh.ply"), Meshes)
    assert isinstance(load(tmp_path / "splats.ply"), Splats)
    with pytest.raises(NerfbakeError, match="holds Gaussian splats"):
        load(tmp_path / "splats.ply", Meshes)


def test_what_the_reader_leaves_out_is_told() -> None:
    content = polygon_ply([(0, 1, 2)])
    assert ply.decode(memoryview(content)).notes == ()
    told = "texture 'a b.png' is not read from a .ply, but from a .glb or .obj"
    for name in (b"TextureFile a b.png", b"TextureFile a b.png\ncomment TextureFile c.png"):
        named = content.replace(b"\nelement vertex", b"\ncomment " + name + b"\nelement vertex")
        assert ply.decode(memoryview(named)).notes == (told,)
    assert ply.decode(memoryview(named.replace(b"TextureFile", b"TextureFiles"))).notes == ()


def test_colours_of_faces_are_told() -> None:
    lines = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {axis}" for axis in "xyz")]
    lines += ["element face 1", "property list uchar int vertex_indices"]
    lines += [*(f"property uchar {name}" for name in COLOURS), "end_header", "0 0 0", "1 0 0", "0 1 0"]
    found = ply.decode(memoryview("\n".join([*lines, "3 0 1 2 255 0 0", ""]).encode()))
    assert found.notes == ("colours of faces are not read, but colours of vertices",)


def test_a_texture_is_not_dropped_silently(tmp_path: Path) -> None:
    with pytest.raises(NerfbakeError, match=r"has a texture; allowed: vertex colours, or \.glb"):
        save(tmp_path / "b.ply", painted())
    assert not (tmp_path / "b.ply").exists()


SOUND = polygon_ply([(0, 1, 2)])
LIES: dict[str, tuple[bytes, str]] = {
    "cut": (SOUND[:-3], "element face declares 1 rows, with 4 bytes or numbers left"),
    "words": (SOUND.replace(b"255 0 0", b"255 x 0"), "has words that are no numbers"),
    "a corner too many": (polygon_ply([(0, 1, 4)]), "has a corner at vertex 4; allowed: 0 to 3"),
    "a corner below zero": (polygon_ply([(0, 1, -1)]), "has a corner at vertex -1"),
    "two corners": (polygon_ply([(0, 1)]), "has a face of 2 corners"),
    "a fractional corner": (SOUND.replace(b"7 3 0 1 2", b"7 3 0 1 nan"), "has a corner at vertex -1"),
    "no faces": (polygon_ply([]), "has no faces; allowed: at least one triangle"),
    "no z": (SOUND.replace(b"float z", b"float w"), "element vertex has no property z"),
    "no list": (SOUND.replace(b"vertex_indices", b"others"), "element face has no list vertex_indices"),
    "many rows": (SOUND.replace(b"vertex 4", b"vertex 99999999999"), "declares 99,999,999,999 rows"),
    "a long list": (SOUND.replace(b"7 3 0 1 2", b"7 1e300 0 1 2"), "does not end within the file"),
    "no number": (SOUND.replace(b"0 0 1 51", b"inf 0 1 51"), "mesh positions[3, 0] is inf"),
    "bright": (SOUND.replace(b"51 102 204", b"51 102 256"), "mesh colours"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_ply_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, named = LIES[lie]
    assert named in refused_as_it_is(tmp_path / "bad.ply", content, capsys)


def test_a_list_that_leaves_the_file_is_refused() -> None:
    body = bytearray(b"".join(ply.encode(Meshes((square(),)))))
    body[-13] = 255  # the length of the last list
    with pytest.raises(NerfbakeError, match="element face does not end within the file"):
        ply.decode(memoryview(bytes(body)))
