"""The files of a nerfstudio run beside its checkpoints, outputs/NAME/METHOD/TIME.

    config.yml                   every setting of the training; of `pipeline.model` some are not in the checkpoint
    dataparser_transforms.json   {"transform": 3 x 4, "scale": s}: the trained coordinates are s transform [p; 1]
    transforms.json              of the capture, if its user copied it here: the cameras, applied_transform A and
                                 applied_scale a. It may also be named capture_transforms.json here

`transform` starts at the world before A, and `scale` contains a. Cameras are in the world after A, so that for them the
trained coordinates are s/a transform A^-1 [p; 1]. Source: docs/fields.md, "Programs"; nerfstudio_dataparser.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera import transforms
from nerfbake.formats.wire.json import key_place, number, parse_object, shorten, table, whole
from nerfbake.formats.wire.yaml import parse_map
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose, inverse
from nerfbake.scene.camera import Cameras

CONFIG, WORLD = "config.yml", "dataparser_transforms.json"
CAPTURE, _RENAMED = "transforms.json", "capture_transforms.json"
_MODEL = f"{CONFIG}: pipeline.model"
_COLMAP = "colmap/sparse/0/cameras.bin"
_OF_COLMAP = [[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]  # applied_transform of captures that do not name it
_SCALES = 1e-9, 1e9

Background = tuple[float, float, float] | Literal["last"]
_BACKGROUNDS: dict[Any, Background] = {
    "last_sample": "last",
    "random": (0.0, 0.0, 0.0),  # when it evaluates
    "black": (0.0, 0.0, 0.0),
    "white": (1.0, 1.0, 1.0),
}


class RunFolder(Protocol):
    """Files by name, read on access."""

    def __contains__(self, name: object) -> bool: ...

    def __getitem__(self, name: str) -> memoryview: ...


@dataclass(frozen=True)
class Run:
    """What is known of a run.

    settings  `pipeline.model` of config.yml; None without that file
    frame     (3, 4) from the world to the trained coordinates
    cameras   of the capture, in the world
    notes     one line each
    """

    settings: dict[Any, Any] | None = None
    frame: Floats = field(default_factory=lambda: np.eye(3, 4))
    cameras: Cameras | None = None
    notes: tuple[str, ...] = ()

    def _fields(self, key: str, default: Any, absent: Any) -> dict[str, Any]:
        """Return {key: value}: default without a config.yml, absent if it does not have the key."""
        if self.settings is None:
            return {key: default}
        return {key: self.settings.get(key, default if absent is None else absent)}

    def number(self, key: str, default: float, *, low: float, high: float, absent: float | None = None) -> float:
        return number(self._fields(key, default, absent), key, _MODEL, low=low, high=high)

    def whole(self, key: str, default: int, *, low: int, high: int) -> int:
        return whole(self._fields(key, default, None), key, _MODEL, low=low, high=high)

    def flag(self, key: str, default: bool) -> bool:
        value = self._fields(key, default, None)[key]
        if type(value) is not bool:
            raise InvalidFile(Problem(key_place(_MODEL, key), f"is {shorten(value)}", "true or false"))
        return value

    def collider(self, near: float, far: float) -> tuple[float, float]:
        """Return where rays begin and end, of a model that has them in `collider_params`."""
        key = "collider_params"
        found = self._fields(key, {}, None)[key]
        if not isinstance(found, dict):
            raise InvalidFile(Problem(key_place(_MODEL, key), f"is {shorten(found)}", "near_plane and far_plane"))
        place = key_place(_MODEL, key)
        low = number(found, "near_plane", place, default=near, low=0.0, high=1e9)
        return low, number(found, "far_plane", place, default=far, low=0.0, high=1e9)

    def background(self, default: str) -> Background:
        """The colour behind the field when the program evaluates it."""
        value = self._fields("background_color", default, None)["background_color"]
        if not isinstance(value, str) or value not in _BACKGROUNDS:
            found = f"is {shorten(value)}"
            raise InvalidFile(Problem(key_place(_MODEL, "background_color"), found, ", ".join(_BACKGROUNDS)))
        return _BACKGROUNDS[value]


def read_run(files: RunFolder | None) -> Run:
    """Return what the files of a run say. files: of the run's folder, or of its folder nerfstudio_models.

    Raises InvalidFile naming the file, MemoryLimit.
    """
    at = None if files is None else _place(files)
    if files is None or at is None:
        return Run(notes=(_no_settings(), _no_world()))
    settings, notes = None, list[str]()
    if at + CONFIG in files:
        settings = _settings(files[at + CONFIG])
    else:
        notes.append(_no_settings())
    if at + WORLD not in files:
        return Run(settings, notes=(*notes, _no_world()))
    fields = parse_object(files[at + WORLD], WORLD)
    transform = table(fields.get("transform"), f"{WORLD}: transform", (3, 4))
    scale = number(fields, "scale", WORLD, low=_SCALES[0], high=_SCALES[1])
    name = next((each for each in (CAPTURE, _RENAMED) if at + each in files), None)
    if name is None:
        notes.append(
            f"without the capture's {CAPTURE} beside {CONFIG}, there are no cameras, and its applied_transform, if it "
            "has one, is undone"
        )
        return Run(settings, scale * transform, notes=tuple(notes))
    capture = parse_object(files[at + name], name, comments=True)
    applied = capture.get("applied_transform", _OF_COLMAP if at + _COLMAP in files else None)
    scale /= number(capture, "applied_scale", name, default=1.0, low=_SCALES[0], high=_SCALES[1])
    if applied is not None:
        transform = compose(transform, _inverse(table(applied, f"{name}: applied_transform", (3, 4))))
    return Run(settings, scale * transform, transforms.decode(files[at + name]), tuple(notes))


def _no_settings() -> str:
    return f"without {CONFIG} of the run, its settings are assumed"


def _no_world() -> str:
    return f"without {WORLD} of the run, the world is the one in which it was trained"


def _place(files: RunFolder) -> str | None:
    """Return where the run's files are: '' or '../'; None: nowhere."""
    if CONFIG in files or WORLD in files:
        return ""
    return "../" if f"../{CONFIG}" in files and f"../{WORLD}" in files else None


def _settings(view: memoryview) -> dict[Any, Any]:
    pipeline = parse_map(view, CONFIG).get("pipeline")
    model = pipeline.get("model") if isinstance(pipeline, dict) else None
    if not isinstance(model, dict):
        raise InvalidFile(Problem(CONFIG, "has no pipeline.model", "the config.yml of a nerfstudio run"))
    return model


def _inverse(applied: Floats) -> Floats:
    """(4, 4) inverse of a (3, 4) transform. Raises InvalidFile if it has none."""
    with np.errstate(all="ignore"):
        found = inverse(np.vstack([applied, [0.0, 0, 0, 1]]))
    if not np.isfinite(found).all():
        raise InvalidFile(Problem(f"{CAPTURE}: applied_transform", "has no inverse", "a rotation and a translation"))
    return found
