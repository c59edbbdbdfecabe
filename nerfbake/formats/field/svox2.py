"""Read svox2 checkpoints of Plenoxels (ckpt.npz): a lattice of links to rows of values.

Rows may be in any order (training sorts them along a Morton curve); only the links map nodes to rows. Keys:
docs/formats/checkpoints.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.npz import NpzReader
from nerfbake.formats.wire.zip_reader import npz_keys
from nerfbake.kernels.maths.elementary import cast
from nerfbake.scene.lattice_field import Activation, LatticeField, ShColour

_SIZES = (1, 4, 9)  # coefficients per channel that svox2's kernels support
_SH = 1
_OTHERS = {4: "a learned texture", 255: "an MLP"}
_NO_SH = "spherical harmonics (basis_type 1)"


def recognise(view: memoryview) -> bool:
    """Return True for an archive with links and the values of one of the two dialects."""
    keys = npz_keys(view)
    return "links" in keys and bool(keys & {"density_data", "data"})


def decode(view: memoryview) -> LatticeField:
    """Return the lattice of a checkpoint. The background layers outside the box are left out; a note reports this."""
    npz = NpzReader(view)
    old = "density_data" not in npz and "data" in npz
    npz.require("links", *(("data",) if old else ("density_data", "sh_data")))
    _require_harmonics(npz)
    links = npz.shaped("links", "i", (None, None, None))
    if links.dtype != np.int32:
        memory.hold("links", 4 * links.size)
        if links.size and (int(links.max()) >= 1 << 31 or int(links.min()) < -1 << 31):
            raise InvalidFile(Problem("links", "contain numbers beyond 32 bits", "rows of the values, or -1"))
        links = links.astype(np.int32)
    density, features = _values(npz, old=old)
    radius, centre = _world(npz, "radius", 1.0), _world(npz, "center", 0.0)
    layered = "background_links" in npz or "background_data" in npz
    return LatticeField(
        links=links,
        density=density,
        features=features,
        activation=Activation("relu"),
        colour=ShColour(features.shape[1] // 3),
        box=np.stack([centre - radius, centre + radius]),
        dialect="svox2, old" if old else "svox2",
        notes=("the background (sphere layers around the box) is left out",) if layered else (),
    )


def _require_harmonics(npz: NpzReader) -> None:
    """Raise InvalidFile unless the basis is spherical harmonics. basis_data alone is a learned texture."""
    named = npz.scalar("basis_type") if "basis_type" in npz else 4 if "basis_data" in npz else _SH
    if named != _SH:
        kind = _OTHERS.get(named, "unknown") if isinstance(named, int) else "unknown"
        raise InvalidFile(Problem("basis_type", f"is {named}, {kind}", _NO_SH))


def _values(npz: NpzReader, *, old: bool) -> tuple[npt.NDArray[np.float32], npt.NDArray[Any]]:
    """Return raw densities (n,) and coefficients (n, 3B)."""
    if old:  # the density comes first; in svox it comes last
        data = _table(npz, "data", 1)
        return np.ascontiguousarray(data[:, 0], np.float32), data[:, 1:]
    density = npz.shaped("density_data", "f", (None, 1))
    memory.hold("density_data", 4 * density.size)
    features = _table(npz, "sh_data", 0)
    if len(features) != len(density):
        raise InvalidFile(Problem("sh_data", f"has {len(features):,} rows", f"{len(density):,}, as density_data has"))
    return cast(density.reshape(-1), np.float32), features


def _table(npz: NpzReader, key: str, others: int) -> npt.NDArray[Any]:
    """Return a table of floats. Its width must be that of a supported basis plus `others` columns."""
    table = npz.shaped(key, "f", (None, None))
    widths = [3 * size + others for size in _SIZES]
    if table.shape[1] not in widths:
        allowed = f"{', '.join(map(str, widths))}, for SH1, SH4, SH9"
        raise InvalidFile(Problem(key, f"has {table.shape[1]} columns", allowed))
    if table.dtype == np.float64:
        memory.hold(key, 4 * table.size)
        return cast(table, np.float32)
    return table


def _world(npz: NpzReader, key: str, default: float) -> npt.NDArray[np.float64]:
    """Return one number or three as (3,); old files do not have the key."""
    if key not in npz:
        return np.full(3, default)
    array = npz.array(key, limit=1 << 16)
    if array.dtype.kind not in "fi" or array.size not in (1, 3):
        raise InvalidFile(Problem(key, f"has dtype {array.dtype}, shape {array.shape}", "one number or three"))
    return np.broadcast_to(cast(array.reshape(-1), np.float64), 3).copy()
