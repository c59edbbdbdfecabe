"""An octree as other programs would have trained it: Plenoxels' lattice, and DirectVoxGO's with an MLP fitted to it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.formats.wire.torch_writer import numpy_array, ordered, torch_file
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import sigmoid
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.scene.octree import SparseVoxelOctree

FEATURES, WIDTH, SHIFT = 12, 128, -5.0
_BATCH, _STEP = 2048, 3e-3
_EMPTY = -15.0  # raw density where nothing is

Array = npt.NDArray[Any]


def write_plenoxels(path: Path, octree: SparseVoxelOctree, edge: int) -> None:
    """ckpt.npz with a node in each of edge^3 voxels that holds something, rows in no order. Its colours are sums, cut
    at 0, that are nearest to the octree's sigmoids."""
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
    """fine_last.tar with edge^3 nodes of 12 features, and an MLP with two hidden layers of 128 units that was fitted
    for so many steps: its colours are near the octree's."""
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
    """Of edge^3 nodes, x-major, those that hold something: their numbers, and the octree's values there."""
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
    """rgbnet: by Adam, on colours of random nodes in random directions."""
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
    """Of the squared error of colours, and a little of logits: by the weights, then by the biases."""
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
