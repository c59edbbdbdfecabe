"""Gaussian splats -> sparse voxel octree: densities and colours of the splats at the voxels' centres."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Coords, Floats, Ints, Points, Singles
from nerfbake.kernels.lattice.harmonics import inverse_of, refit_coefficients
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.parallel import cores, over_chunks
from nerfbake.kernels.splat.voxels import SIZE, Gaussians, count_in_bricks, fill_bricks, gaussians_of, list_in_bricks
from nerfbake.scene.basis import Basis, parse_basis
from nerfbake.scene.octree import MAX_SIZE, Layout, SparseVoxelOctree
from nerfbake.scene.splats import Splats
from nerfbake.scene.views import world_box
from nerfbake.scene.volume import OctreeFrame
from nerfbake.stages._cube_levels import Block, octree_of_blocks
from nerfbake.stages.half import cast_values
from nerfbake.stages.splat_box import OPACITY_MIN, inner_box

_THINNEST = 0.001  # optical depth of a voxel below which it is empty
# Variance that pictures of splats add to a splat, in squared pixels. Voxels blur as well, so splats get only a share of
# it in voxels of the edge h: 1 / (1 + 1.5 h^2 / pixel^2). A real scene in pictures of 400x400: 256^3, where a voxel is
# 1.3 pixels wide, has 29.1, 31.5, 32.4 and 30.5 dB with shares of 0, 0.1, 0.28 and 1; 512^3 has 28.0, 32.0 and 33.4 dB
# with 0, 0.28 and 0.54.
_BLUR, _COARSE = 0.3, 1.5
_PAIRS = 1 << 23  # splats of bricks that are listed at a time
_CHUNK = 32  # bricks that a core processes before it takes the next ones
_FITTED = 1 << 16  # voxels whose colours are converted at a time
_SPLAT_BYTES = 230  # per splat, as a Gaussian
_LISTED_BYTES = 12  # per brick of the grid, while splats are listed
_DIRECTIONS = 128  # in which coefficients are fitted to colours


def build_octree_from_splats(
    splats: Splats,
    *,
    resolution: int = 256,
    box: Sequence[float] | Points | None = None,
    opacity_min: float = OPACITY_MIN,
    sigma_min: float | None = None,
    pixel: float = 0.0,
    basis: str | None = None,
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
) -> SparseVoxelOctree:
    """Convert splats to an octree of cubic voxels, which store the density and the colour of the splats.

    resolution   voxels along the longest edge of the box, 1 to 4096
    box          lowest and highest corner (2, 3) in the world; None: inner_box(). What is outside is left out
    opacity_min  splats that are thinner are left out
    sigma_min    voxels of a lower density (1/world unit) are empty; None: those with an optical depth below 0.001
    pixel        edge of a pixel, in world units at the splats, of the pictures that the octree is to look like: they
                 blur splats by about a pixel, which makes thin ones wider. 0: splats have their own width
    basis        SH1 to SH25 of the colours; None: the degree of the splats

    In pictures of splats, the opacity of a splat is the same in every direction. In a density it is not, so the optical
    depth through a splat is right as the mean over all directions. Colours become the sigmoid of a sum of spherical
    harmonics, by a least-squares fit of the logits. refit_bricks() with pictures of the splats brings the octree closer
    to them. The result does not depend on the number of threads. Raises InvalidScene for broken splats, and if no voxel
    is filled; MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import Splats, build_octree_from_splats
    >>> ball, turn = np.full((1, 3), 0.1, np.float32), np.array([[1, 0, 0, 0]], np.float32)
    >>> splats = Splats(ball, ball, turn, np.full(1, 0.9, np.float32), np.zeros((1, 1, 3), np.float32))
    >>> octree = build_octree_from_splats(splats, resolution=8)
    >>> octree.size, octree.data_format
    ((8, 8, 8), 'SH1')
    """
    splats.require_usable()
    wanted = Basis("SH", splats.B) if basis is None else parse_basis(basis)
    if wanted.kind != "SH":
        raise InvalidScene(Problem("basis", f"is {basis}", "SH1, SH4, SH9, SH16, SH25"))
    if not 1 <= resolution <= MAX_SIZE:
        raise InvalidScene(Problem("resolution", f"is {resolution}", f"1 to {MAX_SIZE} voxels along an axis"))
    corners = inner_box(splats, opacity_min=opacity_min) if box is None else world_box(np.ravel(box).tolist())
    edges = corners[1] - corners[0]
    if not edges.max() > 0:
        raise InvalidScene(Problem("the splats", "are one point of size 0", "splats with a size, or a box"))
    h = float(edges.max()) / resolution
    W, H, D = (int(edge) for edge in np.clip(np.ceil(edges / h - 1e-6), 1, resolution))
    least = _THINNEST if sigma_min is None else sigma_min * h
    held = (splats.opacity >= opacity_min) & (splats.opacity > 0)
    memory.require("the splats as densities", int(np.count_nonzero(held)) * (_SPLAT_BYTES + 12 * splats.B))
    with progress.part(0, 0.1):
        gaussians, colours = _gaussians(splats, held, corners[0], h, pixel)
    with progress.part(0.1, 0.8):
        cells, values = _filled(gaussians, colours, (W, H, D), least)
    if not len(cells):
        raise InvalidScene(Problem("the splats", "fill no voxel", "an opacity and a box that leave some of them"))
    frame = OctreeFrame((W, H, D), str(wanted), layout, corners[0].copy(), np.full(3, h))
    with progress.part(0.8, 1), memory.scope():
        memory.hold("the voxels", cells.nbytes + values.nbytes + 4 * wanted.data_dim * len(cells))
        data = cast_values(_converted(values, splats.B, wanted, h), np.dtype(dtype), what="the field", asked="float16")
        del values
        blocks = [Block(cells.astype(np.int64), 0, np.arange(len(cells)))]
        return memory.kept(octree_of_blocks(blocks, data, frame))


def _gaussians(splats: Splats, held: Bits, low: Floats, h: float, pixel: float) -> tuple[Gaussians, Singles]:
    """Return these splats in voxels, and their colours (n, 3 B), channel by channel."""
    scales = splats.scales[held]
    if pixel > 0 and not splats.antialiased:  # the blur of antialiased splats keeps their mass, as that of a voxel
        wider = _BLUR * pixel * pixel / (1 + _COARSE * (h / pixel) ** 2)
        scales = np.sqrt(scales * scales + np.float32(wider))
    found = gaussians_of(splats.means[held], scales, splats.quats[held], splats.opacity[held], low, h)
    colours = np.ascontiguousarray(splats.sh[held].transpose(0, 2, 1)).reshape(-1, 3 * splats.B)
    return found, colours


def _filled(gaussians: Gaussians, colours: Singles, size: tuple[int, int, int], least: float) -> tuple[Coords, Singles]:
    """Return the voxels (m, 3) that are not empty, and their values (m, D), of fill_bricks()."""
    grid = tuple(-(-edge // 8) for edge in size)
    memory.require("the bricks of the grid", int(np.prod(grid)) * _LISTED_BYTES)
    counts = np.zeros(grid, np.int32)
    count_in_bricks(gaussians, counts)
    cells, values = [np.zeros((0, 3), np.int32)], [np.zeros((0, colours.shape[1] + 1), np.float32)]
    held = 0
    for first, last in progress.each(_parts(counts)):
        for some, own in _part(gaussians, colours, counts[first:last], first, size, least):
            cells.append(some)
            values.append(own)
            held += some.nbytes + own.nbytes
            memory.require("the voxels", 2 * held)
    return np.concatenate(cells), np.concatenate(values)


def _parts(counts: npt.NDArray[np.int32]) -> list[tuple[int, int]]:
    """Return runs of layers of bricks with at most _PAIRS splats together, or a single layer."""
    layers, runs = counts.sum(axis=(1, 2), dtype=np.int64).tolist(), []
    first, total = 0, 0
    for layer, count in enumerate(layers):
        if total and total + count > _PAIRS:
            runs.append((first, layer))
            first, total = layer, 0
        total += count
    return [*runs, (first, len(layers))]


def _part(
    gaussians: Gaussians,
    colours: Singles,
    counts: npt.NDArray[np.int32],
    first: int,
    size: tuple[int, int, int],
    least: float,
) -> Iterator[tuple[Coords, Singles]]:
    """Yield the voxels of some layers of bricks, from layer `first` on, and their values."""
    total = int(counts.sum(dtype=np.int64))
    memory.require("the splats of each brick", 4 * total)
    ends = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    order = np.empty(total, np.int32)
    list_in_bricks(gaussians, first, ends[:-1].reshape(counts.shape).copy(), order)
    places = np.ascontiguousarray(np.argwhere(counts), np.int32)
    held = np.concatenate([[0], np.cumsum(counts[counts > 0], dtype=np.int64)])
    places[:, 0] += first
    lists = _Lists(places, held, order, np.array(size, np.int32))
    together = _CHUNK * cores()
    memory.require("the voxels of some bricks", together * SIZE * 4 * (colours.shape[1] + 4))
    for begin in progress.each(range(0, len(places), together)):
        yield from _chunks(gaussians, colours, lists, begin, min(begin + together, len(places)), least)


class _Lists(NamedTuple):
    """The arguments bricks, ends, order and size of fill_bricks()."""

    bricks: npt.NDArray[np.int32]
    ends: Ints
    order: npt.NDArray[np.int32]
    size: npt.NDArray[np.int32]


def _chunks(
    gaussians: Gaussians, colours: Singles, lists: _Lists, first: int, last: int, least: float
) -> list[tuple[Coords, Singles]]:
    """Return the voxels of the bricks first .. last in chunks, each computed on one core."""
    found = [(np.zeros((0, 3), np.int32), np.zeros((0, 0), np.float32))] * -(-(last - first) // _CHUNK)

    def work(begin: int, end: int) -> None:
        cells = np.empty((SIZE * (end - begin), 3), np.int32)
        values = np.empty((len(cells), colours.shape[1] + 1), np.float32)
        some = slice(first + begin, first + end)
        bricks, ends = lists.bricks[some], lists.ends[some.start : some.stop + 1]
        count = fill_bricks(gaussians, colours, bricks, ends, lists.order, lists.size, least, cells, values)
        found[begin // _CHUNK] = cells[:count].copy(), values[:count].copy()

    over_chunks(work, last - first, _CHUNK)
    return found


def _converted(values: Singles, B: int, wanted: Basis, h: float) -> Singles:
    """Return the values (m, D) of an octree: coefficients behind a sigmoid, and densities per world unit."""
    # A colour of one coefficient is the same in all directions.
    directions = fibonacci(1 if B == 1 == wanted.size else _DIRECTIONS)
    basis, inverse = sh_basis(directions, B, np.float32), inverse_of(sh_basis(directions, wanted.size))
    out = np.empty((len(values), wanted.data_dim), np.float32)
    for begin in progress.each(range(0, len(values), _FITTED)):
        some = values[begin : begin + _FITTED]
        out[begin : begin + len(some), :-1] = refit_coefficients(some[:, :-1], basis, inverse)
        out[begin : begin + len(some), -1] = some[:, -1] / np.float32(h)
    return out
