"""Meshes from .obj, and whatever is wrong with them in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from nerfbake import Meshes, load, save
from nerfbake.errors import BudgetMissed, NerfbakeError, OutputError
from nerfbake.formats.mesh import obj
from nerfbake.io import saving
from tests.support.hostile import refused_as_it_is
from tests.support.meshes import TEXELS, assert_same_mesh, cube, painted, square


def test_obj_there_and_back(tmp_path: Path) -> None:
    scenes = (Meshes((cube(0.25),)), Meshes((painted().meshes[1],)), Meshes((square(), cube())))
    for scene in scenes:
        save(tmp_path / "a.obj", scene, force=True)
        back = load(tmp_path / "a.obj", Meshes).meshes
        for one, other in zip(scene.meshes, sorted(back, key=lambda m: len(m.faces)), strict=True):
            assert_same_mesh(one, other, atol=0.5 / 255)  # trimesh has vertex colours as bytes
    assert [path.name for path in tmp_path.iterdir()] == ["a.obj"]


TEXTURED = Meshes((replace(square(half=1.0), texture=TEXELS),))


def test_a_texture_stands_beside_its_obj(tmp_path: Path) -> None:
    size = save(tmp_path / "a toy.obj", TEXTURED)
    names = ["a toy.mtl", "a toy.obj", "a toy.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert size == sum(path.stat().st_size for path in tmp_path.iterdir())
    assert_same_mesh(load(tmp_path / "a toy.obj", Meshes).meshes[0], TEXTURED.meshes[0], atol=1e-6)
    found: Any = trimesh.load(tmp_path / "a toy.obj", process=False)
    np.testing.assert_array_equal(np.asarray(found.visual.material.image.convert("RGB")), TEXELS)
    np.testing.assert_allclose(found.visual.uv * [1, -1] + [0, 1], TEXTURED.meshes[0].require_uvs(), atol=1e-6)


def test_several_textures_as_jpegs(tmp_path: Path) -> None:
    plain, _, flat = painted().meshes
    scene = Meshes((flat, replace(flat, texture=np.full((8, 8, 3), 90, np.uint8)), plain))
    save(tmp_path / "a.obj", scene, image="jpeg")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mtl", "a.obj", "a_0.jpg", "a_1.jpg"]
    back = load(tmp_path / "a.obj", Meshes).meshes
    assert [None if mesh.texture is None else mesh.texture.shape for mesh in back] == [(4, 4, 3), (8, 8, 3), None]


def test_nothing_is_replaced_without_force_and_all_of_it_with(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists already"):
        save(tmp_path / "a.obj", TEXTURED)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    save(tmp_path / "a.obj", TEXTURED, force=True)
    assert_same_mesh(load(tmp_path / "a.obj", Meshes).meshes[0], TEXTURED.meshes[0], atol=1e-6)


def test_a_rejected_obj_keeps_its_texture(tmp_path: Path) -> None:
    def reject(path: str) -> None:
        assert load(path, Meshes).meshes[0].texture is not None
        raise BudgetMissed("bad")

    with pytest.raises(BudgetMissed), saving(tmp_path / "a.obj", TEXTURED) as saved:
        reject(saved.path)
    assert [path.name for path in tmp_path.iterdir()] == ["a.obj.rejected"]
    assert load(tmp_path / "a.obj.rejected" / "a.obj", Meshes).meshes[0].texture is not None


def test_a_texture_needs_a_file_with_room_beside_it(tmp_path: Path) -> None:
    with pytest.raises(NerfbakeError, match=r"has a texture; allowed: .*\.glb, or an \.obj on the disk"):
        save(tmp_path / "a.obj.zst", TEXTURED)
    with pytest.raises(NerfbakeError, match=r"has 2 levels of detail; allowed: one, or \.glb"):
        save(tmp_path / "a.obj", Meshes((cube(),), (cube(),)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("library", "material"),
    [
        ("../a.mtl", "map_Kd a.png"),
        ("gone.mtl", "map_Kd a.png"),
        ("./../a.mtl", "map_Kd a.png"),
        ("a.mtl", "map_Kd ../a.png"),
        ("a.mtl", "map_Kd ./../a.png"),
        ("a.mtl", "map_Kd ./below/../../a.png"),
        ("a.mtl", "map_Kd /etc/passwd.png"),
        ("a.mtl", "map_Kd gone.png"),
        ("a.mtl", "map_Kd a.tga"),
        ("a.mtl", "map_Kd"),
        ("a.mtl", "map_Kd " + 300 * "x" + ".png"),
    ],
)
def test_a_material_elsewhere_is_ignored(library: str, material: str, tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    for folder in (tmp_path, tmp_path / "below"):  # so that what a wrong name would find is there
        save(folder / "a.obj", TEXTURED)
    text = (tmp_path / "below" / "a.obj").read_text()
    (tmp_path / "below" / "a.obj").write_text(text.replace("mtllib a.mtl", f"mtllib {library}"))
    (tmp_path / "below" / "a.mtl").write_text(f"newmtl mesh_0\n{material}\n")
    (tmp_path / "below" / "a.tga").write_bytes(b"no picture")
    assert load(tmp_path / "below" / "a.obj", Meshes).meshes[0].texture is None


INSIDE: dict[str, tuple[str, str]] = {  # of each case: the library of the .obj and the picture of its material
    "textures/a.png": ("a.mtl", "textures/a.png"),
    "a backslash": ("a.mtl", "textures\\a.png"),
    "./textures//a.png": ("a.mtl", "./textures//a.png"),
    "with options": ("a.mtl", "-bm 1 textures/a.png"),
    "a library below": ("textures/a.mtl", "a.png"),
    "a library below, from the .obj": ("textures/a.mtl", "textures/a.png"),
}


@pytest.mark.parametrize("case", INSIDE)
def test_a_picture_may_be_in_a_folder_below(case: str, tmp_path: Path) -> None:
    library, picture = INSIDE[case]
    save(tmp_path / "a.obj", TEXTURED)
    (tmp_path / "textures").mkdir()
    (tmp_path / "a.png").rename(tmp_path / "textures" / "a.png")
    (tmp_path / library).write_text(f"newmtl mesh_0\nmap_Kd {picture}\n")
    (tmp_path / "a.obj").write_text((tmp_path / "a.obj").read_text().replace("mtllib a.mtl", f"mtllib {library}"))
    found = load(tmp_path / "a.obj", Meshes)
    np.testing.assert_array_equal(found.meshes[0].texture, TEXELS)
    assert found.notes == ()


@pytest.mark.parametrize("name", ["textures/a.png", "out/a.png", "textures/../../outside/a.png", "in/../in/a.png"])
def test_no_name_leads_out_of_the_folder_through_links(name: str, tmp_path: Path) -> None:
    outside, folder = tmp_path / "outside", tmp_path / "mesh"
    (folder / "textures").mkdir(parents=True)
    (folder / "in").mkdir()
    outside.mkdir()
    save(outside / "a.obj", TEXTURED)
    (folder / "a.obj").write_bytes((outside / "a.obj").read_bytes())
    (folder / "in" / "a.png").write_bytes((outside / "a.png").read_bytes())
    (folder / "textures" / "a.png").symlink_to(outside / "a.png")
    (folder / "out").symlink_to(outside)
    (folder / "a.mtl").write_text(f"newmtl mesh_0\nmap_Kd {name}\n")
    found = load(folder / "a.obj", Meshes)
    assert found.meshes[0].texture is None
    assert found.notes == (f"texture {name!r} is no PNG or JPEG in the folder of the .obj",)
    (folder / "inside").symlink_to(folder / "in")
    (folder / "a.mtl").write_text("newmtl mesh_0\nmap_kd inside/a.png\n")
    assert load(folder / "a.obj", Meshes).meshes[0].texture is not None


def test_options_of_a_map_are_skipped(tmp_path: Path) -> None:
    save(tmp_path / "a.obj", TEXTURED)
    (tmp_path / "a.png").rename(tmp_path / "my 2.png")
    for options in ("-clamp on -bm 1.5", "-imfchan r -blendu off", "-mm 0 1e0 \t", "-s 1 1 1"):
        (tmp_path / "a.mtl").write_text(f"newmtl other\nmap_Kd b.png\n\nnewmtl mesh_0\n\tmap_Kd {options} my 2.png\n")
        assert load(tmp_path / "a.obj", Meshes).meshes[0].texture is not None, options


LEFT: dict[str, tuple[str, str]] = {
    "newmtl mesh_0\nmap_Kd gone.png": ("", "texture 'gone.png' is no PNG or JPEG in the folder of the .obj"),
    "newmtl mesh_0\nmap_Kd below/a.png": ("", "texture 'below/a.png' is no PNG or JPEG in the folder of the .obj"),
    "newmtl mesh_0\nmap_Kd a.tga": ("", "texture 'a.tga' is no PNG or JPEG in the folder of the .obj"),
    "newmtl mesh_0\nmap_Kd -s 2 2 1 a.png": ("", "texture '-s 2 2 1 a.png' is shown without its options"),
    "newmtl mesh_0\nmap_Kd a.png": (
        "usemtl mesh_0\nf 1 2 3\n",
        "texture 'a.png' is not shown, because corners lack texture coordinates",
    ),
    "newmtl mesh_0\nmap_Kd a.png ": (
        "mtllib my b.mtl\nmtllib c.mtl\n",
        "mtllib 'my b.mtl' is not in the folder of the .obj, so that its materials are not known (and 1 more)",
    ),
}


@pytest.mark.parametrize("library", LEFT)
def test_one_line_tells_what_of_the_materials_is_left_out(library: str, tmp_path: Path) -> None:
    more, told = LEFT[library]
    save(tmp_path / "a.obj", TEXTURED)
    assert load(tmp_path / "a.obj", Meshes).notes == ()
    (tmp_path / "a.mtl").write_text(library + "\n")
    (tmp_path / "a.obj").write_text((tmp_path / "a.obj").read_text() + more)
    found = load(tmp_path / "a.obj", Meshes)
    assert found.notes == (told,)
    shown = "shown without" in told or "mtllib" in told
    assert (found.meshes[0].texture is not None) == shown


def test_a_material_without_a_picture_is_no_note(tmp_path: Path) -> None:
    save(tmp_path / "a.obj", TEXTURED)
    for library in ("", "newmtl mesh_0\n", "newmtl mesh_0\nKd 1 0 0\nmap_Kd\n", "newmtl other\nmap_Kd gone.png\n"):
        (tmp_path / "a.mtl").write_text(library)
        assert load(tmp_path / "a.obj", Meshes).notes == ()


RED, BLUE = [200, 0, 0], [0, 0, 200]
A, B = "newmtl A\nmap_Kd red.png\n", "newmtl B\nmap_Kd b #2.png\n"
# Of each case: the lines of the .obj that name libraries, and the libraries.
LIBRARIES: dict[str, tuple[str, dict[str, str]]] = {
    "this folder": ("mtllib ./a.mtl", {"a.mtl": "newmtl A\nmap_Kd ./red.png\nnewmtl B\nmap_Kd .\\b #2.png\n"}),
    "tabs": ("mtllib\ta.mtl", {"a.mtl": "newmtl\tA\nmap_Kd\tred.png\nnewmtl\tB\n\tmap_Kd\tb #2.png\t\n"}),
    "two on a line": ("mtllib a.mtl\tb.mtl", {"a.mtl": A, "b.mtl": B}),
    "two lines": ("mtllib gone.mtl\nmtllib a.mtl\nmtllib b.mtl", {"a.mtl": A, "b.mtl": B}),
    "the first counts": ("mtllib a.mtl b.mtl", {"a.mtl": A, "b.mtl": A.replace("red", "gone") + B}),
    "a space in a name": ("mtllib a b.mtl", {"a b.mtl": A + B, "a": "newmtl A\n", "b.mtl": "newmtl B\n"}),
    "# in a name": ("mtllib #a.mtl", {"#a.mtl": "# " + A.replace("red", "gone").replace("\n", "\n#") + "\n" + A + B}),
    "a byte order mark": ("mtllib a.mtl", {"a.mtl": "\ufeff" + A + B}),
}


def two_triangles(folder: Path, head: str, first: str, second: str, libraries: dict[str, str]) -> list[Any]:
    """The first texel of each of two triangles, whose materials may show red.png and "b #2.png"."""
    for name, content in libraries.items():
        (folder / name).write_text(content)
    for name, colour in (("red.png", RED), ("b #2.png", BLUE)):
        Image.new("RGB", (2, 2), tuple(colour)).save(folder / name)
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    faces = f"usemtl {first}\nf 1/1 2/2 3/3\nusemtl\t{second}\nf 3/3 2/2 1/1\n"
    (folder / "a.obj").write_text(f"{head}\n{corners}{faces}")
    textures = [mesh.texture for mesh in load(folder / "a.obj", Meshes).meshes]
    return [None if texture is None else texture[0, 0].tolist() for texture in textures]


@pytest.mark.parametrize("case", LIBRARIES)
def test_every_way_to_name_a_library_and_a_picture(case: str, tmp_path: Path) -> None:
    head, libraries = LIBRARIES[case]
    assert two_triangles(tmp_path, head, "A", "B", libraries) == [RED, BLUE]


def test_materials_whose_names_differ_behind_a_hash_stay_apart(tmp_path: Path) -> None:
    library = A.replace("A", "Material #1") + B.replace("B", "Material #2")
    found = two_triangles(tmp_path, "mtllib a.mtl", "Material #1", "Material #2", {"a.mtl": library})
    assert found == [RED, BLUE]


@pytest.mark.parametrize("lines", ["mtllib " + 101 * "{} ", 101 * "mtllib {}\n"])
def test_more_libraries_than_any_writer_names_are_refused(lines: str, tmp_path: Path) -> None:
    triangle = "\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text(lines.format(*(f"{k}.mtl" for k in range(101))) + triangle)
    with pytest.raises(NerfbakeError, match=r"a\.obj: mtllib names more than 100 libraries; allowed: 100 at most"):
        load(tmp_path / "a.obj")
    (tmp_path / "a.obj").write_text(lines.format(*(101 * ["a.mtl"])) + triangle)
    assert len(load(tmp_path / "a.obj", Meshes).meshes) == 1


def parsed(text: str) -> Any:
    (found,) = obj.decode(memoryview(text.encode())).meshes
    return found


def test_comments_stand_on_lines_of_their_own_and_behind_numbers() -> None:
    plain = parsed("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    noted = (
        "#v 9 9 9\n # v 9 9 9\nv 0 0 0 # v 9\nv 1 0 0\t#1 2 3\nv 0 1 0#4\nvt 0 0 # u\nf 1/1 2/1 3/1 # 4 5 #\n#f 1 1 1\n"
    )
    assert_same_mesh(parsed(noted), plain)


def test_a_byte_order_mark_hides_no_line() -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5\nf 1 2 3\n"
    assert_same_mesh(parsed("\ufeff" + text), parsed(text))


def test_a_weight_is_not_a_colour() -> None:
    for colours in ("1 0 .25", "9 1 0 .25"):
        found = parsed(f"v 0 0 0 {colours}\nv 1 0 0 {colours}\nv 0 1 0 1 0 .25\nf 1 2 3\n")
        np.testing.assert_array_equal(found.colours, [[1, 0, 0.25]] * 3)
    assert parsed("v 0 0 0 1\nv 1 0 0 1\nv 0 1 0 1\nf 1 2 3\n").colours is None


def decoded(text: str) -> Meshes:
    return obj.decode(memoryview(text.encode()))


AMBIGUOUS = "vertices with seven numbers are read as x y z, red, green, blue and opacity"


@pytest.mark.parametrize(
    ("rows", "colours", "notes"),
    [
        # Opacity, a weight, and both in the same places.
        (("1 0 0 1", "0 1 0 1", "0 0 1 1"), np.eye(3), ()),
        (("1 0 0 .5", "0 1 0 .5", "0 0 1 0"), np.eye(3), ()),
        (("255 0 0 255", "0 255 0 255", "0 0 255 255"), np.eye(3), ("colours go to 255, and are divided by 255",)),
        (("1 1 0 0", "1 0 1 0", "1 0 0 1"), np.eye(3), ()),
        (("1.0 1 0 0", "1 0 1 0", "1 0 0 1"), np.eye(3), ()),
        (("2 1 0 0", "1 0 1 0", "3 0 0 1"), np.eye(3), ()),
        (("1 0 0 1", "1 .5 0 1", "1 0 .5 1"), [[1, 0, 0], [1, 0.5, 0], [1, 0, 0.5]], (AMBIGUOUS,)),
        (("1 1 1 1", "1 1 1 1", "1 1 1 1"), np.ones((3, 3)), ()),
    ],
)
def test_seven_numbers_are_a_colour_with_opacity_or_a_weight(rows: Any, colours: Any, notes: Any) -> None:
    corners = ("0 0 0", "1 0 0", "0 1 0")
    text = "".join(f"v {corner} {row}\n" for corner, row in zip(corners, rows, strict=True))
    found = decoded(text + "f 1 2 3\n")
    np.testing.assert_allclose(np.array(found.meshes[0].colours), colours, atol=1e-6)
    assert found.notes == notes


def test_vertices_without_a_colour_are_grey_beside_others_and_white_on_a_texture(tmp_path: Path) -> None:
    grey, white = (f"vertices without a colour beside others are {name}" for name in ("grey", "white"))
    some = "v 0 0 0\nv 1 0 0 1 0 0\nv 0 1 0 7\n"
    found = decoded(some + "f 1 2 3\n")
    np.testing.assert_array_equal(found.meshes[0].colours, [[0.75] * 3, [1, 0, 0], [0.75] * 3])
    assert found.notes == (grey,)
    two = "o a\nusemtl a\nv 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n"
    two += "o b\nusemtl {}\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf 4 5 6\n"
    apart = decoded(two.format("b"))
    assert ([mesh.colours is None for mesh in apart.meshes], apart.notes) == ([False, True], ())
    joined = decoded(two.format("a"))
    np.testing.assert_array_equal(joined.meshes[0].colours, [[1, 0, 0]] * 3 + [[0.75] * 3] * 3)
    assert joined.notes == (grey,)
    save(tmp_path / "a.obj", TEXTURED)
    (tmp_path / "a.obj").write_text((tmp_path / "a.obj").read_text().replace("v -1 -1 0", "v -1 -1 0 1 0 0"))
    found = load(tmp_path / "a.obj", Meshes)
    np.testing.assert_array_equal(found.meshes[0].colours, [[1, 0, 0]] + [[1, 1, 1]] * 3)
    assert found.notes == (white,)


def test_colours_that_zbrush_writes_as_comments() -> None:
    corners, face = "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "f 1 2 3\n"
    found = decoded(f"{corners}#MRGB ffff0000ff00ff00\n#MRGB 000000FF\n{face}")
    np.testing.assert_array_equal(found.meshes[0].colours, np.eye(3))
    told = ("the colours of #MRGB are not read, because they do not fit the vertices",)
    for paint in ("ffff0000", "ffff000", "ffff000x" * 3):
        found = decoded(f"{corners}#MRGB {paint}\n{face}")
        assert (found.meshes[0].colours, found.notes) == (None, told)


def test_faces_of_fewer_than_three_corners_are_skipped() -> None:
    found = decoded("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\nf 3 2 1\nf 1\nusemtl b\nf 1 2 3\nf \n")
    assert [mesh.faces.tolist() for mesh in found.meshes] == [[[2, 1, 0]], [[0, 1, 2]]]
    assert found.notes == ("faces of fewer than three corners are skipped (3)",)


def test_indices_of_texture_coordinates_that_the_file_lacks_are_told() -> None:
    found = decoded("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1/1 2/7/1 3/-1\n")
    assert (found.meshes[0].uvs, found.meshes[0].faces.tolist()) == (None, [[0, 1, 2]])
    assert found.notes == ("faces name texture coordinates, of which the file has none",)


@pytest.mark.parametrize("wrong", ["nan nan", "-nan 1", "-1.#IND00 0", "1.#QNAN 1", "-nan(ind) 0", "nan(snan) 0"])
def test_texture_coordinates_that_are_not_numbers_are_told(wrong: str) -> None:
    found = decoded(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt {wrong}\nvt 0 1 # 1.#IND\nf 1/1 2/2 3/3\n")
    assert found.meshes[0].require_uvs()[1][0] == 0
    assert found.notes == ("texture coordinates that are not numbers are 0",)


@pytest.mark.parametrize("text", ["f 1 \\\n2\\\r\n 3\n", "f 1 2 \\ \t\r\n3\n", "f 1 2 3"])
def test_lines_are_joined_and_end_as_on_any_system(text: str) -> None:
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    assert parsed(corners + text).faces.tolist() == [[0, 1, 2]]
    assert parsed((corners + "usemtl a\nf 1 2 3\n").replace("\n", "\r")).faces.tolist() == [[0, 1, 2]]


def test_a_texture_coordinate_may_be_one_number() -> None:
    found = parsed("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt .25\nvt 1 .5 0\nvt .75\nf 1/1 2/2 3/3\n")
    np.testing.assert_array_equal(found.require_uvs(), [[0.25, 1], [1, 0.5], [0.75, 1]])


def test_coordinates_of_a_map_keep_their_digits(tmp_path: Path) -> None:
    near, far = "v 0 0 0\nv 10 0 0\nv 0 10 0\nf 1 2 3\n", "v 500000.1 0 5400000.4\nv 500010.1 0 5400000.4\n"
    assert obj.decode(memoryview(near.encode())).notes == ()
    found = obj.decode(memoryview(f"{far}v 500000.1 0 5400010.4\nf 1 2 3\n".encode()))
    assert (found.notes, found.origin.tolist()) == ((), [500010.0, 0.0, 5400010.0])
    corners = [[500000.1, 0, 5400000.4], [500010.1, 0, 5400000.4], [500000.1, 0, 5400010.4]]
    for scene in (found, Meshes((replace(found.meshes[0], colours=np.ones((3, 3), np.float32)),), origin=found.origin)):
        save(tmp_path / "a.obj", scene, force=True)
        theirs: Any = trimesh.load(tmp_path / "a.obj", process=False)
        np.testing.assert_allclose(theirs.vertices, corners, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(load(tmp_path / "a.obj", Meshes).origin, found.origin)


def test_a_picture_that_is_none_is_one_line(tmp_path: Path) -> None:
    save(tmp_path / "a.obj", TEXTURED)
    (tmp_path / "a.png").write_bytes(b"none")
    with pytest.raises(NerfbakeError, match=r"a\.png cannot be read"):
        load(tmp_path / "a.obj")


LIES: dict[str, tuple[bytes, str]] = {
    "no faces": (b"v 0 0 0\nv 1 0 0\n", "has no faces; allowed: at least one triangle"),
    "only a line": (b"v 0 0 0\nv 1 0 0\nl 1 2\n", "has no faces"),
    "a corner too many": (
        b"v 0 0 0\nf 1 1 1\n\nf 1 2 3\n",
        "cannot be read: face 2 has the v index 2; allowed: 1 to 1",
    ),
    "no such texture coordinate": (
        b"v 0 0 0\nvt 0\nf 1 1 1\nf 1/1 1/0 1\n",
        "face 2 has the vt index 0; allowed: 1 to 1",
    ),
    "two corners": (b"v 0 0 0\nf 1 1\nf 1\nf \n", "has no faces; allowed: at least one triangle"),
    "a corner too many behind two corners": (b"v 0 0 0\nf 1 1\nf 1 1 1\nf 1 1 2\n", "face 3 has the v index 2"),
    "a fractional corner": (b"v 0 0 0\nf 1 1 1\nf 1 1.0 1\n", "cannot be read: face 2 has '1.0'"),
    "two numbers": (b"v 0 0 0\n# v\nv 1 0\nf 1 1 1\n", "cannot be read: vertex 2 has 2 numbers; allowed: 3 or more"),
    "NaN": (b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "mesh positions[0, 0] is nan"),
    "no numbers": (
        b"v 0 0 0\nv a b c\nf 1 2 3\n",
        "cannot be read: vertex 2 has 'a'; allowed: a whole .obj of polygons",
    ),
    "a comma": (b"v 0 0 0\nvt 0\nvt 0,5 1\nf 1 1 1\n", "cannot be read: texture coordinate 2 has '0,5'"),
    "bytes": (b"v 0 0 0\n\xff\xfe", "has no faces"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_obj_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, named = LIES[lie]
    assert named in refused_as_it_is(tmp_path / "bad.obj", content, capsys)


def test_a_stream_is_known_by_its_first_bytes() -> None:
    assert obj.recognise(memoryview(b"# Blender\nmtllib a.mtl\nv 0 0 0\n"))
    assert obj.recognise(memoryview(b"\xef\xbb\xbfv 0 0 0\n"))
    assert obj.recognise(memoryview(b"v\t0 0 0\n"))
    assert not obj.recognise(memoryview(b'{"frames": [],\n"v": 1}'))
    assert not obj.recognise(memoryview(b"\0v 1 2 3\nv "))


@pytest.mark.data
def test_odd_files_of_other_programs(data: Path) -> None:
    folder = data / "reports" / "F9_odd_meshes"
    assert load(folder / "line2.obj", Meshes).notes == ("faces of fewer than three corners are skipped (1)",)
    assert load(folder / "vt_none.obj", Meshes).notes == ("faces name texture coordinates, of which the file has none",)
    found = load(folder / "sub.obj", Meshes)
    assert (found.meshes[0].texture is not None, found.notes) == (True, ())
