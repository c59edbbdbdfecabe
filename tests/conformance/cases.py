"""All frozen scenes."""

from __future__ import annotations

from tests.conformance import (
    atlases,
    cameras,
    compressed,
    functions,
    lattices,
    meshes,
    n3trees,
    octrees,
    pictures,
    splats,
    stages,
    volumes,
    voxels,
)

CASES = [
    case
    for family in (
        octrees,
        voxels,
        compressed,
        n3trees,
        volumes,
        pictures,
        cameras,
        meshes,
        splats,
        atlases,
        lattices,
        functions,
        stages,
    )
    for case in family.cases()
]
