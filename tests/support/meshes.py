"""Small synthetic meshes, and cameras that look at them."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from nerfbake.scene.camera import Camera, look_at
from nerfbake.scene.mesh import Mesh, Meshes

ORIGIN = np.zeros(3)
TEXELS = np.arange(48, dtype=np.uint8).reshape(4, 4, 3) * 5


def mesh(positions: Any, faces: Any, **more: Any) -> Mesh:
    uvs = more.pop("uvs", None)
    uvs = None if uvs is None else np.array(uvs, np.float32)
    return Mesh(np.array(positions, np.float32), uvs, np.array(faces, np.uint32), **more)


def cube(half: float = 0.5, **more: Any) -> Mesh:
    """A cube around the origin. The vertex index is x + 2y + 4z."""
    corners = np.stack(np.meshgrid([-half, half], [-half, half], [-half, half], indexing="ij"), axis=-1)
    quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]]
    faces = [[a, b, c] for a, b, c, _ in quads] + [[a, c, d] for a, _, c, d in quads]
    return mesh(corners.transpose(2, 1, 0, 3).reshape(-1, 3), faces, **more)


def sphere(rings: int = 24, sides: int = 48) -> Mesh:
    """A closed sphere of radius 1. Each pole is one vertex."""
    polar = np.pi * np.arange(1, rings) / rings
    around = 2 * np.pi * np.arange(sides) / sides
    z, turn = np.meshgrid(np.cos(polar), around, indexing="ij")
    r = np.sqrt(1 - z**2)
    points = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1).reshape(-1, 3)
    index = np.arange((rings - 1) * sides).reshape(rings - 1, sides)
    right = np.roll(index, -1, axis=1)
    north, south = np.full(sides, len(points)), np.full(sides, len(points) + 1)
    faces = [np.stack([north, index[0], right[0]], axis=1), np.stack([south, right[-1], index[-1]], axis=1)]
    a, b, c, d = index[:-1], index[1:], right[1:], right[:-1]
    faces += [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    return mesh(np.concatenate([points, [[0, 0, 1], [0, 0, -1]]]), np.concatenate(faces))


def painted() -> Meshes:
    """Three meshes: plain, with vertex colours, and with a texture."""
    colours = np.linspace(0, 1, 24, dtype=np.float32).reshape(8, 3)
    flat = square(half=1.0)
    return Meshes((cube(), cube(0.2, colours=colours), Mesh(flat.positions, flat.uvs, flat.faces, texture=TEXELS)))


def assert_same_mesh(a: Mesh, b: Mesh, *, atol: float = 0.0) -> None:
    for name in ("positions", "faces", "uvs", "texture", "colours"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        if x is not None:
            np.testing.assert_allclose(x, y, atol=atol, err_msg=name)


def camera(
    width: int = 40, height: int = 30, distance: float = 3.0, azimuth: float = 0.7, elevation: float = 0.4
) -> Camera:
    """A camera that looks at the origin with a vertical field of view of 40 degrees."""
    focal = 0.5 * height / np.tan(np.radians(20))
    return Camera(width, height, focal, look_at(ORIGIN, azimuth, elevation, distance))


def square(z: float = 0.0, half: float = 100.0) -> Mesh:
    """A square of two triangles at height z. Texture coordinates from 0 to 1: u along x, v along -y."""
    corners = [[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]]
    return mesh(corners, [[0, 1, 2], [0, 2, 3]], uvs=[[0, 1], [1, 1], [1, 0], [0, 0]])


def straight_down(width: int = 5, height: int = 3, focal: float = 4.0, z: float = 2.0) -> Camera:
    """A camera above the origin that looks down, with x to the right and y up."""
    pose = np.eye(4)
    pose[2, 3] = z
    return Camera(width, height, focal, pose)


def polygon_ply(polygons: list[tuple[int, ...]]) -> bytes:
    """A .ply in text, of these polygons over the corners of a tetrahedron, with colours and a property of no use."""
    corners = ["0 0 0 255 0 0", "1 0 0 0 255 0", "0 1 0 0 0 255", "0 0 1 51 102 204"]
    columns = [f"property float {axis}" for axis in "xyz"] + [
        f"property uchar {name}" for name in ("red", "green", "blue")
    ]
    head = ["ply", "format ascii 1.0", "comment by hand", "element vertex 4", *columns, f"element face {len(polygons)}"]
    head += ["property uchar flags", "property list uchar int vertex_indices", "end_header"]
    faces = [" ".join(map(str, (7, len(polygon), *polygon))) for polygon in polygons]
    return "\n".join([*head, *corners, *faces, ""]).encode()


ODD_OBJ = b"""# what other programs write
v 0 0 0 1 0 0
v 1 0 0 nan 0 0
v 0 1 0 \\
 1 1 0 0
v 0 0 1
vt 0
vt nan 1
vt 1.#QNAN 0.5
usemtl a
f 1/1/1 2/2 3/3
f 1 2
f -1 -2 -3
#MRGB ffff000000ff00ff
"""


def odd_plys() -> Iterator[bytes]:
    """Strips of triangles in text and binary, rows that are longer than declared in both, and colours of floats."""
    columns = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"element vertex 4\n{columns}"
    points, corners = np.vstack([np.zeros(3), np.eye(3)]).astype("<f4"), (0, 1, 2, 3, -1, 2, 1, 0)
    text, binary = "ply\nformat ascii 1.0\n", "ply\nformat binary_little_endian 1.0\n"
    rows = "".join(" ".join(map(str, row)) + "\n" for row in points.tolist())
    end = "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    yield (text + head + end + rows + " ".join(map(str, (len(corners), *corners))) + "\n").encode()
    yield (binary + head + end).encode() + points.tobytes() + np.array([len(corners), *corners], "<i4").tobytes()
    end = "element face 2\nproperty list uchar int vertex_indices\nproperty uchar red\nend_header\n"
    faces = np.zeros(2, [("n", "u1"), ("v", "<i4", 3), ("m", "u1"), ("c", "<f4", 3)])
    faces["n"], faces["v"], faces["m"] = 3, [[0, 1, 2], [3, 2, 1]], 3
    yield (binary + "by hand\n" + head + end).encode() + points.tobytes() + faces.tobytes()
    yield (text + head + end + rows + "3 0 1 2 3 1 1 1\n3 2 1 0 3 1 1 1\n").encode()
    colours = "".join(f"property double {name}\n" for name in ("red", "green", "blue"))
    rows = "".join(f"{row} 255 0 nan\n" for row in rows.splitlines())
    yield (text + head + colours + end + rows + "3 0 1 2 3\n3 1 0 3 1\n").encode().replace(b"\n", b"\r")


def sparse_glb() -> bytes:
    """A triangle with a sparse accessor of zeros, colours of integers that lack `normalized`, in a data URI."""
    body = np.array([1, 2], "<u2").tobytes() + np.eye(2, 3, dtype="<f4").tobytes() + bytes(range(0, 240, 20))
    views = [{"buffer": 0, "byteOffset": at, "byteLength": size} for at, size in ((0, 4), (4, 24), (28, 12))]
    part = {"count": 2, "indices": {"bufferView": 0, "componentType": 5123}, "values": {"bufferView": 1}}
    root = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}}]}],
        "accessors": [
            {"componentType": 5126, "count": 3, "type": "VEC3", "sparse": part},
            {"bufferView": 2, "componentType": 5121, "count": 3, "type": "VEC4"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(body), "uri": "data:;base64," + base64.b64encode(body).decode()}],
    }
    text = json.dumps(root).encode()
    text += bytes(-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text
