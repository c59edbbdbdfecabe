"""Synthetic PlenVDB folders: a DirectVoxGO checkpoint with its grids in .vdb files, plain or merged."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake.formats.volume import openvdb
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.vdb_topology import topology_of
from nerfbake.scene.volume import Volume
from tests.support.lattices import SHAPE
from tests.support.n3trees import archive
from tests.support.torch_files import dvgo, dvgo_file

Files = dict[str, bytes]
_IDENTITY = np.eye(4)[:3]


def plenvdb(*, shape: tuple[int, int, int] = SHAPE, mlp: str = "random") -> dict[str, Any]:
    """A DirectVoxGO checkpoint with six features, or three colours, and a mask with the shape of its lattice."""
    checkpoint = dvgo(mlp=mlp, features=6, shape=shape)
    mask = np.random.default_rng(6).random(shape) < 0.7
    checkpoint["model_state_dict"]["mask_cache.mask"] = mask
    return checkpoint


def merged(checkpoint: dict[str, Any]) -> dict[str, Any]:
    """The checkpoint as a merged folder stores it: grids rounded to float16, and zeros where the mask is false."""
    state = dict(checkpoint["model_state_dict"])
    mask = state["mask_cache.mask"]
    for key in ("density.grid", "k0.grid"):
        state[key] = np.where(mask, state[key], 0).astype(np.float16).astype(np.float32)
    return checkpoint | {"model_state_dict": state}


def model_file(checkpoint: dict[str, Any]) -> bytes:
    """The bytes of fine_last.tar: the checkpoint without its grids."""
    state = type(checkpoint["model_state_dict"])(checkpoint["model_state_dict"])
    del state["density.grid"], state["k0.grid"]
    settings = checkpoint["model_kwargs"] | {"density_type": "VDBGrid", "k0_type": "VDBGrid"}
    return dvgo_file(checkpoint | {"model_kwargs": settings, "model_state_dict": state, "time_recoder": [1.5]})


def grid_file(*grids: Any, at: Any = None) -> bytes:
    """A .vdb file of grids (X, Y, Z, c), in reverse order, without names except for OpenVDB's numbers.

    at: mask of the active nodes; None: all nodes.
    """
    trees = []
    for number, grid in reversed(list(enumerate(grids))):
        coords = np.argwhere(np.ones(grid.shape[:3], bool) if at is None else at)
        topology, order = topology_of(coords)
        values = grid[tuple(coords[order].T)].astype(np.float32)
        trees.append(VdbTree(f"\x1e{number}", topology, values, np.zeros(grid.shape[3], np.float32), "unknown"))
    return b"".join(openvdb.encode(Volume(tuple(trees), _IDENTITY), codec="none"))


def grids_of(checkpoint: dict[str, Any]) -> tuple[Any, list[Any]]:
    """The density (X, Y, Z, 1), and the features in groups of three channels."""
    density, features = (checkpoint["model_state_dict"][key][0] for key in ("density.grid", "k0.grid"))
    return np.moveaxis(density, 0, -1), np.split(np.moveaxis(features, 0, -1), len(features) // 3, axis=3)


def plenvdb_folder(checkpoint: dict[str, Any]) -> Files:
    density, colours = grids_of(checkpoint)
    return {
        "fine_last.tar": model_file(checkpoint),
        "finedensity.vdb": grid_file(density),
        "finecolor.vdb": grid_file(*colours),
    }


def merged_folder(checkpoint: dict[str, Any]) -> Files:
    """The files that PlenVDB's vdb_compression.py writes, without the earlier files that it leaves in the folder."""
    state = checkpoint["model_state_dict"]
    mask, density, features = state["mask_cache.mask"], state["density.grid"][0, 0], state["k0.grid"][0]
    rows = np.zeros(mask.shape, np.float32)
    rows[mask] = np.arange(1, np.count_nonzero(mask) + 1)
    den = np.concatenate([[0], density[mask]]).astype(np.float16)
    col = np.concatenate([np.zeros((1, len(features))), features[:, mask].T]).astype(np.float16)
    return {
        "fine_last.tar": model_file(checkpoint),
        "mergedidxs.vdb": grid_file(rows[..., None], at=mask),
        "mergeddata.npz": archive({"den": den, "col": col}, deflated=False),
    }


def written(folder: Any, files: Files) -> Any:
    """Create a folder with these files, and return it."""
    folder.mkdir()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder
