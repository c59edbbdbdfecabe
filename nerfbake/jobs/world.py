"""The world of cameras in metres and upright: by a distance, by positions and gravity in photographs, by the ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from nerfbake import io
from nerfbake.errors import InvalidScene, Problem
from nerfbake.jobs.known_distance import KnownDistance, frame_by_distance, parse_distance
from nerfbake.jobs.steps import Steps
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras
from nerfbake.scene.origin import choose_origin_of_cameras
from nerfbake.scene.world import UP, EarthPlace, Frame, World

if TYPE_CHECKING:
    from nerfbake.stages.frames import Gravity

GPS, NONE = "gps", "none"
_SURE = 6  # photographs with a position, of which those that fit are used without being asked for
_OFF = 0.1  # of the spread of the positions: a larger median residual says that they are too rough for it


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """In which world cameras are used.

    scale   gps: metres, with x east, y north and z up, by the GPS positions in the photographs; POINT,POINT=1.2m: the
            distance between two points, each the NAME of a photograph, for its place, or what two photographs show at a
            pixel, NAME:X:Y+NAME:X:Y; None: as in the file
    ground  turn the world so that the ground, the largest plane of sparse points below the cameras, is z = 0
    """

    scale: str | None = None
    ground: bool = False

    def __post_init__(self) -> None:
        self.distance()

    def distance(self) -> KnownDistance | None:
        """Return the known distance, or None. Raises UsageError for what is neither that nor gps nor none."""
        return None if self.scale in (None, GPS, NONE) else parse_distance(str(self.scale))

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

    def size_of(number: int) -> tuple[int, int]:
        camera, path = cameras.cameras[number], photographs[number] if photographs else None
        own = camera.width, camera.height
        width, height = own if path is None else read_once(path).size or own
        turned = width != height and (width > height) == (camera.width < camera.height)
        return (height, width) if turned else (width, height)

    with io.blame(name):
        frame, world, told = Frame(), cameras.world, []
        if (distance := options.distance()) is not None:
            frame, found_by = frame_by_distance(cameras, distance, size_of)
            world = World(metres=True, upright=world.upright)
            told.append(found_by)
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

    places = [None if each is None else each.place for each in metadata]
    kept = [i for i, place in enumerate(places) if place is not None]
    if len(kept) < (LEAST if asked else _SURE):
        if asked:
            found = f"have a GPS position and an altitude in {len(kept)} of {plural(len(places), 'file')}"
            raise InvalidScene(Problem("the photographs", found, f"{LEAST} or more, or `scale=POINT,POINT=1.2m`"))
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

    ups = [None if each is None else each.up for each in metadata]
    kept = [i for i, up in enumerate(ups) if up is not None]
    if len(kept) < LEAST:
        return None
    try:
        return frame_of_gravity(cameras.take(kept), [up for up in ups if up is not None])
    except InvalidScene as error:
        steps.say(f"{name}: gravity is not used: {error}")
        return None
