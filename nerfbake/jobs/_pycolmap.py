"""Structure from motion with pycolmap, in a process of its own, which jobs.poses starts.

pycolmap and Pillow in one process have aborted with a corrupted heap, so this module imports pycolmap and the standard
library alone. It reads one line of JSON from stdin, the fields of Request, and writes lines of JSON to stdout:

    {"step": "matching 66 pairs of pictures"}            a step begins
    {"share": 0.25}                                      the finished share of this step
    {"models": [12, 4], "points": 922, "error": 0.51}    the end: pictures of each model; facts about the first model
    {"missing": "..."}, {"unread": "a.jpg"} or {"failed": "..."}    the end: an error

The process ends when its stdin is closed, so it never outlives the process that started it.

pycolmap otherwise numbers the pictures in the order in which its threads finish. So they are numbered before, and the
last step uses one thread. Then the same pictures and seed give the same model, except that the matches of 97 pictures
have differed slightly between two runs.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

MAX_EDGE = 1000  # pixels: larger pictures are shrunk before features are extracted
_OVERLAP = 10  # next pictures that each picture is matched with, and as many at distances of powers of two
_EVERY = 0.5  # seconds between two reports
_FILES = ("cameras.bin", "images.bin", "points3D.bin")
_WARNING = 2  # glog's level above warnings
_KEYPOINTS = "select count(*) from keypoints"
_PAIRS = "select count(*) from two_view_geometries"
_READ = "select name from images where image_id in (select image_id from keypoints)"


class Request(NamedTuple):
    """What to do.

    pictures    the folder of the pictures
    groups      names of pictures of the same size; each group has one camera
    work        a new folder for the database and the models
    model       an existing folder for the files of the largest model
    sequential  match each picture only with the next ones, in the order of names
    seed        random seed, 0 to 2^31 - 1
    threads     number of threads; -1: as many as there are cores
    """

    pictures: str
    groups: list[list[str]]
    work: str
    model: str
    sequential: bool
    seed: int
    threads: int


def pairs_of(count: int, *, sequential: bool) -> int:
    """The number of pairs of pictures that are matched."""
    if not sequential:
        return count * (count - 1) // 2
    steps = {*range(1, _OVERLAP + 1), *(1 << k for k in range(_OVERLAP))}
    return sum(max(count - step, 0) for step in steps)


def main() -> None:
    """Do what the line on stdin asks for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which then ends this process
    told = os.dup(1)
    os.dup2(2, 1)  # what libraries print must not be between our lines

    def tell(**event: Any) -> None:
        os.write(told, json.dumps(event).encode() + b"\n")

    request = Request(**json.loads(sys.stdin.buffer.readline()))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        import pycolmap
    except ImportError as error:
        tell(missing=str(error))
        return
    try:
        _find(pycolmap, request, tell)
    except Exception as error:  # pycolmap raises RuntimeError, ValueError and others
        tell(failed=str(error))


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(1)


def _find(pycolmap: Any, request: Request, tell: Callable[..., None]) -> None:
    pycolmap.logging.minloglevel = _WARNING
    pycolmap.set_random_seed(request.seed)
    names = sorted(name for group in request.groups for name in group)
    work = Path(request.work)
    work.mkdir()
    database = str(work / "database.db")

    tell(step=f"finding features in {len(names)} pictures")
    with _counting(database, _KEYPOINTS, len(names), tell):
        _extract(pycolmap, request, database, names)
    if unread := sorted({*names} - {name for (name,) in _rows(database, _READ)}):
        tell(unread=unread[0])
        return

    pairs = pairs_of(len(names), sequential=request.sequential)
    tell(step=f"matching {pairs:,} pairs of pictures")
    with _counting(database, _PAIRS, pairs, tell):
        _match(pycolmap, request, database)

    tell(step=f"placing {len(names)} cameras")
    models = _map(pycolmap, request, database, len(names), tell)
    models.sort(key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    facts = {"points": 0, "error": 0.0}
    if models:
        best = work / "best"
        best.mkdir()
        models[0].write_binary(str(best))
        for name in _FILES:
            (best / name).replace(Path(request.model) / name)
        facts = {"points": models[0].num_points3D(), "error": models[0].compute_mean_reprojection_error()}
    shutil.rmtree(work)
    tell(models=[model.num_reg_images() for model in models], **facts)


def _extract(pycolmap: Any, request: Request, database: str, names: list[str]) -> None:
    pycolmap.Database.open(database).close()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "OPENCV"
    for group in request.groups:
        pycolmap.import_images(database, request.pictures, pycolmap.CameraMode.SINGLE, group, reader)
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads = MAX_EDGE, request.threads
    pycolmap.extract_features(
        database, request.pictures, names, pycolmap.CameraMode.AUTO, reader, options, device=pycolmap.Device.cpu
    )


def _match(pycolmap: Any, request: Request, database: str) -> None:
    matching, checking = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads, checking.ransac.random_seed = request.threads, request.seed
    options = {"matching_options": matching, "verification_options": checking, "device": pycolmap.Device.cpu}
    if request.sequential:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap, pairing.loop_detection = _OVERLAP, False  # its detection of loops downloads a vocabulary
        for powers in (False, True):  # powers of two replace the other distances; pairs are not matched twice
            pairing.quadratic_overlap = powers
            pycolmap.match_sequential(database, pairing_options=pairing, **options)
    else:
        pycolmap.match_exhaustive(database, **options)


def _map(pycolmap: Any, request: Request, database: str, count: int, tell: Callable[..., None]) -> list[Any]:
    placed = 0

    def place(more: int) -> None:
        nonlocal placed
        placed += more
        tell(share=min(placed / count, 1.0))

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3  # a small model is better than none, and jobs.poses reports its size
    options.num_threads = options.mapper.num_threads = 1  # sums in threads have no fixed order
    for each in (options, options.mapper, options.triangulation):
        each.random_seed = request.seed
    output = Path(request.work) / "models"
    output.mkdir()
    found = pycolmap.incremental_mapping(
        database,
        request.pictures,
        str(output),
        options,
        initial_image_pair_callback=lambda: place(2),
        next_image_callback=lambda: place(1),
    )
    return list(found.values())


@contextmanager
def _counting(database: str, query: str, count: int, tell: Callable[..., None]) -> Iterator[None]:
    """Report the share of the rows that the block has written to the database, from a thread."""
    done = threading.Event()

    def watch() -> None:
        while not done.wait(_EVERY):
            with suppress(sqlite3.Error):  # the database is not there yet, or it is locked
                tell(share=min(_rows(database, query)[0][0] / count, 1.0))

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()


def _rows(database: str, query: str) -> list[Any]:
    opened = sqlite3.connect(f"{Path(database).absolute().as_uri()}?mode=ro", uri=True)
    try:
        return opened.execute(query).fetchall()
    finally:
        opened.close()


if __name__ == "__main__":
    main()
