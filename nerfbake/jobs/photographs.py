"""The photographs of a capture, with the cameras that took them: those to fit a field to, and those to judge it by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import nerfbake
from nerfbake import io
from nerfbake.errors import InvalidFile, Problem, UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.steps import Steps
from nerfbake.jobs.views import read_cameras

HOLDOUT = 8  # every so many-th view judges, where a capture has none of its own for that
_LEAST = 2  # views that a field is fitted to
_ABOVE = 3  # folders above a model's own in which its pictures may stand

Colour = tuple[float, float, float]


class Album(NamedTuple):
    """Which photographs of a capture a field is fitted to, and which judge it.

    background  the sRGB colour in 0..1 behind the object; None: white for pictures with alpha, else what is at the
                pictures' edges
    masks       a folder with a mask NAME.png for each picture, white where the object is; None: there are none
    test        another file or folder of cameras, whose pictures judge; None: as the capture has it
    holdout     every so many-th view judges and is not fitted to; None: every eighth, where the capture has no views
                of its own for that
    """

    background: Colour | None = None
    masks: str | None = None
    test: str | None = None
    holdout: int | None = None

    def require(self) -> None:
        """Raises UsageError, before any work is done, for what contradicts itself."""
        if self.test is not None and self.holdout is not None:
            raise UsageError("`test` has the views to judge by; allowed: it or `holdout`")
        if self.holdout is not None and self.holdout < 2:
            raise UsageError(f"`holdout` is {self.holdout}; allowed: 2 or more")


ALL = Album()


class Posed(NamedTuple):
    """trained: what a field is fitted to; judges: what it is judged by, which it has not seen."""

    trained: nerfbake.Views
    judges: nerfbake.Views


def read_photographs(steps: Steps, source: Source, album: Album = ALL) -> Posed:
    """The views of a capture, a file or a folder; says which cameras it took. Raises NerfbakeError."""
    split = io.load_split(source.path)
    trained = split[0] if split else source.path
    test = album.test or (split[1] if split and album.holdout is None else None)
    if test is not None:
        views = _read(steps, trained, album)
        known = album._replace(background=views.background)
        posed = Posed(views, _read(steps, test, known))
    else:
        posed = _held_out(_read(steps, trained, album), album.holdout or HOLDOUT, trained)
    if len(posed.trained.pictures) < _LEAST:
        found = f"are {len(posed.trained.pictures)} to fit to and {len(posed.judges.pictures)} to judge by"
        raise InvalidFile(Problem("the views", found, f"{_LEAST} or more to fit to"), source=source.name)
    return posed


def _held_out(views: nerfbake.Views, every: int, name: str) -> Posed:
    """Every so many-th view judges, starting with the first."""
    numbers = range(len(views.pictures))
    trained = [i for i in numbers if i % every]
    if len(trained) < _LEAST:
        found = f"are {len(numbers)}, of which every {every}th judges"
        raise InvalidFile(Problem("the views", found, f"{_LEAST} or more besides"), source=name)
    return Posed(views.take(trained), views.take(numbers[::every]))


def _read(steps: Steps, path: str, album: Album) -> nerfbake.Views:
    cameras, files = _with_pictures(steps, path, read_cameras(steps, path))
    masks = None if album.masks is None else _masks(album.masks, cameras)
    with steps.phase(f"reading {len(files)} pictures"), io.blame(path):
        cameras.require_covered()
        return nerfbake.build_views(cameras, _pictures(cameras, files, masks), background=album.background)


def _pictures(cameras: nerfbake.Cameras, files: Sequence[Path], masks: Sequence[Path] | None) -> Iterator[Any]:
    """One after the other: a picture is held beside its mask for no longer than it takes to put them together."""
    from nerfbake.stages.pictures_to_views import cut_out  # here, since the help loads no arrays

    for i, (camera, file) in enumerate(zip(cameras.cameras, files, strict=True)):
        size = camera.width, camera.height
        pixels = io.load_photograph(file, size)
        if masks is not None:
            mask = io.load_photograph(masks[i], size)
            with io.blame(str(masks[i])):
                pixels = cut_out(pixels, mask)
        yield pixels


def _with_pictures(steps: Steps, path: str, cameras: nerfbake.Cameras) -> tuple[nerfbake.Cameras, list[Path]]:
    """The cameras that have a picture, and these pictures; says how many cameras have none.

    Captures are shared without the pictures that were blurred: instant-ngp's fox has 50 of 67. Raises InvalidFile where
    fewer than half of the pictures are there, since the folder is then more likely to be the wrong one.
    """
    for i, camera in enumerate(cameras.cameras):
        if not camera.picture:
            found, allowed = "names no picture in the folder of the capture", "a PNG or a JPEG there, or below"
            raise InvalidFile(Problem(f"camera {camera.name or i}", found, allowed), source=path)
    names = [camera.picture for camera in cameras.cameras]
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    # A model's own folder stands below the one that has the pictures.
    folders = [folder, *folder.resolve().parents[:_ABOVE]] if cameras.dialect == "COLMAP" else [folder]
    folder = next((each for each in folders if any(io.find_photograph(each, name) for name in names)), folder)
    files = [io.find_photograph(folder, name) for name in names]
    kept = [i for i, file in enumerate(files) if file is not None]
    if 2 * len(kept) < len(files):
        _all_of(names, files, path, "picture")
    if left_out := len(files) - len(kept):
        steps.say(f"{path}: {left_out} of {len(files)} cameras have no picture and are left out")
        cameras = replace(cameras, cameras=tuple(cameras.cameras[i] for i in kept))
    return cameras, [file for file in files if file is not None]


def _masks(folder: str, cameras: nerfbake.Cameras) -> list[Path]:
    """Each picture's mask: of the picture's own path in the folder, or of its name alone, with any picture's ending."""
    if not Path(folder).is_dir():
        raise InvalidFile("is no folder; allowed: one with a mask for each picture", source=folder)
    found = []
    for camera in cameras.cameras:
        path = PurePosixPath(camera.picture)
        names = (str(path.with_suffix("")), str(path), path.stem, path.name)
        paths = (io.find_photograph(folder, name) for name in names)
        found.append(next((path for path in paths if path), None))
    return _all_of([PurePosixPath(camera.picture).stem for camera in cameras.cameras], found, folder, "mask")


def _all_of(names: Sequence[str], paths: Sequence[Path | None], source: str, noun: str) -> list[Path]:
    missing = [name for name, path in zip(names, paths, strict=True) if path is None]
    if missing:
        problem = Problem(f"{noun} {missing[0]}", "is not there", "a PNG or a JPEG of that name", len(missing))
        raise InvalidFile(problem, source=source)
    return [path for path in paths if path is not None]
