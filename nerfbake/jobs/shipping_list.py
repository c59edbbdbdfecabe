"""What `nerfbake ship` makes for whom: the targets, their files, and the programs that read these files.

docs/ship.md has the same tables, which a test compares with these. A program stands here only with what is known about
this very format: docs/splats.md, docs/usd.md, docs/volumes.md and engines/unity/README.md say how it was tested.
"""

from __future__ import annotations

from difflib import get_close_matches
from typing import NamedTuple

from nerfbake.errors import UsageError
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.shipment import ReadingProgram
from nerfbake.scene.splats import Splats
from nerfbake.scene.volume import Volume


class ListedFile(NamedTuple):
    """A file of a shipment: what it is, the type of scene that is read back to judge it, and who reads it.

    The scene of a page, which has no type of its own, is None.
    """

    what: str
    scene: type | None
    readers: tuple[ReadingProgram, ...]


_UPRIGHT = "every number; turns nothing"
FILES: dict[str, ListedFile] = {
    "scene.html": ListedFile(
        "page to look around in",
        None,
        (
            ReadingProgram("Chromium", "156", "shows the scene as nerfbake renders it", "ran"),
            ReadingProgram("Firefox", "153", "shows the scene as nerfbake renders it", "ran"),
            ReadingProgram("Safari", "", "", "not run"),
        ),
    ),
    "scene.vdb": ListedFile(
        "volume of density and mean colour",
        Volume,
        (
            ReadingProgram("OpenVDB", "10.0.1", "every voxel", "ran"),
            ReadingProgram("Blender", "3.4", "renders the object where it is", "ran"),
            ReadingProgram("Blender", "5.3", "", "not run"),
            ReadingProgram("Houdini", "", "", "not run"),
        ),
    ),
    "mesh.usdz": ListedFile(
        "triangles with a texture",
        Meshes,
        (
            ReadingProgram("usd-core", "26.11", "triangles, texture, material; no errors of its validators", "ran"),
            ReadingProgram("usd-core", "26.5", "no failed check of ARKit's rules", "ran"),
            ReadingProgram("Blender", "5.0.1", "upright, with its texture", "ran"),
            ReadingProgram("tinyusdz", "0.9.4", "opens it", "ran"),
            ReadingProgram("AR Quick Look", "", "", "not run"),
            ReadingProgram("Omniverse", "", "", "not run"),
        ),
    ),
    "splats.spz": ListedFile(
        "Gaussian splats, compressed, SPZ 3, y up",
        Splats,
        (
            ReadingProgram("splat-transform", "3.7.0", _UPRIGHT, "ran"),
            ReadingProgram("gaussforge", "0.6.0", _UPRIGHT, "ran"),
            ReadingProgram("three.js", "0.187", "draws them as nerfbake renders them", "ran"),
            ReadingProgram("Spark", "2.2", "turns nothing; centres in half floats", "ran"),
            ReadingProgram("Babylon.js", "9.28", "turns nothing", "ran"),
            ReadingProgram("gsply", "0.4.6", _UPRIGHT, "ran"),
            ReadingProgram("usd-convert-gsplat", "0.1.15", _UPRIGHT, "ran"),
            ReadingProgram("Omniverse's converter", "", "SPZ 2 and 3", "read"),
        ),
    ),
    "splats.sog": ListedFile(
        "Gaussian splats, compressed",
        Splats,
        (
            ReadingProgram("splat-transform", "3.7.0", _UPRIGHT, "ran"),
            ReadingProgram("gaussforge", "0.6.0", _UPRIGHT, "ran"),
        ),
    ),
    "splats.ply": ListedFile(
        "Gaussian splats, y down",
        Splats,
        (
            ReadingProgram("splat-transform", "3.7.0", _UPRIGHT, "ran"),
            ReadingProgram("gaussforge", "0.6.0", _UPRIGHT, "ran"),
            ReadingProgram("usd-convert-gsplat", "0.1.15", "says that y is up: upside down", "ran"),
            ReadingProgram("Blender", "5.3", "", "not run"),
        ),
    ),
    "splats.usdc": ListedFile(
        "Gaussian splats, OpenUSD 26.03 or newer",
        Splats,
        (
            ReadingProgram("usd-core", "26.11", "every attribute, bit for bit; no errors of its validators", "ran"),
            ReadingProgram("usd-validation-nvidia", "1.22.0", "passes VG.035, its rule for splats", "ran"),
            ReadingProgram("tinyusdz", "0.9.4", "every number", "ran"),
            ReadingProgram("Omniverse Kit and RTX", "110.1", "renders", "read"),
            ReadingProgram("Blender", "5.0.1", "brings nothing", "ran"),
        ),
    ),
    "scene.svo.pb": ListedFile(
        "octree, Protocol Buffers",
        SparseVoxelOctree,
        (
            ReadingProgram("engines/unity, C# under Mono", "6.8", "every bit", "ran"),
            ReadingProgram("Unity", "2021.3", "", "not run"),
        ),
    ),
    "scene.svo.npz": ListedFile(
        "octree with all of its values, plain arrays",
        SparseVoxelOctree,
        (ReadingProgram("NumPy", "2", "every array", "ran"),),
    ),
    "scene.svoq": ListedFile(
        "octree, compressed to a loss of 0.1 dB",
        SparseVoxelOctree,
        (ReadingProgram("nerfbake", "", "all of it", "ran"),),
    ),
}
TARGETS: dict[str, tuple[str, ...]] = {
    "blender": ("scene.vdb", "mesh.usdz", "splats.ply"),
    "web": ("scene.html", "splats.spz", "splats.sog"),
    "ios": ("mesh.usdz", "scene.html"),
    "unity": ("scene.svo.pb",),
    "omniverse": ("splats.usdc", "mesh.usdz"),
    "archive": ("scene.svo.npz", "scene.svoq", "splats.ply"),
}


def require_targets(names: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return the files to make, in the order of FILES, each with its targets. Raises UsageError for an unknown name."""
    for name in names:
        if name not in TARGETS:
            near = get_close_matches(name.lower(), TARGETS, n=1)
            meant = f", perhaps {near[0]!r} is meant" if near else ""
            raise UsageError(f"{name[:40]!r} is no target{meant}; allowed: {', '.join(TARGETS)}")
    if not names:
        raise UsageError(f"there is no target; allowed: {', '.join(TARGETS)}")
    ordered = [name for name in TARGETS if name in names]
    wanted = {file: tuple(name for name in ordered if file in TARGETS[name]) for file in FILES}
    return {file: targets for file, targets in wanted.items() if targets}
