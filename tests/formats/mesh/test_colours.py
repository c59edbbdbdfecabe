"""Colours of vertices: the same stored numbers are the same colours and notes in .obj, .ply and .glb."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Meshes, load
from nerfbake.formats.mesh import glb, obj, ply
from nerfbake.kernels.picture.metrics import from_linear
from tests.formats.mesh.test_glb import document
from tests.formats.mesh.test_glb import glb as glb_of

PLACES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
NAN, BYTES = "colours that are not numbers are grey", "colours go to 255, and are divided by 255"
CLAMPED = "colours outside 0 to 1 are clamped"
INTEGERS = "colours are integers that are not marked as normalized, and are read as if they were"
nan, inf = float("nan"), float("inf")
HALF = [0.5, 0.5, 0.5]
GREY = [0.75] * 3
# Of each case: what is stored, what is read as sRGB (of a .glb after the curve, but for grey), and the notes.
CASES: dict[str, tuple[Any, Any, tuple[str, ...]]] = {
    "sound": ([[1, 0, 0], HALF, [0, 0.25, 0]], [[1, 0, 0], HALF, [0, 0.25, 0]], ()),
    "a NaN": ([HALF, [nan, 0, 0], [0, 0, 1]], [HALF, GREY, [0, 0, 1]], (NAN,)),
    "only NaN": ([[nan] * 3] * 3, [GREY] * 3, (NAN,)),
    "rounded": ([[1.0001, 0, 0], [-1e-7, 0.5, 1], HALF], [[1, 0, 0], [0, 0.5, 1], HALF], ()),
    "too bright": ([[1.4, 1.2, 1], HALF, HALF], [[1, 1, 1], HALF, HALF], (CLAMPED,)),
    "all a little too bright": ([[1.4, 1.2, 1], [1.1, 0, 0], [1, 1, 2]], [[1, 1, 1], [1, 0, 0], [1, 1, 1]], (CLAMPED,)),
    "a lamp": ([[200, 200, 10], HALF, HALF], [[1, 1, 1], HALF, HALF], (CLAMPED,)),
    "below 0": ([[-0.01, 0, 0], HALF, HALF], [[0, 0, 0], HALF, HALF], (CLAMPED,)),
    "infinite": ([[inf, inf, 0], [-inf, 0.5, 1], HALF], [[1, 1, 0], [0, 0.5, 1], HALF], (CLAMPED,)),
    "bytes": ([[255, 0, 0], [0, 102, 0], [0, 0, 51]], [[1, 0, 0], [0, 0.4, 0], [0, 0, 0.2]], (BYTES,)),
    "fractions of bytes": ([[255, 0, 0], [0, 127.5, 0], [0, 0, 0]], [[1, 0, 0], [0, 0.5, 0], [0, 0, 0]], (BYTES,)),
    "bytes, one almost black": ([[255, 0, 0], [1, 0, 0], [0] * 3], [[1, 0, 0], [1 / 255, 0, 0], [0] * 3], (BYTES,)),
    "bytes and a NaN": ([[255, 0, 0], [nan] * 3, [51] * 3], [[1, 0, 0], GREY, [0.2] * 3], (NAN, BYTES)),
    "the largest number": ([[3e38, 0, 0], HALF, HALF], [[1, 0, 0], HALF, HALF], (CLAMPED,)),
}


def obj_of(colours: Any) -> Meshes:
    rows = [" ".join(map(str, (*place, *colour))) for place, colour in zip(PLACES.tolist(), colours, strict=True)]
    return obj.decode(memoryview("".join([*(f"v {row}\n" for row in rows), "f 1 2 3\n"]).encode()))


def ply_of(colours: Any, kind: str = "float", names: Any = ("red", "green", "blue"), stored: str = "<f4") -> Meshes:
    columns = [f"property float {axis}" for axis in "xyz"] + [f"property {kind} {name}" for name in names]
    head = ["ply", "format binary_little_endian 1.0", "element vertex 3", *columns, "element face 1"]
    head += ["property list uchar int vertex_indices", "end_header", ""]
    rows = [place.tobytes() + np.array(colour, stored).tobytes() for place, colour in zip(PLACES, colours, strict=True)]
    return ply.decode(memoryview("\n".join(head).encode() + b"".join(rows) + struct.pack("<B3i", 3, 0, 1, 2)))


def glb_with(colours: Any, stored: str = "<f4", component: int = 5126, **more: Any) -> Meshes:
    values = np.array(colours, stored)
    body = PLACES.tobytes() + values.tobytes()
    views = [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": values.nbytes}]
    parts = [
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
        {"bufferView": 1, "componentType": component, "count": 3, "type": f"VEC{values.shape[1]}", **more},
    ]
    meshes = [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}}]}]
    return glb.decode(memoryview(glb_of(document(accessors=parts, bufferViews=views, meshes=meshes), body)))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("decode", [obj_of, ply_of, glb_with])
def test_odd_colours_are_the_same_in_all_formats(decode: Callable[[Any], Meshes], case: str) -> None:
    stored, wanted, notes = CASES[case]
    found = decode(stored)
    if decode is glb_with:  # linear light
        wanted = np.where(np.array(wanted) == 0.75, 0.75, from_linear(np.array(wanted)))
    np.testing.assert_allclose(np.array(found.meshes[0].colours), wanted, atol=2e-6)
    assert found.notes == notes
    np.testing.assert_array_equal(found.meshes[0].faces, [[0, 1, 2]])


def test_integers_of_a_glb_that_lack_their_word() -> None:
    bytes_ = [[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255]]
    for component, stored, factor in ((5121, "u1", 1), (5123, "<u2", 257)):
        for more, told in (({"normalized": True}, ()), ({}, (INTEGERS,))):
            found = glb_with(np.array(bytes_) * factor, stored, component, **more)
            np.testing.assert_array_equal(found.meshes[0].colours, np.eye(3))
            assert found.notes == told
    assert glb_with(np.eye(3), "u1", 5121).notes == ()


@pytest.mark.parametrize("names", [("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")])
def test_other_names_of_colours_in_a_ply(names: tuple[str, ...]) -> None:
    found = ply_of(255 * np.eye(3), "uchar", names, "u1")
    np.testing.assert_array_equal(found.meshes[0].colours, np.eye(3))


def test_bytes_in_16_bits_of_a_ply() -> None:
    told = ("colours of 16 bits go to 255 only, and are read as those of 8 bits",)
    found = ply_of(255 * np.eye(3), "ushort", stored="<u2")
    np.testing.assert_array_equal(found.meshes[0].colours, np.eye(3))
    assert found.notes == told
    for white in (256, 65535):
        assert ply_of(white * np.eye(3), "ushort", stored="<u2").notes == ()


def test_numbers_beyond_their_type_are_clamped_without_a_warning() -> None:
    found = ply_of([[1e308, 0, 0], [0, -1e308, 1], HALF], "double", stored="<f8")
    np.testing.assert_array_equal(found.meshes[0].colours, [[1, 0, 0], [0, 0, 1], HALF])
    assert found.notes == (CLAMPED,)
    found = ply_of([[2**31 - 1, 0, 0], [-(2**31), 255, 0], [0, 0, 0]], "int", stored="<i4")
    np.testing.assert_array_equal(found.meshes[0].colours, [[1, 0, 0], [0, 1, 0], [0, 0, 0]])
    assert found.notes == (CLAMPED,)


@pytest.mark.data
def test_no_file_is_refused_for_its_colours(data: Path) -> None:
    for path in sorted((data / "reports" / "F5_vertex_colours").iterdir()):
        if path.suffix in (".obj", ".ply", ".glb"):
            (found,) = load(path, Meshes).meshes
            assert found.colours is not None, path.name
