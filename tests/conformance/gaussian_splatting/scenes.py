"""The valid files: what each is for, its bytes, and its splats as they stand in the scene."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tests.conformance.gaussian_splatting.container import (
    BYTE,
    NAME,
    SHORT,
    UBYTE,
    USHORT,
    Glb,
    Json,
    attributes_of,
    primitive_of,
)

EDGE = 48  # pixels
FOV = 1.0  # radians, vertical
# The camera looks along -(2, 3, 6) / 7 from a distance of 5.25, so that no coefficient is 0 for all splats.
POSE = np.array([[6, -3, 2, 10.5], [2, 6, 3, 15.75], [-3, -2, 6, 31.5], [0, 0, 0, 7]]) / 7
CAMERA: Json = {"type": "perspective", "perspective": {"aspectRatio": 1.0, "yfov": FOV, "znear": 0.1}}
GREY, RED, BLUE = [0.0, 0.0, 0.0], [1.25, -1.0, -1.0], [-1.0, -0.5, 1.5]
S = math.sqrt(0.5)


@dataclass(frozen=True)
class Part:
    """Splats of a primitive in the coordinates of its node, and the node's matrix to the scene."""

    splats: Json
    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True)
class Scene:
    """name: of the file, without extension. about: what it is for. parts: in the order of the file."""

    name: str
    about: str
    data: bytes
    parts: tuple[Part, ...]
    linear: bool = False


def grid(degree: int = 0) -> Json:
    """Nine balls side by side, so that each is seen from another direction."""
    positions = [[1.25 * x, 1.25 * y, -0.25 * (x + 1.5 * y)] for y in (1, 0, -1) for x in (-1, 0, 1)]
    sh = np.zeros((9, (degree + 1) ** 2, 3))
    sh[:, 0] = GREY
    for i in range(9):
        for k in range(1, sh.shape[1]):
            sh[i, k] = [((3 * i + 5 * k) % 7 - 3) / 16, ((5 * i + 2 * k) % 7 - 3) / 16, ((2 * i + 3 * k) % 7 - 3) / 16]
    return {
        "positions": positions,
        "rotations": [[0.0, 0.0, 0.0, 1.0]] * 9,
        "scales": [[0.3125] * 3] * 9,
        "opacities": [0.875] * 9,
        "sh": sh.tolist(),
    }


def needles() -> Json:
    """Long ellipsoids in six rotations: none, by 90 degrees about each axis, by 120, and with w < 0."""
    return {
        "positions": [
            *([-1.25, 1.0, 0.0], [0.0, 1.0, 0.25], [1.25, 1.0, -0.25]),
            *([-1.25, -0.75, 0.5], [0.0, -0.75, 0.0], [1.25, -0.75, -0.5]),
        ],
        "rotations": [
            *([0, 0, 0, 1], [S, 0, 0, S], [0, S, 0, S], [0, 0, S, S]),
            *([0.5, 0.5, 0.5, 0.5], [0.5, -0.5, 0.5, -0.5]),
        ],
        "scales": [[0.5, 0.125, 0.0625]] * 6,
        "opacities": [0.9375, 0.75, 0.875, 0.625, 0.8125, 0.6875],
        "sh": [[RED], [BLUE], [[0.5, 1.0, -1.0]], [[1.0, 1.0, -1.0]], [[-1.0, 1.0, 1.0]], [[1.0, -1.0, 1.0]]],
    }  # fmt: skip


def coloured(degree: int) -> Json:
    """The needles with coefficients of this degree."""
    part, other = needles(), grid(degree)
    part["sh"] = [[own[0], *rest[1:]] for own, rest in zip(part["sh"], other["sh"][:6], strict=True)]
    return part


def single(glb: Glb, part: Json, *, node: Json | None = None, stored: Json | None = None, **look: Any) -> bytes:
    """A file of one primitive."""
    glb.root["meshes"] = [{"primitives": [primitive_of(attributes_of(glb, part, **(stored or {})), **look)]}]
    glb.node({"name": "splats", "mesh": 0, **(node or {})})
    return glb.finish()


def new() -> Glb:
    return Glb(CAMERA, POSE)


def scenes() -> Iterator[Scene]:
    for degree in range(4):
        part = grid(degree)
        about = f"All coefficients up to degree {degree}, nine splats seen from different directions."
        yield Scene(f"degree_{degree}", about, single(new(), part), (Part(part),))
    yield from _coefficients()
    part = needles()
    about = "Rotations by 90 and 120 degrees, and one with w < 0, of ellipsoids with three different scales."
    yield Scene("rotations", about, single(new(), part), (Part(part),))
    yield from _nodes()
    yield from _integers()
    yield from _properties()
    yield from _several()


def _coefficients() -> Iterator[Scene]:
    for degree in range(4):
        for m in range(2 * degree + 1):
            part = grid(degree)
            sh = np.zeros((9, (degree + 1) ** 2, 3))
            sh[:, degree * degree + m] = [0.75, -0.5, 0.25]
            part["sh"] = sh.tolist()
            about = f"SH_DEGREE_{degree}_COEF_{m} alone (order {m - degree}); all other coefficients are 0."
            yield Scene(f"coefficient_{degree}_{m}", about, single(new(), part), (Part(part),))


def _nodes() -> Iterator[Scene]:
    part = coloured(3)
    # By 90 degrees about z, then 120 about the diagonal: x to y, y to z, z to x.
    cycle = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    turned = "The node's {}. Centres, ellipsoids and SH turn along."
    yield Scene("node_rotation", turned.format("rotation, by 120 degrees about (1, 1, 1)"),
        single(new(), part, node={"rotation": [0.5, 0.5, 0.5, 0.5]}), (Part(part, cycle),))  # fmt: skip
    moved = np.eye(4)
    moved[:3, 3] = [0.5, -0.25, -1.0]
    yield Scene("node_translation", "The node's translation.",
        single(new(), part, node={"translation": [0.5, -0.25, -1.0]}), (Part(part, moved),))  # fmt: skip
    yield Scene("node_scale", "The node's scale, the same along all axes: centres and sizes grow.",
        single(new(), part, node={"scale": [1.5, 1.5, 1.5]}), (Part(part, np.diag([1.5, 1.5, 1.5, 1])),))  # fmt: skip
    yield Scene("node_uneven_scale", "The node's scale, different along its axes: it stretches ellipsoids, not SH.",
        single(new(), part, node={"scale": [1.5, 1.0, 0.5]}), (Part(part, np.diag([1.5, 1.0, 0.5, 1])),))  # fmt: skip
    whole = moved @ cycle @ np.diag([1.25, 1.25, 1.25, 1])
    yield Scene("node_matrix", turned.format("matrix, a rotation, a scale and a translation"),
        single(new(), part, node={"matrix": whole.T.reshape(-1).tolist()}), (Part(part, whole),))  # fmt: skip
    uneven = moved @ cycle @ np.diag([1.5, 0.75, 1.0, 1])
    yield Scene("node_uneven_matrix", "A rotation and an uneven scale: SH turn by the rotation alone.",
        single(new(), part, node={"matrix": uneven.T.reshape(-1).tolist()}), (Part(part, uneven),))  # fmt: skip
    quarter = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    glb = new()
    glb.root["meshes"] = [{"primitives": [primitive_of(attributes_of(glb, part))]}]
    above = glb.node({"name": "above", "rotation": [0, 0, S, S], "scale": [0.75, 0.75, 0.75]})
    glb.node({"name": "first", "mesh": 0, "translation": [0, 1.5, 0]}, inside=above)
    glb.node(
        {"name": "second", "mesh": 0, "translation": [0, -1.5, -1.0], "rotation": [0.5, 0.5, 0.5, 0.5]}, inside=above
    )
    outer = quarter @ np.diag([0.75, 0.75, 0.75, 1])
    first, second = np.eye(4), cycle.copy()
    first[:3, 3], second[:3, 3] = [0, 1.5, 0], [0, -1.5, -1.0]
    yield Scene("node_hierarchy", "Two nodes with the same mesh below a node with a rotation and a scale.",
        glb.finish(), (Part(part, outer @ first), Part(part, outer @ second)))  # fmt: skip


def _integers() -> Iterator[Scene]:
    part = needles()
    quats = np.asarray(part["rotations"])
    for word, component, most in (("byte", BYTE, 127), ("short", SHORT, 32767)):
        codes = np.rint(quats * most).astype(int)
        read = {**part, "rotations": np.maximum(codes / most, -1).tolist()}
        stored = {"ROTATION": (codes, component, True)}
        yield Scene(
            f"rotation_{word}", f"Rotations as normalised {word}s.", single(new(), part, stored=stored), (Part(read),)
        )
    sizes = np.asarray(part["scales"])
    for word, component, most in (("unsigned_byte", UBYTE, 255), ("unsigned_short", USHORT, 65535)):
        codes = np.rint(sizes * most).astype(int)
        read = {**part, "scales": (codes / most).tolist()}
        stored = {"SCALE": (codes, component, True)}
        about = f"Scales as normalised {word.replace('_', ' ')}s."
        yield Scene(f"scale_{word}_normalized", about, single(new(), part, stored=stored), (Part(read),))
        whole = np.rint(sizes * 16).astype(int)
        large = {**part, "positions": (np.asarray(part["positions"]) * 16).tolist()}
        read = {**large, "scales": whole.tolist()}
        stored = {"SCALE": (whole, component, False)}
        about = f"Scales as {word.replace('_', ' ')}s that are not normalised: whole units, in a node of scale 1/16."
        data = single(new(), large, stored=stored, node={"scale": [0.0625] * 3})
        yield Scene(f"scale_{word}", about, data, (Part(read, np.diag([0.0625, 0.0625, 0.0625, 1])),))
        codes = np.rint(np.asarray(part["opacities"]) * most).astype(int)
        read = {**part, "opacities": (codes / most).tolist()}
        stored = {"OPACITY": (codes, component, True)}
        about = f"Opacities as normalised {word.replace('_', ' ')}s."
        yield Scene(f"opacity_{word}", about, single(new(), part, stored=stored), (Part(read),))
    codes = np.rint(np.asarray(part["positions"]) * 8192).astype(int)
    glb = new()
    glb.root["extensionsUsed"].append("KHR_mesh_quantization")
    glb.root["extensionsRequired"] = ["KHR_mesh_quantization"]
    read = {**part, "positions": codes.tolist(), "scales": (sizes * 8192).tolist()}
    data = single(
        glb, {**part, "scales": read["scales"]}, stored={"POSITION": (codes, SHORT)}, node={"scale": [2**-13] * 3}
    )
    about = "Positions as shorts (KHR_mesh_quantization), whose node restores their size."
    yield Scene("position_short", about, data, (Part(read, np.diag([2**-13, 2**-13, 2**-13, 1])),))


def _properties() -> Iterator[Scene]:
    part = coloured(1)
    data = single(new(), part, colorSpace="lin_rec709_display")
    about = "Colours in linear light: blended as they are; the picture has them in sRGB after that."
    yield Scene("color_linear", about, data, (Part(part),), linear=True)
    data = single(new(), part, projection=None, sortingMethod=None)
    yield Scene("defaults", "Without projection and sortingMethod, which are optional.", data, (Part(part),))
    glb = new()
    glb.root["extensionsRequired"] = [NAME]
    yield Scene("required", "The extension is required, too.", single(glb, part), (Part(part),))
    part = {**coloured(0), "scales": [[0.5, 0.25, 0.0]] * 6, "opacities": [0.0, 1.0, 0.5, 1.0, 0.0, 1.0]}
    yield Scene("limits", "Opacities of 0 and 1, and scales of 0.", single(new(), part), (Part(part),))
    glb, part = new(), coloured(2)
    attributes = attributes_of(glb, part)
    fallback = np.rint(np.full((6, 4), 0.25) * 255).astype(int)
    attributes["COLOR_0"] = glb.accessor(fallback, UBYTE, normalised=True)
    glb.root["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [0, 1, 0, 1]}}]
    glb.root["meshes"] = [{"primitives": [{**primitive_of(attributes), "material": 0}]}]
    glb.node({"mesh": 0})
    about = "COLOR_0 and a material, which are only for programs without the extension."
    yield Scene("fallback", about, glb.finish(), (Part(part),))


def _several() -> Iterator[Scene]:
    low, high = coloured(0), grid(3)
    high = {**high, "positions": (np.asarray(high["positions"]) - np.array([0, 0, 1.5])).tolist()}
    glb = new()
    primitives = [primitive_of(attributes_of(glb, part)) for part in (low, high)]
    glb.root["meshes"] = [{"primitives": primitives}]
    glb.node({"mesh": 0})
    about = "Two primitives of different degrees in a mesh, which are sorted together."
    yield Scene("several_primitives", about, glb.finish(), (Part(low), Part(high)))
    part = {**grid(1), "rotations": [[0.5, 0.5, 0.5, 0.5]] * 9}
    glb = new()
    shared = attributes_of(glb, {**part, "sh": np.asarray(part["sh"])[:, :1]})
    own = glb.accessor(np.asarray(part["sh"])[:, 1])
    part["sh"] = [[row[0], row[1], row[1], row[1]] for row in part["sh"]]
    shared |= {f"{NAME}:SH_DEGREE_1_COEF_{m}": own for m in range(3)}
    glb.root["meshes"] = [{"primitives": [primitive_of(shared)]}]
    glb.node({"mesh": 0})
    yield Scene("shared_accessor", "Three coefficients refer to the same accessor.", glb.finish(), (Part(part),))
    part = coloured(1)
    glb = new()
    rows = np.concatenate([np.asarray(part["positions"]), np.asarray(part["scales"])], axis=1).astype("<f4")
    attributes = attributes_of(glb, part)
    view = {"buffer": 0, "byteOffset": len(glb.body), "byteLength": rows.nbytes, "byteStride": 24, "target": 34962}
    glb.body += rows.tobytes()
    glb.root["bufferViews"].append(view)
    for name, offset in (("POSITION", 0), (f"{NAME}:SCALE", 12)):
        entry = glb.root["accessors"][attributes[name]]
        entry |= {"bufferView": len(glb.root["bufferViews"]) - 1, "byteOffset": offset}
    glb.root["meshes"] = [{"primitives": [primitive_of(attributes)]}]
    glb.node({"mesh": 0})
    yield Scene("interleaved", "Positions and scales lie in one buffer view, in turn.", glb.finish(), (Part(part),))
