"""What a person or a script wants to know about cameras."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.scene.camera import Camera, Cameras

_AGREE = 0.5  # length of the mean of all cameras' up: 1 where all agree
ALONG = 0.95  # how much of it one axis has, for that axis to be called up


def summary_of_cameras(cameras: Cameras) -> dict[str, Any]:
    """Dialect, pictures by size, focal lengths and centres in pixels, lenses, and where they stand.

    Ranges are [least, greatest] over all cameras; centres are told from the picture's middle. up is an axis of the
    world only where the cameras' own upward directions agree on it, as those of a hand-held capture do. samples are
    told where pictures are to have more than one ray a pixel.
    """
    all_of = cameras.cameras
    places = np.array([camera.pose[:3, 3] for camera in all_of])
    return {
        "kind": "cameras",
        "dialect": cameras.dialect or None,
        "read_from": cameras.source or None,
        "cameras": len(all_of),
        "pictures": dict(Counter(f"{camera.width}x{camera.height}" for camera in all_of)),
        "focal_x": _range([camera.fx for camera in all_of]),
        "focal_y": _range([camera.fy for camera in all_of]),
        "centre_x_off": _range([camera.cx - camera.width / 2 for camera in all_of]),
        "centre_y_off": _range([camera.cy - camera.height / 2 for camera in all_of]),
        **({} if cameras.samples == 1 else {"samples": cameras.samples}),
        "lenses": dict(Counter(map(_lens, all_of))),
        "position_box": [places.min(axis=0).tolist(), places.max(axis=0).tolist()],
        "up": _up(np.array([camera.pose[:3, 1] for camera in all_of])),
        "notes": list(cameras.notes) or None,
    }


def _range(values: list[float]) -> list[float]:
    return [float(min(values)), float(max(values))]


def _lens(camera: Camera) -> str:
    if camera.lens is None or not camera.lens.bends:
        return "pinhole"
    k = ", ".join(f"k{i} {value:g}" for i, value in enumerate(camera.lens.k, start=1) if value)
    p = ", ".join(f"p{i} {value:g}" for i, value in enumerate(camera.lens.p, start=1) if value)
    return f"{camera.lens.model} ({', '.join(part for part in (k, p) if part)})" if k or p else camera.lens.model


def _up(ups: npt.NDArray[np.float64]) -> str | None:
    mean = (ups / np.linalg.norm(ups, axis=1, keepdims=True)).mean(axis=0)
    length, axis = np.sqrt((mean * mean).sum()), int(np.argmax(np.abs(mean)))
    if length < _AGREE or abs(mean[axis]) < ALONG * length:
        return None
    return f"{'-' if mean[axis] < 0 else ''}{'xyz'[axis]}"
