#!/usr/bin/env bash
# nerfbaselines 1.2.12: p1 and p2 of nerfstudio change places, and k1 and k2 of Bundler become the principal point.
#
# A transforms.json states a lens once for all frames, as `ns-process-data` writes it, or in each frame. In the first
# case, the loader takes p2 for p1 and p1 for p2; in the second, the same numbers stay in place. With those below, the
# corner of a picture is off by 2 pixels. The first line of a camera in Bundler's file is "f k1 k2"; the loader reads
# "f cx cy" unless it is told otherwise, so the principal point of a picture is in its corner, and no lens is left. It
# pairs cameras with the pictures of the folder in the order of the disk: list.txt, which names them, is not read.
# load_dataset() chooses both loaders by itself, and nothing says a word.
#
# Seen on 2026-11-28 (fx fy cx cy, k1 k2 p1 p2, of -0.1 0.02 0.001 -0.002 and a picture of 800 x 600):
#   nerfstudio, in each frame: [500.0, 500.0, 400.0, 300.0] [-0.1, 0.02, 0.001, -0.002]
#   nerfstudio, once for all:  [500.0, 500.0, 400.0, 300.0] [-0.1, 0.02, -0.002, 0.001]
#   Bundler, k1 and k2:        [500.0, 500.0, -0.1, 0.02] [0.0, 0.0, 0.0, 0.0]
#
# nerfbake reads the same lens from both of nerfstudio's files, k1 and k2 from Bundler's, and pictures from list.txt.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check nerfbaselines==1.2.12 numpy==1.26.4 2>/dev/null
venv/bin/python - <<'PYTHON' 2>log || (cat log && false)
import json
from pathlib import Path

from nerfbaselines.datasets import load_dataset
from PIL import Image

SIZE = {"fl_x": 500, "fl_y": 500, "cx": 400, "cy": 300, "w": 800, "h": 600}
LENS = {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002}
CENTRES = {"a": (0, 0, 0), "b": (1, 0, 0), "c": (0, 1, 0)}
FRAMES = [
    {"file_path": f"images/{name}.png", "transform_matrix": [[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, z], [0, 0, 0, 1]]}
    for name, (x, y, z) in CENTRES.items()
]


def loaded(name, **files):
    folder = Path(name)
    (folder / "images").mkdir(parents=True)
    for each in CENTRES:
        Image.new("RGB", (800, 600)).save(folder / "images" / f"{each}.png")
    for path, text in files.items():
        (folder / path.replace("_", ".")).write_text(text)
    found = load_dataset(name, "train", features=frozenset())
    camera = found["cameras"][0]
    numbers = [camera.intrinsics.tolist(), camera.distortion_parameters[:4].tolist()]
    return [[round(each, 4) for each in part] for part in numbers], [Path(each).name for each in found["image_paths"]]


every = {"camera_model": "OPENCV", "frames": [{**frame, **SIZE, **LENS} for frame in FRAMES]}
once = {"camera_model": "OPENCV", **SIZE, **LENS, "frames": FRAMES}
lines = [f"500 -0.1 0.02\n1 0 0\n0 1 0\n0 0 1\n{-x} {-y} {-z}\n" for x, y, z in CENTRES.values()]
bundle = {"cameras_out": f"# Bundle file v0.3\n{len(lines)} 0\n" + "".join(lines)}
names = [frame["file_path"] + "\n" for frame in FRAMES]
every, _ = loaded("every", transforms_json=json.dumps(every))
once, _ = loaded("once", transforms_json=json.dumps(once))
bundler, pictures = loaded("bundler", **bundle, list_txt="".join(names))
_, again = loaded("again", **bundle, list_txt="".join(reversed(names)))
print("nerfstudio, in each frame:", *every)
print("nerfstudio, once for all: ", *once)
print("Bundler, k1 and k2:       ", *bundler)
assert every == [[500, 500, 400, 300], [-0.1, 0.02, 0.001, -0.002]]
assert once == [[500, 500, 400, 300], [-0.1, 0.02, -0.002, 0.001]]
assert bundler == [[500, 500, -0.1, 0.02], [0, 0, 0, 0]]
assert pictures == again
PYTHON
