"""Take the sharp frames of a video as photographs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from nerfbake import io, progress
from nerfbake.errors import UsageError
from nerfbake.jobs.files import AnySource, as_source
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.stages.sharpness import choose_sharpest, measure_sharpness

A_SECOND, FEWEST, MOST = 2, 40, 150  # frames that are taken by default; `poses` compares all pairs of 150 pictures
_EDGE = 640  # pixels of the pictures whose sharpness is measured: noise counts less than at full size
_CONTENTS = io.FolderContents("frames of a video", re.compile(r"\d{4,}\.jpg"), lambda files: "0000.jpg" in files)


class FramesResult(NamedTuple):
    """What take_frames() has written.

    folder   the folder with the frames
    frames   their number
    of       number of frames that the video has
    seconds  how long it is
    width    of the frames, in pixels
    height   of the frames, in pixels
    """

    folder: str
    frames: int
    of: int
    seconds: float
    width: int
    height: int


def take_frames(
    source: AnySource, folder: str | Path, *, count: int | None = None, force: bool = False, steps: Steps = SILENT
) -> FramesResult:
    """Write the sharp frames of a video as photographs and return facts about them. This is `nerfbake frames`.

    Reads the video `source` and writes NNNN.jpg to `folder`: of each of `count` stretches the sharpest frame, upright.
    Needs PyAV, which the extra `video` installs. Raises NerfbakeError.

    count  number of frames, or all if the video has fewer; None: two a second, but 40 to 150
    force  replace a folder of frames

    >>> take_frames("walk.mp4", "walk").frames
    40
    """
    source, out = as_source(source), Path(folder)
    if io.STREAM in (source.path, str(folder)):
        raise UsageError("a pipe is neither a video nor a folder; allowed: paths")
    if count is not None and count < 1:
        raise UsageError(f"`count` is {count}; allowed: 1 or more")
    io.require_no_folder(out, _CONTENTS, force=force, inputs=[source.path])
    height = width = number = 0
    with io.opened_video(source.path) as video, io.replacing_folder(out, _CONTENTS, force=force) as part:
        wanted = count or min(max(round(A_SECOND * video.seconds), FEWEST), MOST)
        wanted = min(wanted, video.frames)
        with steps.phase(f"choosing {wanted} of {video.frames:,} frames"):
            for frame in choose_sharpest(_measured(video), total=video.frames, count=wanted):
                pixels = frame.pixels()
                height, width = pixels.shape[:2]
                io.save_photograph(part / f"{number:04d}.jpg", pixels)
                number += 1
    found = FramesResult(str(folder), number, video.frames, video.seconds, width, height)
    steps.say(
        f"{source.name}: {number} of {video.frames:,} frames, the sharpest of every {video.seconds / number:.2g} "
        f"seconds, {width}x{height} pixels, are in {folder}"
    )
    return found


def _measured(video: Any) -> Iterator[tuple[float, Any]]:
    for number, frame in enumerate(video, 1):
        yield measure_sharpness(frame.grey(_EDGE)), frame
        progress.report(number / video.frames)
