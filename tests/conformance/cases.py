"""All frozen scenes."""

from __future__ import annotations

from tests.conformance import atlases, cameras, meshes, n3trees, octrees, pictures, volumes

CASES = [case for family in (octrees, n3trees, volumes, pictures, cameras, meshes, atlases) for case in family.cases()]
