"""Read instant-ngp's snapshots of radiance fields: .msgpack, and .ingp, which is the same in gzip or zlib.

The file is one map of MessagePack: the network's configuration, and what was trained.

    encoding          n_levels, n_features_per_level, log2_hashmap_size, base_resolution
    network           n_neurons, n_hidden_layers: the density, 16 outputs, of which output 0 is ln density
    rgb_network       the colour, of these 16 outputs and 16 spherical harmonics
    snapshot
      n_params, params_type ("__half" or "float"), params_binary: first network, second network, grid
      density_grid_size (128), density_grid_binary: half, (cascades, 128^3), see occupied_cells.py
      nerf.aabb_scale A, nerf.dataset (ngp_dataset.py), background_color, render_aabb
      optimizer       two more copies, which are not read

The factor between levels is not stored: it is exp(ln(2048 A / base) / (levels - 1)), each operation in float32. The
trained box is 1/2 - A/2 to 1/2 + A/2. A value of the density grid is the optical thickness of one step; the cell is
occupied if it exceeds min(0.01, the mean of the first cascade's positive values). -1: no training camera saw the cell.

Source: docs/fields.md, "Programs"; testbed.cu, testbed_nerf.cu, nerf_network.h.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.field import tcnn
from nerfbake.formats.field.ngp_dataset import DATASET, cameras_of, frame_of
from nerfbake.formats.field.occupied_cells import CELLS, EDGE, nested_cubes
from nerfbake.formats.wire.deflate import gunzip, gunzip_start, inflate_all
from nerfbake.formats.wire.json import kind_of, number, shorten, table, whole
from nerfbake.formats.wire.msgpack import parse_map
from nerfbake.formats.wire.wrapping import is_gzip
from nerfbake.kernels.arrays import Bits, Points, Singles
from nerfbake.kernels.maths.elementary import cast, exp, log
from nerfbake.scene.function_field import FunctionField, Occupancy
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import HeadColour, Mlp, Network

_MOST = 1 << 32  # bytes of a snapshot that is packed: 2^24 rows of 8 features with the optimiser's state
_OUTPUTS, _CODE = 16, 16
_MOST_SCALE = 128
_FINEST = 2048.0  # nodes of the last level along the unit cube
_LEAST = 0.01  # optical thickness of a step through an occupied cell
_TYPES: dict[str, np.dtype[Any]] = {"__half": np.dtype("<f2"), "half": np.dtype("<f2"), "float": np.dtype("<f4")}
_KEYS = ("dir_encoding", "distortion_map", "encoding", "envmap", "loss", "network", "parent", "rgb_network", "snapshot")
_STARTS = tuple(bytes([0xA0 + len(key)]) + key.encode() for key in _KEYS)  # text of MessagePack


def recognise(view: memoryview) -> bool:
    """Return True for a map of MessagePack whose first key is one of instant-ngp's, also in gzip."""
    head = bytes(view[:HEAD])
    if is_gzip(view):
        try:
            head = gunzip_start(view, HEAD, "")
        except InvalidFile:
            return False
    skip = {0xDE: 3, 0xDF: 5}.get(head[0], 1 if 0x81 <= head[0] <= 0x8F else 0) if head else 0
    return bool(skip) and head[skip:].startswith(_STARTS)


def decode(view: memoryview) -> FunctionField:
    """Return the field of a snapshot. Raises InvalidFile, MemoryLimit."""
    root = parse_map(_unpacked(view), "the snapshot", skip=("snapshot.optimizer",))
    snapshot = _map(root, "snapshot")
    _require_nerf(snapshot)
    nerf = _map(snapshot, "nerf", "snapshot.")
    notes = []
    dataset = nerf.get("dataset", {})
    if not isinstance(dataset, dict):
        raise InvalidFile(Problem(DATASET, f"is {kind_of(dataset)}", "an object"))
    if not dataset:
        notes.append("the snapshot has no data set: the default scale 0.33 and offset 0.5 are assumed, and no cameras")
    _require_plain(dataset)
    size = _aabb_scale(dataset if "aabb_scale" in dataset else nerf)
    aabb = np.array([[0.5 - size / 2] * 3, [0.5 + size / 2] * 3])
    box = _box(snapshot, aabb)
    if (box != aabb).any():
        notes.append("what is outside of render_aabb is cut off, as in the program")
    if number(snapshot, "exposure", "snapshot", default=0.0):
        notes.append("the exposure of the program's viewer is not applied")
    environment = dataset.get("envmap_resolution")
    if isinstance(environment, list) and any(edge != 0 for edge in environment):
        notes.append("the environment map is not read: the background is one colour")
    occupied = _occupancy(snapshot, size)
    if occupied is None:
        notes.append("the snapshot has no density grid: the network is used everywhere")
    frame = frame_of(dataset)
    return FunctionField(
        network=_network(root, snapshot, size),
        frame=frame,
        box=box,
        unit=aabb,
        occupied=occupied,
        cameras=cameras_of(dataset, frame),
        background=_background(snapshot),
        dialect="instant-ngp",
        notes=tuple(notes),
    )


# -- the container ---------------------------------------------------------------------------------------------
def _unpacked(view: memoryview) -> memoryview:
    if is_gzip(view):
        return gunzip(view, "the snapshot in gzip", most=_MOST)
    if len(view) > 1 and view[0] == 0x78 and (view[0] << 8 | view[1]) % 31 == 0:  # the header of zlib, no map
        return inflate_all(view, "the snapshot in zlib", most=_MOST)
    return view


def _map(fields: dict[str, Any], key: str, place: str = "") -> dict[str, Any]:
    found = fields.get(key)
    if not isinstance(found, dict):
        what = "is missing" if found is None else f"is {kind_of(found)}"
        raise InvalidFile(Problem(f"{place}{key}", what, "the map of an instant-ngp snapshot of a NeRF"))
    return found


def _array(fields: dict[str, Any], key: str, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return bytes as an array. Files that were JSON in between have them as {"bytes": [0, ...], "subtype": null}."""
    found, place = fields.get(key), f"snapshot.{key}"
    if isinstance(found, dict) and isinstance(found.get("bytes"), list):
        memory.hold(place, len(found["bytes"]))
        try:
            found = memoryview(bytes(found["bytes"]))
        except (ValueError, TypeError):
            raise InvalidFile(Problem(f"{place}.bytes", "has values that are no bytes", "0 to 255")) from None
    if not isinstance(found, memoryview):
        what = "is missing" if found is None else f"is {kind_of(found)}"
        raise InvalidFile(Problem(place, what, "bytes"))
    if len(found) % dtype.itemsize:
        raise InvalidFile(Problem(place, f"has {len(found):,} bytes", f"a multiple of {dtype.itemsize}"))
    return np.frombuffer(found, dtype)


# -- settings --------------------------------------------------------------------------------------------------
def _require_nerf(snapshot: dict[str, Any]) -> None:
    if (version := whole(snapshot, "version", "snapshot", high=1 << 31)) != 1:
        raise InvalidFile(Problem("snapshot.version", f"is {version}", "1"))
    mode = snapshot.get("mode", "nerf" if "nerf" in snapshot else None)
    if not isinstance(mode, str) or mode.lower() != "nerf":
        raise InvalidFile(Problem("snapshot.mode", f"is {shorten(mode)}", "nerf (not sdf, image or volume)"))


def _require_plain(dataset: dict[str, Any]) -> None:
    """Raise InvalidFile for what changes the colours in a way that is not read."""
    if dataset.get("is_hdr", False) is not False:
        found = f"is {shorten(dataset['is_hdr'])}: colours are linear and have no upper limit"
        raise InvalidFile(Problem(f"{DATASET}.is_hdr", found, "a scene of 8-bit pictures"))
    key = "n_extra_learnable_dims"
    if whole(dataset, key, DATASET, default=0, high=1 << 31):
        found = f"is {dataset[key]}: each picture has an appearance of its own"
        raise InvalidFile(Problem(f"{DATASET}.{key}", found, "0"))


def _aabb_scale(fields: dict[str, Any]) -> int:
    size = whole(fields, "aabb_scale", DATASET, default=1, low=1, high=_MOST_SCALE)
    if size & (size - 1):
        raise InvalidFile(Problem(f"{DATASET}.aabb_scale", f"is {size}", f"a power of two, 1 to {_MOST_SCALE}"))
    return size


def _box(snapshot: dict[str, Any], aabb: Points) -> Points:
    """Return the trained box, cut by render_aabb unless that is turned."""
    given, turn = snapshot.get("render_aabb"), snapshot.get("render_aabb_to_local", np.eye(3).tolist())
    if not isinstance(given, dict) or (table(turn, "snapshot.render_aabb_to_local", (3, 3)) != np.eye(3)).any():
        return aabb
    low, high = (table(given.get(key), f"snapshot.render_aabb.{key}", (3,)) for key in ("min", "max"))
    box = np.stack([np.maximum(low, aabb[0]), np.minimum(high, aabb[1])])
    if not (box[0] < box[1]).all():
        raise InvalidFile(Problem("snapshot.render_aabb", "is outside of the trained box", "a box that meets it"))
    return box


def _background(snapshot: dict[str, Any]) -> tuple[float, float, float] | None:
    given = snapshot.get("background_color")
    if given is None:
        return None
    red, green, blue, *_ = np.clip(table(given, "snapshot.background_color", (4,)), 0, 1).tolist()
    return red, green, blue


# -- networks --------------------------------------------------------------------------------------------------
def _network(root: dict[str, Any], snapshot: dict[str, Any], size: int) -> Network:
    grid = _grid(_map(root, "encoding"), size)
    _require_harmonics(_map(root, "dir_encoding"))
    first = _sizes(_map(root, "network"), "network", grid.inputs, _OUTPUTS, ones=False)
    second = _sizes(_map(root, "rgb_network"), "rgb_network", _OUTPUTS + _CODE, 3, ones=True)
    tcnn.require_grid(grid, "encoding")
    params = _params(snapshot)
    expected = first.numbers + second.numbers + tcnn.rows_of(grid) * grid.features
    if len(params) != expected:
        parts = f"{first.numbers:,} and {second.numbers:,} for the networks, {tcnn.rows_of(grid):,} rows of the grid"
        raise InvalidFile(Problem("snapshot.params_binary", f"has {len(params):,} numbers", f"{expected:,}: {parts}"))
    trunk, colours, table_ = np.split(params, [first.numbers, first.numbers + second.numbers])
    head: Mlp = tcnn.mlp_of(colours, second, "rgb_network")
    density = np.zeros(_OUTPUTS, np.float32)
    density[0] = 1
    return Network(
        tcnn.hash_grid_of(table_, grid, "encoding"),
        tcnn.mlp_of(trunk, first, "network"),
        density,
        0.0,
        Activation("exponential"),
        HeadColour(head, "SH16"),  # its inputs are in this order: 16 outputs with the density, then the direction
    )


def _params(snapshot: dict[str, Any]) -> Singles:
    kind = snapshot.get("params_type")
    if not isinstance(kind, str) or kind not in _TYPES:
        raise InvalidFile(Problem("snapshot.params_type", f"is {shorten(kind)}", ", ".join(_TYPES)))
    count = whole(snapshot, "n_params", "snapshot", low=1, high=1 << 40)
    stored = _array(snapshot, "params_binary", _TYPES[kind])
    if len(stored) != count:
        found = f"has {len(stored):,} numbers"
        raise InvalidFile(Problem("snapshot.params_binary", found, f"{count:,}, as n_params says"))
    memory.hold("the parameters", 4 * count)
    return np.ascontiguousarray(cast(stored, np.float32))


def _grid(encoding: dict[str, Any], size: int) -> tcnn.Grid:
    _require(encoding, "encoding", "otype", ("hashgrid", "grid"))
    _require(encoding, "encoding", "type", ("hash",), default="hash")
    _require(encoding, "encoding", "hash", ("coherentprime",), default="coherentprime")
    _require(encoding, "encoding", "interpolation", ("linear",), default="linear")
    features = whole(encoding, "n_features_per_level", "encoding", default=2, low=1, high=8)
    total = whole(encoding, "n_features", "encoding", default=0, high=512)
    levels = total // features if total else whole(encoding, "n_levels", "encoding", default=16, low=1, high=64)
    log2_rows = whole(encoding, "log2_hashmap_size", "encoding", low=1, high=tcnn.MAX_LOG2_ROWS)
    base = whole(encoding, "base_resolution", "encoding", default=0, high=1 << 20) or 1 << log2_rows // 3
    given = number(encoding, "per_level_scale", "encoding", default=0.0, low=0.0, high=1e6)
    return tcnn.Grid(levels, features, log2_rows, base, np.float32(given) if given else _growth(levels, base, size))


def _growth(levels: int, base: int, size: int) -> np.float32:
    """exp(log(2048 A / base) / (levels - 1)), rounded to float32 after each operation."""
    if levels < 2:
        return np.float32(1)
    ratio = np.float32(_FINEST * size) / np.float32(base)
    return np.float32(exp(np.float32(log(ratio)) / np.float32(levels - 1)))


def _sizes(fields: dict[str, Any], name: str, inputs: int, outputs: int, *, ones: bool) -> tcnn.Perceptron:
    _require(fields, name, "otype", ("fullyfusedmlp", "cutlassmlp", "megakernelmlp"))
    _require(fields, name, "activation", ("relu",), default="relu")
    _require(fields, name, "output_activation", ("none",), default="none")
    width = whole(fields, "n_neurons", name, default=128, low=1, high=4096)
    hidden = whole(fields, "n_hidden_layers", name, default=5, high=16)
    return tcnn.Perceptron(inputs, width, hidden, outputs, ones)


def _require(fields: dict[str, Any], place: str, key: str, allowed: Iterable[str], *, default: str = "") -> None:
    """Raise InvalidFile unless the field has one of these values, in any case."""
    value = fields.get(key, default)
    if not isinstance(value, str) or value.lower() not in allowed:
        raise InvalidFile(Problem(f"{place}.{key}", f"is {shorten(value)}", f"{', '.join(allowed)}"))


def _require_harmonics(encoding: dict[str, Any]) -> None:
    """Raise InvalidFile unless directions are encoded by 16 spherical harmonics."""
    nested = encoding.get("nested")
    first = nested[0] if isinstance(nested, list) and nested else encoding
    if not isinstance(first, dict):
        raise InvalidFile(Problem("dir_encoding.nested[0]", f"is {kind_of(first)}", "SphericalHarmonics"))
    _require(first, "dir_encoding", "otype", ("sphericalharmonics",))
    if (degree := whole(first, "degree", "dir_encoding", default=4, low=1, high=8)) != 4:
        raise InvalidFile(Problem("dir_encoding.degree", f"is {degree}", "4"))


# -- occupancy -------------------------------------------------------------------------------------------------
def _occupancy(snapshot: dict[str, Any], size: int) -> Occupancy | None:
    if (edge := whole(snapshot, "density_grid_size", "snapshot", high=1 << 20)) != EDGE:
        raise InvalidFile(Problem("snapshot.density_grid_size", f"is {edge}", f"{EDGE}"))
    stored = _array(snapshot, "density_grid_binary", np.dtype("<f2"))
    if not len(stored):
        return None
    cascades = size.bit_length()
    if len(stored) != cascades * CELLS:
        found = f"has {len(stored):,} cells"
        allowed = f"{cascades * CELLS:,}, for {cascades} cascades of {EDGE}^3"
        raise InvalidFile(Problem("snapshot.density_grid_binary", found, allowed))
    memory.hold("the occupancy", len(stored))
    memory.require("the occupancy", 16 * CELLS)
    values = stored.reshape(cascades, CELLS)
    with np.errstate(invalid="ignore"):  # signalling NaN
        flags: Bits = values > _threshold(values[0])
    return nested_cubes(flags, 0.5, [0.5 * (1 << cascade) for cascade in range(cascades)])


def _threshold(thickness: npt.NDArray[Any]) -> np.float32:
    """min(0.01, the mean of the positive part of (128^3,) half), the sum of which is exact in multiples of 2^-24."""
    positive = cast(thickness, np.float64)
    positive = np.where(positive > 0, np.minimum(positive, 65504), 0)
    total = int((positive * (1 << 24)).astype(np.int64).sum())
    return np.float32(min(_LEAST, total / (1 << 24) / len(thickness)))
