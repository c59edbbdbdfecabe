"""The world of cameras in metres and upright: by a distance, by positions and gravity in photographs, by the ground."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

from nerfbake import io
from nerfbake.errors import InvalidScene, Problem, UsageError
from nerfbake.jobs.steps import Steps
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras
from nerfbake.scene.origin import choose_origin_of_cameras
from nerfbake.scene.world import UP, EarthPlace, Frame, World

if TYPE_CHECKING:
    from nerfbake.stages.frames import Gravity

GPS, NONE = "gps", "none"
_UNITS = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
_DISTANCE = re.compile(r"([0-9]{1,9}(?:\.[0-9]{0,9})?|\.[0-9]{1,9}) ?(m|cm|mm)?")
_SURE = 6  # photographs with a position, of which those that fit are used without being asked for
_OFF = 0.1  # of the spread of the positions: a larger median residual says that they are too rough for it


class _Pair(NamedTuple):
    first: str
    second: str
    metres: float


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """In which world cameras are used.

    scale   gps: metres, with x east, y north and z up, by the GPS positions in the photographs; NAME1,NAME2=1.2m: the
            distance between two photographs; None: as in the file
    ground  turn the world so that the ground, the largest plane of sparse points below the cameras, is z = 0
    """

    scale: str | None = None
    ground: bool = False

    def __post_init__(self) -> None:
        self.pair()

    def pair(self) -> _Pair | None:
        """Return the known distance between two photographs, or None. Raises UsageError for what is neither."""
        if self.scale in (None, GPS, NONE):
            return None
        names, _, distance = str(self.scale).rpartition("=")
        first, comma, second = names.partition(",")
        match = _DISTANCE.fullmatch(distance.strip())
        metres = float(match[1]) * _UNITS[match[2] or ""] if match else 0.0
        if not (first and comma and second and 1e-6 <= metres <= 1e9):
            allowed = "gps, none, or NAME1,NAME2=1.2m, with m, cm or mm"
            raise UsageError(f"`scale` is {str(self.scale)[:60]!r}; allowed: {allowed}")
        return _Pair(first.strip(), second.strip(), metres)

    @property
    def asked(self) -> bool:
        """Whether anything is to be changed."""
        return self.ground or self.scale not in (None, NONE)


class MovedWorld(NamedTuple):
    """frame: from the world of the cameras to another one. world: what is known of that."""

    frame: Frame
    world: World

    def apply(self, cameras: Cameras) -> Cameras:
        return replace(cameras.transformed(self.frame.matrix), world=self.world)


def find_world(
    steps: Steps,
    name: str,
    cameras: Cameras,
    options: WorldOptions,
    photographs: Sequence[Path | None],
    *,
    automatic: bool = False,
    read: Callable[[Path], io.PhotographMetadata] = io.load_metadata,
) -> MovedWorld | None:
    """Return where the cameras of a capture are moved, and print what this was found by; None if they stay.

    name         of the capture, in messages
    photographs  one for each camera, if there is one
    automatic    use GPS positions without being asked if they fit well, and gravity
    read         returns what a photograph says of itself; it is called once for each

    Raises UsageError, InvalidScene.
    """
    from nerfbake.stages import frames as stage

    read_once = cache(read)

    def metadata() -> list[io.PhotographMetadata | None]:
        return [None if path is None else read_once(path) for path in photographs]

    with io.blame(name):
        frame, world, told = Frame(), cameras.world, []
        if (pair := options.pair()) is not None:
            first, second = (_number(cameras, each) for each in pair[:2])
            frame = stage.frame_between(cameras, first, second, pair.metres)
            world = World(metres=True, upright=world.upright)
            told.append(f"by {pair.metres:g} m between {cameras.names[first]} and {cameras.names[second]}")
        elif options.scale == GPS or (automatic and options.scale is None):
            found = _by_positions(steps, name, cameras, metadata(), asked=options.scale == GPS)
            if found is not None:
                frame, world = found.frame, found.world
                told.append(found.told)
        # Positions that are not on a line tell what is up as well, and better than a phone that moves.
        asked = options.ground or options.scale == GPS or (automatic and options.scale != NONE)
        if asked and not world.upright and (gravity := _by_gravity(steps, name, cameras, metadata())) is not None:
            frame, world = frame.then(gravity.frame), world._replace(upright=True)
            told.append(f"z is up by gravity in {plural(gravity.used, 'photograph')}, {gravity.off:.1f} degrees off")
        if options.ground:
            moved = cameras.transformed(frame.matrix)
            start = choose_origin_of_cameras(moved.eyes)  # squares of coordinates far from 0 have few digits left
            near = moved.relative_to(start)
            up = UP if world.upright else stage.vertical_of(near)
            ground = stage.frame_of_ground(near, up)
            level = stage.lowered(ground.height, start) if world.upright else ground.frame
            frame = frame.then(Frame(shift=-start)).then(level)
            place = world.place
            if place is not None:
                place = place._replace(altitude=place.altitude + ground.height)
            world = World(world.metres, True, place)
            told.append(f"z is 0 on the ground, a plane with {ground.share:.0%} of the points")
    if not told:
        return None
    steps.say(f"{name}: world: {world}; {'; '.join(told)}")
    return MovedWorld(frame, world)


class _Found(NamedTuple):
    frame: Frame
    world: World
    told: str


def _by_positions(
    steps: Steps, name: str, cameras: Cameras, metadata: Sequence[io.PhotographMetadata | None], *, asked: bool
) -> _Found | None:
    """Return the world of the positions in the photographs. asked=False: None if they are few or rough."""
    from nerfbake.stages.frames import LEAST, frame_to_positions, local_positions

    places = [each and each.place for each in metadata]
    kept = [i for i, place in enumerate(places) if place is not None]
    if len(kept) < (LEAST if asked else _SURE):
        if asked:
            found = f"have a GPS position and an altitude in {len(kept)} of {plural(len(places), 'file')}"
            raise InvalidScene(Problem("the photographs", found, f"{LEAST} or more, or `scale=NAME1,NAME2=1.2m`"))
        return None
    positions, middle = local_positions([EarthPlace(*place) for place in places if place is not None])
    try:
        fitted = frame_to_positions(cameras.eyes[kept], positions)
    except InvalidScene:
        if asked:
            raise
        return None
    off = f"{fitted.residual:.2g} m off at the median, in a spread of {fitted.spread:.3g} m"
    if fitted.residual > _OFF * fitted.spread:
        if not asked:
            steps.say(f"{name}: the GPS positions are not used, because they are {off}")
            return None
        steps.say(f"{name}: warning: the GPS positions are {off}, so scale and rotation are rough")
    told = f"by the GPS positions of {fitted.used} of {plural(len(places), 'photograph')}, {off}"
    if not fitted.turned:
        return _Found(fitted.frame, World(metres=True), f"{told}; they are on a line, so the world is not turned")
    return _Found(fitted.frame, World(True, True, middle), told)


def _by_gravity(
    steps: Steps, name: str, cameras: Cameras, metadata: Sequence[io.PhotographMetadata | None]
) -> Gravity | None:
    """Return the world that is upright by the cameras' sensors; None if few photographs have gravity, or disagree."""
    from nerfbake.stages.frames import LEAST, frame_of_gravity

    ups = [each and each.up for each in metadata]
    kept = [i for i, up in enumerate(ups) if up is not None]
    if len(kept) < LEAST:
        return None
    try:
        return frame_of_gravity(cameras.take(kept), [up for up in ups if up is not None])
    except InvalidScene as error:
        steps.say(f"{name}: gravity is not used: {error}")
        return None


def _number(cameras: Cameras, name: str) -> int:
    """Return the number of the camera with this name, or whose picture has it, with or without extension."""
    found = {i for i, camera in enumerate(cameras.cameras) if name in (camera.name, camera.picture)}
    if not found:
        known = (PurePosixPath(camera.picture or camera.name) for camera in cameras.cameras)
        found = {i for i, path in enumerate(known) if name in (path.name, path.stem)}
    if len(found) != 1:
        text = f"names {len(found)} cameras" if found else "names no camera"
        raise UsageError(f"{name[:80]!r} of `scale` {text}; allowed: a photograph such as {cameras.names[0]}")
    return found.pop()
