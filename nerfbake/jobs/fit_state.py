"""Where a fit stands, in a folder: a run that was killed goes on from there to the same bytes."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import nerfbake
from nerfbake import io
from nerfbake.errors import InvalidFile, Problem
from nerfbake.jobs.fit_course import Point

_OFTEN = 30.0  # seconds of work that may be lost
_VERSION = 1


class Kept(NamedTuple):
    """A checkpoint's file, its arrays, CPU seconds of work and the curve until then."""

    path: str
    arrays: dict[str, Any]
    worked: float
    curve: list[Point]


class Keeper:
    """Keeps checkpoints of one fit in a folder. arguments: what its bytes depend on beside the pictures, as text."""

    def __init__(self, folder: str, arguments: Mapping[str, str], views: nerfbake.Views) -> None:
        self._folder = folder
        self._key = {"version": str(_VERSION), **arguments, "pictures": _digest(views)}
        self._kept = time.monotonic()

    @property
    def is_due(self) -> bool:
        return time.monotonic() - self._kept > _OFTEN

    def keep(self, now: Any, *, worked: float, curve: Sequence[Point]) -> None:
        """Replaces the last checkpoint in one step. Raises OutputError."""
        facts = {"key": self._key, "worked": worked, "curve": curve}
        io.save_checkpoint(self._folder, facts, now.arrays())
        self._kept = time.monotonic()

    def last(self) -> Kept | None:
        """What was kept last; None where there is nothing.

        Raises InvalidFile for a file that is none, and for one of a fit with other arguments or pictures.
        """
        found = io.load_checkpoint(self._folder)
        if found is None:
            return None
        facts, arrays = found
        path = str(io.checkpoint_path(self._folder))
        with io.blame(path):
            self._require_same(facts.get("key"))
            return Kept(path, arrays, _number("worked", facts.get("worked")), _points(facts.get("curve")))

    def _require_same(self, key: Any) -> None:
        key = key if isinstance(key, dict) else {}
        for name, value in self._key.items():
            if key.get(name) != value:
                was = str(key.get(name, "nothing"))[:80]
                if name == "pictures":
                    problem = Problem("the fit", "had other pictures or cameras", "the same, or another `state`")
                else:
                    problem = Problem(
                        f"the fit's {name}", f"was {was}", f"the same as now ({value}), or another `state`"
                    )
                raise InvalidFile(problem)


def _digest(views: nerfbake.Views) -> str:
    """A name for what a fit sees: cameras, pixels and what is behind them."""
    import hashlib  # here, since the help loads nothing that it does not show

    found = hashlib.sha256(repr((tuple(map(float, views.background)), views.masked)).encode())
    for camera, pixels in zip(views.cameras.cameras, views.pictures, strict=True):
        inside = tuple(map(float, (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)))
        found.update(repr((inside, camera.lens, camera.pose.tolist())).encode())
        found.update(pixels.tobytes())
    return found.hexdigest()


def _number(name: str, value: Any) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value < 1e9:
        raise InvalidFile(Problem(name, f"is {str(value)[:40]}", "a number of seconds"))
    return float(value)


def _points(rows: Any) -> list[Point]:
    size = len(Point._fields)
    fine = isinstance(rows, list) and all(isinstance(row, list) and len(row) == size for row in rows)
    if not fine or not all(type(value) in (int, float) for row in rows for value in row):
        raise InvalidFile(Problem("curve", "is no list of points", f"{size} numbers each"))
    return [Point(*row) for row in rows]
