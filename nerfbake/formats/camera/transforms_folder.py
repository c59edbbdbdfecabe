"""A folder with a transforms.json, or with those of NeRF-Synthetic's splits; the first of _NAMES is taken.

The split that nobody trained on comes first: pictures are judged there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from nerfbake.formats.camera import transforms
from nerfbake.formats.camera.capture import Folder
from nerfbake.scene.camera import Cameras

_NAMES = ("transforms.json", "transforms_test.json", "transforms_val.json", "transforms_train.json")


def recognise(files: Folder) -> bool:
    return any(name in files for name in _NAMES)


def split(files: Folder) -> tuple[str, str] | None:
    """The cameras to train with, and those to judge by; None where the folder does not tell them apart."""
    trained, judges = _NAMES[3], [name for name in _NAMES[1:3] if name in files]
    return (trained, judges[0]) if trained in files and judges else None


def decode(files: Folder, *, member: str = "") -> Cameras:
    name = next(name for name in (member, *_NAMES) if name in files)
    return replace(transforms.decode(files[name], beside=files), source=name)


def encode(cameras: Cameras) -> Iterator[tuple[str, Iterable[bytes]]]:
    """The one file, without pictures."""
    yield _NAMES[0], transforms.encode(cameras)
