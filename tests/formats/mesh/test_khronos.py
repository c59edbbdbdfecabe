"""Khronos' own validator reads every .glb that we write: no error, no warning. `make tools` installs it, for tests."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Meshes, sample_stage1, save
from nerfbake.io import save_folder
from nerfbake.stages.stage1_to_atlas import bake_stage1
from tests.conftest import REPOSITORY
from tests.support.meshes import painted, sphere

MODULES = REPOSITORY / "tests" / "shaders" / "scripts" / "node_modules"
pytestmark = [
    pytest.mark.tools,
    pytest.mark.skipif(
        shutil.which("node") is None or not (MODULES / "gltf-validator").exists(),
        reason="no gltf-validator: `make tools` installs it",
    ),
]
_SCRIPT = """
const [, path] = process.argv, fs = require("fs");
require("gltf-validator").validateBytes(new Uint8Array(fs.readFileSync(path)), {maxIssues: 20})
    .then((found) => console.log(JSON.stringify(found)));
"""


def validated(path: Path) -> dict[str, Any]:
    """The validator's report of a file."""
    done = subprocess.run(
        ["node", "-e", _SCRIPT, path], cwd=MODULES.parent, capture_output=True, text=True, check=True, timeout=60
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def require_valid(path: Path) -> dict[str, Any]:
    found = validated(path)
    issues = found["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
    return found


def test_materials_are_valid(tmp_path: Path) -> None:
    ball = sphere(8, 12)
    uvs, texture = ((ball.positions[:, :2] + 1) / 2).astype(np.float32), np.full((16, 16, 3), 90, np.uint8)
    shiny = replace(ball, uvs=uvs, texture=texture, material=np.full((16, 16, 2), (64, 255), np.uint8))
    save(tmp_path / "a.glb", Meshes((shiny,)), image="jpeg", quantised=True, up="z")
    assert "KHR_materials_specular" in require_valid(tmp_path / "a.glb")["info"]["extensionsUsed"]


@pytest.mark.parametrize("picture", ["png", "jpeg", "webp"])
@pytest.mark.parametrize("lit", [False, True])
@pytest.mark.parametrize("quantised", [False, True])
def test_meshes_are_valid(picture: Any, lit: bool, quantised: bool, tmp_path: Path) -> None:
    ball = sphere(8, 12)
    uvs = ((ball.positions[:, :2] + 1) / 2).astype(np.float32)
    texture = np.full((16, 8, 3), (200, 120, 40), np.uint8)
    level = replace(ball, uvs=uvs, texture=texture, colours=np.clip(ball.positions, 0, 1))
    options: dict[str, Any] = {"lit": lit, "quantised": quantised, "image": picture, "up": "z"}
    for number, scene in enumerate((painted(), Meshes((level,), (level, replace(level, colours=None))))):
        save(tmp_path / f"{number}.glb", scene, **options)
        found = require_valid(tmp_path / f"{number}.glb")
        assert found["info"]["hasTextures"]
        assert ("KHR_mesh_quantization" in found["info"].get("extensionsUsed", [])) == quantised


@pytest.mark.slow
def test_the_scene_of_an_atlas_is_valid(tmp_path: Path) -> None:
    baked = bake_stage1(sample_stage1(resolution=32), clusters=4, map_size=8, directions=9)
    save_folder(tmp_path / "atlas", baked)
    require_valid(tmp_path / "atlas" / "scene.glb")


def test_the_validator_finds_a_mistake(tmp_path: Path) -> None:
    save(tmp_path / "a.glb", painted())
    content = (tmp_path / "a.glb").read_bytes().replace(b'"count":36', b'"count":37', 1)
    (tmp_path / "a.glb").write_bytes(content)
    assert validated(tmp_path / "a.glb")["issues"]["numErrors"] > 0
