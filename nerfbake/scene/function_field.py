"""A radiance field that is a function of position and direction: a network that another program trained."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

import numpy as np

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Floats, Points, Singles
from nerfbake.kernels.dilation import dilated
from nerfbake.kernels.maths.affine import compose, rotate, transform_points
from nerfbake.kernels.maths.elementary import sigmoid
from nerfbake.scene.base import Scene, edge_problems, place_problems, require_shape
from nerfbake.scene.camera import Cameras
from nerfbake.scene.network import HashGrid, Network

CHUNK = 1 << 15  # points at a time, which limits the memory for their features
_GRID, _COARSE_GRID = 128, 64  # cells along an edge of `filled`: for hash grids, and for larger perceptrons
_CLEAR = 1e-4  # optical thickness of a cell that counts as empty
MAX_CASCADES = 8


class Fields(Protocol):
    """What computes density and colours in the field's own coordinates: a Network, or many of them side by side."""

    @property
    def numbers(self) -> int: ...

    def features(self, points: Singles) -> Singles: ...

    def density_of(self, features: Singles) -> Singles: ...

    def logits(self, features: Singles, directions: Points) -> Singles: ...

    def problems(self) -> list[Problem]: ...


class Occupancy(NamedTuple):
    """Which cells may have a density, as the training program recorded it. The networks have any values elsewhere.

    cells  (C, X, Y, Z) bool: the cells of nested boxes
    boxes  (C, 2, 3) float64: lowest and highest corner of each, in the trained coordinates, the smallest first. The
           smallest one that contains a point decides; outside all of them the density is 0
    """

    cells: Bits
    boxes: Points

    def at(self, points: Points) -> Bits:
        """Return whether there may be a density at points (m, 3), in the trained coordinates."""
        found, counts = np.zeros(len(points), bool), np.array(self.cells.shape[1:])
        for cells, box in zip(reversed(self.cells), reversed(self.boxes), strict=True):
            place = np.floor((points - box[0]) * (counts / (box[1] - box[0]))).astype(np.int64)
            inside = ((place >= 0) & (place < counts)).all(axis=1)
            x, y, z = place[inside].T
            found[inside] = cells[x, y, z]
        return found


@dataclass(frozen=True, eq=False, repr=False)
class FunctionField(Scene):
    """A trained radiance field that is evaluated at any point. Source: docs/fields.md.

    network     density and colours in the network's coordinates
    frame       (3, 4) float64, a rotation times a scale, and a translation: from the world to the trained coordinates
    box         (2, 3) float64, trained coordinates: the part of space that is baked, of a contracted field the inner
                cube. Unless the field is contracted, it is empty outside
    unit        (2, 3) float64, trained (or contracted) coordinates: what becomes 0 and 1 in the network's coordinates
    contracted  x becomes x for |x| < 1, else (2 - 1/|x|) x/|x|, where |x| is the largest coordinate: all of space
    occupied    the cells that may have a density; None: all
    cameras     those that the field was trained with, in the world; None: not in the file
    background  the colour behind the field; last: the colour of a ray's last sample; None: unknown
    near, far   where rays began and ended in training, in trained coordinates
    dialect     the program that trained it
    notes       what was ignored or assumed, one line each

    >>> import numpy as np
    >>> from nerfbake import FunctionField
    >>> from nerfbake.scene.lattice_field import Activation
    >>> from nerfbake.scene.network import Frequencies, HeadColour, Mlp, Network
    >>> sum_ = Mlp((np.ones((1, 3), np.float32),), (np.zeros(1, np.float32),))
    >>> grey = HeadColour(Mlp((np.zeros((3, 1), np.float32),), (np.zeros(3, np.float32),)), "none")
    >>> one = np.ones(1, np.float32)
    >>> network = Network(Frequencies(np.zeros(0)), sum_, one, 0.0, Activation("relu"), grey)
    >>> field = FunctionField(network, np.eye(3, 4), np.array([[-1.0] * 3, [1.0] * 3]))
    >>> field.density(np.array([[0.5, 0.25, 0.0], [-0.5, 0.0, 0.0], [2.0, 2.0, 2.0]]))[0]
    array([0.75, 0.  , 0.  ], dtype=float32)
    """

    network: Fields
    frame: Floats
    box: Points
    unit: Points | None = None
    contracted: bool = False
    occupied: Occupancy | None = None
    cameras: Cameras | None = None
    background: tuple[float, float, float] | Literal["last"] | None = None
    near: float = 0.0
    far: float = np.inf
    dialect: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_shape("the field's frame", self.frame, (3, 4), np.float64)
        require_shape("the field's box", self.box, (2, 3), np.float64)
        if self.unit is not None:
            require_shape("the field's unit cube", self.unit, (2, 3), np.float64)
        if self.occupied is not None:
            cells, boxes = self.occupied
            C = len(cells) if cells.ndim == 4 and 0 not in cells.shape else 0
            if cells.dtype != np.bool_ or not 1 <= C <= MAX_CASCADES:
                found = f"has shape {cells.shape}, dtype {cells.dtype}"
                raise InvalidScene(Problem("the occupancy", found, f"(C, X, Y, Z) bool, C of 1 to {MAX_CASCADES}"))
            require_shape("the occupancy's boxes", boxes, (C, 2, 3), np.float64)

    def __str__(self) -> str:
        inside = "all of space" if self.contracted else "a box"
        return f"field of {self.network.numbers:,} numbers over {inside}: {self.network}"

    # -- coordinates -------------------------------------------------------------------------------------------
    @property
    def scale(self) -> float:
        """Trained units per world unit."""
        return float(np.sqrt(np.square(self.frame[:, 0]).sum()))

    @property
    def world_box(self) -> Points:
        """(2, 3) the smallest box in the world around `box`."""
        corners = self._in_world(np.array([[self.box[i >> a & 1, a] for a in range(3)] for i in range(8)]))
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    def _in_world(self, own: Points) -> Points:
        """Return trained coordinates (m, 3) in the world."""
        return rotate(own - self.frame[:, 3], self.frame[:, :3].T / self.scale**2)

    @property
    def space(self) -> Points:
        """(2, 3) what `filled` covers: the box, or all of contracted space, a cube from -2 to 2."""
        return np.array([[-2.0] * 3, [2.0] * 3]) if self.contracted else self.box

    @cached_property
    def filled(self) -> Bits:
        """(G, G, G) bool: the cells [x][y][z] of `space` that may have a density that can be seen.

        The density is evaluated once, at the centres of cells; a cell is also filled if a neighbour has a density.
        """
        hashed = isinstance(self.network, Network) and isinstance(self.network.encoding, HashGrid)
        G = _GRID if hashed else _COARSE_GRID
        memory.grown(self, "the filled cells", G**3)
        found, (low, high) = np.zeros((G, G, G), bool), self.space
        planes = max(1, CHUNK // G**2)
        for begin in progress.each(range(0, G, planes)):
            cells = np.argwhere(np.ones((min(planes, G - begin), G, G), bool)) + np.array([begin, 0, 0])
            places = low + (cells + 0.5) * ((high - low) / G)
            longer = np.ones(len(cells))
            if self.contracted:
                far = np.maximum(np.abs(places).max(axis=1), 1)
                longer = 1 / (2 - far)  # the largest coordinate before the contraction
                places *= (longer / far)[:, None]
            length = float((high - low).max()) / G / self.scale * longer**2
            found[begin : begin + planes] = (self.density(self._in_world(places))[0] * length > _CLEAR).reshape(
                -1, G, G
            )
        found = dilated(found)
        if self.contracted:  # the outermost cells reach to infinity
            for axis in range(3):
                np.moveaxis(found, axis, 0)[[0, -1]] = True
        return found

    def in_trained_world(self) -> FunctionField:
        """Return the field, and its cameras, in the coordinates that it was trained in."""
        cameras = self.cameras and self.cameras.transformed(self.frame)
        return replace(self, frame=np.eye(3, 4), cameras=cameras)

    def _places(self, points: Points) -> tuple[Singles, Bits]:
        """Return world points in the network's coordinates (m, 3), and which of them may have a density (m,)."""
        own = transform_points(points, self.frame)
        inside = np.ones(len(own), bool)
        if not self.contracted:
            inside = ((own > self.box[0]) & (own < self.box[1])).all(axis=1)
        if self.occupied is not None:
            inside &= self.occupied.at(own)
        # From here in float32, as the programs compute: a level of 2,048 nodes shows every other rounding.
        place = own.astype(np.float32)
        if self.contracted:
            far = np.maximum(np.abs(place).max(axis=1), np.float32(1))[:, None]
            place = (2 - 1 / far) * (place / far)
        if self.unit is not None:
            low, high = self.unit
            place = (place - low.astype(np.float32)) / (high - low).astype(np.float32)
        return place, inside

    # -- values ------------------------------------------------------------------------------------------------
    def density(self, points: Points) -> tuple[Singles, Singles]:
        """Return the density (m,) float32 per world unit at points (m, 3) of the world, and their features (m, G).

        Features are inputs of logits(); they are 0 where the density must be 0.
        """
        density, features = np.zeros(len(points), np.float32), None
        for begin in range(0, len(points), CHUNK):
            places, inside = self._places(np.asarray(points[begin : begin + CHUNK], np.float64))
            found = self.network.features(places[inside])
            if features is None:
                features = np.zeros((len(points), len(found)), np.float32)
            rows = begin + np.flatnonzero(inside)
            density[rows] = self.network.density_of(found) * np.float32(self.scale)
            features[rows] = found.T
        if features is None:
            features = np.zeros((0, len(self.network.features(np.zeros((0, 3), np.float32)))), np.float32)
        return density, features

    def logits(self, features: Singles, directions: Points) -> Singles:
        """(m, 3) float32: the colours before the sigmoid, of features (m, G) in unit directions (m, 3) of the world."""
        out = np.empty((len(features), 3), np.float32)
        turn = self.frame[:, :3] / self.scale
        for begin in range(0, len(features), CHUNK):
            part = slice(begin, begin + CHUNK)
            own = rotate(np.asarray(directions[part], np.float64), turn)
            out[part] = self.network.logits(np.ascontiguousarray(features[part].T), own).T
        return out

    def colour(self, features: Singles, directions: Points) -> Singles:
        """(m, 3) float32 sRGB colours of features (m, G) in unit directions (m, 3) of the world."""
        return sigmoid(self.logits(features, directions)).astype(np.float32)

    # -- checks ------------------------------------------------------------------------------------------------
    def structure_problems(self) -> list[Problem]:
        found = place_problems("the field's frame", self.frame) + place_problems("the field's box", self.box)
        if found:
            return found
        turned = self.frame[:, :3] / max(self.scale, 1e-300)
        if not self.scale > 0 or np.abs(compose(turned, turned.T) - np.eye(3)).max() > 1e-3:
            return [
                Problem("the field's frame", "is no rotation times a scale", "axes of equal length, at right angles")
            ]
        found = edge_problems("the field's box", self.box[1] - self.box[0])
        if self.unit is not None:
            found += edge_problems("the field's unit cube", self.unit[1] - self.unit[0])
        if self.occupied is not None:
            boxes = self.occupied.boxes
            found += edge_problems("the occupancy's boxes", boxes[:, 1] - boxes[:, 0])
        return found

    def value_problems(self) -> list[Problem]:
        return self.network.problems()
