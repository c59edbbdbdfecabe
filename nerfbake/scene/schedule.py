"""Schedules of a fit: stages from coarse to fine, as text, from presets, or for a given time."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

from nerfbake.errors import InvalidScene, Problem

Rates = tuple[float, float]  # learning rates of the first and of the last step
RESOLUTIONS = (8, 1024)
MAX_MINUTES = 10_000.0
_SECONDS_BEFORE, _SECONDS_AN_EPOCH = 22.0, 16.0  # before the stages with 2 x 2 rays, and of each of their epochs
_SECONDS_BEFORE_LARGE, _SECONDS_A_LARGE_EPOCH = 65.0, 50.0  # the same for 512 cells along an axis
MAX_EPOCHS, MAX_SCALE, MAX_RAYS, MAX_RATE = 1000, 16, 4, 10.0
_NAMES = ("cells", "scale", "epochs", "density", "colour", "rays", "split", "prune")


class Stage(NamedTuple):
    """Epochs over all pictures with one set of cells.

    cells    along an axis of the lattice; the same number as in the stage before, or twice as many
    scale    pictures are downscaled by this factor
    epochs   how often every picture is used
    density, colour  learning rates of the first and of the last step; they decrease geometrically
    rays     along an edge of a pixel: 2 is 2 x 2 rays per pixel, whose mean is compared with the picture
    split    before the stage, this share of the cells is divided into eight: the cells with the largest error in the
             pictures
    prune    after the stage, cells are removed if their largest weight in any ray is below this
    """

    cells: int
    scale: int = 1
    epochs: int = 1
    density: Rates = (0.1, 0.02)
    colour: Rates = (0.4, 0.1)
    rays: int = 1
    split: float = 0.0
    prune: float = 0.01

    def __str__(self) -> str:
        density, colour = ("..".join(f"{rate:g}" for rate in rates) for rates in (self.density, self.colour))
        values = (self.cells, self.scale, self.epochs, density, colour, self.rays, f"{self.split:g}", f"{self.prune:g}")
        return ",".join(f"{name}={value}" for name, value in zip(_NAMES, values, strict=True))


VIEWS = 100  # number of pictures that the presets are made for; if there are fewer, each is used more often
_BEFORE = (4, 2, 3), (2, 2, 3), (1, 1, 1)  # R / cells, scale and epochs of the stages before any cell is split
PRESETS = {"fast": 1, "balanced": 4, "best": 8}  # epochs of the stages of R cells with some cells split
_FINAL = 1.5  # with 3 x 3 rays, the last epoch takes as long as so many with 2 x 2
_AGAIN = 6  # from this many epochs with split cells on, more cells are split halfway
# Pictures of this many pixels show cells of 1 / 512 of the box. The first stage has R / 8 cells: fog of R / 4 cells
# hides twice as much behind it, and some of it never goes away. Before cells are split, more of them are pruned, which
# makes the file smaller (docs/tuning.md). `fast` has only one epoch of R cells before that: a second one takes
# 14 seconds for 0.15 dB.
_LARGE = 600
_LARGE_BEFORE = (8, 4, 6), (4, 4, 3), (2, 2, 2), (1, 1, 2)
_COARSE = ((0.3, 0.05), (0.5, 0.2), 0.01), ((0.1, 0.015), (0.5, 0.2), 0.03)  # rates and pruning of the first stages
_FINE = (0.08, 0.03), (0.5, 0.3)  # rates of those after them
_UNSEEN = 0.005  # pruning within a stage: only cells that no ray needs
# Pictures are downscaled by the largest whole factor that leaves an object this many pixels, squared. The chair has
# 367^2 at 800x800. The time of a fit grows with the pixels, and so does the quality (docs/tuning.md). So small objects
# keep all of them.
_LEAST_SIDE = 384


class Schedule(tuple[Stage, ...]):
    """Stages in order; str() is the text that parse_schedule() reads.

    >>> from nerfbake.scene.schedule import parse_schedule
    >>> schedule = parse_schedule("cells=32,scale=2,epochs=2/cells=64,epochs=3,rays=2")
    >>> schedule.resolution, schedule.epochs
    (64, 5)
    >>> parse_schedule(str(schedule)) == schedule
    True
    """

    __slots__ = ()

    def __new__(cls, stages: Iterable[Stage]) -> Schedule:
        made = super().__new__(cls, stages)
        if not made:
            raise InvalidScene(Problem("the schedule", "has no stages", "one or more"))
        for number, stage in enumerate(made):
            _require_stage(stage, number)
        for number, (before, stage) in enumerate(pairwise(made), start=1):
            whole = not any(earlier.split for earlier in made[: number + 1])
            grown = (before.cells, 2 * before.cells) if whole else (before.cells,)
            if stage.cells not in grown:
                allowed = " or ".join(map(str, grown)) + ("" if whole else ", because cells are split already")
                raise InvalidScene(Problem(f"stage {number + 1}, cells", f"is {stage.cells}", allowed))
        return made

    def __str__(self) -> str:
        return "/".join(map(str, self))

    @property
    def resolution(self) -> int:
        """Cells along an axis in the last stage; cells that were split are twice as fine."""
        return self[-1].cells

    @property
    def finest(self) -> int:
        """Cells along an axis that are as wide as the smallest ones, which were split."""
        return self.resolution * (2 if any(stage.split for stage in self) else 1)

    @property
    def smooth(self) -> int:
        """Number of the stages with larger cells than the last one: a fit of an object interpolates densities there."""
        return sum(stage.cells < self.resolution for stage in self)

    @property
    def epochs(self) -> int:
        """Epochs of all stages together."""
        return sum(stage.epochs for stage in self)


def parse_schedule(text: str) -> Schedule:
    """Parse the text of a schedule. Missing values of a stage have the defaults of Stage. Raises InvalidScene."""
    return Schedule(_parse_stage(part, f"stage {number}") for number, part in enumerate(text.split("/"), start=1))


def resolution_for(edge: int) -> int:
    """The cells along an axis that the presets have for pictures whose shorter edge has `edge` pixels."""
    return 512 if edge >= _LARGE else 256


def preset_schedule(
    name: str = "balanced",
    *,
    resolution: int | None = None,
    samples: int = 2,
    views: int = VIEWS,
    edge: int = 400,
    side: float = 0.0,
) -> Schedule:
    """A preset's stages for a lattice of `resolution` cells along an axis, 16 or more; None: resolution_for(edge).

    samples: rays along an edge of a pixel. views: number of pictures. A fit takes as many steps for a few views as for
    a hundred, in about the same time. If there are several epochs with 2 x 2 rays, the last one has 3 x 3. With
    samples = 1 it has single rays, so that pictures with single rays look best. edge: the pictures' shorter edge in
    pixels. side: the object has side^2 pixels in a picture; from 768^2 on, all stages downscale the pictures.
    """
    if name not in PRESETS:
        raise InvalidScene(Problem("preset", f"is {name!r}", ", ".join(PRESETS)))
    resolution = resolution or resolution_for(edge)
    return _stages(PRESETS[name], resolution, samples, views, edge, side)


def schedule_for(
    minutes: float,
    *,
    resolution: int | None = None,
    samples: int = 2,
    views: int = VIEWS,
    edge: int = 400,
    side: float = 0.0,
) -> Schedule:
    """The longest schedule that takes about `minutes` on two cores for a scene like NeRF-Synthetic's chair.

    The other arguments are those of preset_schedule(). resolution None: resolution_for(edge) if there is time for it,
    else 256.
    """
    if not 0 < minutes <= MAX_MINUTES:
        raise InvalidScene(Problem("minutes", f"are {minutes:g}", f"above 0, to {MAX_MINUTES:g}"))
    if resolution is None:
        resolution = resolution_for(edge)
        if 60 * minutes < _SECONDS_BEFORE_LARGE + _SECONDS_A_LARGE_EPOCH:
            resolution = 256
    large = resolution >= 512
    before, each = (_SECONDS_BEFORE_LARGE, _SECONDS_A_LARGE_EPOCH) if large else (_SECONDS_BEFORE, _SECONDS_AN_EPOCH)
    number = (60 * minutes - before) / each
    epochs = max(1, min(round(number if number < 1 + _FINAL else number + 1 - _FINAL), MAX_EPOCHS))
    return _stages(epochs, resolution, samples, views, edge, side)


def _stages(epochs: int, resolution: int, samples: int, views: int, edge: int, side: float) -> Schedule:
    def times(epochs: int) -> int:
        return max(1, min(round(epochs * VIEWS / views), MAX_EPOCHS))

    large = resolution >= 512
    second = epochs // 2 if epochs >= _AGAIN else 0
    first, again = (min(4 * epochs, 12) / 100, 0.05) if large else (0.1, 0.1)
    made = []
    for number, (parts, scale, each) in enumerate(_LARGE_BEFORE if large else _BEFORE):
        density, colour, prune = (*_COARSE, (*_FINE, 0.03 if large else 0.02), (*_FINE, 0.04))[number]
        cells, scale = max(resolution // parts, RESOLUTIONS[0]), min(scale, 4 if edge >= _LARGE else 2)
        each = min(each, epochs) if parts == 1 else each
        made.append(Stage(cells, scale, times(each), density, colour, prune=prune))
    prune = 0.03 if large and epochs == 1 else 0.02
    made.append(Stage(resolution, 1, times(epochs - second), (0.12, 0.02), (1.0, 0.12), 2, first, prune))
    if second:
        made.append(Stage(resolution, 1, times(second), (0.1, 0.02), (0.4, 0.1), 2, again, prune))
    if samples > 1 and epochs > 1:
        made[-1:] = _with_final(made[-1], times(1))
    if samples == 1:
        made.append(Stage(resolution, 1, times(1), (0.02, 0.01), (0.2, 0.1), prune=0.02))
    factor = max(1, int(side / _LEAST_SIDE))
    return Schedule(stage._replace(scale=min(factor * stage.scale, MAX_SCALE)) for stage in made)


def _with_final(stage: Stage, final: int) -> list[Stage]:
    """Return a stage as two, of which the second has the last epochs, with 3 x 3 rays."""
    most = stage.epochs - final
    if most < 1:
        return [stage]
    density, colour = (
        float(f"{begin * (end / begin) ** (most / stage.epochs):.3g}") for begin, end in (stage.density, stage.colour)
    )
    first = stage._replace(epochs=most, density=(stage.density[0], density), colour=(stage.colour[0], colour))
    last = Stage(stage.cells, 1, final, (density, stage.density[1]), (colour, stage.colour[1]), 3, prune=stage.prune)
    return [first._replace(prune=_UNSEEN), last]


# Epochs of the stages of R / 8, R / 4 and R / 2 cells, and of the stages in which some cells are split.
SCENERY_PRESETS = {"fast": (3, 2, 2, (1,)), "balanced": (3, 2, 3, (2, 1)), "best": (3, 3, 4, (3, 3, 3))}
_SCENERY_MINUTES = {"fast": 1.0, "balanced": 2.0, "best": 5.0}
# Pixels of a picture of 4:3 with 1.5 times as many pixels along the shorter edge as a cube has cells, by cells^2. In
# larger ones, fewer epochs are as good (docs/tuning.md).
_SCENERY_PIXELS = 3.0


def scenery_scale(edge: int, cells: int) -> int:
    """The factor that reduces a picture with a shorter edge of `edge` pixels to about 1.5 times the cells of a cube."""
    return max(1, round(edge / (1.5 * cells)))


def scenery_schedule(
    name: str = "balanced",
    *,
    resolution: int = 256,
    views: int = VIEWS,
    edge: int = 512,
    pixels: float = 0.0,
    minutes: float | None = None,
) -> Schedule:
    """A preset's stages for pictures with scenery; `resolution` is that of the smallest cells in the inner cube.

    views: as in preset_schedule(). edge: the pictures' shorter edge in pixels; each stage scales them so that it has
    about 1.5 times as many pixels as the inner cube has cells. pixels: of a picture, on average; a stage with more than
    a picture of 4:3 has with 1.5 times as many as cells has fewer epochs. minutes: select the stages for this time
    instead of the preset.
    """
    if name not in SCENERY_PRESETS:
        raise InvalidScene(Problem("preset", f"is {name!r}", ", ".join(SCENERY_PRESETS)))
    factor = 1.0
    if minutes is not None:
        if not 0 < minutes <= MAX_MINUTES:
            raise InvalidScene(Problem("minutes", f"are {minutes:g}", f"above 0, to {MAX_MINUTES:g}"))
        name = [preset for preset, least in _SCENERY_MINUTES.items() if least <= max(minutes, 1)][-1]
        factor = minutes / _SCENERY_MINUTES[name]

    def scale(cells: int) -> int:
        return min(scenery_scale(edge, cells), MAX_SCALE)

    def times(epochs: int, cells: int) -> int:
        share = min(1.0, _SCENERY_PIXELS * (cells * scale(cells)) ** 2 / max(pixels, 1))
        return max(1, min(round(factor * epochs * VIEWS / views * share), MAX_EPOCHS))

    half = max(resolution // 2, 32)
    first, second, third, last = SCENERY_PRESETS[name]
    density, colour = (0.025, 0.015), (0.5, 0.3)
    made = [
        Stage(max(half // 4, 32), scale(half // 4), times(first, half // 4), (0.03, 0.015), colour, prune=0.03),
        Stage(max(half // 2, 32), scale(half // 2), times(second, half // 2), density, colour, prune=0.03),
        Stage(half, scale(half), times(third, half), density, colour, prune=0.03),
    ]
    for number, epochs in enumerate(last):
        end = number == len(last) - 1
        rates = ((0.025, 0.01), (0.5, 0.2)) if end else (density, colour)
        split = 0.06 if number else 0.2
        made.append(Stage(half, scale(2 * half), times(epochs, 2 * half), *rates, split=split, prune=0.02))
    return Schedule(made)


def _parse_stage(text: str, place: str) -> Stage:
    found: dict[str, str] = {}
    for word in text.split(","):
        name, _, value = word.strip().partition("=")
        if name not in _NAMES or name in found:
            raise InvalidScene(
                Problem(place, f"has {word.strip()[:40]!r}", f"{', '.join(_NAMES)}, each once, such as cells=64")
            )
        found[name] = value
    if "cells" not in found:
        raise InvalidScene(Problem(place, "has no cells", "cells=64 or another power of two"))
    values: dict[str, int | float | Rates] = {}
    for name, value in found.items():
        numbers = re.fullmatch(r"([0-9.e-]+?)(?:\.\.([0-9.e-]+))?", value)
        try:
            if name in ("density", "colour"):
                if numbers is None:
                    raise ValueError(value)
                begin = float(numbers[1])
                values[name] = begin, float(numbers[2]) if numbers[2] else begin
            else:
                values[name] = float(value) if name in ("split", "prune") else int(value)
        except ValueError:
            allowed = "rates such as 0.1..0.02" if name in ("density", "colour") else "a number"
            raise InvalidScene(Problem(f"{place}, {name}", f"is {value[:40]!r}", allowed)) from None
    return Stage(**values)  # type: ignore[arg-type]


def _require_stage(stage: Stage, number: int) -> None:
    """Raise InvalidScene if a value of the stage is out of range."""
    place = f"stage {number + 1}, "
    low, high = RESOLUTIONS
    if not low <= stage.cells <= high or stage.cells & (stage.cells - 1):
        raise InvalidScene(Problem(place + "cells", f"is {stage.cells}", f"a power of two, {low} to {high}"))
    whole = (("scale", stage.scale, MAX_SCALE), ("epochs", stage.epochs, MAX_EPOCHS), ("rays", stage.rays, MAX_RAYS))
    for name, value, most in whole:
        if not 1 <= value <= most:
            raise InvalidScene(Problem(place + name, f"is {value}", f"1 to {most}"))
    for name, rates in (("density", stage.density), ("colour", stage.colour)):
        for rate in rates:
            if not 0 < rate <= MAX_RATE:
                raise InvalidScene(Problem(place + name, f"is {rate:g}", f"rates above 0, to {MAX_RATE:g}"))
    for name, share in (("split", stage.split), ("prune", stage.prune)):
        if not 0 <= share < 1:
            raise InvalidScene(Problem(place + name, f"is {share:g}", "0 or more, below 1"))
    if stage.split and not number:
        raise InvalidScene(Problem(place + "split", f"is {stage.split:g}", "0 in the first stage"))
