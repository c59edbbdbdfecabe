"""Meshes from .ply, against trimesh and plyfile, and whatever is wrong with them in one line."""

from __future__ import annotations

import io
import time
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
from tests.support.meshes import assert_same_mesh, cube, odd_plys, painted, polygon_ply, sphere, square
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


def test_another_program_reads_coordinates_of_a_map(tmp_path: Path) -> None:
    origin = np.array([453000.125, 5012345.5, 120.25])
    scene = Meshes((COLOURED, cube()), origin=origin)
    save(tmp_path / "a.ply", scene)
    found: Any = trimesh.load(tmp_path / "a.ply", process=False)
    places = np.concatenate([COLOURED.positions, cube().positions]) + origin
    np.testing.assert_allclose(found.vertices, places, rtol=0, atol=1e-6)
    back = load(tmp_path / "a.ply", Meshes)
    np.testing.assert_allclose(back.meshes[0].positions + back.origin, places, rtol=0, atol=1e-6)
    assert (back.notes, np.abs(back.origin - origin).max() < 2) == ((), True)


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
    "cut": (SOUND[:-3], "element face declares 1 rows, with 4 numbers left"),
    "words": (SOUND.replace(b"255 0 0", b"255 x 0"), "has words that are no numbers"),
    "a corner too many": (polygon_ply([(0, 1, 4)]), "has a corner at vertex 4; allowed: 0 to 3"),
    "a corner below zero": (polygon_ply([(0, 1, -1)]), "has a corner at vertex -1"),
    "two corners": (polygon_ply([(0, 1)]), "has no faces; allowed: at least one triangle"),
    "a fractional corner": (SOUND.replace(b"7 3 0 1 2", b"7 3 0 1 nan"), "has a corner at vertex -1"),
    "no faces": (polygon_ply([]), "has no faces; allowed: at least one triangle"),
    "no z": (SOUND.replace(b"float z", b"float w"), "element vertex has no property z"),
    "no list": (SOUND.replace(b"vertex_indices", b"others"), "element face has no list vertex_indices"),
    "many rows": (SOUND.replace(b"vertex 4", b"vertex 99999999999"), "declares 99,999,999,999 rows"),
    "a long list": (SOUND.replace(b"7 3 0 1 2", b"7 1e300 0 1 2"), "does not end within the file"),
    "no number": (SOUND.replace(b"0 1 0 0", b"inf 1 0 0"), "mesh positions[2, 0] is inf"),
    "a header of millions": (b"ply\nformat ascii 1.0\n" + b"comment x\n" * 110_000, "does not end within 1,048,576"),
    "a broken property": (SOUND.replace(b"property float z", b"property float"), "has the line 'property float'"),
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


def text_ply(
    *rows: str, columns: str = "", face: str = "", head: str = "", vertices: int = 3, faces: int = 1
) -> Meshes:
    """A mesh of rows of text. columns: properties of a vertex behind x y z; face: those behind the list of a face."""
    lines = ["ply", "format ascii 1.0", *head.splitlines(), f"element vertex {vertices}"]
    lines += [*(f"property float {axis}" for axis in "xyz"), *columns.splitlines(), f"element face {faces}"]
    lines += ["property list uchar int vertex_indices", *face.splitlines(), "end_header", *rows, ""]
    return ply.decode(memoryview("\n".join(lines).encode()))


CORNERS = ("0 0 0", "1 0 0", "0 1 0")
LONGER = "rows have more numbers than the header declares, which are skipped"


def test_a_row_of_text_is_a_line_with_more_numbers_than_declared() -> None:
    """MeshLab's VCGLIB declares four numbers of a colour and writes a list of nine, in trimesh's fuze_ascii.ply."""
    face = "property list uchar float texcoord\nproperty uchar red\nproperty uchar green"
    rows = ("3 0 1 2 6 0 0 1 0 0 1 9 1 1 1 1 1 1 1 1 1", "3 0 2 1 6 0 0 0 1 1 0 9 1 1 1 1 1 1 1 1 1")
    found = text_ply(*CORNERS, *rows, face=face, faces=2)
    np.testing.assert_array_equal(found.meshes[0].faces, [[0, 1, 2], [0, 2, 1]])
    assert found.notes == (LONGER,)
    found = text_ply("0 0 0 9", "1 0 0 9", "", "0 1 0 9 8", "3 0 1 2 5", "3 2 1 0", faces=2)
    np.testing.assert_array_equal(found.meshes[0].positions, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(found.meshes[0].faces, [[0, 1, 2], [2, 1, 0]])
    assert found.notes == (LONGER,)


@pytest.mark.parametrize(
    "rows",
    [
        ("0 0 0 1 0 0 0 1 0 3 0 1 2",),
        ("0 0 0 1 0 0 0 1 0", "3 0 1 2"),
        ("0", "0 0 1", "0 0 0 1 0 3", "0 1", "2"),
        ("0 0 0", "", " 1 0 0 ", "0\t1 0\r", "\t3 0 1 2", "", ""),
    ],
)
def test_rows_of_text_may_be_broken_or_joined(rows: tuple[str, ...]) -> None:
    found = text_ply(*rows)
    np.testing.assert_array_equal(found.meshes[0].positions, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(found.meshes[0].faces, [[0, 1, 2]])
    assert found.notes == ()


def test_elements_behind_the_faces_are_no_longer_rows() -> None:
    head = polygon_ply([(0, 1, 2), (3, 2, 1, 0)])
    edges = b"element edge 1\nproperty int a\nproperty int b\nend_header"
    joined = head.replace(b"end_header", edges).replace(b"255 0 0\n1", b"255 0 0 1") + b"0 1\n"
    found = ply.decode(memoryview(joined))
    assert (len(found.meshes[0].faces), found.notes) == (3, ())


def test_short_binary_rows_that_are_longer_than_declared() -> None:
    """As declared, the second row would be a polygon without corners and the byte behind it."""
    content = list(odd_plys())[2]
    found = ply.decode(memoryview(content))
    np.testing.assert_array_equal(found.meshes[0].faces, [[0, 1, 2], [3, 2, 1]])
    assert found.notes == ("the line 'by hand' of the header is skipped", LONGER)
    assert len(ply.decode(memoryview(content[:-12] + b"abc")).meshes[0].faces) == 1


@pytest.mark.parametrize("order", "<>")
def test_binary_rows_that_are_longer_than_declared_fill_the_file(order: str) -> None:
    row = [
        ("n", "u1"),
        ("v", f"{order}i4", 3),
        ("m", "u1"),
        ("c", f"{order}f4", 6),
        ("k", "u1"),
        ("w", f"{order}f4", 9),
    ]
    wanted = np.array([[0, 1, 2], [2, 1, 3], [3, 1, 0]])
    faces = np.zeros(3, row)
    faces["n"], faces["v"], faces["m"], faces["c"], faces["k"], faces["w"] = 3, wanted, 6, 0.5, 9, 1
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    columns = [f"property float {axis}" for axis in "xyz"]
    head = ["ply", f"format {form} 1.0", "comment VCGLIB generated", "element vertex 4", *columns, "element face 3"]
    head += ["property list uchar int vertex_indices", "property list uchar float texcoord"]
    head += [*(f"property uchar {name}" for name in (*COLOURS, "alpha")), "end_header", ""]
    points = np.arange(12).astype(f"{order}f4")
    found = ply.decode(memoryview("\n".join(head).encode() + points.tobytes() + faces.tobytes()))
    np.testing.assert_array_equal(found.meshes[0].faces, wanted)
    assert found.notes[0] == LONGER


def test_bytes_behind_the_last_row_are_ignored() -> None:
    content = b"".join(ply.encode(Meshes((square(),))))
    for more in (b"\n", bytes(26), bytes(27)):  # as many as two rows, too
        found = ply.decode(memoryview(content + more))
        assert_same_mesh(found.meshes[0], replace(square(), uvs=None))
        assert found.notes == ()


def test_a_line_of_the_header_without_its_word_is_told() -> None:
    """Blender 2.47 wrote so."""
    found = text_ply(*CORNERS, "3 0 1 2", head="Created by Blender3D 2.47\n\n  obj_info x")
    assert len(found.meshes[0].faces) == 1
    assert found.notes == ("the line 'Created by Blender3D 2.47' of the header is skipped",)


def test_polygons_of_fewer_than_three_corners_are_skipped() -> None:
    told = ("faces of fewer than three corners are skipped (3)",)
    found = text_ply(*CORNERS, "2 0 1", "3 0 1 2", "0", "1 7", faces=4)
    assert (found.meshes[0].faces.tolist(), found.notes) == ([[0, 1, 2]], told)
    rows = [[0, 1], [2, 1, 0], [], [7]]
    faces = b"".join(bytes([len(row)]) + np.array(row, "<i4").tobytes() for row in rows)
    content = b"".join(ply.encode(Meshes((square(),))))
    head = content[: content.index(b"end_header\n") + 11].replace(b"element face 2", b"element face 4")
    found = ply.decode(memoryview(head + square().positions.tobytes() + faces))
    assert (found.meshes[0].faces.tolist(), found.notes) == ([[2, 1, 0]], told)


def test_vertices_without_a_place_that_no_face_uses_are_dropped() -> None:
    found = text_ply("nan nan nan", *CORNERS, "0 0 inf", "3 1 3 2", vertices=5)
    np.testing.assert_array_equal(found.meshes[0].positions, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(found.meshes[0].faces, [[0, 2, 1]])


def strips(*numbers: int, form: str = "ascii") -> Meshes:
    lines = ["ply", f"format {form} 1.0", "element vertex 5", *(f"property float {axis}" for axis in "xyz")]
    lines += ["element tristrips 1", "property list int int vertex_indices", "end_header", ""]
    points = np.arange(15, dtype=np.float32)
    head, rows = "\n".join(lines).encode(), (len(numbers), *numbers)
    text = " ".join(map(str, points)) + "\n" + " ".join(map(str, rows)) + "\n"
    body = text.encode() if form == "ascii" else points.tobytes() + np.array(rows, "<i4").tobytes()
    assert ply.recognise(memoryview(head + body))
    return ply.decode(memoryview(head + body))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_strips_of_triangles(form: str) -> None:
    (found,) = strips(0, 1, 2, 3, 4, -1, 2, 1, 0, -1, 3, 4, -1, -1, form=form).meshes
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [2, 1, 3], [2, 3, 4], [2, 1, 0]])
    (found,) = strips(0, 1, 2, 2, 3, 4, form=form).meshes  # joined by triangles without an area
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [3, 2, 4]])
    for lie in ((0, 1, 5), (0, 1, -2)):
        with pytest.raises(NerfbakeError, match=f"has a corner at vertex {lie[2]}"):
            strips(*lie, form=form)
    for empty in ([], [0], [0, 1, -1, 2, 3]):
        with pytest.raises(NerfbakeError, match="has no faces"):
            strips(*empty, form=form)


@pytest.mark.parametrize("ends", [b"\r", b"\r\n"])
def test_lines_may_end_as_on_old_systems(ends: bytes) -> None:
    content = b"".join(ply.encode(Meshes((square(),))))
    at = content.index(b"end_header\n") + 11
    found = ply.decode(memoryview(content[:at].replace(b"\n", ends) + content[at:]))
    assert_same_mesh(found.meshes[0], replace(square(), uvs=None))
    (found_text,) = ply.decode(memoryview(polygon_ply([(0, 1, 2)]).replace(b"\n", ends))).meshes
    np.testing.assert_array_equal(found_text.faces, [[0, 1, 2]])


@pytest.mark.parametrize(
    "changed",
    [
        SOUND.replace(b"\nelement vertex", b"\ncomment " + b"x" * 100 + b"\ncomment" * 5000 + b"\nelement vertex"),
        SOUND.replace(b"element face", b"element  face"),
        SOUND.replace(b"element face", b"element\tface "),
        SOUND.replace(b"\n", b"\r\n"),
        SOUND.replace(b"comment by hand", b"comment by hand f_dc_0 packed_position"),
        SOUND.replace(b"comment by hand", b"by hand"),
    ],
    ids=["long", "two spaces", "tab", "CRLF", "comment", "no word"],
)
def test_a_mesh_is_recognised_however_its_header_is_spelled(changed: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(changed)
    assert len(load(tmp_path / "a.ply", Meshes).meshes[0].faces) == 1


def test_a_header_of_many_elements_takes_no_time() -> None:
    many = b"".join(b"element e%d 0\n" % k for k in range(20_000))
    content = SOUND.replace(b"element vertex", many + b"element vertex", 1)
    start = time.process_time()
    assert ply.recognise(memoryview(content))
    assert time.process_time() - start < 2


@pytest.mark.data
def test_odd_files_of_other_programs(data: Path) -> None:
    folder = data / "reports" / "F9_odd_meshes"
    assert (
        load(folder / "header_without_comment.ply", Meshes).notes[0].startswith("the line 'Created by an old Blender")
    )
    found = load(folder / "meshlab_extra_numbers.ply", Meshes)
    assert (found.meshes[0].faces.tolist(), found.notes[0]) == ([[0, 1, 2], [0, 2, 1]], LONGER)
    assert load(data / "hostile4" / "blame" / "overflow.mesh.ply", Meshes).notes
