"""Pictures of a file: one or many, beside each other, moving, with depth and alpha."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import nerfbake
from nerfbake import catalog, io
from nerfbake.errors import UsageError
from nerfbake.jobs.files import AnySource, Source, as_source
from nerfbake.jobs.grids import AS_IT_IS, Choice
from nerfbake.jobs.lattices import octree_of, tell_notes
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import views_of

Field: TypeAlias = "nerfbake.RadianceField | nerfbake.LatticeField"

EDGE = 800  # pixels of an orbit's pictures


class Shots(NamedTuple):
    """Which views are rendered.

    cameras    a capture; None: an orbit around the scene
    frame      which of the cameras, from 0
    every      all of the cameras
    turntable  so many pictures around the scene
    size       (W, H) pixels; None: the cameras', 800 x 800 for an orbit
    samples    rays along each edge of a pixel; None: as the cameras have it, or 1
    """

    cameras: str | None = None
    frame: int = 0
    every: bool = False
    turntable: int | None = None
    size: tuple[int, int] | None = None
    samples: int | None = None

    @property
    def several(self) -> bool:
        return self.every or self.turntable is not None

    def require(self) -> None:
        """Raises UsageError, before any work is done, for what contradicts itself."""
        if self.turntable and self.cameras:
            raise UsageError("`turntable` goes around the scene; allowed: it or `cameras`")

    def of(self, steps: Steps, field: Field, name: str) -> nerfbake.Cameras:
        """The cameras; name: the scene's, for errors. Raises UsageError where there is no such frame."""
        frames = self.turntable or 1
        views = views_of(
            steps, field, self.cameras, name=name, frames=frames, edge=EDGE, size=self.size, samples=self.samples
        )
        if not self.several:
            if not 0 <= self.frame < len(views.cameras):
                raise UsageError(f"`frame` is {self.frame}; allowed: 0 to {len(views.cameras) - 1}")
            views = nerfbake.Cameras(views.cameras[self.frame : self.frame + 1], samples=views.samples)
        with io.blame(self.cameras or name):
            views.require_covered()
        return views


ONE_SHOT = Shots()


class Pictures(NamedTuple):
    """Where pictures go, and what is written beside each of them.

    out    of one picture a .png, or '-' for stdout; of several a .gif, a .png that shows them all, or a folder
    depth  png: NAME.depth.png, 16 bits, thousandths of a world unit; npy: NAME.depth.npy, world units
    alpha  NAME.alpha.png, white is opaque
    force  replace what exists
    """

    out: str
    depth: Literal["png", "npy"] | None = None
    alpha: bool = False
    force: bool = False

    def together(self, *, several: bool) -> str | None:
        """The type of scene that several pictures make in one file; None where each is a file of its own."""
        return next((kind for kind in ("Animation", "Image") if several and catalog.is_ending(self.out, kind)), None)

    def require(self, *, several: bool) -> None:
        """Raises, before any work is done, if they could not be written; of a folder settle() tells more."""
        together = self.together(several=several)
        if several and self.out == io.STREAM:
            raise UsageError("stdout takes one picture; allowed for several: a .gif, a .png or a folder")
        if (self.depth or self.alpha) and (together or self.out == io.STREAM):
            raise UsageError("`depth` and `alpha` write files beside a picture; allowed: a .png of one, or a folder")
        if together or not several:
            io.format_for(self.out, together or "Image")
            for path in (self.out, *self.beside(self.out)):
                io.require_absent(path, force=self.force)

    def settle(self, views: Sequence[nerfbake.Camera], *, several: bool) -> list[str]:
        """Each picture's path. Raises OutputError if one of them, or of what stands beside it, cannot be written."""
        paths = [str(Path(self.out) / f"{view.name}.png") if several else self.out for view in views]
        io.require_room([target for path in paths for target in (path, *self.beside(path))], force=self.force)
        return paths

    def beside(self, path: str) -> list[str]:
        """What is written beside the picture of this path."""
        stem = path.removesuffix(".png")
        return [f"{stem}.depth.{self.depth}"] * bool(self.depth) + [f"{stem}.alpha.png"] * self.alpha

    def write(self, path: str, image: nerfbake.Image, *, several: bool) -> None:
        """The picture, and what stands beside it."""
        io.save(path, image, force=self.force, parents=several)
        for beside in self.beside(path):
            plane = image.mask if beside.endswith(".alpha.png") else nerfbake.Depth(image.depth)
            io.save(beside, plane, force=self.force)


class PlacedMesh(NamedTuple):
    """Opaque triangles in a field's world.

    path  an .obj or .glb
    up    the field's axis that the mesh's y becomes
    how   as render_field_and_meshes() has it
    """

    path: str
    up: Literal["y", "z"] = "y"
    how: Literal["stop", "ztest"] = "stop"

    def read(self) -> nerfbake.Meshes:
        """The triangles where they stand. Raises NerfbakeError."""
        return io.load(self.path, nerfbake.Meshes).with_up(self.up)


def render_views(
    source: AnySource,
    pictures: Pictures | str | Path,
    shots: Shots = ONE_SHOT,
    *,
    lod: int | None = None,
    choice: Choice = AS_IT_IS,
    mesh: PlacedMesh | None = None,
    steps: Steps = SILENT,
    **options: Any,
) -> list[str]:
    """Renders views of a PlenOctree, an octree, a volume or a lattice, and gives the paths of the pictures; `nerfbake
    render`.

    Reads `source`, and the cameras and the mesh that are named; writes `pictures`, and what they want beside them.
    lod: the level of an octree to show. choice: which grids of a volume. Options go to render_field(); a lattice is
    shown as its own program shows it, by render_lattice(), whatever the lookup. All names are settled before the first
    picture is made. Raises NerfbakeError.

    >>> render_views("a.npz", "views", Shots(turntable=2, size=(32, 32)))
    ['views/0000.png', 'views/0001.png']
    >>> render_views("a.npz", Pictures("a.png", depth="npy"), Shots(size=(32, 32)), lookup="trilinear")
    ['a.png']
    """
    source = as_source(source)
    pictures = pictures if isinstance(pictures, Pictures) else Pictures(str(pictures))
    shots.require()
    pictures.require(several=shots.several)
    field = _read(steps, source, lod, choice, alone=mesh is None)
    views = shots.of(steps, field, source.name)
    together = pictures.together(several=shots.several)
    paths = [pictures.out] if together else pictures.settle(views.cameras, several=shots.several)
    drawn = _drawn(steps, source, views.cameras, _renderer(field, mesh, views.samples, options))
    if together:
        with io.blame(pictures.out):
            views.require_memory()
        _write_together(steps, pictures, together, list(drawn), views.rays_told)
        return paths
    for path, image in zip(paths, drawn, strict=True):
        pictures.write(path, image, several=shots.several)
        steps.say(f"{path}: {image}{views.rays_told}")
    return paths


def _read(steps: Steps, source: Source, lod: int | None, choice: Choice, *, alone: bool) -> Field:
    """The field of a scene, made once for its cameras and all of its pictures; of a lattice itself, if it stands alone
    in them."""
    others = () if lod is not None else (nerfbake.N3Tree, nerfbake.Volume, nerfbake.LatticeField)
    scene = choice.of(steps, source, source.read(steps, *others, nerfbake.SparseVoxelOctree))
    if isinstance(scene, nerfbake.LatticeField):
        if alone:
            tell_notes(steps, source, scene)
            return scene
        scene = octree_of(steps, source, scene)
    if lod is not None:
        with source.blamed(steps, f"cutting at level {lod}"):
            scene = nerfbake.cut_octree(scene, level=lod)
    with source.blamed(steps, "building the field"):
        return nerfbake.build_field(scene)


def _renderer(
    field: Field, mesh: PlacedMesh | None, samples: int, options: dict[str, Any]
) -> Callable[..., nerfbake.Image]:
    """What makes a picture of a camera. A lattice has a lookup of its own."""
    if isinstance(field, nerfbake.LatticeField):
        own = {name: value for name, value in options.items() if name != "lookup"}
        return partial(nerfbake.render_lattice, field, samples=samples, **own)
    if mesh is None:
        return partial(nerfbake.render_field, field, samples=samples, **options)
    return partial(nerfbake.render_field_and_meshes, field, mesh.read(), how=mesh.how, samples=samples, **options)


def _drawn(
    steps: Steps, source: Source, views: Sequence[nerfbake.Camera], render: Callable[..., nerfbake.Image]
) -> Iterator[nerfbake.Image]:
    """One picture after the other, each made when it is asked for."""
    for view in views:
        with source.blamed(steps, f"rendering {view.name}"):
            image = render(camera=view)
        yield image


def _write_together(steps: Steps, pictures: Pictures, kind: str, images: list[nerfbake.Image], rays: str) -> None:
    with steps.phase(f"writing {pictures.out}"), io.blame(pictures.out):
        whole = nerfbake.Animation(tuple(images)) if kind == "Animation" else nerfbake.Image.tiled(images)
        written = io.save(pictures.out, whole, force=pictures.force)
    steps.say(f"{pictures.out}: {whole}{rays}, {written:,} bytes")
