"""Find the density grid of a volume."""

from __future__ import annotations

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.volume import Volume


def density_of(volume: Volume) -> VdbTree:
    """Return the grid `density`, or else the only grid with one channel.

    Raises InvalidScene if there is no such grid, or if it is a level set.
    """
    scalars = [grid for grid in volume.grids if isinstance(grid, VdbTree) and grid.values.shape[1] == 1]
    named = [grid for grid in scalars if grid.name == "density"]
    fogs = [grid for grid in scalars if grid.grid_class != "level set"]
    if not named and len(fogs) != 1 and len(scalars) != 1:
        allowed = "density among them, or index; `grid=NAME` for one of them"
        raise InvalidScene(Problem("the volume", f"has the grids {', '.join(volume.labels)}", allowed))
    grid = (named or fogs or scalars)[0]
    if grid.grid_class == "level set":
        allowed = "a fog volume; level sets only for info, check, and convert between .vdb, .nvdb, .vdb.npz"
        raise InvalidScene(Problem(f"grid {grid.name!r}", "is a level set", allowed))
    return grid
