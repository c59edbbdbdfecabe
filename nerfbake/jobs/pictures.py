"""Render pictures of a scene: single pictures, sheets, animations and folders, with depth and alpha."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias, Unpack

from nerfbake import catalog, io
from nerfbake.errors import UsageError
from nerfbake.jobs.devices import DEVICE, renderer_on
from nerfbake.jobs.files import AnySource, Source, as_source
from nerfbake.jobs.function_voxels import FunctionVoxels, World
from nerfbake.jobs.grids import GridChoice
from nerfbake.jobs.readings import Reading
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import views_of
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.image import WHITE, Animation, Depth, Image
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.origin import no_origin, step_at
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.splats import Splats
from nerfbake.scene.stage1 import Stage1
from nerfbake.scene.volume import Volume
from nerfbake.stages.field_and_meshes_to_image import render_field_and_meshes
from nerfbake.stages.field_to_image import RenderOptions
from nerfbake.stages.function_to_image import render_function
from nerfbake.stages.lattice_to_image import render_lattice
from nerfbake.stages.meshes_to_image import render_meshes
from nerfbake.stages.octree_to_octree import cut_octree
from nerfbake.stages.renderers import Renderer
from nerfbake.stages.stage1_to_image import render_stage1

# Scenes with surfaces or splats, for which options of fields have no effect.
Shapes: TypeAlias = Meshes | Stage1 | BakedAtlas | Splats
Field: TypeAlias = RadianceField | LatticeField | FunctionField | Shapes

_PLAIN = {"transmittance_cut": 1e-4, "lookup": "nearest"}  # the defaults of render_field()
EDGE = 800  # width and height of the pictures of an orbit, in pixels
_OF_OTHERS = (".mp4", ".webm", ".mov", ".avi", ".mkv", ".webp", ".apng", ".jpg", ".jpeg")  # no names of folders


@dataclass(frozen=True, kw_only=True)
class ViewSelection:
    """The views to render.

    cameras    a capture; None: an orbit around the scene
    frame      the number of the camera, from 0
    every      render all cameras
    turntable  number of views around the scene
    size       (W, H) pixels; None: that of the cameras, 800 x 800 for an orbit
    samples    rays along each edge of a pixel; None: from the cameras, else 1
    world      of a trained field: that of the user's cameras, or that of the network
    """

    cameras: str | None = None
    frame: int = 0
    every: bool = False
    turntable: int | None = None
    size: tuple[int, int] | None = None
    samples: int | None = None
    world: World = "original"

    @property
    def several(self) -> bool:
        return self.every or self.turntable is not None

    def require(self) -> None:
        """Raise UsageError for contradictory options. Call it before doing any work."""
        if self.turntable and self.cameras:
            raise UsageError("`turntable` and `cameras` both select the views; allowed: one of them")

    def of(self, steps: Steps, field: Field, name: str) -> Cameras:
        """Return the cameras. name: name of the scene in errors. Raises UsageError if the frame does not exist."""
        frames = self.turntable or 1
        views = views_of(
            steps, field, self.cameras, name=name, frames=frames, edge=EDGE, size=self.size, samples=self.samples
        )
        if not self.several:
            if not 0 <= self.frame < len(views.cameras):
                raise UsageError(f"`frame` is {self.frame}; allowed: 0 to {len(views.cameras) - 1}")
            views = Cameras(views.cameras[self.frame : self.frame + 1], samples=views.samples)
        with io.blame(self.cameras or name):
            views.require_covered()
        return views


@dataclass(frozen=True, kw_only=True)
class PictureOutputs:
    """Output paths of the pictures and of their depth and alpha files.

    out    for one picture a .png, or '-' for stdout; for several a .gif, a .png that shows them all, or a folder
    depth  png: write NAME.depth.png, 16 bits, thousandths of a world unit; npy: write NAME.depth.npy, world units
    alpha  write NAME.alpha.png, white is opaque
    force  replace existing files
    """

    out: str
    depth: Literal["png", "npy"] | None = None
    alpha: bool = False
    force: bool = False

    def together(self, *, several: bool) -> str | None:
        """Return the type of scene that several pictures form in one file, or None if each has its own file."""
        return next((kind for kind in ("Animation", "Image") if several and catalog.is_ending(self.out, kind)), None)

    def require(self, *, several: bool) -> None:
        """Raise NerfbakeError if the pictures cannot be written. The files of a folder are checked by settle()."""
        together = self.together(several=several)
        if several and self.out == io.STREAM:
            raise UsageError("stdout takes one picture; allowed for several: a .gif, a .png or a folder")
        if (self.depth or self.alpha) and (together or self.out == io.STREAM):
            raise UsageError(
                "`depth` and `alpha` need a file for each picture; allowed: a .png of one picture, or a folder"
            )
        if several and not together and self.out.lower().endswith(_OF_OTHERS):
            found = f"{self.out!r} has no file extension for several pictures"
            raise UsageError(f"{found}; allowed: a .gif, a .png, or a folder")
        if together or not several:
            io.format_for(self.out, together or "Image")
            for path in (self.out, *self.beside(self.out)):
                io.require_absent(path, force=self.force)

    def settle(self, views: Sequence[Camera], *, several: bool) -> list[str]:
        """Return the path of each picture. Raises OutputError if a picture, depth or alpha file cannot be written."""
        paths = [str(Path(self.out) / f"{view.name}.png") if several else self.out for view in views]
        io.require_room([target for path in paths for target in (path, *self.beside(path))], force=self.force)
        return paths

    def beside(self, path: str) -> list[str]:
        """Return the paths of the depth and alpha files of the picture at this path."""
        stem = path.removesuffix(".png")
        return [f"{stem}.depth.{self.depth}"] * bool(self.depth) + [f"{stem}.alpha.png"] * self.alpha

    def write(self, path: str, image: Image, *, several: bool) -> None:
        """Write a picture with its depth and alpha files."""
        io.save(path, image, force=self.force, parents=several)
        for beside in self.beside(path):
            plane = image.mask if beside.endswith(".alpha.png") else Depth(image.depth)
            io.save(beside, plane, force=self.force)


@dataclass(frozen=True, kw_only=True)
class PlacedMesh:
    """A mesh of opaque triangles in a field's world coordinates.

    path  an .obj or .glb
    up    the axis of the field that the mesh's y axis maps to
    how   the composite mode of render_field_and_meshes()
    """

    path: str
    up: Literal["y", "z"] = "y"
    how: Literal["stop", "ztest"] = "stop"

    def read(self, steps: Steps) -> Meshes:
        """Read the meshes and move them into the field's world, which has no origin. Raises NerfbakeError."""
        meshes: Meshes = Source(self.path).read(steps, Meshes)
        if meshes.origin.any():
            text = f"is far from 0, where float32 has steps of {step_at(meshes.origin):.2g}"
            steps.say(f"{self.path}: {text}, and is placed in the world of the field")
        return meshes.with_up(self.up).relative_to(no_origin())


def render_views(
    source: AnySource,
    pictures: PictureOutputs | str | Path,
    shots: ViewSelection = ViewSelection(),
    *,
    lod: int | None = None,
    choice: GridChoice = GridChoice(),
    mesh: PlacedMesh | None = None,
    device: str = DEVICE,
    steps: Steps = SILENT,
    **options: Unpack[RenderOptions],
) -> list[str]:
    """Render views of a scene and return the paths of the pictures. This is `nerfbake render`.

    Reads `source` (a PlenOctree, an octree, a volume, a lattice, a trained field, splats, a mesh, a stage-1 folder or
    an atlas), the cameras and the mesh. Writes `pictures`, with their depth and alpha files. All output paths are
    checked before the first picture is rendered. Raises NerfbakeError.

    lod      level of an octree to render
    choice   the grids of a volume
    device   what renders a field or splats, as in renderer_on()
    options  are passed to render_field(); for a lattice to render_lattice(), which renders like the program that
             trained it and ignores the lookup; for a trained field to render_function(), whose default is the
             background that the field was trained with. Splats and triangles take a background only

    >>> render_views("a.npz", "views", ViewSelection(turntable=2, size=(32, 32)))
    ['views/0000.png', 'views/0001.png']
    >>> pictures, view = PictureOutputs(out="a.png", depth="npy"), ViewSelection(size=(32, 32))
    >>> render_views("a.npz", pictures, view, lookup="trilinear")
    ['a.png']
    """
    source = as_source(source)
    pictures = pictures if isinstance(pictures, PictureOutputs) else PictureOutputs(out=str(pictures))
    shots.require()
    pictures.require(several=shots.several)
    render = renderer_on(device, steps=steps)
    field = _read(steps, source, lod, choice, shots.world, alone=mesh is None)
    views = shots.of(steps, field, source.name)
    together = pictures.together(several=shots.several)
    paths = [pictures.out] if together else pictures.settle(views.cameras, several=shots.several)
    drawn = _drawn(steps, source, views.cameras, _renderer(steps, field, mesh, views.samples, options, render))
    if together:
        with io.blame(pictures.out):
            views.require_memory()
        _write_together(steps, pictures, together, list(drawn), views.rays_text)
        return paths
    for path, image in zip(paths, drawn, strict=True):
        pictures.write(path, image, several=shots.several)
        steps.say(f"{path}: {image}{views.rays_text}")
    return paths


def _read(steps: Steps, source: Source, lod: int | None, choice: GridChoice, world: World, *, alone: bool) -> Field:
    """Return the field of a scene, built once for the cameras and all pictures, or its triangles.

    alone: there is no mesh in the pictures. Lattices and trained fields are then returned unchanged, otherwise they
    become octrees.
    """
    shapes = (Splats, Meshes, Stage1, BakedAtlas) if alone else ()
    others = () if lod is not None else (N3Tree, Volume, LatticeField, FunctionField, *shapes)
    placed = FunctionVoxels(world=world)
    reading = Reading(steps, source, *others, SparseVoxelOctree, choice=choice, functions=placed)
    reading.require()
    if alone and isinstance(reading.scene, Shapes | LatticeField | FunctionField):
        return reading.scene
    if lod is not None:
        with source.blamed(steps, f"cutting at level {lod}"):
            reading.scene = cut_octree(reading.scene, level=lod)
    return reading.field()


def _renderer(
    steps: Steps, field: Field, mesh: PlacedMesh | None, samples: int, options: RenderOptions, render: Renderer
) -> Callable[[Iterable[Camera]], Iterator[Image]]:
    """Return the function that renders cameras, each on demand.

    Lattices and trained fields have their own lookup, so that option is dropped. Raises UsageError for options that the
    scene does not have.
    """
    if isinstance(field, Shapes):
        noun = "splats" if isinstance(field, Splats) else "triangles"
        for name, default in _PLAIN.items():
            if options.get(name, default) != default:
                raise UsageError(f"`{name}` has no effect on {noun}; allowed: with a field")
        background = options.get("background", WHITE)
        if isinstance(field, Splats):
            return partial(render.each, field, samples=samples, background=background)
        shape: Any = render_meshes if isinstance(field, Meshes) else render_stage1
        return partial(map, partial(shape, field, samples=samples, background=background))
    if isinstance(field, FunctionField):
        given: dict[str, Any] = {name: value for name, value in options.items() if name != "lookup"}
        if isinstance(field.background, tuple):
            given = {"background": field.background, **given}
        return partial(map, partial(render_function, field, samples=samples, **given))
    if isinstance(field, LatticeField):
        if "lookup" in options:
            del options["lookup"]
        return partial(map, partial(render_lattice, field, samples=samples, **options))  # type: ignore[misc]
    if mesh is None:
        return partial(render.each, field, samples=samples, **options)
    meshes = mesh.read(steps)
    both = partial(render_field_and_meshes, field, meshes, how=mesh.how, samples=samples, render=render, **options)
    return partial(map, both)


def _drawn(
    steps: Steps, source: Source, views: Sequence[Camera], render: Callable[[Iterable[Camera]], Iterator[Image]]
) -> Iterator[Image]:
    """Yield the picture of each view, rendered on demand."""
    images = render(views)
    for view in views:
        with source.blamed(steps, f"rendering {view.name}"):
            image = next(images)
        yield image


def _write_together(steps: Steps, pictures: PictureOutputs, kind: str, images: list[Image], rays: str) -> None:
    with steps.phase(f"writing {pictures.out}"), io.blame(pictures.out):
        whole = Animation(tuple(images)) if kind == "Animation" else Image.tiled(images)
        written = io.save(pictures.out, whole, force=pictures.force)
    steps.say(f"{pictures.out}: {whole}{rays}, {written:,} bytes")
