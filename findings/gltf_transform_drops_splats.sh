#!/usr/bin/env bash
# gltf-transform 4.5.1: `optimize` of a .glb of splats writes a valid .glb without any splat, and exits with 0.
#
# The extension KHR_gaussian_splatting is unknown to it: a line warns that an optional extension is missing. The step
# that simplifies meshes then finds no triangle to keep and removes all points: 281 kB become 120 bytes, an asset without
# a mesh. Without that step (--simplify false) the points stay and positions become integers, which a node's scale
# turns back, but the primitive has lost its extension: readers see points, no splats. `copy` drops the extension, too.
# gltfpack 1.3.0 warns of each attribute and keeps positions alone.
# So compress a .glb of splats with a program that knows them; nerfbake's `convert` writes .spz and .sog.
#
# Seen on 2026-11-28:
#   optimize: code 0, 281424 -> 120 bytes, 0 points
#   optimize --simplify false: code 0, 5000 points, extension kept: False
#   copy: code 0, 5000 points, extension kept: False
#   gltfpack: code 0, attributes ['POSITION'], extension kept: False
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @gltf-transform/cli@4.5.1 gltfpack@1.3.0
venv/bin/python - <<'PYTHON'
import json
import subprocess

import numpy as np

N, SPLATS = 5000, "KHR_gaussian_splatting"
rng = np.random.default_rng(1)
columns = {
    "POSITION": rng.normal(size=(N, 3)),
    f"{SPLATS}:ROTATION": np.full((N, 4), 0.5),
    f"{SPLATS}:SCALE": np.full((N, 3), np.log(0.02)),
    f"{SPLATS}:OPACITY": np.full((N, 1), 0.9),
    f"{SPLATS}:SH_DEGREE_0_COEF_0": rng.normal(size=(N, 3)),
}
data, views, accessors = b"", [], []
for values in columns.values():
    block = values.astype("<f4").tobytes()
    kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
    views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(block)})
    accessors.append({"bufferView": len(accessors), "componentType": 5126, "count": N, "type": kind})
    data += block
places = columns["POSITION"].astype("<f4")
accessors[0] |= {"min": places.min(axis=0).tolist(), "max": places.max(axis=0).tolist()}
how = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
primitive = {
    "mode": 0,
    "attributes": {name: place for place, name in enumerate(columns)},
    "extensions": {SPLATS: how | {"projection": "perspective", "sortingMethod": "cameraDistance"}},
}
document = {
    "asset": {"version": "2.0"},
    "extensionsUsed": [SPLATS],
    "scene": 0,
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [primitive]}],
    "buffers": [{"byteLength": len(data)}],
    "bufferViews": views,
    "accessors": accessors,
}
text = json.dumps(document).encode()
text += b" " * (-len(text) % 4)
head = np.array([2, 28 + len(text) + len(data), len(text)], "<u4").tobytes()
body = head + b"JSON" + text + np.array([len(data)], "<u4").tobytes() + b"BIN\0" + data
open("in.glb", "wb").write(b"glTF" + body)


def run(name, *command):
    code = subprocess.run([f"node_modules/.bin/{command[0]}", *command[1:]], capture_output=True).returncode
    found = open("out.glb", "rb").read()
    made = json.loads(found[20 : 20 + int.from_bytes(found[12:16], "little")])
    drawn = [each for mesh in made.get("meshes", []) for each in mesh["primitives"]]
    points = sum(made["accessors"][each["attributes"]["POSITION"]]["count"] for each in drawn)
    kept = SPLATS in json.dumps([each.get("extensions") for each in drawn])
    return code, len(found), points, kept, [key for each in drawn for key in each["attributes"]]


code, size, points, _, _ = run("optimize", "gltf-transform", "optimize", "in.glb", "out.glb")
print(f"optimize: code {code}, {4 + len(body)} -> {size} bytes, {points} points")
assert (code, points) == (0, 0)
for name, *command in (
    ("optimize --simplify false", "gltf-transform", "optimize", "--simplify", "false", "in.glb", "out.glb"),
    ("copy", "gltf-transform", "copy", "in.glb", "out.glb"),
):
    code, _, points, kept, _ = run(name, *command)
    print(f"{name}: code {code}, {points} points, extension kept: {kept}")
    assert (code, points, kept) == (0, N, False)
code, _, _, kept, names = run("gltfpack", "gltfpack", "-i", "in.glb", "-o", "out.glb")
print(f"gltfpack: code {code}, attributes {names}, extension kept: {kept}")
assert (code, names, kept) == (0, ["POSITION"], False)
PYTHON
