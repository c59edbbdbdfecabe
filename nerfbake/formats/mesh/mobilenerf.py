"""Read MobileNeRF's folders NAME_phone: textured quads with holes, 8 features a texel, and an MLP.

| file | content |
|---|---|
| shape{i}.obj, or shape{i}_{j}.obj, j = 0, 1, ...: parts of one shape | quads of two triangles, 17x17 texels each |
| shape{i}.pngfeat0.png, .pngfeat1.png | RGBA: features 1 to 4, and 5 to 8. Where red of the first is 0 is a hole |
| mlp.json | {0,1,2}_weights [in][out] and {0,1,2}_bias; obj_num, the number of shapes |

    colour = sigmoid(MLP([8 features, d]))      d = the unit vector from the camera to the surface, in the NeRF's world

Coordinates of the .obj are (x, z, -y) of the NeRF's world, which the scene gets back; those of forward-facing scenes
are not turned, but no file says so. The alpha of a PNG holds a feature a as a/2 + 128, because iPhones leave out what
is transparent; a is 2 alpha - 255, at least 0. Without any .obj, all texels but holes count.

Source: MobileNeRF (Chen et al., 2023) and its viewer; docs/formats/atlas.md, "MobileNeRF's folder".
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.mesh.obj import decode_obj
from nerfbake.formats.wire.json import parse_object, table, whole
from nerfbake.formats.wire.picture import decode_rgba
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.surface.raster import covered_texels
from nerfbake.scene.mesh import Mesh, joined_meshes
from nerfbake.scene.origin import no_origin
from nerfbake.scene.stage1 import SpecularField, Stage1

MAX_SHAPES = 256
MAX_TEXELS = 1 << 24  # of a texture: 4096 x 4096, as the program writes them
_NAME, _LAYERS, _FEATURES = "mlp.json", 3, 8
_ALLOWED = "mlp.json, and shape{i}.pngfeat0.png and .pngfeat1.png for every shape"
_FIRST = ("shape0.pngfeat0.png", "shape0.pngfeat1.png", "shape0.obj")
_PART = re.compile(r"shape([0-9]{1,4})_([0-9]{1,4})\.obj")


def recognise(files: Mapping[str, memoryview]) -> bool:
    return _NAME in files and any(name in files for name in _FIRST)


def decode(files: Mapping[str, memoryview]) -> Stage1:
    """Read a folder. A shape is a cascade of the scene.

    Raises InvalidFile with the name of the first missing or wrong file, InvalidScene for arrays that do not match.
    """
    content = parse_object(_require(files, _NAME), _NAME)
    count = whole(content, "obj_num", _NAME, low=1, high=MAX_SHAPES)
    (first, *middle, last), biases = _layers(content)
    # The file has the features before the direction.
    w0 = np.concatenate([first[_FEATURES:], first[:_FEATURES]])
    parts = _parts_of(files, count)
    fields, meshes = [], []
    for shape in range(count):
        features = _features(files, shape)
        H, W, _ = features.shape
        memory.hold(f"shape{shape}", 2 * H * W)  # of holes, and of the texels that are used
        used = features[..., 0] > 0
        mesh = _mesh(files, parts[shape], used)
        if mesh is not None:
            used = used & covered_texels(mesh.require_unwrapped(), mesh.faces, H, W)
        fields.append(SpecularField(features, w0, last, used, tuple(middle), tuple(biases)))
        meshes.append(mesh)
    return Stage1(tuple(fields), tuple(meshes), deferred=True)


def _layers(content: dict[str, Any]) -> tuple[list[Singles], list[Singles]]:
    """Return the weights (in, out) and the biases of all layers. Raises InvalidFile unless their sizes match."""
    weights, biases, inputs = [], [], _FEATURES + 3
    for layer in range(_LAYERS):
        for key in (f"{layer}_weights", f"{layer}_bias"):
            if key not in content:
                raise InvalidFile(Problem(_NAME, f"has no {key}", "weights and biases of three layers"))
        outputs = 3 if layer == _LAYERS - 1 else None
        weight = table(content[f"{layer}_weights"], f"{_NAME}: {layer}_weights", (inputs, outputs))
        inputs = weight.shape[1]
        weights.append(weight.astype(np.float32))
        biases.append(table(content[f"{layer}_bias"], f"{_NAME}: {layer}_bias", (inputs,)).astype(np.float32))
    return weights, biases


def _features(files: Mapping[str, memoryview], shape: int) -> npt.NDArray[np.uint8]:
    """Return the features (H, W, 8) of a shape."""
    names = [f"shape{shape}.pngfeat{k}.png" for k in range(2)]
    first, second = (decode_rgba(_require(files, name), name) for name in names)
    if first.shape != second.shape:
        found, allowed = (f"{texels.shape[1]}x{texels.shape[0]}" for texels in (second, first))
        raise InvalidFile(Problem(names[1], f"has {found} texels", f"{allowed}, as {names[0]} has"))
    if first[..., 0].size > MAX_TEXELS:
        found = f"has {first.shape[1]:,}x{first.shape[0]:,} texels"
        raise InvalidFile(Problem(names[0], found, f"{MAX_TEXELS:,} texels, 4096x4096"))
    memory.hold(names[0], 3 * first.nbytes)  # both together, and the steps from alpha to a feature
    features = np.concatenate([first, second], axis=2)
    for channel in (3, 7):
        alpha = features[..., channel]
        features[..., channel] = np.where(alpha < 128, 0, 2 * (alpha & 127) + 1)  # 2 alpha - 255
    return features


def _parts_of(files: Mapping[str, memoryview], count: int) -> list[list[str]]:
    """Return the names of each shape's .obj files. Raises InvalidFile if only some are there."""
    numbered: dict[int, set[int]] = {}
    for name in files:
        if match := _PART.fullmatch(name):
            numbered.setdefault(int(match[1]), set()).add(int(match[2]))
    parts: list[list[str]] = []
    for shape in range(count):
        whole_shape, numbers = f"shape{shape}.obj", numbered.get(shape, set())
        expected = [f"shape{shape}_{part}.obj" for part in range(max(numbers, default=-1) + 1)]
        parts.append([whole_shape] if whole_shape in files else expected)
        for name in parts[-1]:
            if name not in files:
                raise InvalidFile(Problem(name, "is missing", f"all parts from shape{shape}_0.obj to {expected[-1]}"))
    if any(parts) and not all(parts):
        missing = next(shape for shape in range(count) if not parts[shape])
        raise InvalidFile(Problem(f"shape{missing}.obj", "is missing", "a mesh for every shape, or for none"))
    return parts


def _mesh(files: Mapping[str, memoryview], names: list[str], opaque: npt.NDArray[np.bool_]) -> Mesh | None:
    """Return a shape's mesh in the NeRF's world, with holes, and black where the colour is all the MLP's."""
    if not names:
        return None
    found = [mesh for name in names for mesh in decode_obj(files[name], name).relative_to(no_origin()).meshes]
    positions, faces, _ = joined_meshes(found)
    x, z, y = positions.T
    uvs = np.concatenate([mesh.require_uvs() for mesh in found])
    black, holes = np.zeros((1, 1, 3), np.uint8), None if opaque.all() else opaque
    return Mesh(np.stack([x, -y, z], axis=1), uvs, faces, black, opaque=holes)


def _require(files: Mapping[str, memoryview], name: str) -> memoryview:
    if name not in files:
        raise InvalidFile(Problem(name, "is missing", _ALLOWED))
    return files[name]
