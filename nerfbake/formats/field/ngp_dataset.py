"""The cameras of an instant-ngp snapshot, and the frame from the world to the coordinates in which it was trained.

    snapshot.nerf.dataset   scale, offset, aabb_scale, from_mitsuba, is_hdr, n_extra_learnable_dims, n_images
      paths[i]              of the pictures
      xforms[i].start       3 x 4, camera to the trained coordinates: x right, y down, z forward
      metadata[i]           resolution, focal_length (pixels), principal_point (shares of the resolution), and `lens`
                            (until 2022 `camera_distortion`): k1, k2, p1, p2, or is_fisheye and k1 to k4, or {}

A point p of transforms.json is trained at q = p scale + offset with (x, y, z) of q being its y, z, x, unless
from_mitsuba is true. Source: docs/fields.md, "Programs"; json_binding.h and nerf_loader.h.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.capture import inside_of, names_of, opengl, room_for
from nerfbake.formats.camera.transforms import lens_of
from nerfbake.formats.wire.json import kind_of, number, table, whole
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import rotate
from nerfbake.kernels.soundness import MAX_EDGE, plural
from nerfbake.scene.camera import FOCAL_LENGTHS, Camera, Cameras

DATASET = "snapshot.nerf.dataset"
_SCALE, _OFFSET = 0.33, 0.5  # without a data set
_LENS = ("lens", "camera_distortion")
_NO_LENS = ("ftheta_p0", "latlong", "equirectangular", "orthographic")  # keys of rays that no Lens has


def frame_of(dataset: dict[str, Any]) -> Floats:
    """(3, 4) from the world of transforms.json to the trained coordinates."""
    scale = number(dataset, "scale", DATASET, default=_SCALE, low=1e-9, high=1e9)
    offset = table(dataset.get("offset", [_OFFSET] * 3), f"{DATASET}.offset", (3,))
    frame = np.column_stack([scale * np.eye(3), offset])
    mitsuba = dataset.get("from_mitsuba", False)
    if type(mitsuba) is not bool:
        raise InvalidFile(Problem(f"{DATASET}.from_mitsuba", f"is {kind_of(mitsuba)}", "true or false"))
    return frame if mitsuba else np.roll(frame, -1, axis=0)


def cameras_of(dataset: dict[str, Any], frame: Floats) -> Cameras | None:
    """Return the cameras in the world; None without any. Raises InvalidFile, MemoryLimit."""
    count = whole(dataset, "n_images", DATASET, default=0, high=1 << 31)
    if not count:
        return None
    room_for(count)
    xforms, metadata = (_listed(dataset, key, count) for key in ("xforms", "metadata"))
    given = dataset.get("paths")
    paths = [path if isinstance(path, str) else None for path in given] if isinstance(given, list) else []
    paths = (paths + [None] * count)[:count]
    cameras = []
    for i, (xform, facts, path, name) in enumerate(zip(xforms, metadata, paths, names_of(paths), strict=True)):
        camera = _camera(xform, facts, i)
        if camera is not None:
            cameras.append(Camera(**camera, name=name, picture=inside_of(path)))
    if not cameras:
        return None
    skipped = count - len(cameras)
    notes = (f"{plural(skipped, 'camera')} without a perspective or fisheye lens left out",) if skipped else ()
    turn = frame[:, :3].T / (frame[:, 0] ** 2).sum()
    back = np.column_stack([turn, -rotate(frame[:, 3], turn)])
    return Cameras(tuple(cameras), "instant-ngp", notes=notes).transformed(back)


def _camera(xform: dict[str, Any], facts: dict[str, Any], i: int) -> dict[str, Any] | None:
    """Return the arguments of a camera in the trained coordinates; None for a lens that Lens does not describe."""
    place = f"{DATASET}.metadata[{i}]"
    lens: Any = next((facts[key] for key in _LENS if facts.get(key) is not None), {})
    if not isinstance(lens, dict):
        raise InvalidFile(Problem(f"{place}.lens", f"is {kind_of(lens)}", "an object"))
    if any(key in lens for key in _NO_LENS):
        return None
    pose = np.eye(4)
    pose[:3] = table(xform.get("start"), f"{DATASET}.xforms[{i}].start", (3, 4))
    size = table(facts.get("resolution"), f"{place}.resolution", (2,))
    if not ((size >= 1) & (size <= MAX_EDGE) & (size == np.floor(size))).all():
        raise InvalidFile(Problem(f"{place}.resolution", f"is {size[0]:g} x {size[1]:g}", f"1 to {MAX_EDGE:,} pixels"))
    focal = table(facts.get("focal_length"), f"{place}.focal_length", (2,))
    if not ((focal >= FOCAL_LENGTHS[0]) & (focal <= FOCAL_LENGTHS[1])).all():
        found = f"is {focal[0]:g}, {focal[1]:g}"
        raise InvalidFile(Problem(f"{place}.focal_length", found, "pixels, above 0"))
    centre = table(facts.get("principal_point", [0.5, 0.5]), f"{place}.principal_point", (2,)) * size
    return {
        "width": int(size[0]),
        "height": int(size[1]),
        "focal": (float(focal[0]), float(focal[1])),
        "pose": opengl(pose),
        "centre": (float(centre[0]), float(centre[1])),
        "lens": lens_of(lens, f"{place}.lens"),
    }


def _listed(dataset: dict[str, Any], key: str, count: int) -> list[dict[str, Any]]:
    found = dataset.get(key)
    if not isinstance(found, list) or len(found) != count or not all(isinstance(each, dict) for each in found):
        number_of = f"{len(found):,} entries" if isinstance(found, list) else kind_of(found)
        raise InvalidFile(Problem(f"{DATASET}.{key}", f"has {number_of}", f"{count:,} objects, as n_images says"))
    return found
