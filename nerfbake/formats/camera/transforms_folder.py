"""Read folders with a transforms.json, or with one for each of NeRF-Synthetic's splits. The first of _NAMES is read.

The test split comes before the training split, because pictures are evaluated on held-out views.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace

from nerfbake.formats.camera import transforms
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.scene.camera import Cameras

_NAMES = ("transforms.json", "transforms_test.json", "transforms_val.json", "transforms_train.json")
FILES = re.compile(re.escape(_NAMES[0]))


def recognise(files: CaptureFolder) -> bool:
    return any(name in files for name in _NAMES)


def split(files: CaptureFolder) -> tuple[str, str] | None:
    """Return the file of the training cameras and that of the held-out ones; None if the folder has no such split."""
    training, held_out = _NAMES[3], [name for name in _NAMES[1:3] if name in files]
    return (training, held_out[0]) if training in files and held_out else None


def decode(files: CaptureFolder, *, member: str = "") -> Cameras:
    name = next(name for name in (member, *_NAMES) if name in files)
    return replace(transforms.decode(files[name], beside=files), source=name)


def encode(cameras: Cameras) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield transforms.json. Pictures are not written."""
    yield _NAMES[0], transforms.encode(cameras)
