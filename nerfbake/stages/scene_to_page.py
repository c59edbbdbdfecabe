"""Scene with a radiance field, or splats -> an HTML page that displays it."""

from __future__ import annotations

from nerfbake.scene.page import COVER, Page
from nerfbake.scene.quantised_octree import QuantisedOctree
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.splats import Splats
from nerfbake.stages.field_to_image import render_field
from nerfbake.stages.field_to_page_field import build_page_field
from nerfbake.stages.scene_to_cameras import orbit_cameras
from nerfbake.stages.scene_to_field import FieldSource, build_field
from nerfbake.stages.splats_to_image import render_splats
from nerfbake.stages.splats_to_page_splats import build_page_splats


def view(scene: FieldSource | RadianceField | QuantisedOctree | Splats, *, title: str = "A radiance field") -> Page:
    """Return an interactive page of a scene. A notebook displays it as the output of its cell.

    The page contains the values as float16, the compressed data of a QuantisedOctree, or splats, which it draws as
    splats. save() writes it as .html. Raises InvalidScene for a scene that cannot be rendered, UsageError for a type of
    scene that has no field.

    >>> from nerfbake import sample_n3tree, view
    >>> page = view(sample_n3tree(resolution=16), title="A sample")
    >>> print(page)
    page of a SH9 page field of 573 rows, 2x2x2 cells of 8^3
    """
    if isinstance(scene, Splats):
        around = orbit_cameras(scene, width=COVER, height=COVER)
        return Page(build_page_splats(scene), None, around, render_splats(scene, around.cameras[0]), title)
    shown = scene.restored() if isinstance(scene, QuantisedOctree) else scene
    field = shown if isinstance(shown, RadianceField) else build_field(shown)
    content = scene if isinstance(scene, QuantisedOctree) else build_page_field(field)
    cameras = orbit_cameras(field, width=COVER, height=COVER)
    return Page(content, field, cameras, render_field(field, cameras.cameras[0]), title)
