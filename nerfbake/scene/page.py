"""The contents of a page for viewing: a scene, cameras, and a cover picture that is shown at once.

The scene is a radiance field as a fragment shader reads it, with two dependent fetches per step and a fetch of the
colours, or triangles with all data for their highlights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Ints, Points
from nerfbake.kernels.maths.affine import transform_points
from nerfbake.kernels.soundness import plural
from nerfbake.scene.atlas import OctahedralAtlas
from nerfbake.scene.basis import Basis
from nerfbake.scene.camera import Cameras
from nerfbake.scene.compact_repr import CompactRepr, notebook_html
from nerfbake.scene.image import Image
from nerfbake.scene.mesh import Composite, Mesh
from nerfbake.scene.octree import Lookup
from nerfbake.scene.page_splats import PageSplats
from nerfbake.scene.quantised_octree import QuantisedOctree
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.stage1 import SpecularField

CELL, BLOCK, OCTANT = 8, 4, 2  # voxels along an edge of a top cell, of each of its eight blocks, and of their octants
WHOLE = 1 << 30  # top cells from this value on have one row
ALL = 255  # in place of a block's count: the whole block has one row
WIDE = 8  # a block's lowest flag of an octant that has one row
FARTHEST = 15  # largest distance in top cells
LARGEST = float(np.finfo(np.float16).max)


@dataclass(frozen=True, eq=False, repr=False)
class PageField(CompactRepr):
    """Voxels in a grid of top cells of 8^3, each divided into eight blocks of 4^3, and a row of colours for each voxel.

    top     (X, Y, Z) int32. Negative: the cell is empty, and so is every cell closer than -top cells along all three
            axes, 15 at most; from 0: the number of a leaf; from 2^30: the whole cell has row top - 2^30
    blocks  (8 leaves, 4) uint32, block 4 x + 2 y + z of each leaf: the mask's lower and upper half, the first row,
            and the number of bits set in the lower half; 255 there: the whole block has that row.
            Bit 16 x + 4 y + z of a mask is a voxel of the block; its row is the first row plus the number of set
            bits below its bit. Bit 8 + 4 x + 2 y + z of the fourth number: this octant of the block, 2^3 voxels, has
            one row, that of its lowest voxel; the mask's bits of its other voxels are not set
    texels  (rows, T, 4) float16, T = 1 + 3 ceil((B - 1) / 4): red, green and blue of the first coefficient and the
            density; then red, green, blue of the second, of the third, ..., without gaps; the rest is zeros
    density_unit  densities are multiples of this, a power of two, in 1/world unit
    place   (3, 4) float64: voxels = place @ (world, 1)
    box     (2, 3) float64: in voxels, around everything that is not empty, within the grid
    basis   SH or RGBA, in the field's own axes

    >>> import numpy as np
    >>> from nerfbake import build_field, build_page_field, sample_n3tree
    >>> page_field = build_page_field(build_field(sample_n3tree(resolution=16)))
    >>> page_field.top.shape, page_field.texels.shape[1:]
    ((2, 2, 2), (7, 4))
    """

    top: npt.NDArray[np.int32]
    blocks: npt.NDArray[np.uint32]
    texels: npt.NDArray[np.float16]
    density_unit: float
    place: Points
    box: Points
    basis: Basis

    def __post_init__(self) -> None:
        leaves, rows = len(self.blocks) // 8, len(self.texels)
        for name, shape, dtype in (
            ("top", self.top.shape[:3], np.int32),
            ("blocks", (8 * leaves, 4), np.uint32),
            ("texels", (rows, texels_of(self.basis), 4), np.float16),
            ("place", (3, 4), np.float64),
            ("box", (2, 3), np.float64),
        ):
            array = getattr(self, name)
            if array.shape != shape or array.dtype != dtype or (array.size == 0 and name == "top"):
                found = f"has shape {array.shape}, dtype {array.dtype}"
                raise InvalidScene(Problem(f"the page field's {name}", found, f"{shape} {np.dtype(dtype)}"))

    def __str__(self) -> str:
        grid = "x".join(map(str, self.top.shape))
        return f"{self.basis} page field of {len(self.texels):,} rows, {grid} cells of {CELL}^3"

    def rows(self, points: Points) -> npt.NDArray[np.int64]:
        """The row (m,) at each point (m, 3) in voxels; -1 if there is none. The shader's lookup, line by line."""
        found = np.full(len(points), -1, np.int64)
        at = np.flatnonzero(((points >= 0) & (points < CELL * np.array(self.top.shape))).all(axis=1))
        x, y, z = points[at].astype(np.int64).T
        cell = self.top[x >> 3, y >> 3, z >> 3].astype(np.int64)
        found[at[cell >= WHOLE]] = cell[cell >= WHOLE] - WHOLE
        inside = (cell >= 0) & (cell < WHOLE)
        at, cell, x, y, z = at[inside], cell[inside], x[inside], y[inside], z[inside]
        block = self.blocks[8 * cell + part_at(x, y, z, BLOCK)].astype(np.int64)
        x, y, z = np.array([x, y, z]) & np.where(block[:, 3] >> WIDE + part_at(x, y, z, OCTANT) & 1, 2, 3)
        bit = (x & 1) << 4 | y << 2 | z
        half = np.where(x > 1, block[:, 1], block[:, 0])
        below = np.bitwise_count(half & (1 << bit) - 1)
        whole = block[:, 3] == ALL
        row = block[:, 2] + np.where(whole, 0, below + np.where(x > 1, block[:, 3] & 255, 0))
        found[at] = np.where(half >> bit & 1, row, -1)
        return found

    def sample(self, points: Points) -> npt.NDArray[np.float32]:
        """The values (m, 3 B + 1) of the voxels around world points (m, 3); zeros if there is none."""
        rows = self.rows(transform_points(points, self.place))
        found = np.zeros((len(points), self.basis.data_dim), np.float32)
        found[rows >= 0] = self.values[rows[rows >= 0]]
        return found

    @property
    def values(self) -> npt.NDArray[np.float32]:
        """(rows, 3 B + 1) float32: coefficients of red, of green, of blue, then the density per world unit."""
        B, flat = self.basis.size, self.texels.reshape(-1, 4 * texels_of(self.basis)).astype(np.float32)
        values = np.empty((len(flat), 3 * B + 1), np.float32)
        for channel in range(3):
            values[:, channel * B] = flat[:, channel]
            values[:, channel * B + 1 : (channel + 1) * B] = flat[:, 4 + channel : 4 + 3 * (B - 1) : 3]
        values[:, 3 * B] = flat[:, 3] * np.float32(self.density_unit)
        return values


def part_at(x: Ints, y: Ints, z: Ints, edge: int) -> Ints:
    """The number 4 x + 2 y + z of voxels' blocks in their cells (edge BLOCK), or of octants in blocks (edge OCTANT)."""
    return np.asarray(4 * (x // edge & 1) + 2 * (y // edge & 1) + (z // edge & 1), np.int64)


def grid_of(box: Points) -> tuple[npt.NDArray[np.int64], tuple[int, int, int]]:
    """The voxel at which a grid around this box starts, and its top cells along x, y, z."""
    start = (box[0] // CELL).astype(np.int64) * CELL
    x, y, z = (-(-(np.ceil(box[1]).astype(np.int64) - start) // CELL)).tolist()
    return start, (x, y, z)


def density_unit(densest: float) -> float:
    """The unit of densities in float16.

    1 if float16 can represent the largest density; else the power of two that scales it just below float16's maximum.
    """
    return 1.0 if 1 <= densest <= LARGEST else float(2.0 ** (np.frexp(densest)[1] - 15))


def texels_of(basis: Basis) -> int:
    """RGBA texels of a row."""
    return 1 + 3 * -(-(basis.size - 1) // 4)


@dataclass(frozen=True, eq=False, repr=False)
class PageSurface(CompactRepr):
    """A mesh for each cascade, and what is added to its diffuse colour: nothing, an atlas, an MLP, or a choice of both.

    meshes   with an atlas or an MLP: with texture coordinates, and the diffuse colour as their texture
    atlases  one per cascade, all of one method; none: ()
    fields   feature textures with the MLP that they share, one per cascade; none: ()

    >>> from nerfbake import build_page_surface, sample_stage1
    >>> surface = build_page_surface(sample_stage1(resolution=16))
    >>> surface.highlights
    ('mlp_constants', 'mlp_textures')
    >>> print(surface)
    9,216 triangles, MLP 6-32-3
    """

    meshes: tuple[Mesh, ...]
    atlases: tuple[OctahedralAtlas, ...] = ()
    fields: tuple[SpecularField, ...] = ()

    def __post_init__(self) -> None:
        for name, parts in (("atlases", self.atlases), ("feature textures", self.fields)):
            if parts and len(parts) != len(self.meshes):
                found, allowed = f"are {len(parts)}", f"{len(self.meshes)}, one for each mesh"
                raise InvalidScene(Problem(f"the {name}", found, allowed))
        if len({atlas.method for atlas in self.atlases}) > 1:
            raise InvalidScene(Problem("the atlases", "are of several methods", "one for all cascades"))

    def __str__(self) -> str:
        triangles = sum(len(mesh.faces) for mesh in self.meshes)
        ways = [str(atlas) for atlas in self.atlases[:1]]
        ways += [field.mlp_text for field in self.fields[:1]]
        return ", ".join([plural(triangles, "triangle"), *ways])

    @property
    def highlights(self) -> tuple[str, ...]:
        """The available rendering methods, by their names in the page's shader."""
        atlas = tuple(atlas.method for atlas in self.atlases[:1])
        if self.is_deep:
            return (*atlas, "mlp_constants")
        return atlas + (("mlp_constants", "mlp_textures") if self.fields else ())

    @property
    def is_deep(self) -> bool:
        """Whether the MLP is not nerf2mesh's, of three features and two layers without biases."""
        return any(field.channels != 3 or bool(field.middle or field.biases) for field in self.fields[:1])


COVER = 320  # default pixels along an edge of the cover


@dataclass(frozen=True, eq=False, repr=False)
class Page(CompactRepr):
    """A page for viewing a scene.

    content  the data of the page: a PageField, a PageSurface or PageSplats, a QuantisedOctree stored as the bytes of a
             .svoq, or such bytes
    field    the field that the content was made from: it defines the page's position in the world, its box and its
             basis; None for a PageSurface and PageSplats
    cameras  the views; the page opens with the first
    photographs  a JPEG of each camera, to be shown over the scene; (): none
    cover    the picture of the first camera, square
    title    shown in the page, as text
    turns    the scene rotates slowly until it is touched
    background  sRGB in 0..1; None: the reader's own, light or dark
    lookup   the initial setting, as in render_field()
    meshes   triangles shown with a field, in its world; (): none, or those of a PageSurface
    composite  the initial setting for field and meshes, as in render_field_and_meshes()
    around   fields of the shells around the inner cube, of one resolution, from the innermost one; (): no scenery

    >>> from nerfbake import Page, build_field, build_page_field, orbit_cameras, render_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=16))
    >>> cameras = orbit_cameras(field, width=32, height=32)
    >>> page = Page(build_page_field(field), field, cameras, render_field(field, cameras.cameras[0]))
    >>> print(page)
    page of a SH9 page field of 573 rows, 2x2x2 cells of 8^3
    """

    content: PageField | QuantisedOctree | PageSurface | PageSplats | bytes
    field: RadianceField | None
    cameras: Cameras
    cover: Image
    title: str = "A radiance field"
    turns: bool = True
    background: tuple[float, float, float] | None = None
    lookup: Lookup = "nearest"
    meshes: tuple[Mesh, ...] = ()
    composite: Composite = "stop"
    around: tuple[PageField, ...] = ()
    photographs: tuple[bytes, ...] = ()

    def __post_init__(self) -> None:
        width, height = self.cover.size
        if width != height:
            raise InvalidScene(Problem("the cover", f"has {width}x{height} pixels", "a square picture"))
        if (self.field is None) != isinstance(self.content, PageSurface | PageSplats):
            found = "is missing" if self.field is None else "is present"
            raise InvalidScene(Problem("the field", found, "a field for voxels, none for triangles and splats"))
        if len(self.photographs) not in (0, len(self.cameras.cameras)):
            found = f"are {len(self.photographs):,}"
            raise InvalidScene(Problem("the photographs", found, f"{len(self.cameras.cameras):,}, one per camera"))
        if len({shell.top.shape for shell in self.around}) > 1:
            raise InvalidScene(Problem("the shells", "have grids of several sizes", "one size"))
        if self.meshes and self.field is None:
            raise InvalidScene(
                Problem("the meshes", "are combined with a surface", "meshes with a field, or a surface alone")
            )

    def _repr_html_(self) -> str | None:
        """The page, for a notebook cell."""
        return notebook_html(self)

    def __str__(self) -> str:
        if isinstance(self.content, bytes):
            return f"page of a compressed octree of {len(self.content):,} bytes"
        return f"page of {self.content}" if self.field is None else f"page of a {self.content}"
