"""What a page shows: a scene to look around in, from where, and the picture that is there at once."""

from __future__ import annotations

from dataclasses import dataclass

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.camera import Cameras
from nerfbake.scene.image import Image
from nerfbake.scene.octree import Lookup
from nerfbake.scene.page_field import PageField
from nerfbake.scene.quantised_octree import QuantisedOctree
from nerfbake.scene.radiance_field import RadianceField


@dataclass(frozen=True, eq=False)
class Page:
    """A scene to look around in.

    content  what the page carries: a PageField as it is, or a QuantisedOctree in the bytes of a .svoq
    field    what the content was made from: its place in the world, its box and its basis are the page's
    cameras  where one looks from: at first from the first of them
    cover    what that one sees, a square picture
    title    shown in the page, as text
    turns    the scene turns slowly until it is touched
    background  sRGB in 0..1; None: the reader's own, light or dark
    lookup   how the page opens, as render_field() has it

    >>> from nerfbake import Page, build_field, build_page_field, orbit_cameras, render_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=16))
    >>> cameras = orbit_cameras(field, width=32, height=32)
    >>> page = Page(build_page_field(field), field, cameras, render_field(field, cameras.cameras[0]))
    >>> print(page)
    page of a SH9 page field of 1,252 rows, 2x2x2 cells of 8^3
    """

    content: PageField | QuantisedOctree
    field: RadianceField
    cameras: Cameras
    cover: Image
    title: str = "A radiance field"
    turns: bool = True
    background: tuple[float, float, float] | None = None
    lookup: Lookup = "nearest"

    def __post_init__(self) -> None:
        width, height = self.cover.size
        if width != height:
            raise InvalidScene(Problem("the cover", f"has {width}x{height} pixels", "a square picture"))

    def __str__(self) -> str:
        return f"page of a {self.content}"
