"""Octahedral maps that replace an MLP, and the textures that select a map for each texel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import cbrt
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.surface import octahedron
from nerfbake.kernels.surface.octahedron import TexelLookup
from nerfbake.scene.base import Scene
from nerfbake.scene.compact_repr import CompactRepr
from nerfbake.scene.mesh import Mesh

Method = Literal["kmeans", "affine", "grid"]
METHODS: tuple[Method, ...] = ("kmeans", "affine", "grid")
MAX_TILES = 1 << 16  # labels are 16-bit
MAX_MAP_SIZE = 1024
ZERO_SLOPE = 128  # the byte of an affine map that represents 0
ZERO_OFFSET = 127  # the byte of an affine feature that represents 0


@dataclass(frozen=True, eq=False, repr=False)
class OctahedralAtlas(CompactRepr):
    """The specular colour as a sum over a few maps: weight x map(direction). The method defines maps and weights.

    kmeans  one map, tile `label`, weight 1
    affine  tiles 4 label + i: M0 + sum over i = 1, 2, 3 of J_i o_i; o = (feature byte - 127) / 255 is the texel's
            feature minus its cluster's centre, J_i = (byte - 128) / 127 slope slopes[label] / 255
    grid    n^3 nodes in feature space, tile (r n + g) n + b; the four corners of the tetrahedron around the texel's
            feature

    tiles     (T, R, R, 3) uint8, without gutter, linear values; kernels.surface.octahedron defines the texels
    labels    (H, W) uint16; all zeros for grid
    features  (H, W, 3) uint8: none for kmeans (None), offsets for affine, features for grid; row 0 is the image's top
    border    texels of gutter around each tile in the atlas image
    slope     for `affine`: the value of byte 255 in maps 1 to 3 of the cluster with the steepest ones
    slopes    (K,) uint8, for `affine`: each cluster's share of `slope`, in 255ths

    Source: docs/formats/atlas.md, "Octahedral maps"; `kmeans` is "The thesis' method" there.

    >>> import numpy as np
    >>> from nerfbake import OctahedralAtlas
    >>> atlas = OctahedralAtlas("kmeans", np.zeros((2, 8, 8, 3), np.uint8), np.zeros((4, 4), np.uint16))
    >>> atlas.K, atlas.R, atlas.border
    (2, 8, 1)
    """

    method: Method
    tiles: npt.NDArray[np.uint8]
    labels: npt.NDArray[np.uint16]
    features: npt.NDArray[np.uint8] | None = None
    border: int = 1
    slope: float = 1.0
    slopes: npt.NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        shape = self.tiles.shape
        square = self.tiles.ndim == 4 and shape[1] == shape[2] and shape[3] == 3
        if (
            not square
            or self.tiles.dtype != np.uint8
            or not 1 <= shape[0] <= MAX_TILES
            or not 2 <= shape[1] <= MAX_MAP_SIZE
        ):
            found = f"have shape {shape}, dtype {self.tiles.dtype}"
            allowed = f"(T, R, R, 3) uint8, T to {MAX_TILES:,}, R 2 to {MAX_MAP_SIZE:,}"
            raise InvalidScene(Problem("tiles", found, allowed))
        if self.labels.ndim != 2 or not self.labels.size or self.labels.dtype != np.uint16:
            found = f"have shape {self.labels.shape}, dtype {self.labels.dtype}"
            raise InvalidScene(Problem("labels", found, "(H, W) uint16"))
        if (self.features is None) != (self.method == "kmeans"):
            found = "are missing" if self.features is None else "are present"
            raise InvalidScene(Problem("features", found, "offsets for affine, features for grid, none for kmeans"))
        if self.features is not None and (
            self.features.shape != (*self.labels.shape, 3) or self.features.dtype != np.uint8
        ):
            found = f"have shape {self.features.shape}, dtype {self.features.dtype}"
            raise InvalidScene(Problem("features", found, f"{(*self.labels.shape, 3)} uint8"))
        if not 0 <= self.border <= self.R // 2:
            raise InvalidScene(Problem("border", f"is {self.border}", f"0 to {self.R // 2} texels, half a map"))
        if self.K * self.maps_per_cluster != len(self.tiles) or (
            self.method == "grid" and self.n**3 != len(self.tiles)
        ):
            allowed = {"kmeans": "any number", "affine": "4 a cluster", "grid": "n^3, n from 2"}[self.method]
            raise InvalidScene(Problem("tiles", f"are {len(self.tiles):,}", allowed))
        if not np.isfinite(self.slope):
            raise InvalidScene(Problem("slope", f"is {self.slope:g}", "a finite number"))
        if (self.slopes is None) != (self.method != "affine") or (
            self.slopes is not None and (self.slopes.shape != (self.K,) or self.slopes.dtype != np.uint8)
        ):
            found = (
                "are missing" if self.slopes is None else f"have shape {self.slopes.shape}, dtype {self.slopes.dtype}"
            )
            raise InvalidScene(Problem("slopes", found, f"({self.K},) uint8 for affine, none for others"))
        if int(self.labels.max()) >= self.K:
            at = np.unravel_index(int(np.argmax(self.labels)), self.labels.shape)
            where = f"labels[{at[0]}, {at[1]}]"
            raise InvalidScene(Problem(where, f"is {self.labels.max()}", f"0 to {self.K - 1}, a cluster's number"))

    def __str__(self) -> str:
        return f"{self.method} atlas of {len(self.tiles):,} maps of {self.R}x{self.R}"

    @property
    def R(self) -> int:
        """Texels along an edge of a map."""
        return int(self.tiles.shape[1])

    @property
    def maps_per_cluster(self) -> int:
        return {"kmeans": 1, "affine": 4, "grid": len(self.tiles)}[self.method]

    @property
    def K(self) -> int:
        """Number of clusters: one more than the largest possible label."""
        return len(self.tiles) // self.maps_per_cluster

    @property
    def n(self) -> int:
        """Nodes of `grid` along each axis of feature space."""
        return max(2, round(cbrt(len(self.tiles))))

    @property
    def image(self) -> npt.NDArray[np.uint8]:
        """(rows, columns, 3) uint8: the atlas image, every tile with its gutter."""
        return octahedron.pack(self.tiles, self.border)

    def show(self, directions: npt.NDArray[np.float64], lookup: TexelLookup) -> npt.NDArray[np.float32]:
        """The decoded values (T, N, 3) of each tile in N directions: colours in 0..1, slopes in -1..1."""
        return self._decoded(octahedron.read_maps(self.tiles, directions, lookup), np.arange(len(self.tiles))[:, None])

    def specular(
        self,
        labels: npt.NDArray[np.uint16],
        features: npt.NDArray[np.uint8] | None,
        directions: npt.NDArray[np.float64],
    ) -> npt.NDArray[np.float32]:
        """The specular colours of m texels, each in its own direction: (m, 3) in 0..1.

        labels is (m,), features (m, 3) and directions (m, 3). Maps are interpolated between texel centres, as in
        atlas.glsl.
        """
        tiles, weights = self.terms(labels, np.zeros((len(labels), 3), np.uint8) if features is None else features)
        shown = octahedron.read_maps(self.tiles, directions[:, None], "bilinear", tiles)
        return np.asarray((weights[..., None] * self._decoded(shown, tiles)).sum(axis=1), np.float32)

    def _decoded(self, shown: npt.NDArray[np.float32], tiles: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """Decode bytes (..., 3) of these tiles (...) as colours or slopes."""
        if self.method != "affine":
            return shown / np.float32(255)
        colour = (tiles % 4 == 0)[..., None]
        return np.where(colour, shown / np.float32(255), (shown - ZERO_SLOPE) / np.float32(127))

    def terms(
        self, labels: npt.NDArray[np.uint16], features: npt.NDArray[np.uint8]
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
        """The tiles and weights, (m, t) each, of m texels with labels (m,) and features (m, 3); t is 1 or 4."""
        label = labels.astype(np.int32)[:, None]
        if self.method == "kmeans":
            return label, np.ones(label.shape, np.float32)
        if self.slopes is not None:
            offset = (features.astype(np.float32) - ZERO_OFFSET) / np.float32(255)
            offset *= self.slopes[label] * np.float32(self.slope / 255)
            tiles = (label * 4 + np.arange(4)).astype(np.int32)
            return tiles, np.insert(offset, 0, 1, axis=1).astype(np.float32)
        return tetrahedron(features, self.n)


def tetrahedron(features: npt.NDArray[Any], n: int) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """The nodes of an n^3 grid over 0..255 and their weights, (m, 4) each, for features (m, 3).

    Each cube is cut in six. The path from the cube's low corner to its high corner steps along the axis with the
    largest fraction first. The corners on this path span the tetrahedron. Of equal fractions the first axis comes
    first; the weight between them is zero.
    """
    place = features.astype(np.float32) * np.float32((n - 1) / 255)
    low = np.minimum(place.astype(np.int32), n - 2)
    fraction = place - low.astype(np.float32)
    order = np.argsort(-fraction, axis=1, kind="stable")
    step = np.array([n * n, n, 1], np.int32)[order]
    first = (low * np.array([n * n, n, 1], np.int32)).sum(axis=1, keepdims=True)
    nodes = np.concatenate([first, step], axis=1).cumsum(axis=1, dtype=np.int32)
    edges = np.pad(np.take_along_axis(fraction, order, axis=1), ((0, 0), (1, 1)), constant_values=((0, 0), (1, 0)))
    return nodes, edges[:, :-1] - edges[:, 1:]


@dataclass(frozen=True, eq=False, repr=False)
class BakedAtlas(Scene):
    """The atlases of all cascades of a scene, with the files that an engine needs; cascade c is entry c.

    meshes  None for a cascade without a mesh
    files   meshes and diffuse textures by name, unchanged
    facts   parameters and quality of the bake, for atlas.json

    >>> import numpy as np
    >>> from nerfbake import BakedAtlas, OctahedralAtlas
    >>> atlas = OctahedralAtlas("kmeans", np.zeros((2, 8, 8, 3), np.uint8), np.zeros((4, 4), np.uint16))
    >>> baked = BakedAtlas((atlas,), (None,), {}, {})
    >>> len(baked.atlases), baked.meshes
    (1, (None,))
    """

    atlases: tuple[OctahedralAtlas, ...]
    meshes: tuple[Mesh | None, ...]
    files: Mapping[str, bytes | memoryview]
    facts: Mapping[str, Any]

    def __str__(self) -> str:
        return "; ".join(map(str, self.atlases))
