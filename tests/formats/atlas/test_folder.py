"""Stage-1 folders in, baked folders out, and back; glTF read by other programs."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import nerfbake
from nerfbake.formats.wire.picture import decode_texture
from nerfbake.io import load_folder, save_folder
from nerfbake.scene.atlas import METHODS, BakedAtlas, Method
from tests.support.atlas_scenes import mlp_json, random_atlas, stage1_folder, texture


@pytest.mark.parametrize("method", METHODS)
def test_there_and_back(method: Method, tmp_path: Path) -> None:
    atlas = random_atlas(method)
    save_folder(tmp_path / "out", BakedAtlas((atlas,), (None,), {}, {"note": 1}))
    back = load_folder(tmp_path / "out", BakedAtlas)
    (got,) = back.atlases
    assert back.facts["note"] == 1
    for name in ("tiles", "labels", "features", "slopes"):
        np.testing.assert_array_equal(getattr(got, name), getattr(atlas, name))
    assert (got.method, got.border, got.slope) == (atlas.method, atlas.border, atlas.slope)


def test_labels_are_two_bytes_low_one_red(tmp_path: Path) -> None:
    atlas = random_atlas("kmeans")
    save_folder(tmp_path / "out", BakedAtlas((atlas,), (None,), {}, {}))
    texels = decode_texture(memoryview((tmp_path / "out" / "labels_0.png").read_bytes()), "")
    np.testing.assert_array_equal(texels[..., 0] + 256 * texels[..., 1].astype(int), atlas.labels)
    assert atlas.labels.max() > 255


def test_what_was_given_is_handed_on_untouched(tmp_path: Path) -> None:
    folder = stage1_folder(tmp_path / "in")
    save_folder(tmp_path / "out", nerfbake.bake_stage1(load_folder(folder, nerfbake.Stage1), clusters=3, map_size=8))
    for name in ("mesh_0.obj", "feat0_0.png"):
        assert (tmp_path / "out" / name).read_bytes() == (folder / name).read_bytes()
    document = json.loads((tmp_path / "out" / "atlas.json").read_text())
    assert document["cascades"][0]["files"]["diffuse"] == "feat0_0.png"
    assert document["errors"][0]["mae"] > 0


def test_the_scene_is_gltf_with_its_mesh_and_textures(tmp_path: Path) -> None:
    folder = stage1_folder(tmp_path / "in")
    save_folder(tmp_path / "out", nerfbake.bake_stage1(load_folder(folder, nerfbake.Stage1), clusters=3, map_size=8))
    content = (tmp_path / "out" / "scene.glb").read_bytes()
    scene: Any = trimesh.load(io.BytesIO(content), file_type="glb")
    (mesh,) = scene.geometry.values()
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(mesh.visual.uv, [[0, 0], [1, 0], [0, 1]], atol=1e-6)  # trimesh counts v from below
    picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(picture, texture(seed=1))
    size = int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : 20 + size])
    extras = document["materials"][0]["extras"]["nerfbake_atlas"]
    assert extras["map_size"] == 8
    for role, index in extras["textures"].items():
        view = document["bufferViews"][document["images"][document["textures"][index]["source"]]["bufferView"]]
        start = 28 + size + view["byteOffset"]
        assert content[start : start + view["byteLength"]] == (tmp_path / "out" / f"{role}_0.png").read_bytes()


def test_texels_that_no_triangle_shows_are_not_used(tmp_path: Path) -> None:
    used = load_folder(stage1_folder(tmp_path / "in"), nerfbake.Stage1).fields[0].used
    # The triangle fills the lower left half; v points up in an .obj.
    assert used[-1, 0]
    assert used[12, 10]
    assert not used[0, -1]
    assert 0.5 < used.mean() < 0.65


def test_two_cascades_jpeg_and_any_width(tmp_path: Path) -> None:
    from PIL import Image

    jpeg = io.BytesIO()
    Image.fromarray(texture(16, 16)).save(jpeg, "JPEG")
    mlp = mlp_json(hidden=13, cascade=2)
    folder = stage1_folder(tmp_path / "in", mlp_json=mlp, feat1_1_jpg=jpeg.getvalue())
    save_folder(tmp_path / "out", nerfbake.bake_stage1(load_folder(folder, nerfbake.Stage1), clusters=3, map_size=8))
    back = load_folder(tmp_path / "out", BakedAtlas)
    assert [atlas.labels.shape for atlas in back.atlases] == [(24, 32), (16, 16)]


def test_the_sample_is_a_folder_like_any_other(tmp_path: Path) -> None:
    made = nerfbake.sample_stage1(resolution=32)
    save_folder(tmp_path / "s", made)
    read = load_folder(tmp_path / "s", nerfbake.Stage1)
    np.testing.assert_array_equal(read.fields[0].features, made.fields[0].features)
    np.testing.assert_array_equal(read.fields[0].w0, made.fields[0].w0)
    np.testing.assert_array_equal(read.fields[0].used, made.fields[0].used)
    assert set(read.files) == {"mesh_0.obj", "mesh_0.mtl", "feat0_0.png"}
