"""Splats in .glb: KHR_gaussian_splatting, written without loss, and read as the extension says."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from nerfbake import Meshes, Splats, load, save
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.splat import glb, spz
from nerfbake.io import check
from tests.formats.splat.test_ply import assert_same
from tests.support.hostile import refused_as_it_is
from tests.support.meshes import cube
from tests.support.splat_pictures import covariances
from tests.support.splats import gzip_spz, packed_glb, splats

NAME = "KHR_gaussian_splatting"
TO_GLTF = (-1, -1, 1)  # x left, y up, z to the front
Document = dict[str, Any]


def written(scene: Splats) -> bytes:
    return b"".join(glb.encode(scene))


def parts_of(data: bytes) -> tuple[Document, bytes]:
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def file_of(document: Document, body: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(body), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(body), b"BIN\0") + body


def changed(data: bytes, change: Callable[[Document], object]) -> bytes:
    document, body = parts_of(data)
    change(document)
    return file_of(document, body)


def decoded(data: bytes) -> Splats:
    return glb.decode(memoryview(data))


def primitive(document: Document) -> Document:
    found: Document = document["meshes"][0]["primitives"][0]
    return found


def accessor(document: Document, body: bytes, name: str) -> np.ndarray:
    """An accessor by a reader of its own."""
    entry = document["accessors"][primitive(document)["attributes"][name]]
    view = document["bufferViews"][entry["bufferView"]]
    dtype = {5126: "<f4", 5121: "u1"}[entry["componentType"]]
    raw = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(raw, dtype).reshape(entry["count"], -1)


@pytest.mark.parametrize("degree", range(4))
def test_there_and_back_without_loss(degree: int, tmp_path: Path) -> None:
    scene = splats(70, degree=degree, antialiased=degree == 2)
    save(tmp_path / "a.glb", scene)
    found = load(tmp_path / "a.glb", Splats)
    for name in ("means", "scales", "quats", "opacity", "sh"):
        assert np.array_equal(getattr(found, name), getattr(scene, name)), name
    assert found.antialiased == scene.antialiased


UTM = np.array([453000.125, 5012345.5, 120.25])


def placed(document: Document, body: bytes) -> np.ndarray:
    """The centres in the scene's coordinates, in float64, by a reader of its own."""
    found = []
    for node in document["nodes"]:
        if "mesh" in node:
            shift = np.array(node.get("translation", [0, 0, 0]), np.float64)
            found.append(accessor(document, body, "POSITION") + shift)
    return np.concatenate(found)


def test_a_node_far_from_0_keeps_its_digits(tmp_path: Path) -> None:
    scene = splats(30, degree=1)
    there = scene.means * [-1, -1, 1] + UTM  # glTF's axes
    data = changed(written(scene), lambda document: document["nodes"][0].update(translation=UTM.tolist()))
    found = decoded(data)
    np.testing.assert_allclose(found.means + found.origin, there * [-1, -1, 1], rtol=0, atol=1e-6)
    save(tmp_path / "a.glb", found)
    np.testing.assert_allclose(placed(*parts_of((tmp_path / "a.glb").read_bytes())), there, rtol=0, atol=1e-6)
    clouds: Any = trimesh.load(tmp_path / "a.glb")  # trimesh reads the points without the extension
    (points,) = (part.vertices for part in clouds.dump())
    np.testing.assert_allclose(points, there, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(load(tmp_path / "a.glb", Splats).origin, found.origin)


def test_nodes_share_one_origin_and_compose_in_float64() -> None:
    scene = splats(30, degree=1)

    def place(document: Document) -> None:
        document["nodes"] = [
            {"children": [1, 2], "translation": UTM.tolist(), "scale": [2, 2, 2]},
            {"mesh": 0},
            {"mesh": 0, "translation": [0.5, 0, 1.25], "rotation": [0, 1, 0, 0]},
        ]

    found = decoded(changed(written(scene), place))
    own = scene.means * [-1, -1, 1]
    there = np.concatenate([2 * own, 2 * (own * [-1, 1, -1] + [0.5, 0, 1.25])]) + UTM
    np.testing.assert_allclose(found.means + found.origin, there * [-1, -1, 1], rtol=0, atol=1e-5)
    assert np.abs(found.origin - UTM * [-1, -1, 1]).max() < 10


def test_a_node_near_0_or_without_digits_is_read_as_before() -> None:
    scene = splats(30, degree=0)
    for shift in ([3.3, 0, 1 / 3], [0, 0, 0], [1e308, 0, 0]):
        document, body = parts_of(written(scene))
        document["nodes"] = [{"mesh": 0, "translation": shift}]
        found = decoded(file_of(document, body))
        assert not found.origin.any()
    assert len(found.problems()) == 1


def test_what_the_file_says_by_hand() -> None:
    sh = np.arange(12, dtype=np.float32).reshape(1, 4, 3)
    scene = Splats(
        np.array([[1, 2, 3]], np.float32),
        np.array([[4, 5, 6]], np.float32),
        np.array([[0.5, 0.5, 0.5, 0.5]], np.float32),
        np.full(1, 0.5, np.float32),
        sh,
    )
    document, body = parts_of(written(scene))
    assert document["extensionsUsed"] == [NAME]
    assert primitive(document)["mode"] == 0
    assert primitive(document)["extensions"][NAME] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    # x is left, y up and z forward in glTF: the world's x points right and its y down.
    expected = {
        "POSITION": [-1, -2, 3],
        f"{NAME}:ROTATION": [-0.5, -0.5, 0.5, 0.5],  # x y z w
        f"{NAME}:SCALE": [4, 5, 6],
        f"{NAME}:OPACITY": [0.5],
        f"{NAME}:SH_DEGREE_0_COEF_0": [0, 1, 2],
        f"{NAME}:SH_DEGREE_1_COEF_0": [-3, -4, -5],  # of y
        f"{NAME}:SH_DEGREE_1_COEF_1": [6, 7, 8],  # of z
        f"{NAME}:SH_DEGREE_1_COEF_2": [-9, -10, -11],  # of x
        "COLOR_0": [round(0.214 * 255), round(0.574 * 255), 255, 128],  # 1/2 and 0.782 and more than 1, linear
    }
    assert {name: accessor(document, body, name)[0].tolist() for name in primitive(document)["attributes"]} == expected
    bounds = document["accessors"][0]
    assert (bounds["min"], bounds["max"]) == ([-1, -2, 3], [-1, -2, 3])
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])


def test_a_mesh_is_read_as_a_mesh_and_splats_as_splats(tmp_path: Path) -> None:
    save(tmp_path / "mesh.glb", Meshes((cube(),)))
    save(tmp_path / "splats.glb", splats(3))
    assert isinstance(load(tmp_path / "mesh.glb"), Meshes)
    assert isinstance(load(tmp_path / "splats.glb"), Splats)
    with pytest.raises(
        InvalidFile, match=r"holds Gaussian splats \(`nerfbake mesh` makes a mesh of it\); allowed: a mesh"
    ):
        load(tmp_path / "splats.glb", Meshes)


def test_the_matrices_of_nodes_move_splats_and_colours() -> None:
    scene = splats(20, degree=3)
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]  # a reflection, or a rotation
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * turn, [1, 2, 3]

    def change(document: Document) -> None:
        document["nodes"] = [{"children": [1, 2]}, {"mesh": 0, "matrix": matrix.T.reshape(-1).tolist()}, {"mesh": 0}]

    found = decoded(changed(written(scene), change))
    moved = scene.flipped(TO_GLTF).transformed(matrix[:3]).flipped(TO_GLTF)
    assert found.n == 40
    for name in ("means", "scales", "quats", "opacity", "sh"):
        assert np.array_equal(getattr(found, name), np.concatenate([getattr(moved, name), getattr(scene, name)])), name


def test_quantised_attributes_are_read() -> None:
    scene = splats(30, degree=0)
    document, body = parts_of(written(scene))

    def replaced(name: str, values: np.ndarray, component: int, *, normalised: bool) -> None:
        nonlocal body
        view = {"buffer": 0, "byteOffset": len(body), "byteLength": values.nbytes}
        document["bufferViews"].append(view)
        entry = document["accessors"][primitive(document)["attributes"][f"{NAME}:{name}"]]
        entry |= {"bufferView": len(document["bufferViews"]) - 1, "componentType": component, "normalized": normalised}
        body += values.tobytes() + bytes(-values.nbytes % 4)

    quats = scene.flipped(TO_GLTF).quats[:, [1, 2, 3, 0]]
    replaced("ROTATION", np.rint(quats * 32767).astype("<i2"), 5122, normalised=True)
    replaced("OPACITY", np.rint(scene.opacity * 65535).astype("<u2")[:, None], 5123, normalised=True)
    document["buffers"][0]["byteLength"] = len(body)
    found = decoded(file_of(document, body))
    np.testing.assert_allclose(found.quats, scene.quats, atol=1e-4)
    np.testing.assert_allclose(found.opacity, scene.opacity, atol=1e-5)


def test_logarithms_of_an_early_draft_are_told_by_their_signs() -> None:
    scene = splats(30, degree=0)
    document, body = parts_of(written(scene))
    view = document["bufferViews"][
        document["accessors"][primitive(document)["attributes"][f"{NAME}:SCALE"]]["bufferView"]
    ]
    at = view["byteOffset"]
    early = body[:at] + np.log(scene.scales).astype("<f4").tobytes() + body[at + view["byteLength"] :]
    found = decoded(file_of(document, early))
    np.testing.assert_allclose(found.scales, scene.scales, rtol=1e-5)
    assert found.notes == ("its scales are logarithms, as in an early draft of the extension",)


def positive_logarithms(generator: str | None) -> bytes:
    """Splats of more than one unit, whose logarithms are written as their scales."""
    scene = splats(300, degree=0)
    scene = replace(scene, scales=np.log(scene.scales * 100 + np.float32(1.2)))
    asset = {"version": "2.0"} | ({} if generator is None else {"generator": generator})
    return changed(written(scene), lambda document: document.update(asset=asset))


@pytest.mark.parametrize(
    "generator", ["splat-transform 2.6.0", "splat-transform 1.9.2", "splat-transform 2.0.0-beta.1"]
)
def test_logarithms_of_early_splat_transform_are_told_by_its_name(generator: str) -> None:
    plain = decoded(positive_logarithms("splat-transform 2.7.0"))
    assert plain.notes == ()
    found = decoded(positive_logarithms(generator))
    np.testing.assert_allclose(np.log(found.scales), plain.scales, rtol=1e-4)
    assert found.notes == (f"its scales are logarithms, as {generator[:19]} wrote them",)


@pytest.mark.parametrize("generator", [None, "something", "not splat-transform 2.6.0"])
def test_scales_that_may_be_logarithms_are_a_doubt(generator: str | None) -> None:
    found = decoded(positive_logarithms(generator))
    assert np.array_equal(found.scales, decoded(positive_logarithms("nerfbake")).scales)
    (note,) = found.notes
    assert note.startswith("its scales, 0.")
    assert note.endswith(" are read as sizes, but may be the logarithms of an early draft")


def test_small_scales_are_no_doubt() -> None:
    assert (
        decoded(changed(written(splats(300)), lambda document: document.update(asset={"version": "2.0"}))).notes == ()
    )


@pytest.mark.data
def test_the_scales_of_the_report_are_a_doubt(data: Path) -> None:
    (note,) = load(data / "reports/F9_odd_meshes/logscale_big.glb", Splats).notes
    assert note == "its scales, 0.52 to 1.3, are read as sizes, but may be the logarithms of an early draft"


def test_extensions_of_meshes_that_are_left_out_may_be_required() -> None:
    names = [NAME, "KHR_texture_transform", "KHR_materials_unlit", "EXT_texture_webp"]
    data = changed(written(splats(3)), lambda document: document.update(extensionsRequired=names))
    assert_same(decoded(data), splats(3))


def test_what_is_not_as_usual_is_noted() -> None:
    scene = splats(3)
    data = changed(
        written(scene),
        lambda document: (
            primitive(document)["extensions"][NAME].update(colorSpace="lin_rec709_display"),
            document["meshes"].append({"primitives": [{"attributes": {}}]}),
            document["nodes"].append({"mesh": 1}),
            document["scenes"][0]["nodes"].append(1),
        ),
    )
    assert decoded(data).notes == (
        "its colours are linear; they are kept as they are, and look too dark",
        "meshes in the file are left out",
    )
    assert_same(decoded(data), scene)


def test_what_an_extension_also_stores_in_accessors_is_read() -> None:
    scene = splats(3)
    data = changed(
        written(scene), lambda document: primitive(document)["extensions"][NAME].update(extensions={"EXT_more": {}})
    )
    assert decoded(data).notes == ("the extension 'EXT_more' is left out",)
    assert_same(decoded(data), scene)


def test_degree_4_is_refused() -> None:
    with pytest.raises(InvalidScene, match=r"sh has degree 4; allowed: 0 to 3 in a \.glb"):
        written(splats(2, degree=4))


def test_trimesh_shows_the_splats_as_coloured_points() -> None:
    """Any reader of glTF without the extension: the container is sound, and the fallback is there."""
    scene = splats(40, degree=1)
    loaded: Any = trimesh.load(io.BytesIO(written(scene)), file_type="glb")
    (points,) = loaded.geometry.values()
    np.testing.assert_allclose(points.vertices, scene.flipped(TO_GLTF).means, atol=1e-6)
    shown = np.clip(scene.sh[:, 0] * 0.28209479 + 0.5, 0, 1)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(points.colors[:, :3], linear * 255, atol=0.51)
    np.testing.assert_allclose(points.colors[:, 3], scene.opacity * 255, atol=0.51)


def test_a_node_that_scales_unevenly_stretches_splats() -> None:
    """The ellipsoids are those of the matrix; SH turn by its rotation alone."""
    scene = splats(40, degree=3)
    scales = np.array([1.5, 0.25, 3.0])
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn * scales, [1, 2, 3]
    data = changed(written(scene), lambda document: document["nodes"][0].update(matrix=matrix.T.reshape(-1).tolist()))
    found, own = decoded(data).flipped(TO_GLTF), scene.flipped(TO_GLTF)
    np.testing.assert_allclose(found.means, own.means @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-5)
    expected = matrix[:3, :3] @ covariances(own) @ matrix[:3, :3].T
    size = np.sqrt(np.einsum("nij,nij->n", expected, expected))[:, None, None]
    np.testing.assert_allclose(covariances(found) / size, expected / size, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1, atol=1e-6)
    matrix[:3, :3] = turn
    plain = changed(written(scene), lambda document: document["nodes"][0].update(matrix=matrix.T.reshape(-1).tolist()))
    np.testing.assert_allclose(found.sh, decoded(plain).flipped(TO_GLTF).sh, atol=1e-5)


@pytest.mark.parametrize("scales", [[0, 0, 0], [1, 0, 0], [1, 1, 0], [1e-20, 1, 1e-20]])
def test_flat_splats_are_stretched_too(scales: list[float]) -> None:
    scene = splats(9, degree=0)
    scene = replace(scene, scales=np.tile(np.array(scales, np.float32), (9, 1)))
    found = decoded(changed(written(scene), lambda document: document["nodes"][0].update(scale=[1, 2, 3])))
    assert not found.problems()
    one, own = covariances(found.flipped(TO_GLTF)), covariances(scene.flipped(TO_GLTF))
    matrix = np.diag([1.0, 2, 3])
    np.testing.assert_allclose(one, matrix @ own @ matrix, atol=1e-6)


COMPRESSED = "KHR_gaussian_splatting_compression_spz_2"


@pytest.mark.parametrize(("version", "name"), [(2, COMPRESSED), (3, COMPRESSED.removesuffix("_2"))])
def test_a_spz_inside_is_turned_to_the_axes_of_gltf(version: int, name: str) -> None:
    scene = splats(30, degree=2, antialiased=True)
    data = packed_glb(scene, version, name)
    found, expected = decoded(data), spz.decode(memoryview(gzip_spz(scene, version)))
    for part in ("means", "scales", "quats", "opacity", "sh"):
        np.testing.assert_allclose(getattr(found, part), getattr(expected, part), atol=1e-6)
    assert (found.antialiased, found.notes) == (True, ())
    moved = decoded(changed(data, lambda document: document["nodes"][0].update(translation=[1, 2, 3])))
    np.testing.assert_allclose(moved.means, expected.means + np.array([-1, -2, 3]), atol=1e-6)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["accessors"][2].update(componentType=[5126]),
        lambda d: d["accessors"][2].update(type={}),
        lambda d: d["nodes"][0].update(mesh=[0]),
        lambda d: primitive(d).update(mode=[]),
        lambda d: primitive(d)["extensions"][NAME].update(kernel=[], projection={}),
        lambda d: d.update(extensionsUsed=[[], {}], extensionsRequired=[[]]),
        lambda d: d["accessors"][0].update(min=[None, "a"], max={}),
        lambda d: primitive(d)["attributes"].update({f"{NAME}:SH_DEGREE_99999999999_COEF_0": True}),
    ],
)
def test_any_type_anywhere_is_a_finding_and_not_an_error(change: Callable[[Document], object], tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(changed(written(splats(3)), change))
    assert check(tmp_path / "a.glb")


# -- hostile files ---------------------------------------------------------------------------------------------
SHEAR = [1, 0.5, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
SOUND = written(splats(9, degree=1))


def attribute(name: str, value: Any) -> bytes:
    def change(document: Document) -> None:
        attributes = primitive(document)["attributes"]
        attributes.pop(name) if value is None else attributes.update({name: value})

    return changed(SOUND, change)


def entry(index: int, **fields: Any) -> bytes:
    return changed(SOUND, lambda document: document["accessors"][index].update(fields))


def extension(**fields: Any) -> bytes:
    return changed(SOUND, lambda document: primitive(document)["extensions"][NAME].update(fields))


def compressed(change: Callable[[Document], object]) -> bytes:
    return changed(extension(extensions={"EXT_more": {}}), change)


LIES: dict[str, tuple[bytes, str]] = {
    "2^32 splats": (entry(0, count=2**32), "accessors[0] has 4,294,967,296 entries, up to byte 51,539,607,552"),
    "no POSITION": (attribute("POSITION", None), "attributes lack POSITION"),
    "no SCALE": (attribute(f"{NAME}:SCALE", None), f"lack {NAME}:SCALE"),
    "a gap in SH": (attribute(f"{NAME}:SH_DEGREE_1_COEF_2", None), f"lack {NAME}:SH_DEGREE_1_COEF_2"),
    "another type": (attribute(f"{NAME}:ROTATION", 0), "accessors[0] is VEC3 of 5126; allowed: VEC4"),
    "fewer rows": (entry(3, count=8), f"{NAME}:SCALE has 8 rows; allowed: 9, as POSITION"),
    "triangles": (changed(SOUND, lambda d: primitive(d).update(mode=4)), f"has {NAME} without points"),
    "indices": (
        changed(SOUND, lambda d: primitive(d).update(indices=0)),
        "primitives[0] has indices; allowed: splats in",
    ),
    "no object": (changed(SOUND, lambda d: primitive(d)["extensions"].update({NAME: 3})), "without points"),
    "a kernel": (extension(kernel="cube"), "kernel is cube; allowed: ellipse"),
    "a colour space": (extension(colorSpace=[]), "colorSpace is []; allowed: srgb_rec709_display or lin_rec709"),
    "compressed": (compressed(lambda d: [each.pop("bufferView") for each in d["accessors"]]), "needs EXT_more"),
    "compressed, without accessors": (compressed(lambda d: primitive(d)["attributes"].clear()), "needs EXT_more"),
    "a .spz without a view": (extension(extensions={COMPRESSED: {}}), "bufferViews have no entry None"),
    "a .spz of another kind": (extension(extensions={COMPRESSED: []}), f"{COMPRESSED} is a list; allowed: an object"),
    "no .spz": (extension(extensions={COMPRESSED: {"bufferView": 0}}), "the .spz has no whole header"),
    "required": (
        changed(SOUND, lambda document: document.update(extensionsRequired=["EXT_more"])),
        f"extensionsRequired has EXT_more; allowed: {NAME}",
    ),
    "no splats in the scene": (changed(SOUND, lambda document: document.update(nodes=[{}])), "has no splats"),
    "a node that shears": (
        changed(SOUND, lambda document: document["nodes"][0].update(matrix=SHEAR)),
        "shears, or scales the axes differently; allowed: a rotation, a reflection, and one scale",
    ),
    "a huge node": (changed(SOUND, lambda document: document["nodes"][0].update(scale=[1e300] * 3)), "the transform"),
    "cut": (SOUND[:200], "bytes"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_glb_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, told = LIES[lie]
    assert told in refused_as_it_is(tmp_path / "bad.glb", content, capsys)


def test_rows_that_cannot_be_drawn_are_left_out() -> None:
    document, body = parts_of(written(splats(9, degree=0)))
    found = decoded(file_of(document, b"\xff" * 12 + body[12:]))
    assert (found.n, found.dropped) == (8, 1)


def test_means_that_a_node_moves_too_far_are_problems() -> None:
    scene = replace(splats(3, degree=0))
    far = changed(written(scene), lambda document: document["nodes"][0].update(translation=[1e17, 0, 0]))
    assert any(problem.place.startswith("means") for problem in decoded(far).problems())
