"""The state of a fit: the data needed to return its field, to save it, and to resume it.

A state may come from a file, so all its arrays are validated before compiled code uses their indices.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as attribute
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats, Points, Singles
from nerfbake.kernels.fit.bricks import EMPTY, SIZE, BrickGrid, no_corners, top_grid
from nerfbake.kernels.fit.corners import LEAST_RAW, MOST_RAW
from nerfbake.scene.base import edge_problems, number_problems, place_problems
from nerfbake.scene.basis import Basis, parse_basis
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.n3tree import MAX_SHELLS
from nerfbake.scene.schedule import RESOLUTIONS, Schedule, parse_schedule
from nerfbake.stages._bricks import BrickCells, field_of_cells, lattice_frame, with_corners
from nerfbake.stages._fit_devices import CpuFit, FitDevice
from nerfbake.stages._scenery_depths import Depths
from nerfbake.stages.overlap import Overlap

BRICKS = ("top", "slots", "first", "places", "values")
COUNTERS = ("stage", "epoch", "view", "built", "divided", "seed")
GAINS = 0.05, 20.0  # least and greatest gain of a view
_COARSE_B = 9  # coefficients of a channel before any cell is split: more would only need memory and time
_MOST_TEXT = 1 << 16  # most bytes of the text of a basis and a schedule

Arrays = dict[str, npt.NDArray[Any]]


def coefficients(schedule: Schedule, basis: Basis, stage: int) -> int:
    """Return the number of coefficients of a channel in a stage: all of them from the first on that splits cells."""
    splits = [number for number, each in enumerate(schedule) if each.split]
    return min(basis.size, _COARSE_B) if splits and stage < splits[0] else basis.size


def _own_arrays(arrays: Mapping[str, npt.NDArray[Any]]) -> Arrays:
    """Validate the arrays of a state, and return copies of them. Raises InvalidScene, MemoryLimit."""
    b, n = (len(arrays[name]) if name in arrays and arrays[name].ndim else 0 for name in ("slots", "places"))
    grid = arrays["top"].shape if "top" in arrays and arrays["top"].ndim == 3 else (0, 0, 0)
    r, shells = grid[1], min(max(grid[0] // max(grid[1], 1), 1), MAX_SHELLS)
    shapes: dict[str, tuple[type[np.generic], tuple[int | None, ...]]] = {
        "top": (np.int32, (shells * r, r, r)),
        "slots": (np.int16, (b, SIZE)),
        "first": (np.int32, (b + 1,)),
        "places": (np.int16, (n,)),
        "values": (np.float32, (None,)),
        "raw": (np.float32, (None,)),
        "raw_means": (np.float32, arrays["raw"].shape[:1] if "raw" in arrays else (None,)),
        "means": (np.float32, (n, 2)),
        "seen": (np.float32, (n, 2)),
        "box": (np.float64, (2, 3)),
        "counters": (np.int64, (len(COUNTERS),)),
        "gains": (np.float64, (None, 3)),
        "text": (np.uint8, (None,)),
    }
    if missing := sorted(shapes.keys() - arrays.keys()):
        raise InvalidScene(Problem("the state", f"has no {missing[0]}", ", ".join(shapes)))
    for name, (dtype, shape) in shapes.items():
        array = arrays[name]
        fits = array.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
        if array.dtype != dtype or not fits:
            found = f"has shape {array.shape}, dtype {array.dtype}"
            words = ", ".join("any" if edge is None else str(edge) for edge in shape)
            raise InvalidScene(Problem(f"the state's {name}", found, f"({words}) {np.dtype(dtype)}"))
    least, most = RESOLUTIONS[0], 2 * RESOLUTIONS[1]  # cells that were split are half as wide
    if not (least <= 8 * r <= most and not r & (r - 1) and n and arrays["text"].size <= _MOST_TEXT):
        allowed = f"a power of two of bricks, {least // 8} to {most // 8}, with cells in them"
        raise InvalidScene(Problem("the state's lattice", f"has {r} bricks an axis, {n:,} cells", allowed))
    memory.require("the state", memory.size_of({name: arrays[name] for name in shapes}))
    own = {name: np.array(arrays[name]) for name in shapes}
    _require_bricks(own)
    _require_numbers(own)
    return own


def _require_bricks(own: Arrays) -> None:
    """Raise InvalidScene if the tables of bricks and of cells do not match each other."""
    top, slots, first, places = (own[name] for name in ("top", "slots", "first", "places"))
    counts = first[1:].astype(np.int64) - first[:-1]
    counted = first[0] == 0 and first[-1] == len(places) and bool(((counts >= 1) & (counts <= SIZE)).all())
    problem = None
    if int(np.count_nonzero(top >= 0)) != len(slots) or (top != top_grid(top >= 0)).any():
        problem = Problem(
            "the state's top", "does not number its bricks", "raster order, or minus the distance to the nearest brick"
        )
    elif not counted:
        problem = Problem("the state's first", "does not count its cells", f"from 0, up by 1 to {SIZE} a brick")
    elif (slots < EMPTY).any() or (slots >> 1 >= counts[:, None]).any():
        problem = Problem("the state's slots", "point to cells that do not exist", "-2, -1, or a cell of the brick")
    elif (places < 0).any() or (places >> 1 >= SIZE).any():
        problem = Problem("the state's places", "lie outside of a brick", f"place << 1 | wide, place 0 to {SIZE - 1}")
    else:
        held = np.repeat(np.arange(len(slots)), counts)
        own_slot = (np.arange(len(places)) - first[held]) << 1 | places & 1
        if (slots[held, places >> 1] != own_slot).any():
            problem = Problem("the state's places", "do not match the slots", "for each cell the place of its slot")
    if problem is not None:
        raise InvalidScene(problem)


def _require_numbers(own: Arrays) -> None:
    """Raise InvalidScene for numbers that are not possible in a fit, such as NaN or negative means."""
    problems = place_problems("the state's box", own["box"])
    problems = problems or edge_problems("the state's box", own["box"][1] - own["box"][0])
    for name in ("values", "raw", "raw_means", "means", "seen", "gains"):
        problems = problems or number_problems(f"the state's {name}", own[name])
    for name in ("raw_means", "means", "seen", "counters"):
        if not problems and (own[name] < 0).any():
            problems = [Problem(f"the state's {name}", "are below 0", "0 or more")]
    if not problems and ((own["gains"] < GAINS[0]) | (own["gains"] > GAINS[1])).any():
        problems = [Problem("the state's gains", "are out of range", f"{GAINS[0]:g} to {GAINS[1]:g}")]
    if problems:
        raise InvalidScene(problems[0])


@dataclass(eq=False)
class FitState:
    """The state of a fit. The fit changes it in place, so copy or write anything that you need later.

    stage, epoch, view  number of finished stages, of finished epochs in the next stage, and of views in its next epoch
    built          the stage that the cells were built for
    divided        1 if there are cells of two widths, else 0
    gains          (views, 3): the factor for each channel between the field's colours and those of each view, or (0, 3)
                   if the views have the same exposure
    depths         that pictures with scenery show; None: not found yet, as for a state from a file
    device         what runs the steps; the arrays of the cells are current after read_back()
    """

    schedule: Schedule
    basis: Basis
    seed: int
    box: Points
    cells: BrickCells
    stage: int = 0
    epoch: int = 0
    view: int = 0
    built: int = 0
    divided: int = 0
    gains: Floats = attribute(default_factory=lambda: np.ones((0, 3)))
    depths: Depths | None = None
    device: FitDevice = attribute(default_factory=CpuFit)

    def __post_init__(self) -> None:
        self._mark()

    def _mark(self) -> None:
        self._read = self.stage, self.epoch, self.view, self.gains

    def read_back(self) -> None:
        """Make the arrays of the cells current. Raises DeviceError."""
        self.device.read_back(self.cells)
        self._mark()

    def replace_cells(self, cells: BrickCells) -> None:
        """Replace the cells by those of the next stage."""
        self.cells, self.built = cells, self.stage
        self._mark()

    def return_to_cpu(self) -> None:
        """Return to where the arrays of the cells were current, and go on from there on the CPU."""
        self.device = CpuFit()
        self.stage, self.epoch, self.view, self.gains = self._read

    @property
    def overlap(self) -> Overlap | None:
        """How much pictures with scenery show together. None: not measured yet, as for a state from a file."""
        return None if self.depths is None else self.depths.overlap

    @property
    def done(self) -> bool:
        return self.stage == len(self.schedule)

    @property
    def resolution(self) -> int:
        """Number of cells of the lattice along an axis of the inner cube."""
        return int(8 * self.cells.bricks.top.shape[1])

    def field(self) -> BrickField:
        """Return the field as fitted so far. Raises MemoryLimit, DeviceError."""
        self.read_back()
        return field_of_cells(self.cells, self.box, Basis("SH", self.cells.B))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays that of_arrays() takes, by name. They are not copies: the fit will change them.

        Raises DeviceError.
        """
        self.read_back()
        made = {name: getattr(self.cells.bricks, name) for name in BRICKS}
        counters = np.array([getattr(self, name) for name in COUNTERS], np.int64)
        text = np.frombuffer(f"{self.basis} {self.schedule}".encode(), np.uint8)
        beside = {"box": self.box, "means": self.cells.means, "seen": self.cells.seen, "gains": self.gains}
        corners = self.cells.bricks.corners
        beside |= {"raw": corners.raw, "raw_means": corners.mean}
        return made | beside | {"counters": counters, "text": text}

    @staticmethod
    def of_arrays(arrays: Mapping[str, npt.NDArray[Any]]) -> FitState:
        """Return the state with these arrays(), which are copied. Raises InvalidScene if they are not a valid state."""
        held = _own_arrays(arrays)
        basis, _, schedule = held["text"].tobytes().decode("ascii", "replace").partition(" ")
        made: dict[str, Any] = {name: held[name] for name in BRICKS}
        r = held["top"].shape[1]
        low, size, width = lattice_frame(held["box"], 8 * r, len(held["top"]) // r)
        bricks = BrickGrid(**made, low=low, size=size, width=width, corners=no_corners())
        counters: dict[str, Any] = dict(zip(COUNTERS, map(int, held["counters"]), strict=True))
        cells = BrickCells(bricks, held["means"], held["seen"])
        if len(held["raw"]):
            cells = _with_raw(cells, held["raw"], held["raw_means"])
        state = FitState(
            parse_schedule(schedule),
            parse_basis(basis),
            box=held["box"],
            cells=cells,
            gains=held["gains"],
            **counters,
        )
        _require_sound(state)
        return state


def _with_raw(cells: BrickCells, raw: Singles, means: Singles) -> BrickCells:
    """Return the cells with corners of these raw densities. Raises InvalidScene, MemoryLimit."""
    if (cells.bricks.places & 1).any():
        raise InvalidScene(Problem("the state's raw", f"are {len(raw):,}", "0, because some cells are wide"))
    cells = with_corners(cells)
    corners = cells.bricks.corners
    if len(raw) != len(corners.raw):
        raise InvalidScene(
            Problem("the state's raw", f"are {len(raw):,}", f"{len(corners.raw):,}, one for each corner")
        )
    if raw.min() < LEAST_RAW or raw.max() > MOST_RAW:
        found = f"are {raw.min():g} to {raw.max():g}"
        raise InvalidScene(Problem("the state's raw", found, f"{LEAST_RAW:g} to {MOST_RAW:g}"))
    corners.raw[:], corners.mean[:] = raw, means
    return cells


def _require_sound(state: FitState) -> None:
    """Raise InvalidScene for a state that is not reachable with its schedule."""
    found, stages = len(state.cells.bricks.values), len(state.schedule)
    size = state.cells.n * (3 * coefficients(state.schedule, state.basis, state.built) + 1)
    if found != size:
        raise InvalidScene(Problem("the state's values", f"are {found:,}", f"{size:,}, for {state.basis}"))
    begun = state.stage < stages and state.epoch < state.schedule[state.stage].epochs
    begun = begun or (state.stage == stages and state.epoch == state.view == 0)
    if not (begun and state.built in (state.stage, state.stage - 1) and state.divided <= 1):
        counters = ", ".join(f"{name} {getattr(state, name)}" for name in COUNTERS[:5])
        raise InvalidScene(Problem("the state", f"is at {counters}", f"a position in its schedule of {stages} stages"))
    if state.cells.bricks.smooth and state.built >= state.schedule.smooth:
        raise InvalidScene(Problem("the state's raw", f"exist in stage {state.built}", "none in this stage"))
    cells = state.schedule[min(state.built, stages - 1)].cells << state.divided
    if state.resolution != cells:
        raise InvalidScene(Problem("the state's lattice", f"has {state.resolution} cells an axis", f"{cells}"))
    state.field().require_usable()
