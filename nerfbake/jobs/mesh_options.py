"""Options of meshes: the pictures that they are textured from, their size, and their file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from nerfbake import catalog
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import FRAMES
from nerfbake.jobs.devices import renderer_on
from nerfbake.jobs.files import Source, axis_option
from nerfbake.jobs.fitted_pictures import PICTURES, FittedPictures
from nerfbake.jobs.photographs import SplitViews, render_split
from nerfbake.jobs.steps import Steps
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.splats import Splats

TRIANGLES, TEXTURE = 50_000, 2048
SAMPLES = 2  # rays along each edge of a pixel: the pixels of photographs are averages, too
_SCENERY_PICTURES = 50  # two thirds of the time of 100, for 0.07 dB (docs/tuning.md)

Image = Literal["png", "jpeg", "webp"]


@dataclass(frozen=True, kw_only=True)
class MeshViews(FittedPictures):
    """The pictures that a mesh is textured from. The arguments are those of FittedPictures."""

    def split(
        self, steps: Steps, source: Source, field: RadianceField, splats: Splats | None, *, scenery: bool = False
    ) -> SplitViews:
        """Return the views to fit to and the held-out views. Raises NerfbakeError if they show something else.

        splats: those that the field was made of, which are sharper than its voxels; None: it was made of other things.
        scenery: the field is the inner cube of a scene with scenery.
        """
        shown, render = field if splats is None else splats, renderer_on(self.device, steps=steps)
        if self.views is not None:
            return self.photographs_of(steps, source, field, render)
        frames = self.frames or (_SCENERY_PICTURES if scenery else PICTURES)
        with source.blamed(steps, f"rendering {frames + FRAMES} pictures of {source.name}"):
            return render_split(shown, frames=frames, edge=self.edge, samples=SAMPLES, framed=field, render=render)


@dataclass(frozen=True, kw_only=True)
class MeshOptions:
    """Options of a mesh.

    triangles  the largest number of triangles; several numbers, the largest first, make levels of detail
    texture    texels along an edge of the texture; a coarser level has half as many
    box        x0, y0, z0, x1, y1, z1 of a box in world coordinates; what is outside is left out; None: no box
    largest    keep the largest connected part alone
    seed       seed of the highlights' MLP: the same seed gives the same bytes
    """

    triangles: tuple[int, ...] = (TRIANGLES,)
    texture: int = TEXTURE
    box: tuple[float, float, float, float, float, float] | None = None
    largest: bool = False
    seed: int = 0

    def require(self) -> None:
        """Raise UsageError for levels of detail that do not become coarser. Call it before doing any work."""
        pairs = zip(self.triangles, self.triangles[1:], strict=False)
        if not self.triangles or min(self.triangles) < 4 or any(finer <= coarser for finer, coarser in pairs):
            found = ", ".join(f"{count:,}" for count in self.triangles) or "none"
            raise UsageError(f"`triangles` are {found}; allowed: 4 or more, each level fewer than the one before")


@dataclass(frozen=True, kw_only=True)
class MeshFile:
    """Options of the file.

    in_up  for a .glb: the up axis of the field, which the nodes rotate to y, glTF's; None: z
    lit    for a .glb: a rough material that is lit, with normals; False: the colours are shown as they are
    image  coding of the texture; None: JPEG, or PNG in a folder
    environment  for a .glb: a map of the light of the photographs, from which materials are estimated
    """

    in_up: Literal["y", "z"] | None = None
    lit: bool = False
    image: Image | None = None
    environment: str | None = None

    def options(self, form: catalog.Format) -> dict[str, Any]:
        """Return the options of the format. Those that are given count even if the format does not take them."""
        default = {"image": "jpeg", "quantised": True, "reversible": True, "up": "z"}
        given = {"lit": self.lit or self.environment is not None or None, "image": self.image}
        fitting = {name: value for name, value in default.items() if form.choices(name)}
        fitting |= axis_option(form, self.in_up)
        return fitting | {name: value for name, value in given.items() if value is not None}
