"""A source that is read once, and what the jobs make of it: an octree or a field.

All that differs between the kinds of scenes is here: which options they take, the inner cube of scenery, the up axis of
splats, the grids of a volume, and the loss of becoming voxels. Jobs do their own work on what they get.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from nerfbake.errors import InvalidScene, Problem, UsageError
from nerfbake.jobs.budgets import Budget
from nerfbake.jobs.files import Source
from nerfbake.jobs.function_voxels import FunctionVoxels, bake_field
from nerfbake.jobs.grids import GridChoice, tell_unused
from nerfbake.jobs.reading_options import ReadingOptions
from nerfbake.jobs.splat_voxels import sample_splats
from nerfbake.jobs.steps import Steps
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import MAX_SIZE, Layout, SparseVoxelOctree
from nerfbake.scene.splats import UPS, Splats, Up
from nerfbake.scene.volume import Volume

if TYPE_CHECKING:
    from nerfbake.scene.radiance_field import RadianceField
    from nerfbake.stages.n3tree_to_octree import Resample

_FRAMES, _EDGE = 4, 200  # number and edge of the pictures on which the loss of a conversion is measured

Size = int | tuple[int, int, int]
# All that becomes an octree or a field.
FIELDS = (N3Tree, SparseVoxelOctree, Volume, LatticeField, Splats, FunctionField)
_WORDS = ("a PlenOctree", "an octree", "a volume", "a lattice", "splats", "a trained field")
_NOUNS = dict(zip(FIELDS, _WORDS, strict=True))
_RESAMPLED = (N3Tree, LatticeField, Splats, FunctionField)
# The scenes on which an option has an effect. Octrees and volumes have their own voxels.
TAKEN: dict[str, tuple[type, ...]] = {
    "resolution": _RESAMPLED,
    "sigma_min": _RESAMPLED,
    "dtype": _RESAMPLED,
    "resample": (N3Tree,),
    "box": (N3Tree, Splats, FunctionField),
    "box of six numbers": (Splats, FunctionField),
    "basis": (LatticeField, Splats, FunctionField),
    "scale": (LatticeField,),
    "opacity_min": (Splats,),
    "in_up": (Splats,),
    "epochs": (Splats,),
}
_DEFAULTS = {"resample": "mean", "dtype": "float32"}  # of all other options it is None


def upright_without(cameras: str | None) -> ReadingOptions:
    """Return how splats become voxels that are looked at: upright, or in the world of their cameras if there are any.

    Octrees of splats keep their world by default, and volumes are upright.
    """
    return ReadingOptions(in_up="stated") if cameras is None else ReadingOptions()


def _with_axis(choice: GridChoice, options: ReadingOptions) -> tuple[GridChoice, ReadingOptions]:
    """Return a choice without an axis, which a volume would have, and options for splats with this axis."""
    if choice.in_up is None:
        return choice, options
    axes: dict[str, Up] = {axis: axis for axis in UPS}
    if choice.in_up not in axes:
        raise UsageError(f"`in_up` is {choice.in_up!r}; allowed: {', '.join(UPS)}")
    return replace(choice, in_up=None), replace(options, in_up=axes[choice.in_up])


class Reading:
    """What was read from a source.

    scene    what was read, or the octree that it became
    shown    what results are compared with: what was read, of scenery the inner cube; or the splats that the octree
             shows, in its world
    scenery  the whole scene while use_inner_cube() keeps it; else None
    data     the bytes of an already compressed file; None: the file is not compressed
    """

    scene: Any
    shown: Any
    scenery: N3Tree | None = None

    def __init__(
        self,
        steps: Steps,
        source: Source,
        *kinds: type,
        choice: GridChoice = GridChoice(),
        options: ReadingOptions = ReadingOptions(),
        functions: FunctionVoxels = FunctionVoxels(),
    ) -> None:
        """Read a scene of one of these types; by default of one that becomes an octree. Raises NerfbakeError.

        choice     the grids of a volume, and its up axis; of splats the axis alone
        options    how it becomes an octree
        functions  how a trained field becomes voxels; the box and the basis of `options` come first
        """
        read = source.read_with_format(steps, *(kinds or FIELDS))
        if isinstance(read.scene, Splats):
            choice, options = _with_axis(choice, options)
        self._steps, self._source, self._choice = steps, source, choice
        self._options, self._functions = options, functions
        self.data = read.data
        self.scene = self.shown = choice.of(steps, source, read.scene)
        if isinstance(self.scene, FunctionField):
            self.scene = self.shown = functions.placed(self.scene)
        self._held_out: HeldOut | None = None

    def require(
        self, budget: Budget = Budget(), *, taken: dict[str, tuple[type, ...]] = TAKEN, **options: object
    ) -> None:
        """Raise UsageError for options that have no effect on what was read. Call it before octree() and field().

        budget   its cameras must be in the world of the octree
        taken    the scenes on which an option has an effect
        options  of octree(), by name; those of the reading are known
        """
        if isinstance(self.scene, Splats):
            self._options.require(budget, self.scene)
        given = {name for name, value in options.items() if value not in (None, _DEFAULTS.get(name))}
        given |= self._options.given
        allowing = {name: kinds for name, kinds in taken.items() if name in given}
        allowing |= dict.fromkeys(sorted(self._functions.given), (FunctionField,))
        for name, kinds in allowing.items():
            if not isinstance(self.scene, kinds):
                option, *more = name.split(maxsplit=1)
                text = " ".join([f"`{option}`", *more])
                *others, last = (_NOUNS[kind] for kind in kinds)
                allowed = f"{', '.join(others)} or {last}" if others else last
                own = _NOUNS.get(type(self.scene), "triangles")
                raise UsageError(f"{text} has no effect on {own}; allowed: with {allowed}")

    @property
    def held_out(self) -> HeldOut | None:
        """The pixels of photographs that a fitted PlenOctree stores."""
        return self.scene.held_out if isinstance(self.scene, N3Tree) else self._held_out

    def use_inner_cube(self, *, keep: bool = False) -> bool:
        """Use the inner cube of a scene with scenery alone, and print that. Return whether the scene has scenery.

        keep: keep the whole scene as `scenery`.
        """
        self.bake()
        if not isinstance(self.scene, N3Tree) or self.scene.shells == 1:
            return False
        with self._source.blamed(self._steps, "reading the inner cube"):
            inner = self.scene.inner_cube()
        rest = "shows the scenery around it as walls" if keep else "leaves out the scenery around it"
        self._steps.say(f"{self._source.name}: uses the inner cube of {inner.resolution}^3 and {rest}")
        self.scenery = self.scene if keep else None
        self.scene = self.shown = inner
        return True

    def tell_scenery(self) -> None:
        """Print that the scenery is used, of a scene that has it."""
        self.bake()
        if isinstance(self.scene, N3Tree) and self.scene.shells > 1:
            self._steps.say(f"{self._source.name}: uses all of the scene, also the scenery around the inner cube")

    def octree(
        self,
        *,
        resolution: Size | None = None,
        resample: Resample = "mean",
        layout: Layout = "full",
        dtype: Literal["float32", "float16"] = "float32",
        sigma_min: float | None = None,
    ) -> SparseVoxelOctree:
        """Return the octree of the scene, in which `shown` is its equal. An octree is returned unchanged.

        Prints what is left out, and the loss of lattices and splats. Options are those of bake_octree(); octrees and
        volumes have none. Raises NerfbakeError.
        """
        steps, source = self._steps, self._source
        if isinstance(self.scene, FunctionField):
            self.bake(resolution, sigma_min)
            resolution = None  # the tree has it
        made: dict[str, Any] = {"resolution": resolution, "layout": layout, "dtype": dtype, "sigma_min": sigma_min}
        if self._options.box == "inner":
            self.use_inner_cube()
        if isinstance(self.scene, Splats):
            self.scene, self.shown = sample_splats(steps, source, self.scene, options=self._options, **made)
        elif isinstance(self.scene, LatticeField):
            scale, basis = self._options.scale, self._options.basis or "SH9"
            self.shown = self.scene if scale is None else self.scene.scaled(scale)
            self.scene = sample_lattice(steps, source, self.shown, basis=basis, **made)
        elif isinstance(self.scene, Volume):
            self.scene = self._octree_of_volume(self.scene)
        elif isinstance(self.scene, N3Tree):
            from nerfbake.stages.n3tree_to_octree import build_octree

            made["resolution"] = self._finest(resolution)
            self._held_out = self.scene.held_out
            with source.blamed(steps, "building the octree"):
                self.scene = build_octree(self.scene, resample=resample, **made)
        found: SparseVoxelOctree = self.scene
        return found

    def field(self, *, visible: str | None = None) -> RadianceField:
        """Return the field of the scene. Prints what is left out, and the loss of lattices and splats.

        visible: what cannot be made of a field without a density, which is then refused. Raises NerfbakeError.
        """
        from nerfbake.stages.scene_to_field import build_field

        self.bake()
        if isinstance(self.scene, LatticeField | Splats):
            self.octree()
        tell_unused(self._steps, self._source, self.scene)
        with self._source.blamed(self._steps, "building the field"):
            field = build_field(self.scene)
            if visible is not None and not (field.densities > 0).any():
                allowed = f"at least one, or there is {visible}"
                raise InvalidScene(Problem("the field", "has no leaf with a density", allowed))
            return field

    def tree(self) -> N3Tree:
        """Return the PlenOctree of a trained field, with its scenery. Prints what was baked, and the loss."""
        self.bake()
        found: N3Tree = self.scene
        return found

    def bake(self, resolution: Size | None = None, sigma_min: float | None = None) -> None:
        """Make a PlenOctree of a trained field, which then takes its place; `shown` stays the field itself.

        Other scenes are left unchanged. Prints what was baked, and the loss. Raises NerfbakeError.
        """
        if isinstance(self.scene, FunctionField):
            options = self._functions.with_others(self._options, resolution)
            self.scene, self.shown = bake_field(self._steps, self._source, self.scene, options, sigma_min)

    def _finest(self, resolution: Size | None) -> Size | None:
        """Return the resolution of a whole cube, at most the largest of an octree; print what its inner cube gets.

        A tree without scenery keeps its resolution.
        """
        tree = self.scene
        if tree.shells == 1:
            return resolution
        with self._source.blamed(self._steps, "reading the tree"):
            finest = tree.resolution
        size = min(finest, MAX_SIZE) if resolution is None else resolution
        times = 1 << (tree.shells - 1)
        inner = f"{_size_text(size, times)} of them in the inner cube of {finest // times}^3"
        self._steps.say(f"{self._source.name}: uses all of the scene: {_size_text(size, 1)} voxels, {inner}")
        return size

    def _octree_of_volume(self, volume: Volume) -> SparseVoxelOctree:
        """Return the octree that a volume of `nerfbake vdb` contains, or that of the density of another one."""
        from nerfbake.stages.vdb_to_octree import build_octree_from_density, build_octree_from_volume

        foreign = volume.frame is None or bool(self._choice.grids)
        with self._source.blamed(self._steps, "making the octree"):
            if not foreign:
                return build_octree_from_volume(volume)
            _report_left_out(self._steps, self._source, volume)
            return build_octree_from_density(volume)


def _size_text(size: Size, times: int) -> str:
    edges = (size,) * 3 if isinstance(size, int) else size
    return "x".join(f"{edge / times:g}" for edge in edges)


def _report_left_out(steps: Steps, source: Source, volume: Volume) -> None:
    """Report the grids that are left out besides `density`. Raises InvalidScene if none of several is `density`."""
    labels = [*volume.labels, *(problem.place for problem in volume.unread)]
    if len(labels) == 1:
        return
    if "density" not in labels:
        found = f"has the grids {', '.join(labels)}"
        allowed = "`grid=NAME` of `nerfbake convert`, for an octree of that density only"
        raise InvalidScene(Problem("the volume", found, allowed))
    others = ", ".join(label for label in labels if label != "density")
    steps.say(f"{source.name}: the octree gets the density only, without {others}")


def sample_lattice(
    steps: Steps,
    source: Source,
    lattice: LatticeField,
    *,
    resolution: int | tuple[int, int, int] | None = None,
    basis: str = "SH9",
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
    sigma_min: float | None = None,
) -> SparseVoxelOctree:
    """Sample a lattice to an octree, and print the error of its pictures and colours.

    The options are those of build_octree_from_lattice().
    """

    from nerfbake.stages.lattice_to_octree import build_octree_from_lattice
    from nerfbake.stages.scene_to_field import build_field_from_octree

    with source.blamed(steps, "sampling the lattice"):
        size = (resolution,) * 3 if isinstance(resolution, int) else resolution
        octree = build_octree_from_lattice(
            lattice, resolution=size, basis=basis, layout=layout, dtype=dtype, sigma_min=sigma_min
        )
    with source.blamed(steps, "measuring the loss of sampling"):
        decibels, apart = lattice_loss(lattice, build_field_from_octree(octree))
    voxels = f"{'x'.join(map(str, octree.size))} voxels{_chosen(lattice, octree, resolution)}"
    seen = f"{decibels:.1f} dB against pictures of the lattice"
    steps.say(f"{source.name}: in {voxels}, {seen}; colours differ by {apart:.2g}/255 (RMS)")
    return octree


def _chosen(lattice: LatticeField, octree: SparseVoxelOctree, resolution: Any) -> str:
    """Return the reason why an octree without a chosen resolution is coarser than the cells of the lattice."""
    if resolution is not None or lattice.blocks is None or octree.size == lattice.cells:
        return ""
    return f" (the finest that fit into memory; it has {'x'.join(map(str, lattice.cells))} cells)"


def lattice_loss(lattice: LatticeField, field: RadianceField) -> tuple[float, float]:
    """Return the PSNR in dB of pictures around the lattice, and the RMS error of its colours (0..255)."""

    from nerfbake.jobs.views import orbit_psnr
    from nerfbake.stages.lattice_to_image import measure_lattice

    return orbit_psnr(lattice, field, _FRAMES, _EDGE), measure_lattice(lattice, field)
