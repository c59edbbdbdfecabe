from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import io, memory
from nerfbake.errors import MemoryLimit, NerfbakeError
from nerfbake.formats.mesh import mobilenerf, stage1
from nerfbake.formats.wire.picture import encode_texture
from nerfbake.scene.mesh import Mesh, Meshes
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages.stage1_to_atlas import bake_stage1
from nerfbake.stages.stage1_to_meshes import colour_meshes
from tests.support.mobilenerf_scenes import EDGE, QUADS, layers, mlp_json, obj, phone_files, phone_folder, textures


def read(**files: bytes | None) -> Stage1:
    return mobilenerf.decode({name: memoryview(data) for name, data in phone_files(**files).items()})


def test_every_array_is_what_the_files_say() -> None:
    scene = read()
    [field], [mesh] = scene.fields, scene.meshes
    assert scene.deferred
    assert str(field) == "feature texture of 64x64, 598 texels used, MLP 11-16-16-3"
    weights = layers()
    np.testing.assert_array_equal(field.w0, weights["0_weights"][[8, 9, 10, 0, 1, 2, 3, 4, 5, 6, 7]])
    np.testing.assert_array_equal(field.middle[0], weights["1_weights"])
    np.testing.assert_array_equal(field.w1, weights["2_weights"])
    assert [bias.shape for bias in field.biases] == [(16,), (16,), (3,)]
    written = textures().astype(int)
    plain = [0, 1, 2, 4, 5, 6]
    np.testing.assert_array_equal(field.features[..., plain], written[..., plain])
    np.testing.assert_array_equal(field.features[..., [3, 7]], 2 * written[..., [3, 7]] - 255)
    assert mesh is not None
    np.testing.assert_array_equal(mesh.opaque, written[..., 0] > 0)
    corners = mesh.positions[mesh.faces].reshape(-1, 3)
    for corner, along, down in QUADS:
        for point in (corner, corner + along, corner + down, corner + along + down):
            assert np.abs(corners - point).max(axis=1).min() < 1e-6
    first = mesh.require_uvs()[np.abs(mesh.positions - QUADS[0, 0]).max(axis=1) < 1e-6] * EDGE
    np.testing.assert_allclose(first, [[0.5, 0.5]], atol=1e-4)  # the middle of the upper left texel


def test_an_alpha_of_127_is_a_feature_of_0() -> None:
    """Programs that fill with a/2 + 127.5 write 127, which is -1/255 as MobileNeRF's viewer reads it."""
    bytes_ = textures()
    bytes_[0, 0, 3] = 127
    feat0 = encode_texture(np.ascontiguousarray(bytes_[..., :4]))
    assert read(**{"shape0.pngfeat0.png": feat0}).fields[0].features[0, 0, 3] == 0


def test_parts_of_a_shape_are_one_mesh_on_the_same_textures() -> None:
    parts = {"shape0.obj": None, "shape0_0.obj": obj((0, 1)), "shape0_1.obj": obj((2,))}
    whole, joined = read().meshes[0], read(**parts).meshes[0]
    assert whole is not None
    assert joined is not None
    np.testing.assert_array_equal(joined.positions[joined.faces], whole.positions[whole.faces])


def test_without_any_mesh_all_texels_but_holes_count() -> None:
    scene = read(**{"shape0.obj": None})
    assert scene.meshes == (None,)
    np.testing.assert_array_equal(scene.fields[0].used, textures()[..., 0] > 0)


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "too many shapes": ({"obj_num": 10**9}, "mlp.json: obj_num is 1000000000; allowed: a whole number from 1 to 256"),
    "no shape": ({"obj_num": 0}, "mlp.json: obj_num is 0; allowed: a whole number from 1 to 256"),
    "a fraction": ({"obj_num": 1.5}, "mlp.json: obj_num is 1.5; allowed: a whole number from 1 to 256"),
    "a second shape": ({"obj_num": 2}, "shape1.obj is missing"),
    "ragged": ({"1_weights": [[1.0, 2.0], [1.0]]}, "mlp.json: 1_weights is not a table of numbers"),
    "other inputs": ({"0_weights": [[0.0] * 16] * 6}, "mlp.json: 0_weights has shape (6, 16); allowed: 11 x any"),
    "other outputs": ({"2_weights": [[0.0] * 4] * 16}, "mlp.json: 2_weights has shape (16, 4); allowed: 16 x 3"),
    "a short bias": ({"1_bias": [0.0] * 15}, "mlp.json: 1_bias has shape (15,); allowed: 16 numbers"),
    "no bias": ({"2_bias": None}, "mlp.json has no 2_bias; allowed: weights and biases of three layers"),
    "text": ({"0_bias": ["a"] * 16}, "mlp.json: 0_bias is not a table of numbers"),
    "huge": ({"2_bias": [1e8, 0, 0]}, "net.2.bias[0] is 1e+08; allowed: a finite number within 1e+06"),
}


@pytest.mark.parametrize(("changes", "problem"), WRONG.values(), ids=WRONG)
def test_a_wrong_mlp_is_one_line(changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(NerfbakeError) as caught:
        read(**{"mlp.json": mlp_json(**changes)})
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def grey(width: int, height: int, mode: int = 4) -> bytes:
    return encode_texture(np.full((height, width, mode), 200, np.uint8))


FILES: dict[str, tuple[dict[str, bytes | None], str]] = {
    "no texture": ({"shape0.pngfeat1.png": None}, "shape0.pngfeat1.png is missing; allowed: mlp.json, and shape{i}"),
    "no first texture": ({"shape0.pngfeat0.png": None}, "shape0.pngfeat0.png is missing"),
    "other sizes": (
        {"shape0.pngfeat1.png": grey(64, 32)},
        "shape0.pngfeat1.png has 64x32 texels; allowed: 64x64, as shape0.pngfeat0.png has",
    ),
    "no alpha": ({"shape0.pngfeat0.png": grey(64, 64, 3)}, "holds RGB texels; allowed: RGBA, 8 bits a channel"),
    "a part is missing": (
        {"shape0.obj": None, "shape0_0.obj": obj((0,)), "shape0_2.obj": obj((1,))},
        "shape0_1.obj is missing; allowed: all parts from shape0_0.obj to shape0_2.obj",
    ),
    "no coordinates": ({"shape0.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"}, "no texture coordinates"),
    "all holes": ({"shape0.pngfeat0.png": encode_texture(np.zeros((64, 64, 4), np.uint8))}, "marks no texel"),
}


@pytest.mark.parametrize(("files", "problem"), FILES.values(), ids=FILES)
def test_wrong_files_are_one_line(files: dict[str, bytes | None], problem: str) -> None:
    with pytest.raises(NerfbakeError) as caught:
        read(**files)
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def test_large_textures_are_refused_before_they_are_decoded() -> None:
    bomb = grey(1500, 1500)
    with memory.memory_limit(12_000_000), pytest.raises(MemoryLimit):
        read(**{"shape0.pngfeat0.png": bomb, "shape0.pngfeat1.png": bomb})


def test_the_folder_is_not_taken_for_nerf2mesh_s(tmp_path: Path) -> None:
    loaded = io.load_with_format(phone_folder(tmp_path / "a_phone"), Stage1)
    assert loaded.form.name == "mobilenerf"
    assert isinstance(io.load_folder(tmp_path / "a_phone", Stage1).fields[0].biases, tuple)


def test_nerf2mesh_s_files_cannot_store_it() -> None:
    with pytest.raises(NerfbakeError, match="the MLP is MLP 11-16-16-3; allowed: two layers without biases"):
        list(stage1.encode(read()))


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_holes_survive_in_the_files_of_meshes(tmp_path: Path, ending: str) -> None:
    made = colour_meshes(read())
    io.save(tmp_path / f"a{ending}", made)
    [mesh], [wanted] = io.load(tmp_path / f"a{ending}", Meshes).meshes, made.meshes
    np.testing.assert_array_equal(mesh.opaque, wanted.opaque)
    np.testing.assert_array_equal(mesh.texture, wanted.texture)
    plain = replace(wanted, opaque=None)
    io.save(tmp_path / f"b{ending}", Meshes((plain,)))
    assert io.load(tmp_path / f"b{ending}", Meshes).meshes[0].opaque is None


def test_holes_survive_in_an_atlas(tmp_path: Path) -> None:
    baked = bake_stage1(read(), clusters=4, map_size=8, directions=10)
    io.save_folder(tmp_path / "atlas", baked)
    loaded = io.load_folder(tmp_path / "atlas", type(baked)).meshes[0]
    assert isinstance(loaded, Mesh)
    np.testing.assert_array_equal(loaded.opaque, textures()[..., 0] > 0)
    assert not np.any(loaded.texture)
    glb = (tmp_path / "atlas" / "scene.glb").read_bytes()
    document = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    assert document["materials"][0]["alphaMode"] == "MASK"
    diffuse = document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"]
    assert document["samplers"][document["textures"][diffuse]["sampler"]]["magFilter"] == 9728  # nearest
