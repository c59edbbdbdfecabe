"""Trained function -> field of bricks: densities at the centres of cells, and colours in the directions of cameras."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Points, Singles
from nerfbake.kernels.march.sh import band_of, rotation_of_sh
from nerfbake.kernels.maths.elementary import log
from nerfbake.kernels.maths.linear import product
from nerfbake.kernels.network.projection import choose_cameras, fit_logits
from nerfbake.scene.basis import SH0, parse_basis
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.camera import Cameras
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.network import BasisColour, Network
from nerfbake.stages._function_cells import FunctionCells, Wall, baking_views, find_cells, see, spread_cameras
from nerfbake.stages.function_to_image import look_beyond
from nerfbake.stages.function_to_part import FunctionPart, cameras_of, identify_function_part

# Figures below: PSNR of a nerfacto in 128^3 against its own pictures from 8 cameras, of which 4 were not trained with.
DIRECTIONS = 12  # at least, from which the colours of a cell are computed: 8 cost 0.2 dB, 24 gain 0.02 dB
_PER_COEFFICIENT = 1.5  # of a channel; directions
_RIDGE = (0.0, 1e-3, 4e-3, 9e-3, 16e-3)  # pulls the coefficients of each band towards 0; 10 times as much costs 0.1 dB
# Over the resolution: cells that absorb less of every ray are dropped. Costs 0.06 dB of 47.5 in 128^3, and 0.02 dB of
# 53.5 in 256^3; twice as much costs 0.4 and 1.6 dB.
_WEIGHT = 0.512
_MOST_LOGIT = 8.0  # the sigmoid of more is 0 or 1 to a tenth of a step of 1/255
_PAIRS = 1 << 17  # colours that are computed at a time
_NUMBERS = 1 << 22  # of their features
_WALL_CELLS = 128  # along an edge of a side of the wall, at most
_OPAQUE = 0.5  # alpha of what lies beyond, from which there is a wall
_THICKEST = 8.0  # optical thickness of the wall


def bake_function(
    field: FunctionField,
    *,
    resolution: int = 256,
    basis: str | None = None,
    part: FunctionPart | None = None,
    cameras: Cameras | None = None,
    sigma_min: float = 0.0,
) -> BrickField:
    """Convert a trained function to a field of bricks that shows what the cameras see of it.

    resolution  cells along each edge of the box or inner cube, a power of two from 8; with scenery from 32
    basis       SH1 to SH25; None: that of a network that computes spherical harmonics itself, else SH9
    part        the part of the field; None: identify_function_part()
    cameras     from which the field is seen; None: those that it was trained with, or else 48 all around it
    sigma_min   cells of a lower density per world unit are empty

    A cell has the density at its centre. Cells that absorb less than 0.4 % of every ray in 128^3, in 256^3 less than
    0.2 %, are dropped. Colours are fitted in logit space by weighted least squares, in
    the directions from at most 12 cameras (SH16: 24), with the transmittance from the camera to the cell as weight.
    With scenery, the outermost shell ends in a wall with the colour of what lies beyond, where that is opaque.

    The same arguments give the same bytes, for any number of threads. Raises InvalidScene for a field that cannot be
    rendered, and for one without a visible density; MemoryLimit. Source: docs/fields.md, "Bake".

    >>> import numpy as np
    >>> from nerfbake import FunctionField, bake_function
    >>> from nerfbake.scene.lattice_field import Activation
    >>> from nerfbake.scene.network import Frequencies, HeadColour, Mlp, Network
    >>> fog = Mlp((np.zeros((1, 3), np.float32),), (np.full(1, 9, np.float32),))
    >>> grey = HeadColour(Mlp((np.zeros((3, 1), np.float32),), (np.zeros(3, np.float32),)), "none")
    >>> network = Network(Frequencies(np.zeros(0)), fog, np.ones(1, np.float32), 0.0, Activation("relu"), grey)
    >>> field = FunctionField(network, np.eye(3, 4), np.array([[-1.0] * 3, [1.0] * 3]))
    >>> made = bake_function(field, resolution=8, basis="SH1")
    >>> made.resolution, bool((made.values[:, -1] == 9).all())
    (8, True)
    """
    field.require_usable()
    wanted = parse_basis(basis or _native_basis(field))
    if wanted.kind != "SH":
        raise InvalidScene(Problem("basis", f"is {basis}", "SH1, SH4, SH9, SH16, SH25"))
    cameras = cameras or cameras_of(field)
    cameras.require_covered()
    with progress.part(0, 0.1):
        box, shells, _ = part or identify_function_part(field, cameras)
    with progress.part(0.1, 0.4):
        wall = _wall(field, box, resolution, shells) if shells > 1 and field.contracted else None
        cells = find_cells(field, box, resolution, shells, sigma_min, wall)
    spread = spread_cameras(cameras)
    with progress.part(0.4, 0.5):
        seen = see(cells, baking_views(spread, box, resolution), field.near / field.scale, through=True)
    keep = seen.largest >= _WEIGHT / resolution
    cells, through = cells.kept(keep), np.ascontiguousarray(seen.through[:, keep])
    del seen
    memory.require(f"a field of {cells.n:,} cells", 4 * cells.n * wanted.data_dim + 6 * cells.made.slots.size)
    values = np.empty((cells.n, wanted.data_dim), np.float32)
    values[:, -1] = cells.sigma
    with progress.part(0.5, 1):
        _colour(field, cells, spread.eyes, through, wanted.size, values)
    if wall is not None:
        held, number = cells.in_wall(wall)
        values[held, :-1] = 0
        values[held, : -1 : wanted.size] = _logit(wall.colours[number]) / np.float32(SH0)
    rows = cells.made.slots.astype(np.int32)
    rows += 2 * cells.made.first[:-1, None]
    rows[cells.made.slots < 0] = -1
    return memory.kept(BrickField(resolution, box.copy(), wanted, cells.made.top, rows, values))


def _coefficients(field: FunctionField) -> BasisColour | None:
    """Return the colours of a network that computes spherical harmonics itself."""
    if isinstance(field.network, Network) and isinstance(field.network.colour, BasisColour):
        return field.network.colour if field.network.colour.lobes is None else None
    return None


def _native_basis(field: FunctionField) -> str:
    own = _coefficients(field)
    return f"SH{own.size}" if own is not None else "SH9"


def _wall(field: FunctionField, box: Points, resolution: int, shells: int) -> Wall | None:
    """Return the cells at the end of the outermost shell behind which the field is opaque, as seen from the middle."""
    coarse = min(resolution, _WALL_CELLS)
    times, middle = resolution // coarse, box.mean(axis=0)
    outer = (box[1] - box[0]) * 2.0 ** (shells - 1)
    rim = np.ones((coarse, coarse, coarse), bool)
    rim[1:-1, 1:-1, 1:-1] = False
    sides = np.argwhere(rim)
    away = ((sides + 0.5) / coarse - 0.5) * outer
    distance = np.sqrt(np.square(away).sum(axis=1))
    colours, alpha = look_beyond(field, middle, away / distance[:, None], distance)
    fine = np.zeros((resolution, resolution, resolution), bool)
    fine[0], fine[-1], fine[:, 0], fine[:, -1], fine[:, :, 0], fine[:, :, -1] = True, True, True, True, True, True
    number = np.full(rim.shape, -1, np.int32)
    number[rim] = np.where(alpha >= _OPAQUE, np.arange(len(sides), dtype=np.int32), -1)
    places = np.flatnonzero(fine)
    x, y, z = (index // times for index in np.unravel_index(places, fine.shape))
    own = number[x, y, z]
    places, own = places[own >= 0], own[own >= 0]
    if not len(places):
        return None
    clear = np.maximum(1 - alpha[own], 1e-30)
    thickness = np.minimum(-log(clear), _THICKEST).astype(np.float32)
    return Wall(places, thickness, (colours[own] / alpha[own, None]).astype(np.float32))


def _logit(colours: Singles) -> Singles:
    """(m, 3) float32 the inputs of sigmoids with these values, at most _MOST_LOGIT."""
    inside = np.clip(colours.astype(np.float64), 1e-6, 1 - 1e-6)
    return np.clip(log(inside / (1 - inside)), -_MOST_LOGIT, _MOST_LOGIT).astype(np.float32)


def _colour(
    field: FunctionField,
    cells: FunctionCells,
    eyes: Points,
    through: npt.NDArray[np.uint8],
    B: int,
    values: Singles,
) -> None:
    """Write the coefficients of all cells into values (n, 3 B + 1). through (C, n): transmittances, see SeenCells."""
    own = _coefficients(field)
    if own is not None and own.size == B:
        _copy(field, own, cells, values)
        return
    ridge = np.array(_RIDGE)[band_of(B)]
    count = min(max(DIRECTIONS, int(_PER_COEFFICIENT * B)), len(eyes))
    features = field.density(cells.centres(0, 1))[1].shape[1]
    step = max(1, min(_PAIRS, _NUMBERS // features) // count)
    memory.require("the colours of cells", step * count * (4 * features + 120))
    for begin in progress.each(range(0, cells.n, step)):
        end = min(begin + step, cells.n)
        centres = cells.centres(begin, end)
        chosen = choose_cameras(through[:, begin:end], count)
        looks = centres[:, None] - eyes[chosen]
        looks /= np.maximum(np.sqrt(np.square(looks).sum(axis=2)), 1e-300)[:, :, None]
        held = np.repeat(field.density(centres)[1], count, axis=0)
        logits = field.logits(held, looks.reshape(-1, 3)).reshape(-1, count, 3)
        np.clip(logits, -_MOST_LOGIT, _MOST_LOGIT, out=logits)
        passed = np.take_along_axis(through[:, begin:end].T, chosen, axis=1)
        fit_logits(logits, looks, passed, ridge, values[begin:end, :-1])


def _copy(field: FunctionField, own: BasisColour, cells: FunctionCells, values: Singles) -> None:
    """Write the coefficients that the network computes, turned from the trained axes into those of the world."""
    turn = rotation_of_sh(np.ascontiguousarray((field.frame[:, :3] / field.scale).T), own.size)
    step = max(1, min(_PAIRS, _NUMBERS // own.mlp.inputs))
    for begin in progress.each(range(0, cells.n, step)):
        end = min(begin + step, cells.n)
        found = own.mlp(np.ascontiguousarray(field.density(cells.centres(begin, end))[1].T))
        for c in range(3):
            part = slice(c * own.size, (c + 1) * own.size)
            values[begin:end, part] = product(turn, found[part]).T
