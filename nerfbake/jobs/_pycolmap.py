"""Structure from motion with pycolmap, in a process of its own, which jobs.poses starts.

pycolmap and Pillow in one process have aborted with a corrupted heap, so this module imports pycolmap, NumPy and the
standard library alone. Nor may it import sqlite3: pycolmap brings an SQLite of its own, and two in one process release
each other's locks on a file (https://sqlite.org/howtocorrupt.html, section 2.2.1). The second one then truncated the
shared memory of the database: signal 7, a malformed database, or lost matches.

It reads one line of JSON from stdin, the fields of Request, and writes lines of JSON to stdout:

    {"step": "matching 66 pairs of pictures"}            a step begins
    {"share": 0.25}                                      the finished share of this step
    {"models": [12, 4], "points": 922, "error": 0.51}    the end: pictures of each model; facts about the first model
    {"moved": 1}                                         the end of a request that moves a model
    {"missing": "..."}, {"unread": "a.jpg"} or {"failed": "..."}    the end: an error

The process ends when its stdin is closed, so it never outlives the process that started it.

pycolmap otherwise numbers the pictures in the order in which its threads finish. So they are numbered before. Features
and matches do not depend on the threads that find them, and the last step uses one thread. Then the same pictures and
seed give the same model on any number of threads.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

from nerfbake.jobs import _matching

FEW = 30  # pictures: up to so many, every pair is matched, and each picture keeps more pixels and features
OPENCV_FROM = 30  # pictures of a camera: fewer do not determine two focal lengths and four coefficients of a lens
_AT_ONCE = 8  # pictures per thread between two reports
_FILES = ("cameras.bin", "images.bin", "points3D.bin")
# Points that hold a picture which was placed at once. Of 9 to 17 photographs of a capture, those with 8 or fewer were
# off by 6 to 62 % of the largest distance of a camera, those with 17 or more by at most 5 %.
_SHARED = 15
_WARNING = 2  # glog's level above warnings
# Camera models. With more coefficients, a few pictures of a long lens end with absurd ones, and pycolmap drops these.
_LENS, _ALL_ROUND = "SIMPLE_RADIAL", "EQUIRECTANGULAR"


class Effort(NamedTuple):
    """How precisely features are searched, and how often all cameras and points are adjusted together.

    edge        pixels: larger pictures are shrunk to this edge before features are searched
    features    of a picture: the largest are kept; pycolmap keeps up to half as many more, of two directions each
    affine      True: features are ellipses, which look alike in pictures from farther apart; in the same time
    growth      of the model, in pictures or points, until everything is adjusted again
    rounds      of adjusting and of dropping what does not fit
    """

    edge: int
    features: int
    affine: bool
    growth: float
    rounds: int


# 97 photographs of 1008x756: CPU seconds of the steps; largest error of a position after a similarity, in per cent
#   1,000 pixels: features 49, matching 36, placing 21; 0.30
#     800 pixels: features 25, matching 21, placing 16; 0.31
THOROUGH = Effort(edge=1000, features=4096, affine=True, growth=1.1, rounds=5)
FAST = Effort(edge=800, features=2000, affine=False, growth=1.3, rounds=2)


class Request(NamedTuple):
    """What to do.

    pictures    the folder of the pictures
    groups      names of pictures of the same size; each group has one camera
    panoramas   the same for pictures of all directions
    work        a new folder for the database and the models
    model       an existing folder for the files of the largest model
    sequential  match each picture only with the next ones, in the order of names
    seed        random seed, 0 to 2^31 - 1
    threads     number of threads
    at_once     if placing one picture after another leaves some out, all are placed at once
    """

    pictures: str
    groups: list[list[str]]
    panoramas: list[list[str]]
    work: str
    model: str
    sequential: bool
    seed: int
    threads: int
    at_once: bool = True

    @property
    def names(self) -> list[str]:
        """The names of all pictures, sorted."""
        return sorted(name for group in self.groups + self.panoramas for name in group)


def main() -> None:
    """Do what the line on stdin asks for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which then ends this process
    output = os.dup(1)
    os.dup2(2, 1)  # what libraries print must not be between our lines

    def tell(**event: Any) -> None:
        os.write(output, json.dumps(event).encode() + b"\n")

    fields = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        import pycolmap
    except ImportError as error:
        tell(missing=str(error))
        return
    try:
        if "turn" in fields:
            _move(pycolmap, **fields, tell=tell)
        else:
            _find(pycolmap, Request(**fields), tell)
    except Exception as error:  # pycolmap raises RuntimeError, ValueError and others
        tell(failed=str(error))


def _move(
    pycolmap: Any,
    *,
    model: str,
    scale: float,
    turn: list[list[float]],
    shift: list[float],
    tell: Callable[..., None],
) -> None:
    """Move a model to another world: scale, rotate and then shift it."""
    found = pycolmap.Reconstruction(model)
    found.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn), shift))
    _write(found, Path(model), Path(model) / "moved")
    tell(moved=1)


def _write(found: Any, model: Path, part: Path) -> None:
    """Write the files of a model, in place of existing ones. part: a folder for them until they are complete."""
    part.mkdir(parents=True)
    found.write_binary(str(part))
    for name in _FILES:
        (part / name).replace(model / name)
    shutil.rmtree(part)


def _end_with_parent() -> None:
    while os.read(0, 1024):  # a buffered reader would be locked when the interpreter ends, which then aborts
        pass
    os._exit(1)


def _find(pycolmap: Any, request: Request, tell: Callable[..., None]) -> None:
    pycolmap.logging.minloglevel = _WARNING
    pycolmap.set_random_seed(request.seed)
    names = request.names
    effort = THOROUGH if len(names) <= FEW else FAST
    work = Path(request.work)
    work.mkdir()
    path = str(work / "database.db")

    tell(step=f"finding features in {len(names)} pictures")
    _extract(pycolmap, request, path, names, effort, tell)
    with closing(pycolmap.Database.open(path)) as database, ThreadPoolExecutor(request.threads) as pool:
        images = {
            image.name: image for image in database.read_all_images() if database.exists_keypoints(image.image_id)
        }
        if unread := sorted({*names} - images.keys()):
            tell(unread=unread[0])
            return
        pictures = [_read_picture(database, images[name]) for name in names]
        _match(pycolmap, request, database, pictures, pool, tell)

    tell(step=f"placing {len(names)} cameras")
    models = _largest_first(_map(pycolmap, request, path, effort, tell))
    if request.at_once and (not models or models[0].num_reg_images() < len(names)):
        tell(step=f"placing {len(names)} cameras at once")
        others = _largest_first(_map_at_once(pycolmap, request, path))
        if others and (not models or others[0].num_reg_images() > models[0].num_reg_images()):
            models = others
    facts = {"points": 0, "error": 0.0}
    shutil.rmtree(work)  # frees more room than the model needs, whose writing pycolmap might not check
    if models:
        _adjust(pycolmap, models[0])
        _write(models[0], Path(request.model), work / "best")
        facts = {"points": models[0].num_points3D(), "error": models[0].compute_mean_reprojection_error()}
        shutil.rmtree(work)
    tell(models=[model.num_reg_images() for model in models], **facts)


def _extract(
    pycolmap: Any, request: Request, path: str, names: list[str], effort: Effort, tell: Callable[..., None]
) -> None:
    pycolmap.Database.open(path).close()
    reader = pycolmap.ImageReaderOptions()
    for model, groups in ((_LENS, request.groups), (_ALL_ROUND, request.panoramas)):
        reader.camera_model = model
        for group in groups:
            pycolmap.import_images(path, request.pictures, pycolmap.CameraMode.SINGLE, group, reader)
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads = effort.edge, request.threads
    options.sift.max_num_features = effort.features
    options.sift.estimate_affine_shape = effort.affine
    some = _AT_ONCE * request.threads
    for begin in range(0, len(names), some):
        part = names[begin : begin + some]
        pycolmap.extract_features(
            path, request.pictures, part, pycolmap.CameraMode.AUTO, reader, options, device=pycolmap.Device.cpu
        )
        tell(share=(begin + len(part)) / len(names))


class _Picture(NamedTuple):
    """What is matched of a picture, and its number in the database. points: (n, 2) positions of features in pixels."""

    number: int
    camera: Any
    points: Any
    descriptors: Any
    largest: Any


def _read_picture(database: Any, image: Any) -> _Picture:
    keypoints = database.read_keypoints(image.image_id)
    descriptors = database.read_descriptors(image.image_id).data
    largest = _matching.largest(keypoints, descriptors)
    camera = database.read_camera(image.camera_id)
    return _Picture(image.image_id, camera, keypoints[:, :2].astype(float), descriptors, largest)


def _match(
    pycolmap: Any,
    request: Request,
    database: Any,
    pictures: Sequence[_Picture],
    pool: ThreadPoolExecutor,
    tell: Callable[..., None],
) -> None:
    """Write the pairs of pictures that share points to the database."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = request.seed

    def common(pair: tuple[int, int]) -> int:
        return len(_matching.match(*(pictures[i].largest for i in pair)))

    def seen_by_both(pair: tuple[int, int]) -> Any:
        first, second = (pictures[i] for i in pair)
        matches = _matching.match(first.descriptors, second.descriptors)
        if len(matches) < options.min_num_inliers:
            return None
        return pycolmap.estimate_two_view_geometry(
            first.camera, first.points, second.camera, second.points, matches, options
        )

    pairs = _matching.pairs_in_order(len(pictures)) if request.sequential else _matching.all_pairs(len(pictures))
    if not request.sequential and len(pictures) > FEW:
        tell(step=f"comparing {len(pairs):,} pairs of pictures")
        found = list(_reported(pool.map(common, pairs), len(pairs), tell))
        pairs = _matching.likely_pairs(len(pictures), found)
    tell(step=f"matching {len(pairs):,} pairs of pictures")
    for pair, geometry in zip(pairs, _reported(pool.map(seen_by_both, pairs), len(pairs), tell), strict=True):
        if geometry is not None and len(geometry.inlier_matches) >= options.min_num_inliers:
            database.write_two_view_geometry(*(pictures[i].number for i in pair), geometry)


def _map(pycolmap: Any, request: Request, path: str, effort: Effort, tell: Callable[..., None]) -> list[Any]:
    count, placed = len(request.names), 0

    def place(more: int) -> None:
        nonlocal placed
        placed += more
        tell(share=min(placed / count, 1.0))

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3  # a small model is better than none, and jobs.poses reports its size
    options.num_threads = options.mapper.num_threads = 1  # sums in threads have no fixed order
    options.ba_global_frames_ratio = options.ba_global_points_ratio = effort.growth
    options.ba_global_max_refinements = effort.rounds
    for each in (options, options.mapper, options.triangulation):
        each.random_seed = request.seed
    output = Path(request.work) / "models"
    output.mkdir()
    found = pycolmap.incremental_mapping(
        path,
        request.pictures,
        str(output),
        options,
        initial_image_pair_callback=lambda: place(2),
        next_image_callback=lambda: place(1),
    )
    return list(found.values())


def _map_at_once(pycolmap: Any, request: Request, path: str) -> list[Any]:
    """Place all cameras at once: first their rotations, then their positions, both from all pairs of pictures.

    Pictures that overlap little, or that were taken while walking forward, often stay out of a model that grows one
    picture after another. Source: GLOMAP (Pan et al., 2024), which pycolmap contains.
    """
    options = pycolmap.GlobalPipelineOptions()
    mapper = options.mapper
    for each in (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        each.random_seed = request.seed
    options.num_threads = mapper.num_threads = 1  # as in _map()
    output = Path(request.work) / "models at once"
    output.mkdir()
    found = list(pycolmap.global_mapping(path, request.pictures, str(output), options).values())
    for model in found:
        _drop_loose(model)
    return [model for model in found if model.num_reg_images()]


def _drop_loose(model: Any) -> None:
    """Keep the largest set of pictures that share _SHARED points with each other, directly or through others.

    Placed at once, a picture keeps a pose even if a few wrong matches alone hold it.
    """
    shared: Counter[tuple[int, int]] = Counter()
    for point in model.points3D.values():
        seen_by = sorted({element.image_id for element in point.track.elements})
        shared.update(combinations(seen_by, 2))
    group = {number: {number} for number, image in sorted(model.images.items()) if image.has_pose}
    for (first, second), points in sorted(shared.items()):
        if points >= _SHARED and group[first] is not group[second]:
            group[first] |= group[second]
            for number in group[second]:
                group[number] = group[first]
    kept = max(group.values(), key=len, default=set())
    for number in group.keys() - kept:
        model.deregister_frame(model.images[number].frame_id)


def _largest_first(models: list[Any]) -> list[Any]:
    return sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _adjust(pycolmap: Any, model: Any) -> None:
    """Adjust all cameras and points once more, with more coefficients of the lens where enough pictures have it."""
    pictures = Counter(image.camera_id for image in model.images.values() if image.has_pose)
    for number, camera in model.cameras.items():
        if camera.model_name == _LENS and pictures[number] >= OPENCV_FROM:
            focal, x, y, k1 = camera.params
            camera.model, camera.params = pycolmap.CameraModelId.OPENCV, [focal, focal, x, y, k1, 0, 0, 0]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    # Wrong matches count less than with squares: 40 photographs then had rotations of 0.53 instead of 0.63 degrees.
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = 2.0  # pixels
    options.ceres.solver_options.function_tolerance = 1e-5
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()


def _reported(results: Iterable[Any], count: int, tell: Callable[..., None]) -> Iterator[Any]:
    """Yield the results; report their share, in steps of a per cent."""
    percent = 0
    for done, result in enumerate(results, 1):
        yield result
        if done * 100 // count > percent:
            percent = done * 100 // count
            tell(share=done / count)


if __name__ == "__main__":
    main()
