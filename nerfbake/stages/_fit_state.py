"""Where a fit stands: all that it takes to look at its field, to save it, and to go on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Points
from nerfbake.kernels.fit.bricks import Bricks
from nerfbake.kernels.maths.elementary import log
from nerfbake.scene.basis import Basis, parse_basis
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.schedule import RESOLUTIONS, Schedule, parse_schedule
from nerfbake.stages._bricks import Cells, field_of_cells, lattice
from nerfbake.stages._fit_arrays import BRICKS, COUNTERS, own_arrays

_LN_10 = 2.302585092994046


@dataclass(eq=False)
class FitState:
    """Changes while the fit goes on: what is wanted of it later has to be copied or written before.

    stage, epoch, view  how many stages are done, epochs of the next stage, and views of its next epoch
    built     the stage that the cells are of
    divided   cells are of two widths
    error, values  the sum of squares of what this epoch's pixels were off, and how many numbers that were
    """

    schedule: Schedule
    basis: Basis
    seed: int
    box: Points
    cells: Cells
    stage: int = 0
    epoch: int = 0
    view: int = 0
    built: int = 0
    divided: int = 0
    error: float = 0.0
    values: float = 0.0

    @property
    def done(self) -> bool:
        return self.stage == len(self.schedule)

    @property
    def resolution(self) -> int:
        """Cells of the lattice along an axis."""
        return 8 * len(self.cells.bricks.top)

    @property
    def train_psnr(self) -> float:
        """dB, of the pixels that this epoch has seen so far, as they were when they were seen; 0 before the first."""
        return -10 / _LN_10 * float(log(self.error / self.values)) if self.error > 0 else 0.0

    def field(self) -> BrickField:
        """What has been fitted so far. Raises MemoryLimit."""
        return field_of_cells(self.cells, self.box, self.basis)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that of_arrays() needs, by name; the arrays are the fit's own."""
        made = {name: getattr(self.cells.bricks, name) for name in BRICKS}
        counters = np.array([getattr(self, name) for name in COUNTERS], np.int64)
        sums = np.array([self.error, self.values])
        text = np.frombuffer(f"{self.basis} {self.schedule}".encode(), np.uint8)
        beside = {"box": self.box, "means": self.cells.means, "seen": self.cells.seen}
        return made | beside | {"counters": counters, "sums": sums, "text": text}

    @staticmethod
    def of_arrays(arrays: Mapping[str, npt.NDArray[Any]]) -> FitState:
        """The state whose arrays() these were; it goes on in copies. Raises InvalidScene for others."""
        held = own_arrays(arrays, resolutions=(RESOLUTIONS[0], 2 * RESOLUTIONS[1]))
        basis, _, schedule = held["text"].tobytes().decode("ascii", "replace").partition(" ")
        made: dict[str, Any] = {name: held[name] for name in BRICKS}
        low, size, width = lattice(held["box"], 8 * len(held["top"]))
        bricks = Bricks(**made, low=low, size=size, width=width)
        counters = dict(zip(COUNTERS, map(int, held["counters"]), strict=True))
        error, values = map(float, held["sums"])
        cells = Cells(bricks, held["means"], held["seen"])
        state = FitState(
            parse_schedule(schedule),
            parse_basis(basis),
            box=held["box"],
            cells=cells,
            error=error,
            values=values,
            **counters,
        )
        _require_sound(state)
        return state


def _require_sound(state: FitState) -> None:
    """Raises InvalidScene for a state that its own schedule does not come to."""
    size, found, stages = state.cells.n * state.basis.data_dim, len(state.cells.bricks.values), len(state.schedule)
    if found != size:
        raise InvalidScene(Problem("the state's values", f"are {found:,}", f"{size:,}, for {state.basis}"))
    begun = state.stage < stages and state.epoch < state.schedule[state.stage].epochs
    begun = begun or (state.stage == stages and state.epoch == state.view == 0)
    if not (begun and state.built in (state.stage, state.stage - 1) and state.divided <= 1):
        counters = ", ".join(f"{name} {getattr(state, name)}" for name in COUNTERS[:5])
        raise InvalidScene(Problem("the state", f"stands at {counters}", f"a place in its schedule of {stages} stages"))
    cells = state.schedule[min(state.built, stages - 1)].cells << state.divided
    if state.resolution != cells:
        raise InvalidScene(Problem("the state's lattice", f"has {state.resolution} cells an axis", f"{cells}"))
    state.field().require_usable()
