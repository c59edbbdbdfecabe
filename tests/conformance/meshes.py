"""Meshes as .obj, .glb and .ply: plain ones, painted ones, with textures, with another axis up."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nerfbake import load
from nerfbake.scene.mesh import Mesh, Meshes
from tests.conformance.case import Case, Facts, Frozen, floats, form_named

TEXTURE = [[[255, 0, 0], [0, 255, 0], [9, 8, 7]], [[0, 0, 255], [255, 255, 255], [1, 2, 3]]]
# A square in two triangles, then a triangle beside it; v counts from the top.
SQUARE: Facts = {
    "positions": [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 1.5, 0.25], [0.0, 1.5, 0.25]],
    "faces": [[0, 1, 2], [0, 2, 3]],
    "uvs": [[0.0, 1.0], [1.0, 1.0], [1.0, 0.25], [0.0, 0.25]],
}
TRIANGLE: Facts = {
    "positions": [[-1.0, 0.5, 3.0], [-2.5, 0.5, 3.0], [-1.0, 4.75, 3.0]],
    "faces": [[0, 1, 2]],
    "uvs": [[0.5, 0.5], [0.75, 0.5], [0.5, 0.125]],
}
COLOURS = [[1.0, 0.0, 0.5], [0.25, 0.125, 0.0], [0.0, 1.0, 1.0], [0.75, 0.5, 0.25]]


def told(plain: Facts, **more: Any) -> Facts:
    return {"uvs": None, "colours": None, "texture": None, **plain, **more}


def mesh(plain: Facts) -> Mesh:
    def array(key: str, dtype: Any) -> Any:
        return None if plain[key] is None else np.array(plain[key], dtype)

    colours = array("colours", np.float32)
    return Mesh(
        array("positions", np.float32), array("uvs", np.float32), array("faces", np.uint32), array("texture", np.uint8),
        colours,
    )  # fmt: skip


def cases() -> Iterator[Case]:
    mapped, flat = told(SQUARE), told({**TRIANGLE, "uvs": None})
    painted = told({**SQUARE, "uvs": None}, colours=COLOURS)
    fractions = [[1.0, 0.0, 0.2], [0.4, 0.0, 0.0], [0.0, 1.0, 1.0], [0.8, 0.6, 0.2]]  # multiples of 1/255
    coloured = told({**SQUARE, "uvs": None}, colours=fractions)
    textured = [told(SQUARE, texture=TEXTURE, colours=COLOURS), told(TRIANGLE, texture=TEXTURE)]
    # Fifths of the longest edge, and so multiples of 1/65535 of it.
    fifths = {"positions": [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 1.2, 0.4], [0.0, 1.2, 0.4]]}
    fifths["uvs"] = [[0.0, 1.0], [1.0, 1.0], [1.0, 0.2], [0.0, 0.2]]
    whole = told({**SQUARE, **fifths}, texture=TEXTURE)
    turned = [{**each, "positions": [[x, z, -y] for x, y, z in each["positions"]]} for each in (painted, flat)]
    obj, glb, ply = form_named("obj"), form_named("glb", "Meshes"), form_named("ply", "Meshes")
    about = "Meshes, each with a material of its own."
    for name, plain, files, found in (
        ("mapped", [mapped, told(TRIANGLE)], {"mapped.obj": (obj, {})}, None),
        ("plain", [flat], {"plain.obj": (obj, {}), "plain.glb": (glb, {})}, None),
        ("triangle", [flat], {"triangle.ply": (ply, {})}, None),
        ("bytes", [coloured], {"bytes.ply": (ply, {})}, None),
        ("painted", [painted], {"painted.obj": (obj, {}), "painted.glb": (glb, {})}, None),
        ("textured", textured, {"textured.glb": (glb, {})}, None),
        ("quantised", [whole], {"quantised.glb": (glb, {"quantised": True, "lit": True})}, None),
        ("z_up", [painted, flat], {"z_up.glb": (glb, {"up": "z"})}, turned),
    ):
        scene = Meshes(tuple(map(mesh, plain)))
        frozen = {f"mesh/{file}": Frozen(form, scene, options) for file, (form, options) in files.items()}
        # glTF's colours are linear: the way there and back rounds.
        yield Case(f"mesh/{name}", about, frozen, {"meshes": found or plain}, answer, stored=1e-6)


def facts_of(found: Mesh) -> Facts:
    arrays = (found.positions, found.faces, found.uvs, found.colours, found.texture)
    return dict(zip(("positions", "faces", "uvs", "colours", "texture"), map(floats, arrays), strict=True))


def answer(path: Path, _: Facts) -> Facts:
    return {"meshes": [facts_of(each) for each in load(path, Meshes).meshes]}
