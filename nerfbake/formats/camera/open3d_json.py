"""Read trajectories with intrinsics of Open3D, in JSON.

class_name    PinholeCameraTrajectory
parameters    [{extrinsic: [16], intrinsic: {width, height, intrinsic_matrix: [9]}}, ...]

extrinsic is WORLD to camera, OpenCV's axes, and both matrices are COLUMN by column. The pictures are taken in the order
of their names.
Source: agrees with the .log of the same scene to 3e-16.
"""

from __future__ import annotations

from typing import Any

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, edge_of
from nerfbake.formats.camera.capture import MAX_FRAMES, CaptureFolder
from nerfbake.formats.camera.turns import pose_shifted
from nerfbake.formats.wire.json import number, parse_object, table
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras
from nerfbake.scene.lens import Lens

_CLASS = b"PinholeCameraTrajectory"


def recognise(name: str, head: bytes) -> bool:
    return b'"class_name"' in head and _CLASS in head


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    entries = parse_object(files[name], name).get("parameters")
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_FRAMES:
        found = f"has {len(entries):,} parameters" if isinstance(entries, list) else "has no parameters"
        raise InvalidFile(Problem(name, found, f"1 to {MAX_FRAMES:,}"))
    paths = Album(files).numbered()
    notes = []
    if len(paths) != len(entries):
        notes = [f"{plural(len(paths), 'picture')} for {len(entries):,} poses; the cameras are numbered"]
        paths = [""] * len(entries)
    posed = []
    for i, (entry, path) in enumerate(zip(entries, paths, strict=True)):
        place = f"{name}: parameters[{i}]"
        fields: dict[str, Any] = entry if isinstance(entry, dict) else {}
        matrix = table(fields.get("extrinsic"), f"{place}.extrinsic", (16,)).reshape(4, 4).T
        inside = fields.get("intrinsic")
        inside = inside if isinstance(inside, dict) else {}
        K = table(inside.get("intrinsic_matrix"), f"{place}.intrinsic_matrix", (9,)).reshape(3, 3).T
        width, height = (edge_of(number(inside, key, place), f"{place}.{key}") for key in ("width", "height"))
        focal, centre = (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2]))
        lens = Lens("polynomial", skew=float(K[0, 1]) / (focal[0] or 1))
        pose = pose_shifted(matrix[:3, :3], matrix[:3, 3])
        posed.append(Posed(path or f"{i:06d}", path, pose, (width, height), focal, centre, lens))
    return cameras_of(posed, dialect="Open3D", source=name, notes=notes)
