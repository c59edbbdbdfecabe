"""Find the camera poses of photographs with pycolmap, an optional library."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple

from nerfbake import io, progress
from nerfbake.errors import InvalidFile, NerfbakeError, OutputError, Problem, UsageError
from nerfbake.installation import command_for, require_installed
from nerfbake.io.own_files import require_no_link
from nerfbake.io.reading import check_photograph, copy_photograph, is_heic, is_picture
from nerfbake.io.targets import replacing_folder
from nerfbake.jobs.files import AnySource, Source, as_source
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.world import WorldOptions, find_world
from nerfbake.kernels.parallel import cores
from nerfbake.scene.camera import Cameras

CAMERAS, MODEL = "transforms.json", "sparse/0"  # the outputs, in the folder of the photographs
MOST_EXHAUSTIVE = 150  # pictures of which every pair is matched; more are matched in their order
LEAST = 3  # pictures of a model
MAX_SEED = 2**31 - 1
_CONTENTS = io.FolderContents(
    "a COLMAP model", re.compile(r"(cameras|images|points3D)\.bin"), lambda files: "images.bin" in files
)
_PICTURES = "images"
# Photographs and videos that are not read, so that an error can name one.
_RAW = (".arw", ".cr2", ".cr3", ".nef", ".orf", ".raf", ".rw2")
_VIDEOS = (".mov", ".mp4", ".mkv", ".webm", ".avi")
_OTHERS = (".webp", ".avif", ".jxl", ".tif", ".tiff", ".bmp", ".gif", ".dng", *_RAW, *_VIDEOS)
_COMMAND = [sys.executable, "-P", "-m", "nerfbake.jobs._pycolmap"]  # -P ignores the working directory
_LEAST_ROOM = 1 << 22  # bytes on the disk: with less, pycolmap fails for lack of room
_ENDS = {"models", "missing", "unread", "failed", "moved"}  # what the last line of the process says
_TRACE = ("@", "***", "PC:")  # how pycolmap begins the lines of a stack trace
_ADVICE = "sharp pictures of a textured scene that does not move, each of which shows two thirds of the one before"


class PosesResult(NamedTuple):
    """What find_poses() has found.

    folder      the folder of the photographs, with the outputs
    pictures    number of pictures in it
    registered  number of pictures whose pose was found
    points      number of points in space that the model has
    error       mean distance between a point in a picture and the projection of its point in space, in pixels
    """

    folder: str
    pictures: int
    registered: int
    points: int
    error: float


def find_poses(
    source: AnySource,
    *,
    sequential: bool | None = None,
    panoramas: bool = False,
    seed: int = 0,
    world: WorldOptions = WorldOptions(),
    force: bool = False,
    steps: Steps = SILENT,
) -> PosesResult:
    """Find the camera poses of photographs and return facts about them. This is `nerfbake poses`.

    Reads the pictures in the folder `source`, or in its subfolder images. Writes transforms.json and a COLMAP model in
    sparse/0 to `source`. Needs pycolmap, which the extra `poses` installs. Raises NerfbakeError.

    sequential  match each picture only with the next ones, in the order of names; None: if there are more than 150
    panoramas   pictures twice as wide as high show all directions, even if they do not say so
    seed        the random seed; on one machine, the same pictures and seed give the same poses
    world       the unit and the axes; without a scale, the GPS positions of the photographs are used if they fit
    force       replace existing outputs

    >>> find_poses("room").registered
    8
    """
    source = as_source(source)
    folder = Path(source.path)
    if not 0 <= seed <= MAX_SEED:
        raise UsageError(f"`seed` is {seed}; allowed: 0 to {MAX_SEED}")
    place, names = _pictures_of(folder, source.name)
    require_installed("pycolmap", "finding poses")
    _require_outputs(folder, force)
    groups, round_ones, known = _same_sizes(steps, place, names, panoramas)
    if (distance := world.distance()) is not None:
        shown = [(str(path.relative_to(folder)),) for path in known]
        sizes = [said.size or (0, 0) for said in known.values()]
        distance.require_shown(shown, sizes.__getitem__)
    if sequential is None:
        sequential = len(names) > MOST_EXHAUSTIVE
    with _model_folder(folder, force) as part:
        pictures = _readable(steps, place, names, part / "pictures")
        request: dict[str, Any] = {
            "pictures": str(pictures),
            "groups": groups,
            "panoramas": round_ones,
            "model": str(part),
        }
        request |= {"work": str(part / "work"), "sequential": sequential, "seed": seed, "threads": cores()}
        found = _run(steps, source.name, request)
        if pictures != place:
            shutil.rmtree(pictures)
        _require_model(steps, source.name, found["models"], len(names))
        io.save(folder / CAMERAS, _placed(steps, source.name, folder, place, part, world, known), force=force)
    result = PosesResult(source.path, len(names), found["models"][0], found["points"], found["error"])
    steps.say(
        f"{source.name}: {result.registered} of {result.pictures} pictures have a pose; {result.points:,} points, "
        f"mean reprojection error {result.error:.2f} pixels"
    )
    return result


def require_poses(steps: Steps, source: Source, world: WorldOptions = WorldOptions()) -> bool:
    """Find the poses of a folder that has photographs and no cameras; return False for any other source.

    Raises NerfbakeError as find_poses() does.
    """
    folder = Path(source.path)
    if not io.is_folder(folder):
        return False
    try:
        io.load_split(folder)
    except InvalidFile as error:
        if error.source != str(folder):  # a file in it is wrong
            raise
        if not any(is_picture(file) for file in _files(folder)) and not _unread(folder):
            raise
        for file, reason in io.unread_cameras(folder, ""):
            steps.say(f"{source.name}: warning: {file} is not read: {reason}")
        steps.say(f"{source.name}: has photographs without cameras, so their poses are found first")
        find_poses(source, world=world, steps=steps)
        return True
    return False


def _files(folder: Path) -> list[Path]:
    """Return the files of a folder and of its subfolder of pictures, sorted by name."""
    with io.blame(str(folder)):
        places = [place for place in (folder / _PICTURES, folder) if place.is_dir()]
        return [file for place in places for file in sorted(place.iterdir()) if not file.name.startswith(".")]


def _unread(folder: Path) -> str:
    """Return the name of a photograph or a video that is not read; '' if there is none."""
    return next((file.name for file in _files(folder) if file.suffix.lower() in _OTHERS), "")


def _pictures_of(folder: Path, name: str) -> tuple[Path, list[str]]:
    """Return the folder that has the pictures, and their sorted names."""
    if not io.is_folder(folder):
        found = "is not a folder" if folder.exists() else "does not exist"
        raise InvalidFile(f"{found}; allowed: {_allowed(folder.name, 'a folder of photographs')}", source=name)
    names: list[str] = []
    place = folder
    for place in (folder / _PICTURES, folder):
        with io.blame(str(place)):
            files = sorted(place.iterdir()) if place.is_dir() else []
            files = [file for file in files if is_picture(file) and file.is_file() and not file.name.startswith(".")]
        names = [file.name for file in files]
        if names:
            break
    if len(names) < LEAST:
        found = f"are {len(names)}" if names else "are missing"
        other = "" if names else _unread(folder)
        if other:
            found = f"are missing, except for files such as {other}"
        allowed = f"{LEAST} or more .jpg, .jpeg, .png or .heic in the folder or in its subfolder {_PICTURES}"
        raise InvalidFile(Problem("the pictures", found, _allowed(other, allowed)), source=name)
    for each in names:
        if not each.isprintable() or "\\" in each:
            problem = Problem(f"the name {each!r}", "cannot be written", "printable characters, no \\")
            raise InvalidFile(problem, source=name)
    return place, names


def _allowed(file: str, otherwise: str) -> str:
    """What is allowed instead of this file: of a video its frames."""
    is_video = file.lower().endswith(_VIDEOS)
    return "a folder of the video's frames, which `nerfbake frames` makes" if is_video else otherwise


def _require_outputs(folder: Path, force: bool) -> None:
    """Raise OutputError if an output is a link or exists and must not be replaced, or if the folder is read-only."""
    for name in (CAMERAS, Path(MODEL).parent, MODEL):
        require_no_link(folder / name)  # its target may be outside of the folder
    io.require_absent(folder / CAMERAS, force=force)
    if (folder / MODEL).parent.is_dir():
        io.require_no_folder(folder / MODEL, _CONTENTS, force=force)


def _same_sizes(
    steps: Steps, place: Path, names: list[str], panoramas: bool
) -> tuple[list[list[str]], list[list[str]], dict[Path, io.PhotographMetadata]]:
    """Group the names of the pictures by size: ordinary ones, and panoramas of all directions.

    Also returns what each says of itself, so that no picture is opened for it again. Raises InvalidFile for a picture
    that `fit` could not read.
    """
    groups: dict[tuple[int, int, bool], list[str]] = {}
    known: dict[Path, io.PhotographMetadata] = {}
    with steps.phase(f"reading {len(names)} pictures"):
        for name in progress.each(names):
            said = known[place / name] = check_photograph(place / name)
            assert said.size is not None
            width, height = said.size
            is_round = said.all_round or (panoramas and width == 2 * height)
            groups.setdefault((width, height, is_round), []).append(name)
    flat, all_round = ([group for key, group in groups.items() if key[2] == wanted] for wanted in (False, True))
    if all_round:
        steps.say(f"{place}: {sum(map(len, all_round))} of {len(names)} pictures are panoramas of all directions")
    wide = sum(len(group) for key, group in groups.items() if key[0] == 2 * key[1] and not key[2])
    if wide:
        steps.say(
            f"{place}: warning: {wide} of {len(names)} pictures are twice as wide as high, but do not say that they "
            "show all directions; they are used as ordinary photographs, except by `panoramas` of `nerfbake poses`"
        )
    return flat, all_round, known


def _readable(steps: Steps, place: Path, names: list[str], copies: Path) -> Path:
    """Return the folder from which pycolmap reads the pictures. It cannot read HEIC, so it then has copies in JPEG."""
    if not any(is_heic(place / name) for name in names):
        return place
    with steps.phase(f"converting {len(names)} pictures"), io.blame(str(copies), OutputError):
        copies.mkdir()
        for name in progress.each(names):
            copy_photograph(place / name, copies / name)
    return copies


@contextmanager
def _model_folder(folder: Path, force: bool) -> Iterator[Path]:
    """A new folder that becomes sparse/0 if the block succeeds. A folder `sparse` that stays empty is removed."""
    target = folder / MODEL
    with io.blame(str(target), OutputError):
        target.parent.mkdir(exist_ok=True)
        require_no_link(target.parent)
    try:
        with io.blame(str(target), OutputError), replacing_folder(target, _CONTENTS, force=force) as part:
            yield part
    finally:
        with suppress(OSError):
            target.parent.rmdir()


def _placed(
    steps: Steps,
    name: str,
    folder: Path,
    place: Path,
    part: Path,
    options: WorldOptions,
    known: Mapping[Path, io.PhotographMetadata],
) -> Cameras:
    """Return the cameras of a new model, after it was moved to the world that is asked for."""
    prefix = "" if place == folder else f"{_PICTURES}/"
    cameras = _cameras(part, prefix)
    photographs = [folder / each for each in cameras.names]
    moved = find_world(steps, name, cameras, options, photographs, automatic=True, read=known.__getitem__)
    if moved is None:
        return cameras
    event, ended = _run_once(steps, {"model": str(part), **moved.frame.listed()})
    if "moved" not in event:
        raise NerfbakeError(f"pycolmap could not move the model: {event.get('failed', ended)}", source=name)
    return replace(_cameras(part, prefix), world=moved.world)


def _cameras(model: Path, prefix: str) -> Cameras:
    """Return the cameras of a COLMAP model. Each name is the path of the picture, which is written as file_path."""
    cameras = io.load(model, Cameras)
    named = (f"{prefix}{camera.picture.removeprefix(f'{_PICTURES}/')}" for camera in cameras.cameras)
    return replace(
        cameras,
        cameras=tuple(
            replace(camera, name=name, picture=name) for camera, name in zip(cameras.cameras, named, strict=True)
        ),
    )


def _require_model(steps: Steps, name: str, models: list[int], pictures: int) -> None:
    """Raise InvalidFile if there is no model; print a warning if the pictures form several."""
    if not models or models[0] < LEAST:
        raise InvalidFile(Problem("the pictures", "have too few points in common to find poses", _ADVICE), source=name)
    if len(models) > 1 and models[0] < pictures:  # a second model may also repeat a part of the first
        steps.say(
            f"{name}: warning: the pictures form {len(models)} models that share too few points; the largest has "
            f"{models[0]} of {pictures} pictures and is kept; take more pictures between the groups"
        )


def _run(steps: Steps, name: str, request: Mapping[str, Any]) -> dict[str, Any]:
    """Run pycolmap in a process of its own, twice if it crashes, and return its last line. Raises NerfbakeError."""
    event, ended = _run_once(steps, request)
    if ended:
        _require_disk(name, request, ended)
        steps.say(f"{name}: warning: pycolmap crashed with {ended}; it runs once more, with one thread")
        shutil.rmtree(request["work"], ignore_errors=True)
        again = {"work": f"{request['work']}-again", "threads": 1, "at_once": False}
        event, ended = _run_once(steps, {**request, **again})
    if "models" in event:
        return event
    if "missing" in event:
        raise UsageError(
            Problem("pycolmap", f"cannot be imported ({event['missing']})", command_for("pycolmap")), source=name
        )
    _require_disk(name, request, event.get("failed", ended))
    if "unread" in event:
        picture = str(Path(request["pictures"]) / event["unread"])
        raise InvalidFile("cannot be read by pycolmap; allowed: a PNG, a JPEG or a HEIC of 8 bits", source=picture)
    if "failed" in event:
        raise NerfbakeError(f"pycolmap failed: {event['failed']}", source=name)
    raise NerfbakeError(f"pycolmap crashed twice, the second time with {ended}", source=name)


def _require_disk(name: str, request: Mapping[str, Any], said: str) -> None:
    """Raise OutputError if pycolmap failed because a folder was removed or the disk is full. said: its last words.

    It does not always say so: `No registered database factory succeeded` stands for both.
    """
    model = Path(request["model"])
    for folder in (Path(request["pictures"]), *reversed(model.parents), model):
        if not folder.is_dir():
            found = "was removed while pycolmap was using it; allowed: a folder that stays"
            raise OutputError(found, source=str(folder))
    with io.blame(name, OutputError):
        if "disk is full" in said:  # what SQLite says; it may have given the space back
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        with tempfile.TemporaryFile(dir=model) as file:
            file.write(bytes(_LEAST_ROOM))
            file.flush()


def _run_once(steps: Steps, request: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Return the last line of the process, and how it ended if that line is not an end."""
    event: dict[str, Any] = {}
    with tempfile.TemporaryFile() as words:
        with _process(request, words) as process, ExitStack() as step:
            assert process.stdout is not None
            for line in process.stdout:
                event = json.loads(line)
                if "step" in event:
                    step.close()
                    step.enter_context(steps.phase(event["step"]))
                elif "share" in event:
                    progress.report(event["share"])
            code = process.wait()
        words.seek(0)
        lines = [line.strip() for line in words.read().decode(errors="replace").splitlines()]
    if _ENDS & event.keys():
        return event, ""
    ended = f"signal {-code}" if code < 0 else f"exit code {code}"
    said = [line for line in lines if line and not line.startswith(_TRACE)]
    return event, f"{ended}: {said[-1]}" if said else ended


@contextmanager
def _process(request: Mapping[str, Any], words: IO[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    """Start the process; kill it if the block fails, also after Ctrl-C."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}  # the process multiplies in threads of its own
    with subprocess.Popen(
        _COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=words, env=environment
    ) as process:
        assert process.stdin is not None
        try:
            with suppress(BrokenPipeError):  # it has crashed already
                process.stdin.write(json.dumps(request).encode() + b"\n")
                process.stdin.flush()
            yield process
        finally:
            process.kill()
            with suppress(BrokenPipeError):  # what a crashed process did not read is still in the buffer
                process.stdin.close()
