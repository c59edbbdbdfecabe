"""Triangle meshes with textures and colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import rotate
from nerfbake.kernels.soundness import count_problem
from nerfbake.scene.base import MAX_WORLD, Scene, number_problems
from nerfbake.scene.compact_repr import CompactRepr
from nerfbake.scene.origin import no_origin, relative_to, require_origin

Composite = Literal["stop", "ztest"]  # how meshes and a field are composited
MAX_MESHES = 10_000
MAX_UV = 1e6  # beyond it float32 cannot resolve texels
UV_MARGIN = 1e-3  # how far outside the texture a coordinate may be, for rounding in files


@dataclass(frozen=True, eq=False, repr=False)
class Mesh(CompactRepr):
    """Triangles over vertices with texture coordinates, as in glTF.

    positions  (v, 3) float32, in the world of the field
    uvs        (v, 2) float32, v down: (0, 0) is the upper left corner of the texture, which repeats; None: no texture
               coordinates
    faces      (t, 3) uint32, counter-clockwise from outside
    texture    (H, W, 3) uint8, sRGB, shown unlit; None: a surface of one colour, lit from the camera
    colours    (v, 3) float32, sRGB in 0..1, multiplied by the texture; None: white on a texture, else grey
    material   (h, w, 2) uint8, glTF's roughness and specular strength, 255 is 1; the texture is then the albedo. Only
               .glb stores it, and pictures show the albedo; None: not known
    opaque     (H, W) bool: the texels of the texture that are there; the others are holes, which rays pass through. A
               ray meets the nearest texel, without interpolation. None: all. The texture may be a single texel

    >>> import numpy as np
    >>> from nerfbake import Mesh
    >>> mesh = Mesh(np.eye(3, dtype=np.float32), None, np.array([[0, 1, 2]], np.uint32))
    >>> mesh.positions[mesh.faces].shape
    (1, 3, 3)
    """

    positions: npt.NDArray[np.float32]
    uvs: npt.NDArray[np.float32] | None
    faces: npt.NDArray[np.uint32]
    texture: npt.NDArray[np.uint8] | None = None
    colours: npt.NDArray[np.float32] | None = None
    material: npt.NDArray[np.uint8] | None = None
    opaque: npt.NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        v = len(self.positions)
        if not len(self.faces):
            raise InvalidScene(Problem("the mesh", "has no faces", "at least one triangle"))
        for name, array, shape, dtype in (
            ("positions", self.positions, (v, 3), np.float32),
            ("uvs", self.uvs, (v, 2), np.float32),
            ("faces", self.faces, (len(self.faces), 3), np.uint32),
            ("colours", self.colours, (v, 3), np.float32),
        ):
            if array is not None and (array.shape != shape or array.dtype != dtype or not len(array)):
                found = f"have shape {array.shape}, dtype {array.dtype}"
                raise InvalidScene(Problem(f"mesh {name}", found, f"{shape} {np.dtype(dtype).name}, at least one"))
        if self.texture is not None:
            shape = self.texture.shape
            if len(shape) != 3 or shape[2] != 3 or not self.texture.size or self.texture.dtype != np.uint8:
                found = f"has shape {shape}, dtype {self.texture.dtype}"
                raise InvalidScene(Problem("mesh texture", found, "(H, W, 3) uint8"))
            self.require_uvs()
        if self.material is not None:
            shape = self.material.shape
            if len(shape) != 3 or shape[2] != 2 or not self.material.size or self.material.dtype != np.uint8:
                found = f"has shape {shape}, dtype {self.material.dtype}"
                raise InvalidScene(Problem("mesh material", found, "(H, W, 2) uint8"))
            self.require_uvs()
        if self.opaque is not None:
            shape = (1, 1) if self.texture is None else self.texture.shape[:2]
            allowed = self.opaque.shape if shape == (1, 1) and self.opaque.ndim == 2 else shape
            if self.texture is None or self.opaque.shape != allowed or self.opaque.dtype != np.bool_:
                found = f"have shape {self.opaque.shape}, dtype {self.opaque.dtype}"
                raise InvalidScene(Problem("mesh holes", found, f"{allowed} bool, and a texture"))
        problems = number_problems("mesh positions", self.positions, most=MAX_WORLD)
        problems += count_problem("mesh faces", self.faces >= v, self.faces, f"a vertex, 0 to {v - 1:,}")
        if self.uvs is not None:
            problems += number_problems("mesh uvs", self.uvs, most=MAX_UV)
        if self.colours is not None:
            outside = ~((self.colours >= 0) & (self.colours <= 1))
            problems += count_problem("mesh colours", outside, self.colours, "0 to 1")
        if problems:
            raise InvalidScene(problems[0])

    def require_uvs(self) -> npt.NDArray[np.float32]:
        """Return the texture coordinates. Raises InvalidScene if there are none."""
        if self.uvs is None:
            raise InvalidScene(
                Problem("the mesh", "has no texture coordinates", "texture coordinates for every vertex")
            )
        return self.uvs

    @property
    def texels(self) -> npt.NDArray[np.uint8] | None:
        """The texture as pictures store it: (H, W, 3), or (H, W, 4) with an alpha of 0 in holes; None without one."""
        if self.texture is None or self.opaque is None:
            return self.texture
        texels = np.empty((*self.opaque.shape, 4), np.uint8)
        texels[..., :3], texels[..., 3] = self.texture, np.where(self.opaque, 255, 0)
        return texels

    def require_unwrapped(self) -> npt.NDArray[np.float32]:
        """Return the texture coordinates. Raises InvalidScene if there are none, or any outside the texture."""
        uvs = self.require_uvs()
        outside = ~((uvs >= -UV_MARGIN) & (uvs <= 1 + UV_MARGIN))
        for problem in count_problem("mesh uvs", outside, uvs, "0 to 1"):
            raise InvalidScene(problem)
        return uvs


def require_few(count: int) -> None:
    """Raise InvalidScene if a file shows more meshes than allowed, because each has its own arrays."""
    if count > MAX_MESHES:
        raise InvalidScene(Problem("the scene", f"shows {count:,} meshes or more", f"{MAX_MESHES:,}, one per material"))


@dataclass(frozen=True, eq=False, repr=False)
class Meshes(Scene):
    """All meshes of a file, one for each material.

    coarser: levels of detail of a single mesh, with fewer triangles each; nothing but a .glb stores them
    notes: parts of the file that were left out, and what that means, one line each
    origin: (3,) float64, the point of the world that all positions are relative to; 0 for all files but those far from
            it, see scene/origin.py. Cameras of stages are relative to it, too

    >>> import numpy as np
    >>> from nerfbake import Mesh, Meshes
    >>> mesh = Mesh(np.eye(3, dtype=np.float32), None, np.array([[0, 1, 2]], np.uint32))
    >>> print(Meshes((mesh, mesh)))
    mesh of 2 triangles over 6 vertices
    """

    meshes: tuple[Mesh, ...]
    coarser: tuple[Mesh, ...] = ()
    notes: tuple[str, ...] = ()
    origin: Floats = field(default_factory=no_origin)

    def __post_init__(self) -> None:
        require_origin(self.origin)
        if not self.meshes:
            raise InvalidScene(Problem("the mesh", "has no faces", "at least one triangle"))
        require_few(len(self.meshes))
        if self.coarser and len(self.meshes) > 1:
            raise InvalidScene(Problem("levels of detail", f"belong to {len(self.meshes):,} meshes", "a single mesh"))

    def with_up(self, up: Literal["y", "z", "-z"]) -> Meshes:
        """The same meshes, rotated so that the y axis, which is up in glTF, becomes the axis `up`.

        z maps (x, y, z) to (x, -z, y). -z undoes that: it maps (x, y, z) to (x, z, -y), so that z becomes y.
        """
        if up == "y":
            return self
        turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)
        if up == "-z":
            turn = turn.T.copy()
        turned = (replace(m, positions=rotate(m.positions, turn).astype(np.float32)) for m in self.meshes)
        return Meshes(tuple(turned), notes=self.notes, origin=rotate(self.origin, turn) + 0.0)

    def relative_to(self, origin: Floats) -> Meshes:
        """The same meshes with another origin. Far from it, float32 rounds their positions."""
        if np.array_equal(origin, self.origin):
            return self
        finest, coarser = (
            tuple(replace(m, positions=relative_to(m.positions, origin - self.origin)) for m in meshes)
            for meshes in (self.meshes, self.coarser)
        )
        return replace(self, meshes=finest, coarser=coarser, origin=origin)

    def __str__(self) -> str:
        triangles = sum(len(mesh.faces) for mesh in self.meshes)
        return f"mesh of {triangles:,} triangles over {sum(len(mesh.positions) for mesh in self.meshes):,} vertices"


def vertex_box(meshes: Sequence[Mesh]) -> npt.NDArray[np.float64]:
    """(2, 3) world corners of the box around all vertices that a face uses."""
    held = [mesh.positions[mesh.faces.reshape(-1)] for mesh in meshes]
    corners = [(points.min(axis=0), points.max(axis=0)) for points in held]
    low, high = zip(*corners, strict=True)
    return np.stack([np.min(low, axis=0), np.max(high, axis=0)]).astype(np.float64)


def joined_meshes(
    meshes: Sequence[Mesh],
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32], npt.NDArray[np.int64]]:
    """All meshes as one: positions (v, 3) and faces (t, 3).

    Also returns (n + 1,): the index of each mesh's first face, and the number of faces.
    """
    vertex = np.cumsum([0] + [len(mesh.positions) for mesh in meshes])
    first = np.cumsum([0] + [len(mesh.faces) for mesh in meshes])
    faces = [mesh.faces + np.uint32(shift) for mesh, shift in zip(meshes, vertex, strict=False)]
    return np.concatenate([mesh.positions for mesh in meshes]), np.concatenate(faces), first
