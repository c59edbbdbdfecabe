"""Stage 1, atlases and pictures in a few numbers."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from nerfbake import summarise_scene
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.image import Depth, Image
from nerfbake.scene.stage1 import Stage1
from tests.support.atlas_scenes import field, random_atlas
from tests.support.meshes import cube


def test_stage_1_by_hand() -> None:
    scene = field(24, 32, hidden=8)
    told = summarise_scene(Stage1((scene, scene), (cube(), None), cameras=np.zeros((5, 3))))
    assert told["cameras"] == 5
    colours = len(np.unique(scene.features.reshape(-1, 3), axis=0))
    whole = {"texture": [32, 24], "texels_used": 768, "colours": colours, "hidden_units": 8, "diffuse": None}
    assert told["cascades"] == {"0": {**whole, "triangles": 12}, "1": {**whole, "triangles": None}}


def test_an_atlas_tells_its_errors_and_what_is_no_number_is_left_out() -> None:
    facts = {"errors": [{"mae": 1.5, "texels": 7, "lie": {"x": [1]}}], "bake": {"method": "affine", "long": "x" * 99}}
    told = summarise_scene(BakedAtlas((random_atlas("affine"),), (None,), {}, facts))
    assert told["bake"] == {"method": "affine"}
    cascade = told["cascades"]["0"]
    assert (cascade["method"], cascade["clusters"], cascade["maps"], cascade["map_size"]) == ("affine", 10, 40, 8)
    assert cascade["errors"] == {"mae": 1.5, "texels": 7}
    lies: tuple[dict[str, Any], ...] = ({}, {"errors": 3, "bake": []}, {"errors": []}, {"errors": [[]]})
    for lie in lies:
        told = summarise_scene(BakedAtlas((random_atlas("grid"),), (None,), {}, lie))
        assert (told["bake"], told["cascades"]["0"]["errors"]) == (None, None)
        json.dumps(told)


def test_pictures_by_hand() -> None:
    alpha = np.array([[0, 1, 1, 0.5]], np.float32)
    told = summarise_scene(Image(np.full((1, 4, 3), 0.25, np.float32), alpha, np.zeros_like(alpha), None))
    assert told == {
        "kind": "picture",
        "size": [4, 1],
        "opaque": 0.5,
        "transparent": 0.25,
        "mean_colour": [0.25, 0.25, 0.25],
    }
    assert summarise_scene(Depth(np.array([[0, 2, 4]], np.float32))) == {
        "kind": "depth",
        "size": [3, 1],
        "met": 2 / 3,
        "range": [2, 4],
    }
    assert summarise_scene(Depth(np.zeros((2, 2), np.float32)))["range"] is None
