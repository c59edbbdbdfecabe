"""Invalid files, each with one fault, and the finding that it must cause."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from tests.conformance.gaussian_splatting.container import (
    BYTE,
    FLOAT,
    NAME,
    SHORT,
    UBYTE,
    USHORT,
    Glb,
    Json,
    attributes_of,
    primitive_of,
)

PLACE = "meshes[0].primitives[0]"


class Invalid(NamedTuple):
    """name: of the file. place, found, allowed: of the finding."""

    name: str
    place: str
    found: str
    allowed: str
    data: bytes


def pair(degree: int = 1) -> Json:
    """Two splats."""
    sh = np.zeros((2, (degree + 1) ** 2, 3))
    sh[:, 0] = [0.5, 0.25, -0.5]
    return {
        "positions": [[0.0, 0.0, 0.0], [1.0, 0.5, -0.25]],
        "rotations": [[0.0, 0.0, 0.0, 1.0]] * 2,
        "scales": [[0.25, 0.5, 0.125]] * 2,
        "opacities": [0.75, 0.5],
        "sh": sh.tolist(),
    }


def built(change: Callable[[Glb, Json], object], part: Json | None = None, **stored: Any) -> bytes:
    """A file whose document is changed before it is finished. change(file, primitive)."""
    glb = Glb()
    primitive = primitive_of(attributes_of(glb, part or pair(), **stored))
    glb.root["meshes"] = [{"primitives": [primitive]}]
    glb.node({"mesh": 0})
    change(glb, primitive)
    return glb.finish()


def nothing(glb: Glb, primitive: Json) -> None:
    """Change nothing."""


def invalid() -> Iterator[Invalid]:
    yield from _document()
    yield from _properties()
    yield from _attributes()
    yield from _values()
    yield from _nodes()


def _document() -> Iterator[Invalid]:
    def without(glb: Glb, _: Json) -> None:
        del glb.root["extensionsUsed"]

    yield Invalid("not_used", "extensionsUsed", f"lack {NAME}", "all extensions of the file", built(without))

    def required(glb: Glb, _: Json) -> None:
        glb.root["extensionsRequired"] = [NAME, "EXT_other"]

    yield Invalid("required_not_used", "extensionsRequired", "has EXT_other", "some of extensionsUsed", built(required))

    def inner(glb: Glb, primitive: Json) -> None:
        primitive["extensions"][NAME]["extensions"] = {"EXT_kernel": {}}

    yield Invalid("inner_not_used", "extensionsUsed", "lack EXT_kernel", "all extensions of the file", built(inner))


def _properties() -> Iterator[Invalid]:
    cases: list[tuple[str, str, Any, str, str]] = [
        ("no_kernel", "kernel", None, "is missing", "ellipse, or the kernel of an extension"),
        ("other_kernel", "kernel", "box", "is 'box'", "ellipse, or the kernel of an extension"),
        ("no_color_space", "colorSpace", None, "is missing", "srgb_rec709_display or lin_rec709_display"),
        ("other_color_space", "colorSpace", "BT.709", "is 'BT.709'", "srgb_rec709_display or lin_rec709_display"),
        ("other_projection", "projection", "fisheye", "is 'fisheye'", "perspective"),
        ("other_sorting", "sortingMethod", "zDepth", "is 'zDepth'", "cameraDistance"),
    ]
    for name, key, value, found, allowed in cases:

        def change(_: Glb, primitive: Json, key: str = key, value: Any = value) -> None:
            properties = primitive["extensions"][NAME]
            properties.pop(key)
            if value is not None:
                properties[key] = value

        yield Invalid(name, f"{PLACE}.{NAME}.{key}", found, allowed, built(change))

    def triangles(_: Glb, primitive: Json) -> None:
        primitive["mode"] = 4

    yield Invalid("triangles", f"{PLACE}.mode", "is 4", "0, points", built(triangles))


def _attributes() -> Iterator[Invalid]:
    def dropped(name: str) -> bytes:
        return built(lambda _, primitive: primitive["attributes"].pop(name))

    for name, word in (
        ("POSITION", "position"),
        *((f"{NAME}:{part}", part.lower()) for part in ("ROTATION", "SCALE", "OPACITY")),
    ):
        yield Invalid(
            f"no_{word}", f"{PLACE}.attributes", f"lack {name}", "all attributes of the kernel ellipse", dropped(name)
        )
    base = f"{NAME}:SH_DEGREE_"
    yield Invalid(
        "no_base_color",
        f"{PLACE}.attributes",
        f"lack {base}0_COEF_0",
        "all coefficients up to the highest degree",
        dropped(f"{base}0_COEF_0"),
    )
    yield Invalid(
        "hole_in_degree",
        f"{PLACE}.attributes",
        f"lack {base}1_COEF_1",
        "all coefficients up to the highest degree",
        dropped(f"{base}1_COEF_1"),
    )

    def skipped(_: Glb, primitive: Json) -> None:
        for m in range(3):
            del primitive["attributes"][f"{base}1_COEF_{m}"]

    yield Invalid("hole_between_degrees", f"{PLACE}.attributes", f"lack {base}1_COEF_0, {base}1_COEF_1, {base}1_COEF_2",
        "all coefficients up to the highest degree", built(skipped, pair(2)))  # fmt: skip
    for name, other in (
        ("beyond_degree", f"{base}1_COEF_3"),
        ("degree_4", f"{base}4_COEF_0"),
        ("unknown_attribute", f"{NAME}:NORMAL"),
    ):

        def more(_: Glb, primitive: Json, other: str = other) -> None:
            primitive["attributes"][other] = primitive["attributes"][f"{base}0_COEF_0"]

        yield Invalid(name, f"{PLACE}.attributes", f"have {other}", "the attributes of the kernel ellipse", built(more))
    codes = np.array([[0, 0, 0, 127]] * 2)
    quats = "VEC4 of float, or of normalised byte or short"
    yield Invalid("rotation_unsigned", f"{PLACE}.{NAME}:ROTATION", "is VEC4 of normalised unsigned byte", quats,
        built(nothing, ROTATION=(codes, UBYTE, True)))  # fmt: skip
    yield Invalid("rotation_not_normalized", f"{PLACE}.{NAME}:ROTATION", "is VEC4 of byte", quats,
        built(nothing, ROTATION=(codes, BYTE, False)))  # fmt: skip
    yield Invalid("rotation_vec3", f"{PLACE}.{NAME}:ROTATION", "is VEC3 of float", quats,
        built(nothing, ROTATION=([[0.0, 0.0, 0.0]] * 2, FLOAT, False)))  # fmt: skip
    sizes = "VEC3 of float, or of unsigned byte or short, normalised or not"
    yield Invalid("scale_signed", f"{PLACE}.{NAME}:SCALE", "is VEC3 of normalised short", sizes,
        built(nothing, SCALE=([[8192] * 3] * 2, SHORT, True)))  # fmt: skip
    alphas = "SCALAR of float, or of normalised unsigned byte or short"
    yield Invalid("opacity_not_normalized", f"{PLACE}.{NAME}:OPACITY", "is SCALAR of unsigned short", alphas,
        built(nothing, OPACITY=([1, 0], USHORT, False)))  # fmt: skip

    def halves(glb: Glb, primitive: Json) -> None:
        codes = np.array([[100, 50, 25]] * 2)
        primitive["attributes"][f"{base}1_COEF_2"] = glb.accessor(codes, UBYTE, normalised=True)

    yield Invalid(
        "coefficient_bytes",
        f"{PLACE}.{base}1_COEF_2",
        "is VEC3 of normalised unsigned byte",
        "VEC3 of float",
        built(halves),
    )

    def fewer(glb: Glb, primitive: Json) -> None:
        primitive["attributes"][f"{NAME}:OPACITY"] = glb.accessor([0.5])

    yield Invalid("other_count", f"{PLACE}.{NAME}:OPACITY", "has 1 row", "2, as POSITION", built(fewer))

    def nowhere(_: Glb, primitive: Json) -> None:
        primitive["attributes"][f"{NAME}:SCALE"] = 99

    yield Invalid("no_accessor", f"{PLACE}.{NAME}:SCALE", "refers to accessor 99", "one of 8", built(nowhere))

    def beyond(glb: Glb, primitive: Json) -> None:
        glb.root["accessors"][primitive["attributes"][f"{NAME}:SCALE"]]["byteOffset"] = 8

    yield Invalid(
        "beyond_view",
        f"{PLACE}.{NAME}:SCALE",
        "has 2 entries, up to byte 32",
        "1 or more, within the 24 bytes of its bufferView",
        built(beyond),
    )

    def odd(glb: Glb, primitive: Json) -> None:
        entry = glb.root["accessors"][primitive["attributes"][f"{NAME}:OPACITY"]]
        glb.body += bytes(3)
        glb.root["bufferViews"].append({"buffer": 0, "byteOffset": len(glb.body) - 11, "byteLength": 11})
        entry |= {"bufferView": len(glb.root["bufferViews"]) - 1, "byteOffset": 3}

    yield Invalid("not_aligned", f"{PLACE}.{NAME}:OPACITY", "starts at byte 179", "a multiple of 4", built(odd))


def _values() -> Iterator[Invalid]:
    part = pair()
    part["rotations"] = [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.75, 1.0]]
    yield Invalid(
        "rotation_not_unit",
        f"{PLACE}.{NAME}:ROTATION",
        "has 1 of 2 rows of another length, first 1.25 in row 1",
        "unit quaternions",
        built(nothing, part),
    )
    part = pair()
    part["scales"] = [[0.25, 0.5, 0.125], [0.25, -0.5, 0.125]]
    yield Invalid(
        "scale_negative",
        f"{PLACE}.{NAME}:SCALE",
        "has 1 of 6 numbers outside, first -0.5 in row 1",
        "0 or more",
        built(nothing, part),
    )
    part = pair()
    part["opacities"] = [1.5, 0.5]
    yield Invalid(
        "opacity_above_1",
        f"{PLACE}.{NAME}:OPACITY",
        "has 1 of 2 numbers outside, first 1.5 in row 0",
        "0 to 1",
        built(nothing, part),
    )
    part = pair()
    part["opacities"] = [0.5, -2.25]
    yield Invalid(
        "opacity_logit",
        f"{PLACE}.{NAME}:OPACITY",
        "has 1 of 2 numbers outside, first -2.25 in row 1",
        "0 to 1",
        built(nothing, part),
    )
    part = pair()
    part["sh"][1][3][0] = float("nan")
    yield Invalid(
        "coefficient_nan",
        f"{PLACE}.{NAME}:SH_DEGREE_1_COEF_2",
        "has 1 of 6 numbers outside, first nan in row 1",
        "finite numbers",
        built(nothing, part),
    )

    def unbounded(glb: Glb, primitive: Json) -> None:
        del glb.root["accessors"][primitive["attributes"]["POSITION"]]["min"]

    yield Invalid("no_bounds", f"{PLACE}.POSITION", "has no min", "min and max", built(unbounded))

    def narrow(glb: Glb, primitive: Json) -> None:
        glb.root["accessors"][primitive["attributes"]["POSITION"]]["max"] = [1.0, 0.25, 0.0]

    yield Invalid("wrong_bounds", f"{PLACE}.POSITION", "has max 1, 0.25, 0", "1, 0.5, 0, as its numbers", built(narrow))


def _nodes() -> Iterator[Invalid]:
    allowed = "columns of finite lengths above 0 and at right angles, of a determinant above 0"
    for name, matrix in (
        ("node_mirrored", [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]),
        ("node_sheared", [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]),
        ("node_flat", [[1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0]]),
    ):
        flat = np.array([*matrix, [0, 0, 0, 1]], np.float64).T.reshape(-1).tolist()

        def place(glb: Glb, _: Json, flat: list[float] = flat) -> None:
            glb.root["nodes"][0]["matrix"] = flat

        told = {"node_mirrored": "mirrors splats", "node_sheared": "shears splats", "node_flat": "flattens splats"}[
            name
        ]
        yield Invalid(name, "nodes[0]", told, allowed, built(place))
