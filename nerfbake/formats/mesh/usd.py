"""Read meshes of USD: polygons with a UsdPreviewSurface or with displayColor, in all containers.

Positions are in the coordinates of the world of the stage, in metres: upAxis turns nothing, as in a .glb. Those that
nerfbake has turned are turned back. Polygons
become fans of triangles. A subset of faces with a material of its own becomes a mesh. A texture is a PNG, a JPEG or a
WebP in the package, or below the folder of the layer. What changes only the reflection of light is left out.
Source: OpenUSD 26.11, usdGeom/mesh.h; "UsdPreviewSurface Specification" 2.6.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.mesh.colours import sound_colours
from nerfbake.formats.wire.picture import decode_texture
from nerfbake.formats.wire.usd.content import has_type
from nerfbake.formats.wire.usd.reading import StageContent, StagePrim, read_stage
from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.kernels.maths.affine import determinant, transform_points
from nerfbake.kernels.maths.elementary import cast, sine_cosine
from nerfbake.kernels.picture.metrics import from_linear
from nerfbake.kernels.surface.fans import fan
from nerfbake.scene.mesh import Mesh, Meshes, require_few
from nerfbake.scene.origin import choose_origin, relative_to

KIND = "Mesh"
_ENDINGS = (".png", ".jpg", ".jpeg", ".webp")
_CORNER = 200  # bytes that a corner takes on the way


def recognise(view: memoryview) -> bool:
    """Return True for a file of USD that names meshes."""
    return has_type(view, KIND)


def decode(view: memoryview, *, beside: Mapping[str, memoryview] | None = None) -> Meshes:
    """Read the meshes of a stage. Raises UsageError without OpenUSD, InvalidFile, InvalidScene, MemoryLimit.

    beside: the files of the same folder, with textures.
    """
    return meshes_of(read_stage(view, beside))


def meshes_of(stage: StageContent) -> Meshes:
    """Return the meshes of a stage, one for each mesh and each subset of its faces with a material."""
    reader = _Reader(stage)
    found = [each for prim in stage.of(KIND) for each in reader.meshes(prim)]
    if not found:
        raise InvalidFile(Problem("the stage", "has no faces", "a Mesh with at least one triangle"))
    require_few(len(found))
    meshes, points = [mesh for _, mesh in found], [points for points, _ in found]
    if (origin := choose_origin(points)).any():
        meshes = [replace(m, positions=relative_to(p, origin)) for p, m in zip(points, meshes, strict=True)]
    whole = Meshes(tuple(meshes), notes=(*stage.notes, *reader.notes), origin=origin)
    return whole.with_up("z" if stage.turned == "z" else "y")


class _Reader:
    """The meshes of a stage. notes: what was left out or repaired; each picture is decoded once."""

    def __init__(self, stage: StageContent) -> None:
        self._files = stage.files
        self._textures: dict[str, npt.NDArray[np.uint8]] = {}
        self.notes: dict[str, None] = {}

    def meshes(self, prim: StagePrim) -> Iterator[tuple[npt.NDArray[Any], Mesh]]:
        """Yield positions, float64 unless they are as in the file, with a mesh for each material."""
        points, counts, corners = _polygons(prim)
        memory.require("the mesh", _CORNER * len(corners))
        if prim.values.get("subdivisionScheme", "catmullClark") != "none":
            self.notes["subdivision surfaces are read as the meshes that control them"] = None
        starts = np.cumsum(counts) - counts
        solid = counts >= 3
        holes = prim.values.get("holeIndices")
        if isinstance(holes, np.ndarray) and holes.dtype.kind == "i":
            solid[holes[(holes >= 0) & (holes < len(solid))]] = False
        mirrored = (prim.values.get("orientation") == "leftHanded") != (determinant(prim.place[:3, :3]) < 0)
        if np.array_equal(prim.place, np.eye(4)):
            placed: npt.NDArray[Any] = points
        else:
            with np.errstate(over="ignore", invalid="ignore"):
                placed = transform_points(points.astype(np.float64), prim.place)
        for look, faces in _parts(prim, solid):
            triangles = fan(starts[faces], counts[faces])
            if len(triangles):
                triangles = triangles[:, ::-1] if mirrored else triangles
                yield self._dressed(prim, placed, corners, triangles, look, np.repeat(faces, counts[faces] - 2))

    def _dressed(
        self,
        prim: StagePrim,
        points: npt.NDArray[Any],
        corners: Ints,
        triangles: Ints,
        look: Mapping[str, Any],
        faces: Ints,
    ) -> tuple[npt.NDArray[Any], Mesh]:
        """Return the positions and the mesh of triangles (t, 3), which are numbers of corners. faces: (t,) of each."""
        texture = self._texture(look.get("file"))
        uvs = colours = None
        if texture is not None:
            uvs = self._primvar(prim, str(look.get("st")), 2, corners, triangles, faces)
            texture = None if uvs is None else texture
        light = None if look.get("file") else look.get("colour")
        if light is None and texture is None:
            colours = self._primvar(prim, "displayColor", 3, corners, triangles, faces)
        if texture is not None and look.get("scale") not in (None, [1.0, 1.0, 1.0, 1.0]):
            light = look["scale"][:3]
        vertices, first, number = _vertices(
            corners[triangles].reshape(-1), [v for v in (uvs, colours) if v is not None]
        )
        positions = cast(points[vertices], np.float32)
        mesh = Mesh(positions + np.float32(0), None, number.reshape(-1, 3).astype(np.uint32))
        if uvs is not None and texture is not None:
            moved = _moved(uvs[first].astype(np.float64), look.get("move") or {})
            moved[:, 1] = 1 - moved[:, 1]
            mesh = replace(mesh, uvs=cast(moved, np.float32), texture=texture)
        if isinstance(light, list):
            colours, first = np.array([light]), np.zeros(len(first), np.int64)
        if colours is not None:
            sound, told = sound_colours(colours[first].astype(np.float64), scaled=True)
            self.notes |= dict.fromkeys(told)
            mesh = replace(mesh, colours=cast(from_linear(sound), np.float32))
        return points[vertices], mesh

    def _primvar(
        self, prim: StagePrim, name: str, columns: int, corners: Ints, triangles: Ints, faces: Ints
    ) -> npt.NDArray[Any] | None:
        """Return the values (3 t, columns) of a primvar at the corners of triangles; None if it has none there."""
        found = prim.facts["primvars"].get(name)
        values = found["values"] if found else None
        if not isinstance(values, np.ndarray) or values.ndim != 2 or values.shape[1] != columns:
            return None
        rows = {
            "constant": np.zeros(triangles.size, np.int64),
            "uniform": np.repeat(faces, 3),
            "faceVarying": triangles.reshape(-1),
        }.get(found["on"], corners[triangles].reshape(-1))
        if isinstance(found["indices"], np.ndarray):
            indices = found["indices"].astype(np.int64)
            rows = indices[rows] if len(indices) > rows.max() else np.full(len(rows), -1)
        if rows.min() < 0 or rows.max() >= len(values):
            self.notes[f"{name} of {prim.path} is left out, because its counts do not fit"] = None
            return None
        chosen = values[rows]
        if not np.isfinite(chosen).all():
            self.notes[f"{name} of {prim.path} is left out, because it has numbers that are not finite"] = None
            return None
        return np.ascontiguousarray(chosen)

    def _texture(self, name: Any) -> npt.NDArray[np.uint8] | None:
        if not isinstance(name, str):
            return None
        holds = getattr(self._files, "holds", self._files.__contains__)
        if name not in self._files or not holds(name) or not name.lower().endswith(_ENDINGS):
            self.notes[f"the texture {name[:80]!r} is left out: it is no PNG, JPEG or WebP beside the layer"] = None
            return None
        if name not in self._textures:
            self._textures[name] = decode_texture(self._files[name], name, any_mode=True, webp=True)
        return self._textures[name]


def _polygons(prim: StagePrim) -> tuple[npt.NDArray[Any], Ints, Ints]:
    """Return points (v, 3), the number of corners of each face, and the vertex of each corner. Raises InvalidFile."""
    points, counts, corners = (prim.values.get(name) for name in ("points", "faceVertexCounts", "faceVertexIndices"))
    if not all(isinstance(each, np.ndarray) for each in (points, counts, corners)):
        return np.zeros((0, 3), np.float32), np.zeros(0, np.int64), np.zeros(0, np.int64)
    assert points is not None
    assert counts is not None
    assert corners is not None
    if points.ndim != 2 or points.shape[1] != 3 or counts.dtype.kind != "i" or corners.dtype.kind != "i":
        raise InvalidFile(Problem(prim.path, "has points or faces of another type", "point3f[] and int[]"))
    wide = counts.astype(np.int64)
    if (wide < 0).any() or wide.sum() != len(corners):
        found = f"add up to {wide.sum():,}, with {len(corners):,} indices"
        raise InvalidFile(Problem(f"{prim.path}.faceVertexCounts", found, "as many as faceVertexIndices"))
    outside = (corners < 0) | (corners >= len(points))
    if outside.any():
        found = f"are {corners[outside][0]:,}"
        times = int(outside.sum())
        raise InvalidFile(Problem(f"{prim.path}.faceVertexIndices", found, f"0 to {len(points) - 1:,}", times))
    return points, wide, corners.astype(np.int64)


def _parts(prim: StagePrim, solid: npt.NDArray[np.bool_]) -> Iterator[tuple[Mapping[str, Any], Ints]]:
    """Yield each material with the faces that have it."""
    rest = solid.copy()
    for part in prim.facts["parts"]:
        faces = part["faces"]
        if isinstance(faces, np.ndarray) and faces.dtype.kind == "i":
            chosen = np.zeros(len(solid), bool)
            chosen[faces[(faces >= 0) & (faces < len(solid))]] = True
            yield part, np.flatnonzero(chosen & rest)
            rest &= ~chosen
    yield prim.facts["material"], np.flatnonzero(rest)


def _vertices(corners: Ints, values: list[npt.NDArray[Any]]) -> tuple[Ints, Ints, Ints]:
    """Return the point of each vertex of a mesh, a corner of it, and the vertex of each corner.

    A point becomes several vertices if its corners have several values. If none does, the points stay as they are.
    """
    count = int(corners.max()) + 1
    first = np.zeros(count, np.int64)
    first[corners[::-1]] = np.arange(len(corners))[::-1]
    used = np.zeros(count, bool)
    used[corners] = True
    if used.all() and all((value[first][corners] == value).all() for value in values):
        return np.arange(count), first, corners
    rows: list[npt.NDArray[Any]] = [corners[:, None], *(value.astype(np.float32).view(np.int32) for value in values)]
    keys: npt.NDArray[np.int64] = np.concatenate(rows, axis=1)
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return corners[first], first, number.reshape(-1)


def _moved(places: Floats, move: Mapping[str, Any]) -> Floats:
    """Return texture coordinates that a UsdTransform2d has scaled, rotated counter-clockwise and shifted."""
    scale, shift = move.get("scale") or [1.0, 1.0], move.get("translation") or [0.0, 0.0]
    turn = move.get("rotation") or 0.0
    if not move:
        return places.copy()
    sine, cosine = sine_cosine(np.fmod(float(turn), 360.0) * (np.pi / 180))
    s, t = (places * scale[:2]).T
    return np.stack([cosine * s - sine * t + shift[0], sine * s + cosine * t + shift[1]], axis=1)
