"""Triangles for pages to look around in: nerf2mesh's stage 1, the atlases baked from it, meshes beside a field."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import nerfbake
from nerfbake import io, memory
from nerfbake.jobs.files import Source
from nerfbake.jobs.pictures import PlacedMesh
from nerfbake.jobs.steps import Steps
from nerfbake.jobs.views import page_views

_COPIES = 4  # of triangles while a page is made of them: as they are, as bytes, packed, in base64
Colour = tuple[float, float, float]


class Look(NamedTuple):
    """How a page is looked at: cameras: a capture to look from, or None; the others as Page has them."""

    title: str
    cameras: str | None
    background: Colour | None
    lookup: Literal["nearest", "trilinear"]


class Beside(NamedTuple):
    """What a page has beside its field, as Page takes it."""

    meshes: tuple[nerfbake.Mesh, ...] = ()
    composite: Literal["stop", "ztest"] = "stop"

    @staticmethod
    def of(mesh: PlacedMesh | None) -> Beside:
        """The triangles of a file; nothing where there is none. Raises NerfbakeError."""
        if mesh is None:
            return Beside()
        meshes = mesh.read().meshes
        with io.blame(mesh.path):
            memory.require("the page's triangles and textures", _COPIES * memory.size_of(meshes))
        return Beside(meshes, mesh.how)

    def render(self, field: nerfbake.RadianceField, view: nerfbake.Camera, **options: Any) -> nerfbake.Image:
        """What is seen of both at first; options go to render_field()."""
        if not self.meshes:
            return nerfbake.render_field(field, view, **options)
        meshes = nerfbake.Meshes(self.meshes)
        return nerfbake.render_field_and_meshes(field, meshes, view, how=self.composite, **options)


def surface_page(
    steps: Steps, source: Source, scene: nerfbake.Stage1 | nerfbake.BakedAtlas, stage1: str | None, look: Look
) -> nerfbake.Page:
    """The page of a folder's triangles. stage1: of an atlas the folder whose MLP is shown, too.

    Raises NerfbakeError.
    """
    mlp = None
    if stage1 is not None:
        with steps.phase(f"reading {stage1}"):
            mlp = io.load_folder(stage1, nerfbake.Stage1)
    with source.blamed(steps, "arranging the triangles"):
        surface = nerfbake.build_page_surface(scene, stage1=mlp)
    views, first = page_views(steps, scene, look.cameras, name=source.name)
    with source.blamed(steps, "rendering the cover"):
        cover = nerfbake.render_stage1(scene, first, background=look.background)
    return nerfbake.Page(
        surface, None, views, cover, look.title, turns=look.cameras is None, background=look.background
    )
