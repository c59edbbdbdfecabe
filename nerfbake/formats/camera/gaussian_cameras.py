"""Read and write cameras.json of 3D Gaussian Splatting, which its training writes into its output folder.

[{id, img_name, width, height, position: [3], rotation: [[3], [3], [3]], fx, fy}, ...]

position is the camera's centre; rotation is camera to world, OpenCV's axes, row by row. There is neither a lens nor a
principal point: the cameras belong to undistorted pictures, which lie in `images` of the training's source. img_name
has no extension. width and height may be those of larger pictures; fit scales them to the pictures that it finds.
Source: 99.96 % of COLMAP's tracks are in the frame on a real capture; with the transposed matrix, 20 %.
"""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np

from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, edge_of
from nerfbake.formats.camera.capture import MAX_FRAMES, CaptureFolder, opengl
from nerfbake.formats.camera.turns import pose_of_world
from nerfbake.formats.wire.json import kind_of, number, parse, table
from nerfbake.scene.camera import FOCAL_LENGTHS, Cameras

_KEYS = (b'"img_name"', b'"position"', b'"rotation"')


def recognise(name: str, head: bytes) -> bool:
    return head.lstrip().startswith(b"[") and all(key in head for key in _KEYS)


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    entries = parse(files[name], name)
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_FRAMES:
        raise InvalidFile(Problem(name, f"holds {kind_of(entries)}", f"a list of 1 to {MAX_FRAMES:,} cameras"))
    album, posed = Album(files), []
    for i, entry in enumerate(entries):
        place = f"{name}: [{i}]"
        if not isinstance(entry, dict):
            raise InvalidFile(Problem(place, f"is {kind_of(entry)}", "an object"))
        matrix = np.eye(4)
        matrix[:3, :3] = table(entry.get("rotation"), f"{place}.rotation", (3, 3))
        matrix[:3, 3] = table(entry.get("position"), f"{place}.position", (3,))
        low, high = FOCAL_LENGTHS
        focal = number(entry, "fx", place, low=low, high=high), number(entry, "fy", place, low=low, high=high)
        width, height = (edge_of(number(entry, key, place), f"{place}.{key}") for key in ("width", "height"))
        label = str(entry.get("img_name", ""))
        posed.append(Posed(label, album.find(label), pose_of_world(matrix), (width, height), focal))
    return cameras_of(posed, dialect="3D Gaussian Splatting", source=name)


def encode(cameras: Cameras) -> Iterator[bytes]:
    """Encode cameras.json. Lenses and principal points have no place in it. Raises InvalidScene for panoramas."""
    entries = []
    for i, camera in enumerate(cameras.cameras):
        if camera.lens is not None and camera.lens.all_round:
            found = "shows all directions"
            raise InvalidScene(Problem(f"camera {camera.name}".strip(), found, "a pinhole: the format has no lens"))
        pose = opengl(camera.pose)
        fields = {"id": i, "img_name": camera.name, "width": camera.width, "height": camera.height}
        fields |= {"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}
        entries.append({**fields, "fy": camera.fy, "fx": camera.fx})
    yield json.dumps(entries).encode() + b"\n"
