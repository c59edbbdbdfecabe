"""What a page shows: a scene to look around in, from where, and the picture that is there at once."""

from __future__ import annotations

from dataclasses import dataclass

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.camera import Cameras
from nerfbake.scene.image import Image
from nerfbake.scene.mesh import Composite, Mesh
from nerfbake.scene.octree import Lookup
from nerfbake.scene.page_field import PageField
from nerfbake.scene.page_surface import PageSurface
from nerfbake.scene.quantised_octree import QuantisedOctree
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.shown import Shown, encoded, framed

COVER = 320  # pixels along an edge of the cover, as we make it


@dataclass(frozen=True, eq=False, repr=False)
class Page(Shown):
    """A scene to look around in.

    content  what the page carries: a PageField or a PageSurface as it is, a QuantisedOctree in the bytes of a .svoq, or
             such bytes
    field    what the content was made from: its place in the world, its box and its basis are the page's; None of a
             PageSurface
    cameras  where one looks from: at first from the first of them
    cover    what that one sees, a square picture
    title    shown in the page, as text
    turns    the scene turns slowly until it is touched
    background  sRGB in 0..1; None: the reader's own, light or dark
    lookup   how the page opens, as render_field() has it
    meshes   triangles beside a field, in its world; (): none, or a PageSurface's own
    composite  how both are seen at first, as render_field_and_meshes() has it

    >>> from nerfbake import Page, build_field, build_page_field, orbit_cameras, render_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=16))
    >>> cameras = orbit_cameras(field, width=32, height=32)
    >>> page = Page(build_page_field(field), field, cameras, render_field(field, cameras.cameras[0]))
    >>> print(page)
    page of a SH9 page field of 1,252 rows, 2x2x2 cells of 8^3
    """

    content: PageField | QuantisedOctree | PageSurface | bytes
    field: RadianceField | None
    cameras: Cameras
    cover: Image
    title: str = "A radiance field"
    turns: bool = True
    background: tuple[float, float, float] | None = None
    lookup: Lookup = "nearest"
    meshes: tuple[Mesh, ...] = ()
    composite: Composite = "stop"

    def __post_init__(self) -> None:
        width, height = self.cover.size
        if width != height:
            raise InvalidScene(Problem("the cover", f"has {width}x{height} pixels", "a square picture"))
        if (self.field is None) != isinstance(self.content, PageSurface):
            found = "is missing" if self.field is None else "is there"
            raise InvalidScene(Problem("the field", found, "one of what is marched, none of triangles"))
        if self.meshes and self.field is None:
            raise InvalidScene(Problem("the meshes", "stand beside a surface", "a field, or the surface alone"))

    def _repr_html_(self) -> str:
        """Itself, in the cell of a notebook."""
        return framed(encoded(self), scripts=True, height=500)

    def __str__(self) -> str:
        if isinstance(self.content, bytes):
            return f"page of a compressed octree of {len(self.content):,} bytes"
        return f"page of {self.content}" if self.field is None else f"page of a {self.content}"
