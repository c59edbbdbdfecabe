"""Meshes from .glb, against trimesh, and whatever is wrong with them in one line."""

from __future__ import annotations

import base64
import copy
import io
import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from PIL import Image

from nerfbake import Meshes, load, save
from nerfbake.errors import NerfbakeError
from nerfbake.formats.mesh import glb as glb_format
from nerfbake.formats.mesh.glb_document import Document
from nerfbake.memory import memory_limit
from tests.support.hostile import refused_as_it_is
from tests.support.meshes import TEXELS, assert_same_mesh, cube, painted, sphere, square
from tests.support.meshopt_streams import CUBE, CUBE_KHR


def test_glb_there_and_back(tmp_path: Path) -> None:
    save(tmp_path / "a.glb", painted())
    back = load(tmp_path / "a.glb", Meshes)
    for one, other in zip(painted().meshes, back.meshes, strict=True):
        assert_same_mesh(one, other, atol=1e-6)  # colours go through linear light


BALL = sphere(8, 12)
WRAPPED = replace(
    BALL,
    uvs=((BALL.positions[:, :2] + 1) / 2).astype(np.float32),
    texture=np.full((16, 8, 3), (200, 120, 40), np.uint8),
    colours=np.clip(BALL.positions, 0, 1),
)


def parts(content: bytes) -> tuple[dict[str, Any], bytes]:
    size = int.from_bytes(content[12:16], "little")
    return json.loads(content[20 : 20 + size]), content[28 + size :]


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("lit", [False, True])
@pytest.mark.parametrize("picture", ["png", "jpeg", "webp"])
def test_quantised_attributes_come_back_within_half_a_step(up: Any, lit: bool, picture: Any, tmp_path: Path) -> None:
    moved = replace(WRAPPED, positions=(WRAPPED.positions * [1, 3, 0.2] + [5, -7, 0.1]).astype(np.float32))
    save(tmp_path / "a.glb", Meshes((moved,)), up=up, lit=lit, quantised=True, image=picture)
    (back,) = load(tmp_path / "a.glb", Meshes).with_up(up).meshes
    np.testing.assert_allclose(back.positions, moved.positions, atol=0.51 * 6 / 65535)
    np.testing.assert_allclose(back.require_uvs(), moved.require_uvs(), atol=0.51 / 65535)
    np.testing.assert_allclose(
        np.array(back.colours), np.array(moved.colours), atol=13 * 0.51 / 65535
    )  # the slope of sRGB near 0
    np.testing.assert_array_equal(back.faces, moved.faces)
    np.testing.assert_allclose(np.array(back.texture), np.array(moved.texture), atol=0 if picture == "png" else 4)
    save(tmp_path / "b.glb", Meshes((moved,)), up=up, quantised=True, reversible=True)
    (home,) = load(tmp_path / "b.glb", Meshes).meshes
    np.testing.assert_array_equal(home.positions, back.positions)


def test_another_program_finds_quantised_meshes_where_they_are(tmp_path: Path) -> None:
    moved = replace(
        WRAPPED, positions=(WRAPPED.positions * [1, 3, 0.2] + [5, -7, 0.1]).astype(np.float32), colours=None
    )
    save(tmp_path / "a.glb", Meshes((moved,)), quantised=True)
    found: Any = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    np.testing.assert_allclose(found.vertices, moved.positions, atol=0.51 * 6 / 65535)
    np.testing.assert_array_equal(found.faces, moved.faces)


UTM = np.array([453000.125, 5012345.5, 120.25])


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("quantised", [False, True])
def test_another_program_finds_meshes_on_a_map_to_the_micrometre(up: Any, quantised: bool, tmp_path: Path) -> None:
    two = Meshes((cube(0.3), cube(0.7)), origin=UTM)
    save(tmp_path / "a.glb", two, up=up, quantised=quantised, reversible=True)
    found: Any = trimesh.load(tmp_path / "a.glb", process=False)
    places = np.concatenate([mesh.positions for mesh in two.meshes]) + UTM
    turned = places if up == "y" else places[:, [0, 2, 1]] * [1, 1, -1]
    theirs = np.concatenate([mesh.vertices for mesh in sorted(found.dump(), key=lambda mesh: mesh.extents[0])])
    np.testing.assert_allclose(theirs, turned, rtol=0, atol=2e-5 if quantised else 1e-6)
    back = load(tmp_path / "a.glb", Meshes)
    ours = np.concatenate([mesh.positions for mesh in back.meshes]) + back.origin
    np.testing.assert_allclose(ours, places, rtol=0, atol=2e-5 if quantised else 1e-6)
    assert 0 < np.abs(back.origin - UTM).max() < 2


def test_a_node_far_from_0_keeps_its_digits() -> None:
    found = decoded(glb(document(nodes=[{"mesh": 0, "translation": (UTM + 0.1).tolist()}]), BODY))
    np.testing.assert_allclose(found.meshes[0].positions + found.origin, CORNERS + UTM + 0.1, rtol=0, atol=1e-6)
    near = decoded(glb(document(nodes=[{"mesh": 0, "translation": [3.3, 0, 0]}]), BODY))
    assert not near.origin.any()
    np.testing.assert_array_equal(near.meshes[0].positions, (CORNERS + np.array([3.3, 0, 0])).astype(np.float32))


def test_normals_point_outwards_and_have_no_seam(tmp_path: Path) -> None:
    split = replace(WRAPPED, positions=np.tile(BALL.positions, (2, 1)), uvs=None, texture=None, colours=None)
    split = replace(
        split,
        faces=BALL.faces + np.uint32(len(BALL.positions)) * (np.arange(len(BALL.faces)) % 2)[:, None].astype(np.uint32),
    )
    for quantised in (False, True):
        save(tmp_path / "a.glb", Meshes((split,)), lit=True, quantised=quantised, force=True)
        found = Document(memoryview((tmp_path / "a.glb").read_bytes()))
        index = found.root["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]
        normals = found.accessor(index, ("VEC3",))
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=0.01)
        assert ((normals * split.positions).sum(axis=1) > 0.98).all()
        first, second = np.split(normals, 2)
        np.testing.assert_array_equal(first, second)


def test_quantisation_halves_the_geometry_and_more() -> None:
    ball = sphere(64, 128)
    scene = Meshes((replace(ball, uvs=np.clip((ball.positions[:, :2] + 1) / 2, 0, 1)),))
    plain, small = (len(b"".join(glb_format.encode(scene, quantised=quantised))) for quantised in (False, True))
    assert small < 0.55 * plain


def test_coordinates_beyond_the_texture_stay_floats() -> None:
    scene = Meshes((replace(WRAPPED, uvs=WRAPPED.require_uvs() * 3),))
    (back,) = decoded(b"".join(glb_format.encode(scene, quantised=True))).meshes
    np.testing.assert_array_equal(back.uvs, WRAPPED.require_uvs() * 3)


@pytest.mark.parametrize("asset", [None, [], {}, {"extras": "z"}, {"extras": {"nerfbake_up": ["z"]}}])
def test_odd_extras_turn_nothing(asset: Any) -> None:
    (one,) = decoded(glb(document(asset=asset), BODY)).meshes
    np.testing.assert_array_equal(one.positions, CORNERS)


def test_a_viewer_without_levels_of_detail_shows_the_finest(tmp_path: Path) -> None:
    coarse = (sphere(5, 8), sphere(3, 4))
    save(tmp_path / "a.glb", Meshes((WRAPPED,), coarse), quantised=True)
    whole, _ = parts((tmp_path / "a.glb").read_bytes())
    assert whole["nodes"][0]["extensions"] == {"MSFT_lod": {"ids": [1, 2]}}
    assert (whole["scenes"], "MSFT_lod" in whole["extensionsUsed"]) == ([{"nodes": [0]}], True)
    assert "MSFT_lod" not in whole["extensionsRequired"]
    (back,) = load(tmp_path / "a.glb", Meshes).meshes
    np.testing.assert_array_equal(back.faces, WRAPPED.faces)
    found: Any = trimesh.load(tmp_path / "a.glb", process=False)
    assert [len(mesh.faces) for mesh in found.geometry.values()] == [len(WRAPPED.faces)] or len(
        found.graph.nodes_geometry
    ) == 1
    with pytest.raises(NerfbakeError, match="levels of detail belong to 3 meshes; allowed: a single mesh"):
        Meshes(painted().meshes, coarse)


def test_many_vertices_need_long_indices() -> None:
    for rings, component in ((510, 5123), (514, 5125)):
        content = b"".join(glb_format.encode(Meshes((sphere(rings, 128),)), quantised=True))
        whole, _ = parts(content)
        assert whole["accessors"][1]["componentType"] == component
        np.testing.assert_array_equal(decoded(content).meshes[0].faces, sphere(rings, 128).faces)


def test_another_writers_glb_with_turned_and_scaled_parts(tmp_path: Path) -> None:
    writer: Any = trimesh
    scene = writer.Scene()
    ball = sphere(6, 8)
    turn = writer.transformations.rotation_matrix(0.7, [1, 2, 3])
    turn[:3, 3] = [1, 2, 3]
    turn[:3, :3] *= 0.5
    plain = writer.Trimesh(ball.positions, ball.faces, process=False)
    material = writer.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(TEXELS).convert("RGBA"))
    flat = square(half=1.0)
    assert flat.uvs is not None
    visual = writer.visual.TextureVisuals(uv=flat.uvs * [1, -1] + [0, 1], material=material)
    scene.add_geometry(plain, node_name="a", transform=turn)
    scene.add_geometry(writer.Trimesh(flat.positions, flat.faces, visual=visual, process=False), node_name="b")
    (tmp_path / "other.glb").write_bytes(scene.export(file_type="glb"))
    back = load(tmp_path / "other.glb", Meshes)
    first, second = back.meshes
    np.testing.assert_allclose(first.positions, ball.positions @ turn[:3, :3].T + turn[:3, 3], atol=1e-6)
    np.testing.assert_array_equal(first.faces, ball.faces)
    np.testing.assert_allclose(second.require_uvs(), flat.uvs, atol=1e-6)
    np.testing.assert_array_equal(second.texture, TEXELS)


def glb(document: Any, body: bytes = b"") -> bytes:
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    total = 12 + 8 + len(text) + 8 + len(body)
    head = struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(body), b"BIN\0") + body


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
INDICES = np.array([0, 1, 2, 3], np.uint16)


def document(**changes: Any) -> dict[str, Any]:
    """A triangle, with some of its entries changed."""
    views = [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 8}]
    found: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": 56}],
    }
    return found | changes


BODY = CORNERS.tobytes() + INDICES.tobytes()


def decoded(content: bytes) -> Meshes:
    return glb_format.decode(memoryview(content))


def primitive(**changes: Any) -> list[dict[str, Any]]:
    return [{"primitives": [{"attributes": {"POSITION": 0}, **changes}]}]


@pytest.mark.parametrize(
    ("changes", "faces"),
    [
        ({}, [[0, 1, 2]]),
        ({"meshes": primitive()}, [[0, 1, 2]]),
        ({"meshes": primitive(mode=5)}, [[0, 1, 2], [3, 2, 1]]),
        ({"meshes": primitive(mode=6)}, [[0, 1, 2], [0, 2, 3]]),
        ({"nodes": [{"mesh": 0, "scale": [-1, 1, 1]}]}, [[2, 1, 0]]),
        ({"scenes": []}, [[0, 1, 2]]),
    ],
)
def test_every_way_to_spell_triangles(changes: dict[str, Any], faces: list[list[int]]) -> None:
    (one,) = decoded(glb(document(**changes), BODY)).meshes
    np.testing.assert_array_equal(one.faces, faces)


def test_nodes_stand_in_one_another() -> None:
    # Column-major: the last four numbers are the translation.
    matrix = [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 10, 0, 0, 1]
    half = np.sqrt(0.5)
    nodes = [{"children": [1], "matrix": matrix}, {"mesh": 0, "rotation": [0, 0, half, half], "translation": [0, 0, 1]}]
    (one,) = decoded(glb(document(nodes=nodes), BODY)).meshes
    # A quarter turn around z takes x to y and y to -x.
    np.testing.assert_allclose(one.positions, [[10, 0, 2], [10, 2, 2], [8, 0, 2], [8, 2, 2]], atol=1e-6)


def test_a_node_that_moves_nothing_leaves_every_bit_but_a_zeros_sign() -> None:
    corners = np.array([[-0.0, 1 / 3, 0.1], [1e-40, -2.5, -0.0], [3e38, 0, 0], [1, 1, 1]], np.float32)
    corners[2] /= 1e30
    body = corners.tobytes() + INDICES.tobytes()
    still, moved = (
        decoded(glb(document(nodes=[{"mesh": 0, **moves}]), body)).meshes[0].positions
        for moves in ({}, {"translation": [0, 0, 0.0]})
    )
    expected = corners + np.float32(0)
    assert still.tobytes() == moved.tobytes() == expected.tobytes()
    assert not np.signbit(still[0, 0])


def test_colours_are_turned_from_linear_light() -> None:
    look = {"pbrMetallicRoughness": {"baseColorFactor": [0.2140411, 1, 0, 1]}}
    content = glb(document(materials=[look], meshes=primitive(material=0)), BODY)
    colours: Any = decoded(content).meshes[0].colours
    np.testing.assert_allclose(colours, [[0.5, 1, 0]] * 4, atol=1e-6)


def accessor(**changes: Any) -> dict[str, Any]:
    return {"accessors": [document()["accessors"][0] | changes, document()["accessors"][1]]}


def image(textures: Any = None, **entry: Any) -> dict[str, Any]:
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    uvs = {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC2"}
    return {
        "materials": [material],
        "textures": textures or [{"source": 0}],
        "images": [entry],
        "accessors": [*document()["accessors"], uvs],
        "meshes": primitive(material=0, attributes={"POSITION": 0, "TEXCOORD_0": 2}),
    }


CORNER_UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


def textured(reference: dict[str, Any], uvs: npt.NDArray[Any] = CORNER_UVS, **changes: Any) -> bytes:
    """A triangle whose material is `reference`, to a texture of one texel, with texture coordinates of any type."""
    file = io.BytesIO()
    Image.new("RGB", (1, 1), (9, 8, 7)).save(file, "PNG")
    pieces = [BODY, uvs.tobytes(), file.getvalue()]
    views = document()["bufferViews"]
    views += [
        {"buffer": 0, "byteOffset": len(b"".join(pieces[:k])), "byteLength": len(piece)}
        for k, piece in enumerate(pieces)
        if k
    ]
    entry = image(bufferView=3) | {"materials": [reference], "bufferViews": views}
    entry["accessors"][2] |= {"bufferView": 2, "componentType": {"f": 5126, "u": 5123}[uvs.dtype.kind]}
    return glb(document(**(entry | changes)), b"".join(pieces))


def moved(**transform: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": {MOVED: transform}}}}


MOVED, GLOSSY = "KHR_texture_transform", "KHR_materials_pbrSpecularGlossiness"


@pytest.mark.parametrize(
    ("transform", "wanted"),
    [
        ({}, [[0, 1], [1, 1], [1, 0], [0, 0]]),
        ({"scale": [0.5, 2]}, [[0, 2], [0.5, 2], [0.5, 0], [0, 0]]),
        ({"offset": [3, -1], "scale": [1, 2]}, [[3, 1], [4, 1], [4, -1], [3, -1]]),
        # The example of the extension: the lower left quadrant of the picture, rotated clockwise by 90 degrees.
        (
            {"offset": [0, 1], "rotation": 1.57079632679, "scale": [0.5, 0.5]},
            [[0.5, 1], [0.5, 0.5], [0, 0.5], [0, 1]],
        ),
        # The scale comes first: with (2, 1) and a quarter turn, 2 ends up along v.
        ({"rotation": np.pi / 2, "scale": [2, 1]}, [[1, 0], [1, -2], [0, -2], [0, 0]]),
    ],
)
def test_texture_coordinates_are_transformed(transform: dict[str, Any], wanted: Any) -> None:
    required: dict[str, Any] = {"extensionsUsed": [MOVED], "extensionsRequired": [MOVED]}
    for more in ({}, required):
        (found,) = decoded(textured(moved(**transform), **more)).meshes
        np.testing.assert_allclose(found.require_uvs(), wanted, atol=1e-6)
        assert found.texture is not None


def test_integers_become_texture_coordinates_by_their_transform() -> None:
    """Gltfpack writes them so."""
    content = textured(moved(offset=[0.25, 0], scale=[1 / 4095] * 2), (CORNER_UVS * 4095).astype(np.uint16))
    (found,) = decoded(content).meshes
    np.testing.assert_allclose(found.require_uvs(), CORNER_UVS + np.array([0.25, 0]), atol=1e-7)


def test_a_transform_may_choose_other_texture_coordinates() -> None:
    attributes = {"POSITION": 0, "TEXCOORD_7": 2}
    look = moved(texCoord=7)
    look["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 0
    (found,) = decoded(textured(look, meshes=primitive(material=0, attributes=attributes))).meshes
    np.testing.assert_array_equal(found.require_uvs(), CORNER_UVS)


@pytest.mark.parametrize("required", [[], [GLOSSY]])
def test_an_older_materials_base_colour_is_its_diffuse_colour(required: list[str]) -> None:
    older = {"diffuseTexture": {"index": 0}, "diffuseFactor": [0.2140411, 1, 0, 1]}
    look = {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}, "extensions": {GLOSSY: older}}
    (found,) = decoded(textured(look, extensionsUsed=[GLOSSY], extensionsRequired=required)).meshes
    np.testing.assert_array_equal(found.texture, [[[9, 8, 7]]])
    np.testing.assert_allclose(np.array(found.colours), [[0.5, 1, 0]] * 4, atol=1e-6)


@pytest.mark.parametrize("size", [1, 1.5, 1e200, 1e-200])
def test_a_rotation_of_any_length_only_turns(size: float) -> None:
    (found,) = decoded(glb(document(nodes=[{"mesh": 0, "rotation": [0, 0, size, size]}]), BODY)).meshes
    np.testing.assert_allclose(found.positions, [[0, 0, 0], [0, 1, 0], [-1, 0, 0], [-1, 1, 0]], atol=1e-6)


def test_a_picture_may_be_in_a_data_uri() -> None:
    file = io.BytesIO()
    Image.new("RGB", (1, 1), (1, 2, 3)).save(file, "PNG")
    uri = "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
    look = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    (found,) = decoded(textured(look, images=[{"uri": uri}])).meshes
    np.testing.assert_array_equal(found.texture, [[[1, 2, 3]]])


def test_sparse_accessors_replace_entries_of_an_accessor_or_of_zeros() -> None:
    order = np.array([1, 3], np.uint16).tobytes()
    moved = np.array([[5, 6, 7], [8, 9, 10]], np.float32)
    views = document()["bufferViews"]
    views += [{"buffer": 0, "byteOffset": 56, "byteLength": 4}, {"buffer": 0, "byteOffset": 60, "byteLength": 24}]
    part = {"count": 2, "indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 3}}
    body = BODY + order + moved.tobytes()
    wanted = CORNERS.copy()
    wanted[[1, 3]] = moved
    (found,) = decoded(glb(document(bufferViews=views, **accessor(sparse=part)), body)).meshes
    np.testing.assert_array_equal(found.positions, wanted)
    zeros = document(bufferViews=views, **accessor(sparse=part))
    del zeros["accessors"][0]["bufferView"]
    (found,) = decoded(glb(zeros, body)).meshes
    np.testing.assert_array_equal(found.positions, [[0, 0, 0], moved[0], [0, 0, 0], moved[1]])


@pytest.mark.parametrize("kind", ["octet-stream", "gltf-buffer"])
def test_a_buffer_may_be_in_a_data_uri(kind: str) -> None:
    uri = f"data:application/{kind};base64,{base64.b64encode(BODY).decode()}"
    (found,) = decoded(glb(document(buffers=[{"uri": uri, "byteLength": len(BODY)}]))).meshes
    np.testing.assert_array_equal(found.positions, CORNERS)


def test_the_container_of_sloppy_writers() -> None:
    text = json.dumps(document()).encode()
    padded = glb(text + bytes(-len(text) % 4), BODY)  # zeros instead of spaces
    odd = glb({"asset": {}}) + b"later"
    np.testing.assert_array_equal(decoded(padded + b"\n").meshes[0].positions, CORNERS)
    with pytest.raises(NerfbakeError, match="has no faces"):
        decoded(odd.replace(b"BIN\0", b"ODD\0"))


def test_texture_coordinates_that_are_not_numbers_are_told() -> None:
    uvs = CORNER_UVS.copy()
    uvs[1] = np.nan
    found = decoded(textured(moved(), uvs))
    np.testing.assert_array_equal(found.meshes[0].require_uvs()[1], [0, 0])
    assert found.notes == ("texture coordinates that are not numbers are 0",)


def test_copies_that_are_not_read_are_told() -> None:
    node = {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}}}
    told = "copies by EXT_mesh_gpu_instancing are not read: each mesh is read once"
    assert decoded(glb(document(nodes=[node]), BODY)).notes == (told,)


def test_poses_that_are_not_applied_are_told() -> None:
    assert decoded(glb(document(), BODY)).notes == ()
    assert decoded(glb(document(nodes=[{"mesh": 0, "skin": 0}]), BODY)).notes == (
        "skins are not read: the mesh has the pose that it was modelled in",
    )
    shapes = [{**primitive(targets=[{"POSITION": 0}])[0], "weights": [0, 0.5]}]
    assert decoded(glb(document(meshes=shapes), BODY)).notes == (
        "morph targets are not read: the mesh has its basic shape",
    )
    at_rest = [{**shapes[0], "weights": [0, 0]}, 5, {"weights": 5}]
    assert decoded(glb(document(meshes=at_rest), BODY)).notes == ()


def deep(depth: int) -> dict[str, Any]:
    return {"nodes": [{"children": [i + 1]} for i in range(depth)] + [{"children": [0]}]}


NAN = struct.pack("<f", np.nan) + BODY[4:]
DRACO = "KHR_draco_mesh_compression"
NO_DATA = {"accessors": [{"componentType": 5126, "count": 4, "type": "VEC3"}, document()["accessors"][1]]}
# The indices and the values are the first bytes of the other views.
REPLACED = {"count": 4, "indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 0}}
LIES: dict[str, tuple[bytes, str]] = {
    "no glTF": (b"glTF", "is not a .glb"),
    "version 1": (glb(document(), BODY).replace(b"\x02\0\0\0", b"\x01\0\0\0", 1), "has version 1"),
    "longer than it is": (glb(document(), BODY)[:-1], "declares"),
    "no JSON": (glb(b"{"), "JSON chunk cannot be parsed"),
    "deep JSON": (glb(b"[" * 100_000), "JSON chunk cannot be parsed"),
    "a list": (glb([]), "JSON chunk holds a list"),
    "nothing": (glb({}), "has no faces; allowed: at least one triangle"),
    "no primitives": (glb(document(meshes=[{"primitives": []}]), BODY), "has no faces"),
    "only lines": (glb(document(meshes=primitive(mode=1)), BODY), "has no faces"),
    "two corners": (glb(document(meshes=primitive(mode=5), **accessor(count=2)), BODY), "has no faces"),
    "a node that is its own child": (glb(document(nodes=[{"children": [0]}]), BODY), "is in the scene twice"),
    "a ring of nodes": (glb(document(**deep(5000)), BODY), "is in the scene twice"),
    "no such node": (glb(document(scenes=[{"nodes": [7]}]), BODY), "nodes have no entry 7"),
    "a node of text": (glb(document(nodes=["mesh"]), BODY), "nodes[0] is a str"),
    "no such mesh": (glb(document(nodes=[{"mesh": -1}]), BODY), "meshes have no entry -1"),
    "a short matrix": (glb(document(nodes=[{"mesh": 0, "matrix": [1]}]), BODY), "nodes[0].matrix is not a"),
    "text as a scale": (glb(document(nodes=[{"mesh": 0, "scale": ["2", "2", "2"]}]), BODY), "nodes[0].scale is not a"),
    "a true scale": (glb(document(nodes=[{"mesh": 0, "scale": [True] * 3}]), BODY), "nodes[0].scale is not a list"),
    "no rotation": (
        glb(document(nodes=[{"mesh": 0, "rotation": [0, 0, 0, 0.0]}]), BODY),
        "nodes[0].rotation has length 0; allowed: a quaternion of length 1",
    ),
    "an endless rotation": (glb(b'{"nodes": [{"rotation": [0, 0, 0, 1e999]}]}'), "JSON chunk cannot be parsed"),
    "a true colour": (
        textured({"pbrMetallicRoughness": {"baseColorFactor": [True, "0.5", 0, 1]}}),
        "materials[0].pbrMetallicRoughness.baseColorFactor is not a list of numbers; allowed: 4 finite numbers",
    ),
    "a transform of text": (
        textured(moved(scale=["1", 1])),
        "baseColorTexture.extensions.KHR_texture_transform.scale is not a list of numbers; allowed: 2 finite numbers",
    ),
    "a transform that is none": (
        textured({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": {MOVED: 5}}}}),
        "baseColorTexture.extensions.KHR_texture_transform is a number; allowed: an object",
    ),
    "a rotation of text": (textured(moved(rotation="x")), "KHR_texture_transform.rotation is x; allowed: a number"),
    "coordinates by no number": (textured(moved(texCoord=-1)), "KHR_texture_transform.texCoord is -1"),
    "coordinates far away": (textured(moved(scale=[1e300, 1])), "mesh uvs[1, 0] is inf"),
    "no positions": (glb(document(meshes=primitive(attributes={})), BODY), "accessors have no entry None"),
    "terabytes": (glb(document(**accessor(count=1 << 39)), BODY), "accessors[0] has 549,755,813,888 entries"),
    "no corners": (glb(document(**accessor(count=0)), BODY), "accessors[0] has 0 entries"),
    "a negative offset": (glb(document(**accessor(byteOffset=-12)), BODY), "accessors[0].byteOffset is -12"),
    "past its view": (glb(document(**accessor(byteOffset=12)), BODY), "up to byte 60"),
    "a view past the end": (glb(document(), BODY[:50]), "ends at byte 56"),
    "a flat stride": (
        glb(document(bufferViews=[{"buffer": 0, "byteLength": 48, "byteStride": 1}] * 2), BODY),
        "accessors[0] has 4 entries",
    ),
    "text as positions": (glb(document(**accessor(type="TEXT")), BODY), "accessors[0] is TEXT of 5126"),
    "a list as a type": (glb(document(**accessor(componentType=[])), BODY), "accessors[0] is VEC3 of []"),
    "sparse": (glb(document(**accessor(sparse={})), BODY), "accessors[0].sparse.count is None"),
    "sparse of nothing": (
        glb(document(**accessor(sparse={"count": 1})), BODY),
        "accessors[0].sparse has no indices or values; allowed: indices of 5121, 5123 or 5125, and values",
    ),
    "sparse beyond": (
        glb(document(**accessor(count=3, sparse=REPLACED)), BODY),
        "accessors[0].sparse.indices go to 3; allowed: 0 to 2",
    ),
    "sparse behind the end": (
        glb(document(**accessor(sparse=REPLACED | {"count": 1000})), BODY),
        "accessors[0].sparse.indices has 1,000 entries, up to byte 2,000",
    ),
    "terabytes of zeros": (
        glb(document(accessors=[{"componentType": 5126, "count": 1 << 39, "type": "VEC3"}] * 2), BODY),
        "accessors[0] has 549,755,813,888 entries without a bufferView; allowed: 1 to 5,592,405, which are zeros",
    ),
    "Draco, not required": (
        glb(document(meshes=primitive(extensions={DRACO: {}}), **NO_DATA), BODY),
        f"primitives[0] needs {DRACO}; allowed: triangles without this compression",
    ),
    "another file": (glb(document(buffers=[{"uri": "/etc/passwd"}]), BODY), "is in another file"),
    "a picture elsewhere": (glb(document(**image(uri="file:///etc/passwd")), BODY), "images[0] is in another file"),
    "no picture": (glb(document(**image(bufferView=0)), BODY), "images[0] cannot be read"),
    "WebP by no number": (
        glb(document(**image([{"extensions": {"EXT_texture_webp": {"source": "x"}}}], bufferView=0)), BODY),
        "textures[0].extensions.EXT_texture_webp.source is x",
    ),
    "WebP that is none": (
        glb(document(**image([{"extensions": {"EXT_texture_webp": {"source": 0}}}], bufferView=0)), BODY),
        "images[0] cannot be read",
    ),
    "no source": (glb(document(**image([{"extensions": 5}], bufferView=0)), BODY), "textures[0].source is None"),
    "a picture that only an extension has": (
        glb(document(**image([{"extensions": {"KHR_texture_basisu": {"source": 0}}}], bufferView=0)), BODY),
        "textures[0] needs KHR_texture_basisu; allowed: a picture in PNG, JPEG or WebP",
    ),
    "a picture of no number": (glb(document(**image(uri=5)), BODY), "images[0] is in another file"),
    "a damaged data URI": (
        glb(document(**image(uri="data:image/png;base64,=")), BODY),
        "images[0] has a data URI that is damaged",
    ),
    "a data URI that is no picture": (
        glb(document(**image(uri="data:image/png;base64,AAAA")), BODY),
        "images[0] cannot be read",
    ),
    "Draco": (glb(document(extensionsRequired=["KHR_draco_mesh_compression"]), BODY), "has KHR_draco_mesh"),
    "required by number": (glb(document(extensionsRequired=5), BODY), "JSON.extensionsRequired is a int"),
    "a corner too many": (glb(document(), BODY[:-8] + b"\x09\0" * 4), "mesh faces[0, 0] is 9; allowed: a"),
    "NaN": (glb(document(), NAN), "mesh positions[0, 0] is nan"),
    "far away": (glb(document(nodes=[{"mesh": 0, "scale": [1e300] * 3}]), BODY), "mesh positions[1, 0] is inf"),
}  # fmt: skip


@pytest.mark.parametrize("name", ["KHR_lights_punctual", "KHR_materials_sheen", "KHR_xmp_json_ld"])
def test_an_extension_that_changes_no_triangle_may_be_required(name: str) -> None:
    plain, more = (
        glb_format.decode(memoryview(glb(document(**with_it), BODY)))
        for with_it in (
            {},
            {
                "extensionsRequired": [name],
                "extensionsUsed": [name],
                "extensions": {name: {"lights": [{"type": "sun"}]}},
            },
        )
    )
    np.testing.assert_array_equal(more.meshes[0].positions, plain.meshes[0].positions)


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_glb_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, named = LIES[lie]
    assert named in refused_as_it_is(tmp_path / "bad.glb", content, capsys)


def test_a_mesh_that_many_nodes_show_stays_within_max_memory() -> None:
    content = glb(document(nodes=[{"mesh": 0}] * 2000, scenes=[{"nodes": list(range(2000))}]), BODY)
    with pytest.raises(NerfbakeError, match="needs"), memory_limit(500_000):
        glb_format.decode(memoryview(content))
    assert len(decoded(content).meshes) == 2000


ODD: tuple[Any, ...] = (None, True, -1, 7, 1e300, 10**30, "x", [], [None], [[0]], {}, {"x": 0}, float("nan"))


def with_odd_values(value: Any) -> Iterator[Any]:
    """The document once for every value in it and every odd value in its place."""
    yield from ODD
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, entry in list(entries):
        for odd in with_odd_values(entry):
            changed = copy.copy(value)
            changed[key] = odd
            yield changed


def test_any_value_anywhere_is_refused_or_harmless(tmp_path: Path) -> None:
    save(tmp_path / "a.glb", painted())
    whole, body = parts((tmp_path / "a.glb").read_bytes())
    transform = {"offset": [0, 0], "rotation": 0, "scale": [1, 1], "texCoord": 0}
    reference = whole["materials"][2]["pbrMetallicRoughness"]["baseColorTexture"]
    reference["extensions"] = {MOVED: transform}
    older = {"diffuseTexture": reference, "diffuseFactor": [1, 1, 1, 1]}
    whole["materials"][1]["extensions"] = {GLOSSY: older}
    whole["nodes"][0] |= {"children": [], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
    whole["nodes"][1] |= {"matrix": np.eye(4).reshape(-1).tolist()}
    refused = 0
    for changed in with_odd_values(whole):
        try:
            decoded(glb(changed, body))
        except NerfbakeError:
            refused += 1
    assert refused > 500


def test_a_stream_is_known_by_its_first_bytes() -> None:
    assert glb_format.recognise(memoryview(glb({})))
    assert not glb_format.recognise(memoryview(b"v 0 0 0\n"))


def test_a_material_is_two_textures_and_the_albedo_is_read_again() -> None:
    albedo, own = np.full((4, 4, 3), 90, np.uint8), np.full((4, 4, 2), (64, 200), np.uint8)
    scene = Meshes((replace(square(), texture=albedo, material=own),))
    document = Document(memoryview(b"".join(glb_format.encode(scene))))
    (material,) = document.root["materials"]
    specular = material["extensions"]["KHR_materials_specular"]["specularTexture"]["index"]
    surface = material["pbrMetallicRoughness"]
    assert (surface["metallicFactor"], surface["roughnessFactor"]) == (0, 1)
    assert document.root["extensionsUsed"] == ["KHR_materials_specular"]
    assert "NORMAL" in document.root["meshes"][0]["primitives"][0]["attributes"]

    def pixel(index: int) -> Any:
        image = document.item("images", document.item("textures", index)["source"])
        return Image.open(io.BytesIO(document.view(image["bufferView"]))).getpixel((0, 0))

    assert pixel(surface["metallicRoughnessTexture"]["index"]) == (0, 64, 0)
    assert pixel(specular) == (255, 255, 255, 200)
    (again,) = glb_format.decode(memoryview(b"".join(glb_format.encode(scene)))).meshes
    np.testing.assert_array_equal(again.texture, albedo)


@pytest.mark.parametrize(
    ("packed", "name"), [(CUBE, b"EXT_meshopt_compression"), (CUBE_KHR, b"KHR_meshopt_compression")]
)
def test_a_file_of_gltfpack_is_read(packed: str, name: bytes) -> None:
    """Streams of meshoptimizer, in which nothing is left in the buffer that the views name, and quantised positions."""
    data = base64.b64decode(packed)
    assert b'"%b"' % name in data
    assert b'"KHR_mesh_quantization"' in data
    (found,) = glb_format.decode(memoryview(data)).meshes
    corners, expected = (np.unique(np.round(mesh.positions, 3), axis=0) for mesh in (found, cube()))
    np.testing.assert_allclose(corners, expected, atol=1e-3)
    assert len(found.faces) == len(cube().faces)
    volumes = [float(np.linalg.det(mesh.positions[mesh.faces]).sum()) / 6 for mesh in (found, cube())]
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-3)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"count": 1 << 30}, "EXT_meshopt_compression declares"),
        ({"buffer": 9}, "buffers have no entry 9"),
        ({"byteLength": 1 << 30}, "ends at byte"),
        ({"mode": "LINES"}, "has LINES with NONE"),
        ({"byteStride": "4"}, "byteStride is 4; allowed: a whole number"),
    ],
)
def test_a_lying_stream_is_refused(fields: dict[str, Any], told: str) -> None:
    data = base64.b64decode(CUBE)
    size = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + size])
    for view in document["bufferViews"]:
        view["extensions"]["EXT_meshopt_compression"].update(fields)
    with pytest.raises(NerfbakeError, match=told):
        decoded(glb(document, data[28 + size :]))
