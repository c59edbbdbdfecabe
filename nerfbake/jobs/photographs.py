"""Read the photographs of a capture with their cameras, and split them into training views and held-out views."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Literal, NamedTuple

from nerfbake import catalog, io, memory, progress
from nerfbake.errors import InvalidFile, InvalidScene, Problem, UsageError
from nerfbake.jobs.budgets import FRAMES
from nerfbake.jobs.files import Source
from nerfbake.jobs.steps import Steps
from nerfbake.jobs.views import picture_views, read_cameras
from nerfbake.jobs.world import MovedWorld, WorldOptions, find_world
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.parallel import in_order
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.splats import Splats
from nerfbake.scene.views import Views
from nerfbake.stages.field_and_views_to_views import cut_out_field
from nerfbake.stages.pictures_to_views import PosedPicture, Scenery, apply_mask, join_pictures, pose_picture
from nerfbake.stages.renderers import KERNELS, Renderer
from nerfbake.stages.scene_to_cameras import orbit_cameras, scatter_cameras
from nerfbake.stages.views_to_error import ViewError, measure_views, plain_psnr

HOLDOUT = 8  # every eighth view is held out if the capture has no test views
_PIXEL_BYTES = 64  # a pixel of a picture while it is decoded: twice what a progressive JPEG with a mask needs
_LEAST = 2  # lowest number of training views
_IMAGES = "images/"  # the folder of a COLMAP model's pictures
_CHECKED = 4  # views on which photographs and field are compared before the work
_ALIKE = 1.0  # dB above pictures of a single colour, below which they show something else
_ABOVE = 3  # parent folders of a COLMAP model that may contain its pictures
# The shorter edge of a picture in pixels. More pixels are finer than the smallest cells, 1 / 1024 of the box.
MOST_EDGE = 1200

Colour = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class PhotographOptions:
    """Options for the photographs of a capture: background, masks, and which views are held out.

    background  the sRGB colour behind the object, in 0..1; None: white for pictures with alpha, else the colour at the
                edges of the pictures
    masks       a folder with a mask NAME.png for each picture, white where the object is, or, with scenery=keep, white
                where the picture is used; None: no masks
    test        another file or folder of cameras, whose views are held out; None: the test views of the capture, if any
    holdout     hold out every N-th view; None: the test views of the capture, else every eighth view
    scenery     keep: fit what stands behind the object, too; drop: fit the object alone; auto: keep if the pictures
                show scenery
    """

    background: Colour | None = None
    masks: str | None = None
    test: str | None = None
    holdout: int | None = None
    scenery: Scenery = "auto"

    def require(self) -> None:
        """Raise UsageError for contradictory options. Call it before doing any work."""
        if self.test is not None and self.holdout is not None:
            raise UsageError("`test` and `holdout` both select the held-out views; allowed: one of them")
        if self.holdout is not None and self.holdout < 2:
            raise UsageError(f"`holdout` is {self.holdout}; allowed: 2 or more")


class SplitViews(NamedTuple):
    """training: the training views. held_out: the held-out views, on which the quality is measured."""

    training: Views
    held_out: Views

    @property
    def origin(self) -> Floats:
        """The point (3,) of the capture's world that all cameras are relative to: 0 unless they were moved."""
        return self.training.cameras.origin

    @property
    def cameras(self) -> Cameras:
        """All cameras: those of the training views, then the others."""
        training, held_out = (views.cameras for views in self)
        return replace(training, cameras=training.cameras + held_out.cameras)

    def placed(self, moved: MovedWorld) -> SplitViews:
        """The same views in another world."""
        return SplitViews(*(replace(views, cameras=moved.apply(views.cameras)) for views in self))

    def moved(self, origin: Floats) -> SplitViews:
        """The same views relative to another point of the capture's world."""
        start = origin - self.origin
        return SplitViews(*(replace(views, cameras=views.cameras.relative_to(start)) for views in self))


class MeasuredViews:
    """Means of the errors on held-out views, for a result that has these `views`."""

    views: tuple[ViewError, ...]

    @property
    def psnr(self) -> float:
        """Mean PSNR over the views in dB."""
        return mean_of(self.views, "psnr")

    @property
    def ssim(self) -> float:
        """Mean SSIM over the views."""
        return mean_of(self.views, "ssim")


def mean_of(views: Sequence[ViewError], name: Literal["psnr", "ssim", "corrected"]) -> float:
    """Return the mean of a figure over the views."""
    return float(sum(getattr(view, name) for view in views) / len(views))


def read_photographs_in(
    steps: Steps, source: Source, photographs: PhotographOptions, world: WorldOptions
) -> SplitViews:
    """Read the views of a capture as read_photographs() does, and move their cameras to the world that is asked for."""
    split = read_photographs(steps, source, photographs)
    if not world.asked:
        return split
    cameras = split.cameras
    moved = find_world(steps, source.name, cameras, world, photographs_of(source.path, cameras))
    return split if moved is None else split.placed(moved)


def read_photographs(steps: Steps, source: Source, photographs: PhotographOptions = PhotographOptions()) -> SplitViews:
    """Read the views of a capture, a file or a folder, and print which cameras were read. Raises NerfbakeError."""
    paths = io.load_split(source.path)
    training = paths[0] if paths else source.path
    test = photographs.test
    if test is None and paths is not None and photographs.holdout is None:
        test = _test_views(steps, paths[1])
    if test is not None:
        views = _read(steps, training, photographs)
        known = replace(photographs, background=views.background, scenery="keep" if views.scenery else "drop")
        split = SplitViews(views, _read(steps, test, known))
    else:
        views = _read(steps, training, photographs)
        given = photographs.holdout is None and 0 < len(views.cameras.held_out) < len(views.pictures)
        split = _held_out(views, None if given else photographs.holdout or HOLDOUT, training)
    if len(split.training.pictures) < _LEAST:
        found = f"are {len(split.training.pictures)} to fit to and {len(split.held_out.pictures)} held out"
        raise InvalidFile(Problem("the views", found, f"{_LEAST} or more to fit to"), source=source.name)
    return split


def _test_views(steps: Steps, path: str) -> str | None:
    """Return the path of a capture's test views, or None if there are none of their pictures.

    Blender add-ons write the cameras of both splits, but may render the training views alone.
    """
    if any(file is not None for file in _files(path, io.load(path, Cameras), Path(path).parent)):
        return path
    steps.say(f"{path}: has no pictures; one of every {HOLDOUT} training views is held out instead")
    return None


def read_photographs_of(
    steps: Steps, source: Source, photographs: PhotographOptions, field: RadianceField
) -> SplitViews:
    """Read the views of a capture that shows a field. If they show scenery, cut the field out of them."""
    split = read_photographs(steps, source, photographs)
    return cut_out(steps, source, split, field) if split.training.scenery else split


def cut_out(steps: Steps, source: Source, split: SplitViews, field: RadianceField) -> SplitViews:
    """Return photographs with scenery as photographs of a field alone, which is a part of what they show."""
    with source.blamed(steps, "cutting the field out of the photographs"):
        count = len(split.training.pictures)
        with progress.part(0, count / (count + len(split.held_out.pictures))):
            training = cut_out_field(split.training, field)
        with progress.part(count / (count + len(split.held_out.pictures)), 1):
            return SplitViews(training, cut_out_field(split.held_out, field))


def require_alike(
    steps: Steps,
    source: Source,
    scene: RadianceField | Splats,
    held_out: Views,
    views: str,
    render: Renderer = KERNELS,
) -> None:
    """Raise InvalidScene if the photographs do not show the scene, and print how near it comes to them.

    render: renders fields and splats.
    """
    some = held_out.take(range(0, len(held_out.pictures), -(-len(held_out.pictures) // _CHECKED)))
    with source.blamed(steps, f"comparing with {views}"):
        found = measure_views(scene, some, render=render)
        psnr, plain = mean_of(found, "psnr"), plain_psnr(some)
        if psnr < plain + _ALIKE:
            what, has = ("the splats", "have") if isinstance(scene, Splats) else ("the field", "has")
            text = (
                f"{has} {psnr:.2f} dB on the photographs of {views}, where pictures of a single colour have {plain:.2f}"
            )
            raise InvalidScene(Problem(what, text, "photographs of the same scene, with poses in its coordinates"))
    steps.say(f"{source.name}: {psnr:.2f} dB on {some} of {views}")


def render_split(
    scene: RadianceField | Splats,
    *,
    frames: int,
    edge: int,
    samples: int = 1,
    framed: RadianceField | Splats | None = None,
    zoom: float = 1.0,
    render: Renderer = KERNELS,
) -> SplitViews:
    """Render a scene from all sides: `frames` pictures to fit to, and FRAMES others that are held out.

    framed: the scene around which the cameras stand, if it is another one. zoom: of the pictures to fit to, as in
    scatter_cameras(). render: renders fields and splats.
    """
    framed = scene if framed is None else framed
    around = scatter_cameras(framed, frames=frames, edge=edge, zoom=zoom)
    held_out = orbit_cameras(framed, frames=FRAMES, width=edge, height=edge)
    share = len(around.cameras) / (len(around.cameras) + len(held_out.cameras))
    with progress.part(0, share):
        training = picture_views(scene, around, samples, render)
    with progress.part(share, 1):
        return SplitViews(training, picture_views(scene, held_out, samples, render))


def _held_out(views: Views, every: int | None, name: str) -> SplitViews:
    """Hold out every N-th view, starting with the first; every=None: those that the capture holds out."""
    numbers = range(len(views.pictures))
    chosen = views.cameras.held_out if every is None else numbers[::every]
    training = [i for i in numbers if i not in set(chosen)]
    if every is not None and len(training) < _LEAST:
        found = f"are {len(numbers)}, and one of every {every} is held out"
        raise InvalidFile(Problem("the views", found, f"{_LEAST} or more others"), source=name)
    return SplitViews(views.take(training), views.take(chosen))


def _read(steps: Steps, path: str, photographs: PhotographOptions) -> Views:
    read = read_cameras(steps, path)
    _say_unread(steps, path, read.source)
    cameras, files = with_pictures(steps, path, read)
    masks = None if photographs.masks is None else _masks(photographs.masks, cameras)
    with steps.phase(f"reading {len(files)} pictures"), io.blame(path):
        cameras.require_covered()
        pictures = _pictures(steps, path, cameras, files, masks)
        views = join_pictures(
            cameras,
            pictures,
            background=photographs.background,
            scenery=photographs.scenery,
            rough=masks is not None,
        )
    _say_extreme_alpha(steps, path, views, [picture.alpha for picture in pictures])
    return views


def _say_unread(steps: Steps, path: str, read: str) -> None:
    """Print which files of cameras in a folder are not read. read: the file that is read."""
    for file, reason in io.unread_cameras(path, read):
        steps.say(f"{path}: {file} is not read: {reason}")


def _say_extreme_alpha(steps: Steps, path: str, views: Views, ranges: Sequence[tuple[int, int]]) -> None:
    """Print a warning for pictures that are transparent or opaque everywhere, if others show an object.

    A mask or a rendering that failed is transparent, and empties all space that its camera sees. ranges: the least and
    the largest alpha of each picture.
    """
    if not views.masked or views.scenery:
        return
    clear = [i for i, (_, most) in enumerate(ranges) if most == 0]
    opaque = [i for i, (least, _) in enumerate(ranges) if least == 255]
    for numbers, alpha, so in (
        (clear, 0, "no object is where its camera looks"),
        (opaque, 255, "all that it shows counts as the object"),
    ):
        if numbers:
            first = views.cameras.cameras[numbers[0]].picture
            more = f" (and {len(numbers) - 1:,} more)" if len(numbers) > 1 else ""
            steps.say(f"{path}: warning: {first} has alpha {alpha} everywhere{more}: {so}")


def _pictures(
    steps: Steps, path: str, cameras: Cameras, files: Sequence[Path], masks: Sequence[Path] | None
) -> list[PosedPicture]:
    """Return the pictures, with their masks as alpha. Prints that large pictures are reduced.

    The cores decode them. As many are in memory at a time as have room there if all are as large as the first one.
    """

    def read(number: int) -> PosedPicture:
        camera = cameras.cameras[number]
        size = camera.width, camera.height
        pixels = io.load_photograph(files[number], size)
        if masks is not None:
            mask = io.load_photograph(masks[number], size)
            with io.blame(str(masks[number])):
                pixels = apply_mask(pixels, mask)
        return pose_picture(camera, pixels, edge=MOST_EDGE)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Pillow; each thread does so for all threads, and undoes it at any time
        found = [read(number) for number in range(min(1, len(files)))]
        most = memory.left() // max(1, *(_PIXEL_BYTES * math.prod(picture.size) for picture in found))
        found += in_order((partial(read, number) for number in range(1, len(files))), most=most)
    if reduced := next((picture for picture in found if picture.factor > 1), None):
        (width, height), factor = reduced.size, reduced.factor
        sizes = f"from {width}x{height} to {width // factor}x{height // factor} pixels"
        steps.say(f"{path}: reduces large pictures, such as {sizes}, each the mean of {factor}x{factor}")
    return found


def with_pictures(steps: Steps, path: str, cameras: Cameras) -> tuple[Cameras, list[Path]]:
    """Return the cameras that have a picture, and the paths of these pictures. Print how many cameras have none.

    Captures are often published without their blurred pictures: instant-ngp's fox has 50 of 67. Raises InvalidFile if
    fewer than half of the pictures exist, since the folder is then probably the wrong one.
    """
    _require_named(path, cameras)
    cameras, files = _find_pictures(path, cameras, Path(path) if io.is_folder(path) else Path(path).parent)
    names = [camera.picture for camera in cameras.cameras]
    kept = [i for i, file in enumerate(files) if file is not None]
    if 2 * len(kept) < len(files):
        _all_of(names, files, path, "picture")
    if left_out := len(files) - len(kept):
        steps.say(f"{path}: {left_out} of {len(files)} cameras have no picture and are left out")
        cameras = cameras.take(kept)
    return cameras, [file for file in files if file is not None]


def photographs_of(path: str, cameras: Cameras) -> list[Path | None]:
    """Return the photographs of cameras that were read from `path`, None for those that do not exist."""
    return _find_pictures(path, cameras, Path(path) if io.is_folder(path) else Path(path).parent)[1]


def _require_named(path: str, cameras: Cameras) -> None:
    """Raise InvalidFile for a camera without a path of a picture in the capture."""
    unnamed = next((camera for camera in cameras.cameras if not camera.picture), None)
    if unnamed is None:
        return
    if cameras.dialect == "LLFF":  # its poses belong to the pictures in `images`, in their order
        count = len(cameras.cameras)
        found = f"does not have one picture for each of the {count:,} poses"
        raise InvalidFile(Problem("images", found, f"{count:,} PNG, JPEG or HEIC"), source=path)
    allowed = "a relative path, without .., of a PNG, a JPEG or a HEIC there or below"
    found = "names no picture in the folder of the capture"
    raise InvalidFile(Problem(f"camera {unnamed.name}".strip(), found, allowed), source=path)


def _find_pictures(path: str, cameras: Cameras, folder: Path) -> tuple[Cameras, list[Path | None]]:
    """Return the cameras with the names of their pictures, and the paths of those that exist.

    A COLMAP model is in a subfolder of the folder with the pictures. Its names are relative to `images`, or to that
    folder, if COLMAP was told that the pictures are there. The file of another tool may be in a subfolder, too.
    """
    if cameras.dialect != "COLMAP" and not catalog.is_tool(cameras.dialect):
        return cameras, _files(path, cameras, folder)
    other = _outside_of_images(cameras) if cameras.dialect == "COLMAP" else _inside_images(cameras)
    for named in (cameras, other):
        for place in (folder, *folder.resolve().parents[:_ABOVE]):
            files = _files(path, named, place)
            if any(file is not None for file in files):
                return named, files
    return cameras, [None] * len(cameras.cameras)


def _files(path: str, cameras: Cameras, folder: Path) -> list[Path | None]:
    """Return the pictures of cameras, which were read from `path`, in a folder."""
    stored = io.StoredNames(folder)
    return [_find(path, camera, stored, camera.picture) for camera in cameras.cameras]


def _find(source: str, camera: Camera, folder: io.StoredNames, name: str) -> Path | None:
    """Return the picture or the mask of a camera in a folder, or None."""
    try:
        return io.find_photograph(folder, name)
    except OSError as error:
        found = f"has a picture that cannot be looked up ({error.strerror})"
        raise InvalidFile(
            Problem(f"camera {camera.name}", found, "a name that the system can find"), source=source
        ) from error


def _outside_of_images(cameras: Cameras) -> Cameras:
    moved = (replace(camera, picture=camera.picture.removeprefix(_IMAGES)) for camera in cameras.cameras)
    return replace(cameras, cameras=tuple(moved))


def _inside_images(cameras: Cameras) -> Cameras:
    named = (f"{_IMAGES}{camera.picture.rpartition('/')[2]}" if camera.picture else "" for camera in cameras.cameras)
    moved = (replace(camera, picture=name) for camera, name in zip(cameras.cameras, named, strict=True))
    return replace(cameras, cameras=tuple(moved))


def _masks(folder: str, cameras: Cameras) -> list[Path]:
    """Return the path of each picture's mask: the picture's path or the end of it, with any picture extension."""
    if not io.is_folder(folder):
        raise InvalidFile("is not a folder; allowed: a folder with a mask for each picture", source=folder)
    pictures = [camera.picture for camera in cameras.cameras]
    stored = io.StoredNames(Path(folder))
    found = [_mask_of(folder, camera, stored) for camera in cameras.cameras]
    masks = _all_of([PurePosixPath(picture).stem for picture in pictures], found, folder, "mask")
    owners: dict[Path, str] = {}
    for mask, picture in zip(masks, pictures, strict=True):
        if owners.setdefault(mask, picture) != picture:
            found_in = f"is the mask of {owners[mask]} and of {picture}"
            allowed = "a mask for each picture, in the folders of the pictures"
            raise InvalidFile(Problem(str(mask.relative_to(folder)), found_in, allowed), source=folder)
    return masks


def _mask_of(folder: str, camera: Camera, stored: io.StoredNames) -> Path | None:
    """Return the mask of a picture; for images/left/1.jpg it is named images/left/1, left/1 or 1."""
    path = PurePosixPath(camera.picture)
    for start in range(len(path.parts)):
        end = PurePosixPath(*path.parts[start:])
        for name in (str(end.with_suffix("")), str(end)):
            if (mask := _find(folder, camera, stored, name)) is not None:
                return mask
    return None


def _all_of(names: Sequence[str], paths: Sequence[Path | None], source: str, noun: str) -> list[Path]:
    missing = [name for name, path in zip(names, paths, strict=True) if path is None]
    if missing:
        problem = Problem(f"{noun} {missing[0]}", "is not there", "a PNG, a JPEG or a HEIC of that name", len(missing))
        raise InvalidFile(problem, source=source)
    return [path for path in paths if path is not None]
