"""Triangles with highlights as a page shows them: all that gives them their colours, side by side."""

from __future__ import annotations

from dataclasses import dataclass

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.soundness import plural
from nerfbake.scene.atlas import OctahedralAtlas
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.shown import Shown
from nerfbake.scene.specular import SpecularField


@dataclass(frozen=True, eq=False, repr=False)
class PageSurface(Shown):
    """A mesh for each cascade, and what is added to its diffuse colour: an atlas, an MLP, or both to choose from.

    meshes   with texture coordinates, and the diffuse colour as their texture
    atlases  one a cascade, all of one method; none: ()
    fields   feature textures with the MLP that they share, one a cascade; none: ()

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
        if not (self.atlases or self.fields):
            raise InvalidScene(Problem("the surface", "has neither atlas nor MLP", "one of them, or both"))

    def __str__(self) -> str:
        triangles = sum(len(mesh.faces) for mesh in self.meshes)
        ways = [str(atlas) for atlas in self.atlases[:1]]
        ways += [f"MLP 6-{field.w0.shape[1]}-3" for field in self.fields[:1]]
        return f"{plural(triangles, 'triangle')}, {', '.join(ways)}"

    @property
    def highlights(self) -> tuple[str, ...]:
        """The ways to show them, by the names that the page's shader has for them."""
        atlas = tuple(atlas.method for atlas in self.atlases[:1])
        return atlas + (("mlp_constants", "mlp_textures") if self.fields else ())
