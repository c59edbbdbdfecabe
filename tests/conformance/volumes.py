"""VDB grids: fog, colours, coefficients, a level set, halves, tiles, places, and indices with their tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import sqrt
from typing import Any

import numpy as np

from nerfbake.scene.vdb import GridClass, IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTiles, VdbTopology, topology_of
from nerfbake.scene.volume import OctreeFrame, Volume
from tests.conformance.case import Case, Frozen, form_named
from tests.conformance.volume_facts import answer, facts_of

Voxel = tuple[int, int, int]
Row = tuple[float, ...]
Voxels = Mapping[Voxel, Row]
Places = Mapping[str, Sequence[Row]]
File = tuple[str, str, dict[str, Any]]  # ending, format, options

TRANSFORM: list[list[float]] = [[0.25, 0, 0, -1.5], [0, 0.25, 0, 2.25], [0, 0, 0.5, 0.125]]
# x and z change places, y is mirrored.
MOVED: list[list[float]] = [[0, 0, 2, 1], [0, -0.5, 0, 2], [4, 0, 0, -3]]


@dataclass(frozen=True)
class Tile:
    """A cube of one value."""

    low: Voxel
    edge: int
    value: Row
    active: bool = True


@dataclass(frozen=True)
class Grid:
    """A grid as plain numbers: all that it holds by the place where it stands."""

    name: str
    voxels: Voxels
    background: Row
    grid_class: str = "fog volume"
    inactive: frozenset[Voxel] = frozenset()
    tiles: tuple[Tile, ...] = ()
    place: list[list[float]] | None = None
    dtype: Any = np.float32


@dataclass(frozen=True)
class Scene:
    """Grids, where to look them up (in voxels), and the octree that they were."""

    grids: tuple[Grid, ...]
    places: Places
    files: tuple[File, ...]
    about: str
    frame: OctreeFrame | None = None
    stored: float = 0
    transform: list[list[float]] = field(default_factory=lambda: TRANSFORM)


# Where to look: none is nearer than 1/16 to a place where rounding would choose.
AROUND = {
    "inside": [(3.125, 5.25, 6.0625), (3.75, 5.375, 5.875), (0.25, 0.3125, -0.375)],
    "between": [(2.625, 4.75, 6.375), (-0.625, -0.75, -0.3125)],
    "outside": [(40.25, 3.25, 1.75), (-5000.75, 9.25, 3.375)],
}
PACKED: File = ("_zip.vdb", "vdb", {"codec": "zip"})
NPZ: File = (".vdb.npz", "vdb.npz", {})
PLAIN: File = (".vdb", "vdb", {"codec": "none"})
# A plain .nvdb has 300 kB of zeros at least; zstd takes them away.
NANO: tuple[File, File] = (("_zip.nvdb", "nvdb", {"codec": "zip"}), (".nvdb.zst", "nvdb", {"codec": "none"}))

FOG: dict[Voxel, Row] = {
    (3, 5, 6): (0.5,),
    (4, 5, 6): (1.25,),
    (3, 6, 6): (2.0,),
    (4, 6, 5): (0.1,),
    (0, 0, 0): (40.0,),
    (7, 7, 7): (0.75,),
    (8, 7, 7): (3.0,),
    (130, 2, 1): (6.5,),
    (-1, -1, -1): (0.25,),
    (-1, 0, 0): (300.0,),
}
NEAR: dict[Voxel, Row] = {(x, y, z): (1 + x + y / 4 + z / 16,) for x in range(2) for y in range(3) for z in range(2)}
SMALL = {"inside": [(0.25, 1.125, 0.625)], "between": [(1.375, 2.25, 0.75)], "outside": [(9.25, 9.25, 9.25)]}


def scenes() -> dict[str, Scene]:
    coefficients = {voxel: (value[0] / 4, -0.5, value[0] / -8) for voxel, value in NEAR.items()}
    rows = {voxel: (value[0] / 4, -0.5, value[0] / -8, value[0]) for voxel, value in NEAR.items()}
    frame = OctreeFrame((2, 3, 2), "SH1", "compact", np.array([-1.625, 2.125, -0.125]), np.array([0.25, 0.25, 0.5]))
    lobes = OctreeFrame((2, 3, 2), "SG1", "full", np.zeros(3), np.ones(3), np.array([[1, 0.5, -2, 0.1]], np.float32))
    density = Grid("density", FOG, (0.0,))
    half = Grid("density", {voxel: (value[0] / 8,) for voxel, value in NEAR.items()}, (0.0,), dtype=np.float16)
    return {
        "fog": Scene((density,), AROUND, (PLAIN, PACKED, NPZ, *NANO), "A density in two tiles of the root."),
        "colour": Scene(
            (Grid("Cd", {voxel: (value[0] / 16, 0.5, 0.1) for voxel, value in NEAR.items()}, (0.0,) * 3, "unknown"),),
            SMALL,
            (PACKED, *NANO),
            "Colours: three floats a voxel.",
        ),
        "sh": Scene(
            (Grid("density", NEAR, (0.0,)), Grid("sh_0", coefficients, (0.0, 0.0, 0.0), "unknown")),
            SMALL,
            (PACKED, NPZ),
            "An octree's density and spherical harmonics, with the frame that leads back to the octree.",
            frame,
        ),
        "half": Scene((half,), SMALL, (PLAIN, PACKED, NPZ), "A density of halves."),
        "fp16": Scene(
            (half,), SMALL, NANO, "A density of 16 bits between least and greatest of each leaf.", stored=1e-4
        ),
        "half_colour": Scene(
            (Grid("Cd", {v: (c[0] / 4, 0.5, 0.25) for v, c in NEAR.items()}, (0.0,) * 3, "unknown", dtype=np.float16),),
            SMALL,
            (PACKED,),
            "Colours: three halves a voxel.",
        ),
        "level_set": Scene((_level_set(),), SPHERE, (PLAIN, PACKED, NPZ, *NANO), "A sphere as a level set."),
        "tiles": Scene((_tiles(),), TILES, (PACKED, NPZ, *NANO), "Tiles of all three sizes, one inactive."),
        "places": Scene(
            (
                Grid("density", NEAR, (0.5,)),
                Grid("moved", NEAR, (0.0,), place=MOVED),
                Grid("v", coefficients, (1.0, 2.0, 3.0), "staggered"),
            ),
            SMALL,
            (PACKED, NPZ),
            "Three grids, of which one has a place of its own and one is staggered.",
        ),
        "index": Scene(
            (Grid("index", rows, (0.0,) * 4, "index"),), SMALL, (NPZ, *NANO), "An index and its table, floats.", frame
        ),
        "index_half": Scene(
            (Grid("index", {**rows, (-1, -1, -1): (9.0, 8.0, 7.0, 6.0)}, (0.0,) * 4, "index", dtype=np.float16),),
            SMALL,
            (NPZ, *NANO),
            "An index and its table, halves, in two tiles of the root, with an octree's lobes.",
            lobes,
        ),
    }


SPHERE = {"inside": [(-4.25, -3.75, -4.125), (-2.25, -3.75, -4.125)], "outside": [(3.25, 1.25, 1.25)]}
TILES = {
    "inside": [(2.25, 3.125, 4.25)],
    "tile": [(11.25, 3.25, 5.125), (200.25, 140.75, 3.125), (5000.75, -100.25, 300.25), (20.25, 3.25, 5.125)],
    "between": [(7.75, 3.25, 4.25), (127.75, 130.25, 5.25)],
    "outside": [(60.25, 3.25, 4.25), (-5000.25, 9.25, 3.375)],
}


def _level_set() -> Grid:
    """Distances to a sphere of radius 2.5 voxels, active nearer than 1.5; what is deeper inside is inactive, -1.5."""
    voxels: dict[Voxel, Row] = {}
    inactive = set()
    for voxel in np.ndindex(8, 8, 8):
        x, y, z = (int(c) - 8 for c in voxel)
        distance = sqrt((x + 4) ** 2 + (y + 4) ** 2 + (z + 4) ** 2) - 2.5
        if distance < 1.5:
            voxels[x, y, z] = (float(np.float32(max(distance, -1.5))),)
        if distance <= -1.5:
            inactive.add((x, y, z))
    return Grid("surface", voxels, (1.5,), "level set", frozenset(inactive))


def _tiles() -> Grid:
    tiles = (
        Tile((8, 0, 0), 8, (0.5,)),
        Tile((16, 0, 0), 8, (7.0,), active=False),
        Tile((128, 128, 0), 128, (2.5,)),
        Tile((4096, -4096, 0), 4096, (1.25,)),
    )
    return Grid("density", {(2, 3, 4): (4.0,), (2, 3, 5): (6.0,)}, (0.25,), tiles=tiles)


def cases() -> Iterator[Case]:
    for name, scene in scenes().items():
        made = volume_of(scene)
        files = {
            f"volume/{name}{ending}": Frozen(form_named(form), made, options, ending.endswith(".zst"))
            for ending, form, options in scene.files
        }
        yield Case(f"volume/{name}", scene.about, files, facts_of(scene), answer, stored=scene.stored, computed=1e-5)


# -- the program's own nouns -----------------------------------------------------------------------------------
def volume_of(scene: Scene) -> Volume:
    return Volume(tuple(map(_grid_of, scene.grids)), np.array(scene.transform, np.float64), scene.frame)


def _grid_of(grid: Grid) -> VdbTree | IndexGrid:
    topology, order = topology_of(np.array(list(grid.voxels), np.int64))
    values = np.array(list(grid.voxels.values()), np.float64)[order].astype(grid.dtype)
    background = np.array(grid.background, np.float32)
    if grid.grid_class == "index":
        return IndexGrid(grid.name, topology, np.concatenate([background[None].astype(grid.dtype), values]))
    active = [voxel not in grid.inactive for voxel in map(tuple, topology.coords.tolist())]
    tiles = sorted(grid.tiles, key=lambda tile: (tile.edge, tile.low))
    if tiles:
        topology = _with_tiles(topology, tiles)
        values = np.concatenate([values, np.array([tile.value for tile in tiles], grid.dtype)])
        active += [tile.active for tile in tiles]
    place = None if grid.place is None else np.array(grid.place, np.float64)
    known: Any = grid.grid_class
    grid_class: GridClass = known
    return VdbTree(grid.name, topology, values, background, grid_class, np.array(active), place)


def _with_tiles(topology: VdbTopology, tiles: list[Tile]) -> VdbTopology:
    """In the first lower and the first upper node, and beside them in the root."""
    lower, upper = np.zeros_like(topology.lower_mask), np.zeros_like(topology.upper_mask)
    for tile in tiles:
        if tile.edge < 4096:
            mask, bits, shift = (lower, 4, 3) if tile.edge == 8 else (upper, 5, 7)
            slot = 0
            for along in tile.low:
                slot = slot << bits | along >> shift & (1 << bits) - 1
            mask[0, slot >> 6] |= np.uint64(1 << (slot & 63))
    root = np.array([tile.low for tile in tiles if tile.edge == 4096], np.int32).reshape(-1, 3)
    return replace(topology, tiles=VdbTiles(lower, upper, root))
