"""Read folders with a transforms.json, or with one for each of NeRF-Synthetic's splits. The first of _NAMES is read.

The test split comes before the training split, because pictures are evaluated on held-out views. transforms.json has no
sparse points. If the folder also has the COLMAP model that its poses come from, the points are those of the model.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.camera import colmap, transforms
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.kernels.maths.affine import compose, inverse, rotate
from nerfbake.scene.camera import Cameras
from nerfbake.scene.sparse_points import SparsePoints

_NAMES = ("transforms.json", "transforms_test.json", "transforms_val.json", "transforms_train.json")
_IMAGES = "images/"
FILES = re.compile(re.escape(_NAMES[0]))
_SAME = 1e-4  # largest difference of two poses that are the same, relative to the distances of the cameras


def recognise(files: CaptureFolder) -> bool:
    return any(name in files for name in _NAMES)


def split(files: CaptureFolder) -> tuple[str, str] | None:
    """Return the file of the training cameras and that of the held-out ones; None if the folder has no such split."""
    training, held_out = _NAMES[3], [name for name in _NAMES[1:3] if name in files]
    return (training, held_out[0]) if training in files and held_out else None


def decode(files: CaptureFolder, *, member: str = "") -> Cameras:
    name = next(name for name in (member, *_NAMES) if name in files)
    cameras = replace(transforms.decode(files[name], beside=files), source=name)
    points = None
    if colmap.recognise(files):
        with suppress(InvalidFile, InvalidScene):  # the poses do not need it
            points = _points_of(colmap.decode(files), cameras)
    return replace(cameras, points=points)


def _points_of(model: Cameras, cameras: Cameras) -> SparsePoints | None:
    """Return the points of a COLMAP model in the world of cameras; None if these have other poses.

    The worlds may differ by a rotation and a translation, such as nerfstudio's applied_transform.
    """
    # The pictures of a model are relative to `images`, or to the folder itself if `images` does not exist.
    places = {camera.picture.removeprefix(_IMAGES): i for i, camera in enumerate(model.cameras) if camera.picture}
    names = [camera.picture.removeprefix(_IMAGES) for camera in cameras.cameras]
    pairs = [(places[name], i) for i, name in enumerate(names) if name in places]
    if model.points is None or len(pairs) < 2:
        return None
    found = np.stack([model.cameras[i].pose[:3] for i, _ in pairs])
    wanted = np.stack([cameras.cameras[i].pose[:3] for _, i in pairs])
    turn = compose(wanted[0, :, :3], inverse(found[0, :, :3]))
    shift = wanted[0, :, 3] - rotate(found[0, :, 3], turn)
    moved = np.stack(
        [np.column_stack([compose(turn, each[:, :3]), rotate(each[:, 3], turn) + shift]) for each in found]
    )
    spread = np.abs(wanted[:, :, 3] - wanted[0, :, 3]).max()
    if not (np.abs(moved - wanted) <= _SAME * np.array([1, 1, 1, spread])).all():
        return None
    positions = rotate(model.points.positions, turn) + shift
    return replace(model.points, positions=positions).seen_by(dict(pairs))


def encode(cameras: Cameras) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield transforms.json. Pictures are not written."""
    yield _NAMES[0], transforms.encode(cameras)
