"""Lattices as other programs write them: the files are made here, after their formats. And one that nerfbake writes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import load
from nerfbake.formats.field import dvgo as whole
from nerfbake.kernels.lattice.nodes import densities
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.stages._lattice import features_of, nodes_of, places_of, seen_along
from tests.conformance.case import Case, Facts, Frozen, form_named
from tests.support.lattices import CENTRE, RADIUS, SHAPE, svox2, svox2_file
from tests.support.merf import colour_at as merf_colour
from tests.support.merf import density_of as merf_density
from tests.support.merf import merf, merf_folder, sums_at
from tests.support.plenvdb import merged, merged_folder, plenvdb, plenvdb_folder
from tests.support.snerg import colour_at as snerg_colour
from tests.support.snerg import density_of as snerg_density
from tests.support.snerg import snerg, snerg_folder, values_at
from tests.support.tensorf import colour_at, density_at, tensorf, tensorf_file
from tests.support.torch_files import dvgo, dvgo_file

DIRECTION = [2 / 7, -3 / 7, 6 / 7]
# In shares of the box: between nodes, on one, before the first and behind the last, at a corner, outside.
SHARES = [(0.4375, 0.3, 0.6), (0.3, 0.25, 0.5), (0.05, 0.5, 0.98), (0.98, 0.02, 0.5), (1.0, 1.0, 1.0), (0.2, 0.7, 0.9)]
# The same, none of them half-way between two nodes: there the last bit says which of a mask's is the nearest.
CLEAR = [
    (0.4375, 0.32, 0.6),
    (0.3, 0.25, 0.5),
    (0.05, 0.45, 0.98),
    (0.98, 0.02, 0.5),
    (1.0, 1.0, 1.0),
    (0.2, 0.72, 0.9),
]
Y1 = 0.4886025119029199
Y2 = (1.0925484305920792, 0.31539156525252005)


def cases() -> Iterator[Case]:
    arrays = svox2(empty=0.25, plain=False)
    about = "A checkpoint as svox2 writes it: a lattice of links, rows in no order, halves; one row is nobody's."
    files = {"lattice/plenoxels.ckpt.npz": Frozen(form_named("ckpt.npz"), None, data=svox2_file(arrays))}
    yield Case("lattice/plenoxels", about, files, _plenoxels(arrays), answer, computed=1e-5)
    about = "A checkpoint as DirectVoxGO writes it with torch: nodes on the box, features and an MLP."
    files = {"lattice/voxels.tar": Frozen(form_named("tar"), None, data=dvgo_file(dvgo(mlp="random")))}
    yield Case("lattice/voxels", about, files, _voxels(dvgo(mlp="random"), SHARES), answer, computed=1e-5)
    old = dvgo(mlp="random", dialect="2021", direct=False)
    about = "A checkpoint as DirectVoxGO wrote it in 2021: its MLP asks for the place in the box, too."
    files = {"lattice/voxels_2021.tar": Frozen(form_named("tar"), None, data=dvgo_file(old))}
    yield Case("lattice/voxels_2021", about, files, _voxels(old, SHARES), answer, computed=1e-5)
    checkpoint, folder = plenvdb(), form_named("plenvdb")
    about = "A folder as PlenVDB writes it: the grids of such a checkpoint as .vdb files, unnamed but for a number."
    files = {"lattice/plenvdb": Frozen(folder, None, data=plenvdb_folder(checkpoint))}
    yield Case("lattice/plenvdb", about, files, _voxels(checkpoint, CLEAR), answer, computed=1e-5)
    about = "The same merged: rows in halves, only for nodes where the mask is true; all others are zeros, and empty."
    files = {"lattice/plenvdb_merged": Frozen(folder, None, data=merged_folder(checkpoint))}
    yield Case("lattice/plenvdb_merged", about, files, _voxels(merged(checkpoint), CLEAR), answer, computed=1e-5)
    cubes = merged(_cubes())
    about = "A folder as nerfbake writes it for PlenVDB: its colours one grid behind the other, its mask its own."
    ours = Frozen(folder, whole.decode(memoryview(dvgo_file(cubes))))
    yield Case(
        "lattice/plenvdb_written",
        about,
        {"lattice/plenvdb_written": ours},
        _voxels(cubes, CLEAR),
        answer,
        computed=1e-5,
    )
    decomposed = tensorf()
    about = "A checkpoint as TensoRF writes it with torch: planes and lines, a mask in a box of its own, an MLP."
    files = {"lattice/planes.th": Frozen(form_named("th"), None, data=tensorf_file(decomposed))}
    yield Case("lattice/planes", about, files, _planes(decomposed), answer, computed=1e-5)
    made = snerg()
    about = "A folder as SNeRG exports it: blocks of voxels in an atlas of slices, a diffuse colour and a deferred MLP."
    files = {"lattice/snerg": Frozen(form_named("snerg"), None, data=snerg_folder(made))}
    yield Case("lattice/snerg", about, files, _blocks(made), answer, computed=2e-5)
    baked = merf()
    about = "A folder as MERF exports it: blocks of nodes in an atlas of slices, three planes, and a deferred MLP."
    files = {"lattice/merf": Frozen(form_named("merf"), None, data=merf_folder(baked))}
    yield Case("lattice/merf", about, files, _sums(baked), answer, computed=2e-5)


def _sums(made: dict[str, Any]) -> Facts:
    """By the definition, worked out in tests.support: fetched from the atlas and from each plane, added, activated."""
    points = np.random.default_rng(8).uniform(-1, 1, (200, 3)).round(3)
    held, sums = sums_at(made, points)
    density = merf_density(made, held, sums)
    there = np.flatnonzero(density > 0.1)[:8]
    colours = merf_colour(made, sums[there], DIRECTION)
    lookups = [
        {"point": point, "density": sigma, "colour": colour}
        for point, sigma, colour in zip(points[there].tolist(), density[there].tolist(), colours.tolist(), strict=True)
    ]
    box = [[-1.0] * 3, [1.0] * 3]
    return {"resolution": [14, 14, 14], "world_box": box, "direction": DIRECTION, "lookups": lookups}


def _cubes() -> dict[str, Any]:
    """A checkpoint of DirectVoxGO whose nodes are as far apart on each axis."""
    checkpoint = plenvdb()
    state = checkpoint["model_state_dict"]
    state["xyz_max"] = (state["xyz_min"] + (np.array(SHAPE) - 1) / 4).astype(np.float32)
    return checkpoint


def _blocks(made: dict[str, Any]) -> Facts:
    """By the definition, worked out in tests.support: each of eight voxels fetched from the atlas."""
    box = np.array([[-1.25, -2.75, 1.25], [1.5, 0.75, 3.25]])
    points = box[0] + np.random.default_rng(8).uniform(0.1, 0.9, (60, 3)).round(3) * (box[1] - box[0])
    points = points[values_at(made, points)[:, 7] > 0.1][:8]
    density, colours = snerg_density(values_at(made, points)), snerg_colour(made, points, DIRECTION)
    lookups = [
        {"point": point, "density": sigma, "colour": colour}
        for point, sigma, colour in zip(points.tolist(), density.tolist(), colours.tolist(), strict=True)
    ]
    return {"resolution": [11, 14, 8], "world_box": box.tolist(), "direction": DIRECTION, "lookups": lookups}


def _planes(checkpoint: dict[str, Any]) -> Facts:
    """By the definition, worked out in tests.support: planes and lines interpolated, multiplied, and activated."""
    low, high = checkpoint["kwargs"]["aabb"].astype(np.float64)
    points = low + np.array([*CLEAR, (0.45, 0.3, 0.4), (0.7, 0.6, 0.8)]) * (high - low)
    density = density_at(checkpoint, points)
    points, density = points[density > 0], density[density > 0]  # elsewhere nodes have no colours
    colours = colour_at(checkpoint, points, DIRECTION)
    lookups = [
        {"point": point, "density": sigma, "colour": colour}
        for point, sigma, colour in zip(points.tolist(), density.tolist(), colours.tolist(), strict=True)
    ]
    box = [low.tolist(), high.tolist()]
    return {"resolution": list(SHAPE), "world_box": box, "direction": DIRECTION, "lookups": lookups}


def _plenoxels(arrays: dict[str, Any]) -> Facts:
    """By the definition: eight nodes around a point, those without a link zeros, and activated then."""
    low, size = (CENTRE - RADIUS).astype(np.float64), 2 * RADIUS.astype(np.float64)
    lookups = []
    for share in SHARES:
        at = np.clip(np.array(share) * SHAPE - 0.5, 0, np.array(SHAPE) - 1)
        raw, coefficients = 0.0, np.zeros((3, 9))
        for step in product((0, 1), repeat=3):
            node = np.floor(at).astype(int) + step
            weight = float(np.prod(1 - np.abs(at - node)))
            row = arrays["links"][tuple(np.minimum(node, np.array(SHAPE) - 1))]
            if weight > 0 and row >= 0:
                raw += weight * float(arrays["density_data"][row, 0])
                coefficients += weight * arrays["sh_data"][row].astype(np.float64).reshape(3, 9)
        colour = np.maximum(0.5 + (coefficients * _harmonics(*DIRECTION)).sum(axis=1), 0)
        point = (low + np.array(share) * size).tolist()
        lookups.append({"point": point, "density": max(raw, 0.0), "colour": colour.tolist()})
    return {
        "resolution": list(SHAPE),
        "world_box": [low.tolist(), (low + size).tolist()],
        "direction": DIRECTION,
        "lookups": lookups,
    }


def _voxels(checkpoint: dict[str, Any], shares: list[tuple[float, float, float]]) -> Facts:
    """By the definition: eight nodes around a point, softplus and an MLP between them; nothing where the mask's
    nearest is false."""
    state = checkpoint["model_state_dict"]
    low, high = state["xyz_min"].astype(np.float64), state["xyz_max"].astype(np.float64)
    old = "posfreq" in state
    grid, looks = state["density" if old else "density.grid"], state["k0" if old else "k0.grid"]
    shift = -np.log(1 / 0.01 - 1) if old else float(state["act_shift"][0])
    added = 0 if checkpoint["model_kwargs"]["rgbnet_direct"] else 3
    edge = float(np.prod(high - low) / checkpoint["model_kwargs"]["num_voxels_base"]) ** (1 / 3)
    angles = np.array(DIRECTION)[:, None] * np.array([1.0, 2.0, 4.0, 8.0])
    code = [*DIRECTION, *np.sin(angles).reshape(-1), *np.cos(angles).reshape(-1)]
    lookups = []
    for share in shares:
        at = np.array(share) * (np.array(SHAPE) - 1)
        raw, features = 0.0, np.zeros(looks.shape[1])
        for step in product((0, 1), repeat=3):
            node = np.floor(at).astype(int) + step
            weight = float(np.prod(1 - np.abs(at - node)))
            if weight > 0:
                raw += weight * float(grid[(0, 0, *node)])
                features += weight * looks[(0, slice(None), *node)].astype(np.float64)
        x = np.array([*features[added:], *(_place(share) if old else ()), *code])
        for name in ("rgbnet.0", "rgbnet.2.0"):
            x = np.maximum(state[f"{name}.weight"] @ x + state[f"{name}.bias"], 0)
        logits = state["rgbnet.3.weight"] @ x + state["rgbnet.3.bias"] + (features[:added] if added else 0)
        density = float(np.logaddexp(0, raw + shift)) / edge
        mask = np.ones((1, 1, 1), bool) if old else state["mask_cache.mask"]
        if not mask[tuple(np.floor(np.array(share) * (np.array(mask.shape) - 1) + 0.5).astype(int))]:
            density = 0.0
        point = (low + np.array(share) * (high - low)).tolist()
        lookups.append({"point": point, "density": density, "colour": (1 / (1 + np.exp(-logits))).tolist()})
    box = [low.tolist(), high.tolist()]
    return {"resolution": list(SHAPE), "world_box": box, "direction": DIRECTION, "lookups": lookups}


def _place(share: tuple[float, float, float]) -> list[float]:
    """A place in the box, and its sines: of x times 1, 2, 4, 8, 16, of y, of z; then the cosines."""
    angles = (np.array(share)[:, None] * 2.0 ** np.arange(5)).reshape(-1)
    return [*share, *np.sin(angles), *np.cos(angles)]


def _harmonics(x: float, y: float, z: float) -> npt.NDArray[np.float64]:
    k, zonal = Y2
    second = [k * x * y, -k * y * z, zonal * (2 * z * z - x * x - y * y), -k * x * z, k / 2 * (x * x - y * y)]
    return np.array([0.28209479177387814, -Y1 * y, Y1 * z, -Y1 * x, *second])


def answer(path: Path, expected: Facts) -> Facts:
    lattice = load(path, LatticeField)
    places = places_of(lattice, np.array([each["point"] for each in expected["lookups"]]))
    features = features_of(lattice)(places)
    seen = seen_along(lattice, np.array([expected["direction"]]))
    colours = seen(features, np.zeros(len(places), np.int64)).tolist()
    sigma = densities(nodes_of(lattice), np.clip(places, 0, 1)).tolist()
    return {
        "resolution": list(lattice.shape),
        "world_box": lattice.box.tolist(),
        "direction": expected["direction"],
        "lookups": [
            {"point": each["point"], "density": density, "colour": colour}
            for each, density, colour in zip(expected["lookups"], sigma, colours, strict=True)
        ],
    }
