"""Atlas folders of all three methods, and the stage-1 folder that atlases are baked from."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nerfbake import load
from nerfbake.kernels.surface import octahedron
from nerfbake.kernels.surface.mlp import evaluate_each
from nerfbake.scene.atlas import METHODS, BakedAtlas, Method, OctahedralAtlas
from nerfbake.scene.mesh import Mesh, Meshes
from nerfbake.scene.stage1 import SpecularField, Stage1
from tests.conformance import meshes
from tests.conformance.atlas_lookups import colour_of
from tests.conformance.case import Case, Facts, Frozen, floats, form_named

# The texture's whole square, so that every texel is shown.
UNWRAPPED: Facts = {**meshes.SQUARE, "uvs": [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]}
# Of lengths that are whole or fractions float64 has; above, below, in all octants, none on a fold.
DIRECTIONS = [[2, 3, 6], [-3, 6, 2], [6, -2, 3], [-2, -6, -3], [1, 4, -8], [-4, 1, -8], [8, -1, -4], [-8, -4, 1]]
TEXELS = [(0, 0), (0, 3), (1, 2), (2, 1), (2, 3)]
BORDERS: dict[Method, int] = {"kmeans": 1, "affine": 2, "grid": 0}


def atlas(method: Method) -> OctahedralAtlas:
    """kmeans: 260 maps, so that labels need two bytes; affine: two clusters; grid: 2 x 2 x 2 nodes."""
    count, edge = {"kmeans": (260, 2), "affine": (8, 4), "grid": (8, 4)}[method]
    tiles = (np.arange(count * edge * edge * 3) * 37 % 251).astype(np.uint8).reshape(count, edge, edge, 3)
    labels = np.array([[0, 1, 0, 1], [1, 0, 1, 1], [0, 0, 1, 0]], np.uint16)
    features = (np.arange(36) * 53 % 256).astype(np.uint8).reshape(3, 4, 3)
    if method == "kmeans":
        return OctahedralAtlas(method, tiles, (labels * 256 + 3).astype(np.uint16), None, BORDERS[method])
    if method == "affine":
        slopes = np.array([255, 40], np.uint8)
        return OctahedralAtlas(method, tiles, labels, features, BORDERS[method], 2.5, slopes)
    return OctahedralAtlas(method, tiles, np.zeros_like(labels), features, BORDERS[method])


def cases() -> Iterator[Case]:
    surface = meshes.told(UNWRAPPED, texture=meshes.TEXTURE)
    for method in METHODS:
        made = atlas(method)
        up = "z" if method == "grid" else "y"
        baked = BakedAtlas((made,), (meshes.mesh(surface),), {}, {"note": "not for readers"})
        frozen = Frozen(form_named("atlas"), baked, {"up": up})
        shown = [[x, z, -y] if up == "z" else [x, y, z] for x, y, z in surface["positions"]]
        facts: Facts = {**_arrays(made), "mesh": surface, "scene_glb_positions": shown}
        facts["lookups"] = [
            {"texel": list(texel), "direction": unit, **colour_of(facts, texel, unit)}
            for texel, unit in zip(TEXELS * 2, map(_unit, [*DIRECTIONS, *DIRECTIONS[:2]]), strict=True)
        ]
        about = f"A baked atlas, method {method}: the texel's colour is diffuse + this."
        yield Case(f"atlas/{method}", about, {f"atlas/{method}": frozen}, facts, _answer, computed=1e-5)
    yield _stage1()


def _unit(direction: list[int]) -> list[float]:
    length = math.sqrt(sum(d * d for d in direction))
    return [d / length for d in direction]


def _arrays(made: OctahedralAtlas) -> Facts:
    return {
        "method": made.method,
        "map_size": made.tiles.shape[1],
        "border": made.border,
        "slope": made.slope,
        "slopes": floats(made.slopes),
        "labels": floats(made.labels),
        "features": floats(made.features),
        "tiles": floats(made.tiles),
    }


def _answer(path: Path, expected: Facts) -> Facts:
    baked = load(path, BakedAtlas)
    (made,), (surface,) = baked.atlases, baked.meshes
    assert surface is not None
    (shown,) = load(path / "scene.glb", Meshes).meshes
    facts = {**_arrays(made), "mesh": meshes.facts_of(surface), "scene_glb_positions": floats(shown.positions)}
    return {**facts, "lookups": [_looked_up(made, told) for told in expected["lookups"]]}


def _looked_up(made: OctahedralAtlas, told: Facts) -> Facts:
    row, column = told["texel"]
    labels = made.labels[row, column][None]
    features = np.zeros((1, 3), np.uint8) if made.features is None else made.features[row, column][None]
    tiles, weights = made.terms(labels, features)
    directions, found = np.array([told["direction"]]), dict(told)
    kinds: tuple[octahedron.TexelLookup, ...] = ("bilinear", "nearest", "thesis")
    for how in kinds:
        shown = made.show(directions, how)[:, 0]
        found[how] = (weights[0, :, None] * shown[tiles[0]]).sum(axis=0).tolist()
    assert np.allclose(made.specular(labels, features, directions)[0], found["bilinear"], atol=1e-5)
    return found


# -- stage 1 ---------------------------------------------------------------------------------------------------
W0 = [[((5 * i + 3 * j) % 17 - 8) / 8 for j in range(5)] for i in range(6)]
W1 = [[((7 * i + 2 * j) % 11 - 5) / 4 for j in range(3)] for i in range(5)]
FEATURES = [(np.arange(36) * factor % 256).reshape(3, 4, 3).tolist() for factor in (53, 91)]


def _stage1() -> Case:
    surface = meshes.told(UNWRAPPED, texture=meshes.TEXTURE)
    w0, w1 = np.array(W0, np.float32), np.array(W1, np.float32)
    fields = tuple(SpecularField(np.array(f, np.uint8), w0, w1, np.ones((3, 4), bool)) for f in FEATURES)
    frozen = Frozen(form_named("stage1"), Stage1(fields, (meshes.mesh(surface), None)))
    lookups = [
        {"cascade": cascade, "texel": list(texel), "direction": unit, "specular": _mlp(FEATURES[cascade], texel, unit)}
        for cascade in (0, 1)
        for texel, unit in zip(TEXELS, map(_unit, DIRECTIONS), strict=False)
    ]
    facts = {"w0": W0, "w1": W1, "features": FEATURES, "meshes": [surface, None], "lookups": lookups}
    return Case("stage1/cascades", "Two cascades, of which one has a mesh.", {"stage1/cascades": frozen}, facts, _field)


def _mlp(features: Any, texel: tuple[int, int], direction: list[float]) -> list[float]:
    """sigmoid(relu([direction, feature / 255] w0) w1)."""
    inputs = [*direction, *(byte / 255 for byte in features[texel[0]][texel[1]])]
    hidden = [max(0.0, sum(i * row[j] for i, row in zip(inputs, W0, strict=True))) for j in range(5)]
    return [1 / (1 + math.exp(-sum(h * row[c] for h, row in zip(hidden, W1, strict=True)))) for c in range(3)]


def _field(path: Path, expected: Facts) -> Facts:
    stage1 = load(path, Stage1)
    lookups = []
    for told in expected["lookups"]:
        field, (row, column) = stage1.fields[told["cascade"]], told["texel"]
        feature, direction = field.features[row, column][None] / np.float32(255), np.array([told["direction"]])
        lookups.append({**told, "specular": evaluate_each(feature, direction, field.w0, field.w1)[0].tolist()})
    assert all(field.used.all() for field in stage1.fields)
    return {
        "w0": floats(stage1.fields[0].w0),
        "w1": floats(stage1.fields[0].w1),
        "features": [floats(field.features) for field in stage1.fields],
        "meshes": [_mesh(each) for each in stage1.meshes],
        "lookups": lookups,
    }


def _mesh(found: Mesh | None) -> Facts | None:
    return None if found is None else meshes.facts_of(found)
