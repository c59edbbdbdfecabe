"""Benchmark of `nerfbake svo` on other programs' checkpoints: time and memory of whole processes, loss of the octree.

The files are synthetic, computed from the real chair: a Plenoxels lattice, and a DirectVoxGO lattice with 12 features
and an MLP of 2x128 units that is fitted to the chair's colours. The time includes everything that the command does:
reading, sampling, fitting harmonics, writing, and its report of decibels and colours. Modules and kernels are compiled
before the clock starts.

A smaller Plenoxels lattice measures how well voxels match it, at several resolutions, and compares them with svox2's
conversion to a PlenOctree, which copies the coefficients into a cell for each node.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.aims import FINER, INPUTS, Aim, aims_table
from benchmarks.processes import announced, in_turn, measure_process
from benchmarks.scenes import Scenes
from nerfbake import (
    N3Tree,
    build_octree,
    build_octree_from_lattice,
    compare_scenes,
    load,
    measure_lattice,
    orbit_cameras,
)
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Statistics
from nerfbake.bench.report import Report, Table
from nerfbake.formats.wire.torch_writer import numpy_array, ordered, torch_file
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci, sigmoid
from nerfbake.kernels.octree.node_values import to_float32
from nerfbake.scene.camera import Cameras
from nerfbake.scene.lattice_field import LatticeField, ShColour
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.volume import OctreeFrame
from nerfbake.stages._cube_levels import Block, octree_of_blocks


def copied(lattice: LatticeField) -> SparseVoxelOctree:
    """Copy density and coefficients of each node with a density above 0 into a cell of an octree.

    The lattice's colours are sums clamped at 0, but the octree applies a sigmoid. svox2's to_svox1 does the same (its
    issue 22: greyish).
    """
    assert isinstance(lattice.colour, ShColour)
    cells = np.argwhere(lattice.links >= 0)
    rows = lattice.links[tuple(cells.T)]
    held = lattice.density[rows] > 0
    cells, rows = cells[held], rows[held]
    values = np.concatenate([to_float32(lattice.features[rows]), lattice.density[rows, None]], axis=1).astype(
        np.float32
    )
    edges = (lattice.box[1] - lattice.box[0]) / lattice.shape
    frame = OctreeFrame(lattice.shape, f"SH{lattice.colour.size}", "full", lattice.box[0].copy(), edges)
    return octree_of_blocks([Block(cells.astype(np.int64), 0, np.arange(len(cells)))], values, frame)


FEATURES, WIDTH, SHIFT = 12, 128, -5.0
_BATCH, _STEP = 2048, 3e-3
_EMPTY = -15.0  # raw density of empty nodes

Array = npt.NDArray[Any]


def write_plenoxels(path: Path, octree: SparseVoxelOctree, edge: int) -> None:
    """Write ckpt.npz with a node in each non-empty voxel of edge^3, with rows in random order.

    Its colours, sums clamped at 0, approximate the octree's sigmoids by least squares.
    """
    B = (octree.data_dim - 1) // 3
    size = octree.voxel_size * octree.size
    held, values = _sampled(octree, edge, corners=False)
    basis = sh_basis(fibonacci(256), B)
    inverse = np.linalg.pinv(basis).T
    colours = np.empty((len(held), 3 * B), np.float16)
    for begin in range(0, len(held), 1 << 14):
        seen = sigmoid(values[begin : begin + (1 << 14), :-1].reshape(-1, B) @ basis.T) - 0.5
        colours[begin : begin + (1 << 14)] = (seen @ inverse).reshape(-1, colours.shape[1])
    order = np.random.default_rng(0).permutation(len(held))
    links = np.full(edge**3, -1, np.int32)
    links[held[order]] = np.arange(len(held))
    np.savez(
        path,
        radius=(size / 2).astype(np.float32),
        center=(octree.origin + size / 2).astype(np.float32),
        links=links.reshape(edge, edge, edge),
        density_data=values[order, -1:],
        sh_data=colours[order],
        basis_type=np.int64(1),
    )


def write_voxels(path: Path, octree: SparseVoxelOctree, edge: int, *, steps: int) -> None:
    """Write fine_last.tar with edge^3 nodes of 12 features, and an MLP with two hidden layers of 128 units.

    The MLP is fitted for `steps` steps, so that its colours approximate the octree's.
    """
    low, high = octree.origin, octree.origin + octree.voxel_size * octree.size
    held, values = _sampled(octree, edge, corners=True)
    coefficients = values[:, :-1].astype(np.float64)
    mean = coefficients.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov((coefficients - mean).T))
    most = np.argsort(spread)[::-1][:FEATURES]
    scaled = axes[:, most] * np.sqrt(np.maximum(spread[most], 1e-12))
    features = ((coefficients - mean) @ np.linalg.pinv(scaled).T).astype(np.float32)
    grid = np.zeros((FEATURES, edge**3), np.float32)
    grid[:, held] = features.T
    voxel = float(np.prod(high - low) / edge**3) ** (1 / 3)
    thick = np.maximum(values[:, -1].astype(np.float64) * voxel, 1e-9)
    raw = np.full(edge**3, _EMPTY, np.float32)
    raw[held] = thick + np.log(-np.expm1(-thick)) - SHIFT
    mask = np.zeros(edge**3, bool)
    mask[held] = True
    shape = (edge, edge, edge)
    state = {
        "xyz_min": low.astype(np.float32),
        "xyz_max": high.astype(np.float32),
        "density.grid": raw.reshape(1, 1, *shape),
        "k0.grid": grid.reshape(1, FEATURES, *shape),
        "mask_cache.mask": mask.reshape(shape),
        "act_shift": np.array([SHIFT], np.float32),
        "viewfreq": np.array([1, 2, 4, 8], np.float32),
        **_fitted(features, mean, scaled, steps),
    }
    settings = {
        "xyz_min": numpy_array(state["xyz_min"]),
        "xyz_max": numpy_array(state["xyz_max"]),
        "num_voxels": edge**3,
        "num_voxels_base": edge**3,
        "alpha_init": 1e-2,
        "fast_color_thres": 1e-4,
        "rgbnet_dim": FEATURES,
        "rgbnet_direct": True,
        "viewbase_pe": 4,
    }
    checkpoint = {"global_step": steps, "model_kwargs": settings, "model_state_dict": ordered(state)}
    path.write_bytes(torch_file(checkpoint, prefix="fine_last", location="cuda:0"))


def _sampled(octree: SparseVoxelOctree, edge: int, *, corners: bool) -> tuple[Array, Array]:
    """Return the indices of the non-empty nodes of edge^3, x-major, and the octree's values there."""
    found = [(held + x * edge * edge, values) for x, (held, values) in enumerate(_planes(octree, edge, corners))]
    return np.concatenate([held for held, _ in found]), np.concatenate([values for _, values in found])


def _planes(octree: SparseVoxelOctree, edge: int, corners: bool) -> Iterator[tuple[Array, Array]]:
    shares = (np.linspace(0, 1, edge) * (1 - 1e-9)) if corners else (np.arange(edge) + 0.5) / edge
    y, z = (each.reshape(-1) for each in np.meshgrid(shares, shares, indexing="ij"))
    for x in shares:
        points = np.stack([np.full_like(y, x), y, z], axis=1) * octree.size
        values = octree.sample(octree.origin + points * octree.voxel_size)
        held = np.flatnonzero(values[:, -1] > 0)
        yield held, values[held]


def _fitted(features: Array, mean: Array, axes: Array, steps: int) -> dict[str, Array]:
    """Fit rgbnet with Adam to colours of random nodes in random directions."""
    random = np.random.default_rng(0)
    inputs, B = features.shape[1] + 27, len(mean) // 3
    shapes = ((WIDTH, inputs), (WIDTH, WIDTH), (3, WIDTH))
    weights = [random.normal(0, np.sqrt(2 / shape[1]), shape).astype(np.float32) for shape in shapes]
    whole = [*weights, *(np.zeros(shape[0], np.float32) for shape in shapes)]
    first, second = ([np.zeros_like(each) for each in whole] for _ in range(2))
    directions = fibonacci(4096)
    angles = (directions[:, :, None] * np.array([1, 2, 4, 8.0])).reshape(len(directions), -1)
    code = np.concatenate([directions, np.sin(angles), np.cos(angles)], axis=1).astype(np.float32)
    basis = sh_basis(directions, B, np.float32)
    for step in range(1, steps + 1):
        node, way = random.integers(0, len(features), _BATCH), random.integers(0, len(directions), _BATCH)
        own = (mean + features[node] @ axes.T).astype(np.float32).reshape(-1, 3, B)
        truth = np.einsum("mcb,mb->mc", own, basis[way])
        for i, slope in enumerate(_slopes(whole, np.concatenate([features[node], code[way]], axis=1), truth)):
            first[i] += 0.1 * (slope - first[i])
            second[i] += 0.001 * (slope**2 - second[i])
            rate = _STEP * (1 + np.cos(np.pi * step / steps)) / 2
            mean_slope, mean_square = first[i] / (1 - 0.9**step), second[i] / (1 - 0.999**step)
            whole[i] -= (rate * mean_slope / (np.sqrt(mean_square) + 1e-9)).astype(np.float32)
    names = ("rgbnet.0", "rgbnet.2.0", "rgbnet.3")
    named = {f"{name}.weight": each for name, each in zip(names, whole[:3], strict=True)}
    return named | {f"{name}.bias": each for name, each in zip(names, whole[3:], strict=True)}


def _slopes(whole: list[Array], x: Array, truth: Array) -> list[Array]:
    """Return gradients of the squared error of colours, plus a small one of logits, by the weights, then the biases."""
    w0, w1, w2, b0, b1, b2 = whole
    first = np.maximum(x @ w0.T + b0, 0)
    second = np.maximum(first @ w1.T + b1, 0)
    logits = second @ w2.T + b2
    shown = sigmoid(logits).astype(np.float32)
    out = (2 * (shown - sigmoid(truth)) * shown * (1 - shown) + 0.01 * (logits - truth)) / len(x)
    out = out.astype(np.float32)
    behind = (out @ w2) * (second > 0)
    before = (behind @ w1) * (first > 0)
    return [before.T @ x, behind.T @ first, out.T @ second, before.sum(axis=0), behind.sum(axis=0), out.sum(axis=0)]


ROUNDS = 3
PLENOXELS, VOXELS = 256, 160  # nodes along each axis
STEPS = 500  # optimisation steps of the MLP
FRAMES, EDGE = 4, 200  # pictures that measure the loss of voxels, as in `svo`
SMALL = 64  # nodes along each axis of the lattice whose voxels are compared
SMALL_FRAMES, SMALL_EDGE = 5, 160
COLUMNS = ["input", "nodes", "MB", "s", "peak MB", "voxels", "OUT MB", "PSNR dB", "colours RMS"]
NOTES = [
    "s: time of the whole command, including its report; median [min..max]. peak: of the process, the median.",
    "PSNR: of the octree against the lattice in four pictures, as the command reports it; RMS: error of its colours "
    "against the lattice's in 400 directions, in 0 to 255.",
    "copied: the checkpoint's colours are sums clamped at 0, but are shown through a sigmoid, and nothing is "
    "interpolated.",
]


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    with tempfile.TemporaryDirectory() as folder:
        octree = build_octree(load(scenes.chair, N3Tree))
        plenoxels, voxels = Path(folder) / "ckpt.npz", Path(folder) / "fine_last.tar"
        with announced(f"{plenoxels.name} of {PLENOXELS}^3"):
            write_plenoxels(plenoxels, octree, PLENOXELS)
        with announced(f"{voxels.name} of {VOXELS}^3"):
            write_voxels(voxels, octree, VOXELS, steps=STEPS)
        rows = [_row(path, edge, rounds) for path, edge in ((plenoxels, PLENOXELS), (voxels, VOXELS))]
        finer, decibels = _finer(scenes, Path(folder))
    head = {"scene": scenes.chair.name, "rounds": str(rounds), **environment("numpy", "numba")}
    tables = [Table("`nerfbake svo IN out.svo.npz`", COLUMNS, rows), finer, _aims(rows, decibels)]
    return {"inputs": [Report("Other programs' checkpoints, baked", head, tables, NOTES)]}


def _row(path: Path, edge: int, rounds: int) -> list[Any]:
    out = path.with_name("out.svo.npz")
    command: list[str | Path] = [sys.executable, "-m", "nerfbake", "svo", path, out, "--force", "-q"]
    with announced(f"svo {path.name}, {rounds} rounds"):
        (runs,) = in_turn(partial(measure_process, *command), rounds=rounds)
    lattice, octree = load(path, LatticeField), load(out, SparseVoxelOctree)
    views = orbit_cameras(lattice, frames=FRAMES, width=EDGE, height=EDGE)
    decibels = _decibels(lattice, octree, views)
    return [
        path.name,
        f"{edge}^3",
        path.stat().st_size / 1e6,
        Statistics.of([run.seconds for run in runs]),
        statistics.median(run.peak for run in runs) / 1e6,
        f"{octree.size[0]}^3",
        out.stat().st_size / 1e6,
        f"{decibels:.2f}",
        f"{measure_lattice(lattice, octree):.2f}",
    ]


def _finer(scenes: Scenes, folder: Path) -> tuple[Table, dict[int, float]]:
    """Compare voxels of a small lattice with the lattice; return the table, and dB by voxels for each node."""
    path = folder / "small.ckpt.npz"
    with announced(f"{path.name} of {SMALL}^3, as voxels"):
        write_plenoxels(path, build_octree(load(scenes.chair, N3Tree), resolution=SMALL), SMALL)
        lattice = load(path, LatticeField)
        views = orbit_cameras(lattice, frames=SMALL_FRAMES, width=SMALL_EDGE, height=SMALL_EDGE)
        ways = {"copied, as svox2's to_svox1 does": copied(lattice)}
        ways |= {
            f"{times}x, refitted": build_octree_from_lattice(lattice, resolution=(times * SMALL,) * 3)
            for times in (1, *FINER)
        }
        found = {way: (octree, _decibels(lattice, octree, views)) for way, octree in ways.items()}
    rows = [
        [way, f"{octree.size[0]}^3", int(octree.childless.sum()), f"{dB:.1f}"] for way, (octree, dB) in found.items()
    ]
    title = f"The chair as {SMALL}^3 nodes of Plenoxels: voxels by its own pictures, {SMALL_FRAMES} of {SMALL_EDGE}^2"
    table = Table(title, ["voxels", "resolution", "leaves", "PSNR dB"], rows)
    return table, {times: found[f"{times}x, refitted"][1] for times in FINER}


def _decibels(lattice: LatticeField, octree: SparseVoxelOctree, views: Cameras) -> float:
    return float(compare_scenes(lattice, octree, views, keep_pictures=False).means["a_b"]["psnr"])


def _aims(rows: list[list[Any]], decibels: dict[int, float]) -> Table:
    found: list[tuple[str, Aim, float | None]] = []
    for name, _, _, seconds, peak, *_ in rows:
        for what, figure in (("s", seconds.median), ("peak MB", peak)):
            if (name, what) in INPUTS:
                found.append((f"{name}: {what}", INPUTS[name, what], figure))
    found += [(f"{times}x, refitted: dB", FINER[times], dB) for times, dB in decibels.items()]
    return aims_table(found)
