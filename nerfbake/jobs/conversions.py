"""Convert octrees, volumes, splats and cameras to other formats and layouts, and octrees and volumes to each other."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nerfbake import catalog, io, memory
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import Budget, judge_output
from nerfbake.jobs.files import AnySource, AnyTarget, Source, Target, as_source, as_target
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.grids import GridChoice, warn_about_halves
from nerfbake.jobs.readings import Reading
from nerfbake.jobs.splat_choice import SplatChoice
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.upright import require_up, turned_up
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.origin import lost_origin, no_origin
from nerfbake.scene.splats import Splats
from nerfbake.scene.volume import Volume

if TYPE_CHECKING:
    from nerfbake.stages.splats_to_loss import SplatLoss

_ROUNDING = 1e-3  # of all units of a loss: less is the rounding of logarithms and of directions
_LONGEST_PART = 100  # characters of a grid's name in a file's name


def convert_file(
    source: AnySource,
    target: AnyTarget,
    *,
    layout: Literal["full", "compact"] | None = None,
    no_child: int | None = None,
    choice: GridChoice = GridChoice(),
    codec: str | None = None,
    half: bool = False,
    splats: SplatChoice = SplatChoice(),
    functions: FunctionVoxels = FunctionVoxels(),
    budget: Budget = Budget(),
    steps: Steps = SILENT,
) -> SparseVoxelOctree | Volume | Splats | N3Tree | Cameras:
    """Write an octree, a volume, splats or cameras in another format and return them. This is `nerfbake convert`.

    Reads `source` and writes `target`, whose format selects what is written. For an octree's format, PlenOctrees,
    lattices and splats become octrees as in bake_octree(). A trained field becomes an octree or, with all of its
    scenery, a PlenOctree. For a format or a folder of splats, convert_splats() is called. A stage of USD takes cameras,
    too, which convert_cameras() writes, and a volume, whose grids become a .vdb beside it.

    layout    of an octree: child slots for every node (full), or none on the last level (compact)
    no_child  child index that means 'no child' in an octree's file: 0 or -1
    choice    the grids of a volume, and its up axis; of splats their up axis
    codec     of a volume's format: none or zip
    half      store the values of a volume, or of splats, as float16
    splats    how splats are read and written
    functions  how a trained field becomes voxels
    budget    of an octree or a PlenOctree: the lowest allowed quality of `target`, else it becomes `target`.rejected

    Arguments that are None keep the value of `source`, or the default of the format. Raises NerfbakeError.

    >>> convert_file("octree.svo.npz", "compact.svo.json", layout="compact").layout
    'compact'
    """
    from nerfbake.stages.vdb_to_vdb import cast_volume

    source, target = as_source(source), as_target(target)
    if _is_ending(target, "Splats") or target.folder("Splats"):
        if layout or no_child or codec or choice.grids:
            raise UsageError("splats have no child slots, grids and codecs; allowed: `in_up` and the options of splats")
        _refuse_voxels("splats", functions, budget)
        splats = replace(splats, half=half or splats.half)
        if catalog.is_ending(target.ending, "Cameras"):
            return _convert_stage(steps, source, target, in_up=choice.in_up, choice=splats)
        return convert_splats(source, target, in_up=choice.in_up, choice=splats, steps=steps)
    if target.folder("SplatLevels"):
        raise UsageError(f"{target.path} holds levels of splats; allowed: `nerfbake splats`, which makes them")
    if splats != SplatChoice():
        given = [name for name, value in vars(splats).items() if value]
        allowed = "`nerfbake compress` for octrees" if given == ["small"] else "OUT of splats"
        raise UsageError(f"`{given[0]}` is for splats; allowed: {allowed}")
    if _is_ending(target, "Volume"):
        if layout or no_child:
            raise UsageError("a volume has no child slots; allowed: no `layout` and no `no_child`")
        _refuse_voxels("a volume", functions, budget)
        return _write_volume(steps, source, target, choice, codec, half=half)
    if _is_ending(target, "N3Tree") and not _is_ending(target, "SparseVoxelOctree"):
        if layout or no_child or codec or half:
            raise UsageError("a PlenOctree has no child slots, halves and codecs; allowed: none of these options")
        return _bake_tree(steps, source, target, functions, budget)
    target.require("SparseVoxelOctree", no_child=no_child, codec=codec)
    budget.require(target)
    reading = Reading(steps, source, choice=choice, functions=functions)
    reading.require(budget)
    if isinstance(reading.scene, Volume):
        _require_axes(reading.scene, choice)
        if half:
            with source.blamed(steps, "rounding"):
                reading.scene = cast_volume(reading.scene, dtype="float16")
    elif half:
        raise UsageError("`half` is for volumes; allowed: `nerfbake svo --dtype float16`")
    octree = reading.octree()
    octree = octree.with_layout(layout or octree.layout)
    with target.writing(steps, octree, no_child=no_child, codec=codec) as written:
        judge_output(written.path, reading.shown, budget, made_from=source.name, name=target.path, steps=steps)
    return octree


def _refuse_voxels(written: str, functions: FunctionVoxels, budget: Budget) -> None:
    """Raise UsageError for options of a trained field's voxels, and for a budget. written: what is written instead."""
    given = [*sorted(functions.given), *(["min_psnr"] if budget != Budget() else [])]
    if given:
        raise UsageError(f"`{given[0]}` has no effect on {written}; allowed: with an octree or a PlenOctree as OUT")


def _bake_tree(steps: Steps, source: Source, target: Target, functions: FunctionVoxels, budget: Budget) -> N3Tree:
    """Bake a trained field to a PlenOctree."""
    target.require("N3Tree")
    budget.require(target)
    reading = Reading(steps, source, FunctionField, functions=functions)
    tree = reading.tree()
    with target.writing(steps, tree) as written:
        judge_output(written.path, reading.shown, budget, made_from=source.name, name=target.path, steps=steps)
    return tree


def _require_axes(volume: Volume, choice: GridChoice) -> None:
    if volume.frame is not None and choice.in_up and not choice.grids:
        raise UsageError("the octree in IN keeps its own axes; allowed: no `in_up`, or `grid` for the density only")


def _is_ending(target: Target, scene: str) -> bool:
    """True if the target has the extension of a format of this scene type, even of one that is only read."""
    suffixes = tuple(form.suffix for form in catalog.FORMATS if form.scene == scene)
    return catalog.uncompressed(target.ending).lower().endswith(suffixes)


def convert_splats(
    source: AnySource,
    target: AnyTarget,
    *,
    in_up: str | None = None,
    choice: SplatChoice = SplatChoice(),
    steps: Steps = SILENT,
) -> Splats:
    """Write splats in another format, report what it loses, and return the splats as they were written.

    in_up   the axis of their world that points up: x, -x, y, -y, z or -z. They are rotated so that it becomes -y, which
            the formats store as their own up axis. None: they are not rotated
    choice  their axes in the files, and how they are written

    The folder of a .sog is written for a `target` FOLDER/meta.json. SH bands that the format cannot store are left out.
    Raises NerfbakeError.

    >>> import numpy as np
    >>> places, turns = np.eye(3, dtype=np.float32), np.eye(4, dtype=np.float32)[:3]
    >>> grey = np.zeros((3, 1, 3), np.float32)
    >>> splats = nerfbake.Splats(places, places + 1, turns, np.full(3, 0.5, np.float32), grey)
    >>> _ = nerfbake.save("splats.ply", splats)
    >>> print(convert_splats("splats.ply", "splats.spz"))
    3 splats of SH degree 0
    """
    source, target = as_source(source), as_target(target)
    form = _require_splats(source, target, in_up, choice)
    return _write_splats(steps, source, source.read(steps, Splats), target, form, in_up=in_up, choice=choice)


def _convert_stage(
    steps: Steps, source: Source, target: Target, *, in_up: str | None, choice: SplatChoice
) -> Splats | Cameras | Volume:
    """Write the splats, the cameras or the volume of `source` in a format that has all of them."""
    from nerfbake.jobs.cameras import write_cameras
    from nerfbake.jobs.views import tell_file_of

    form = _require_splats(source, target, in_up, choice)
    found = source.read(steps, Splats, Cameras, Volume)
    if isinstance(found, Splats):
        return _write_splats(steps, source, found, target, form, in_up=in_up, choice=choice)
    is_volume = isinstance(found, Volume)
    if given := [name for name, value in vars(choice).items() if value and not (is_volume and name == "half")]:
        held = "a volume" if is_volume else "cameras"
        raise UsageError(f"`{given[0]}` is for splats, but {source.name} holds {held}; allowed: `in_up`")
    if is_volume:
        return _write_stage_of(steps, source, found, target, in_up=in_up, half=choice.half)
    tell_file_of(steps, source.name, found)
    return write_cameras(steps, found, source, target, in_up=in_up)


def _write_stage_of(
    steps: Steps, source: Source, read: Volume, target: Target, *, in_up: str | None, half: bool
) -> Volume:
    """Write a stage with the grids of a volume in a .vdb beside it."""
    target.require("Volume")
    volume: Volume = GridChoice(in_up=in_up).whole(steps, source, read)
    volume = _rounded(steps, source, target, volume, half=half)
    if in_up is None:
        steps.say(f"{target.name}: z is up in the stage; {source.name} does not say its axis, so name it by `in_up`")
    target.write(steps, volume)
    return volume


def _require_splats(source: Source, target: Target, in_up: str | None, choice: SplatChoice) -> catalog.AnyFormat:
    """Return the format, or the kind of folder, to write. Call it before doing any work. Raises NerfbakeError."""
    require_up(in_up)
    if (folder := target.folder("Splats")) is None:
        return target.require("Splats", **choice.of_format)
    folder.require("Splats", [source.path])
    kind = catalog.folder_to_write("Splats")
    kind.require_options(choice.of_format)
    return kind


def _write_splats(
    steps: Steps,
    source: Source,
    read: Splats,
    target: Target,
    form: catalog.AnyFormat,
    *,
    in_up: str | None,
    choice: SplatChoice,
) -> Splats:
    from nerfbake.stages.splats_to_loss import measure_splats

    options, module = choice.of_format, form.load_splat_module()
    splats = choice.read(steps, source, read)
    with source.blamed(steps, "checking the splats"):
        splats.require_usable()
    (splats,) = turned_up(steps, source, require_up(in_up), splats)
    if splats.origin.any() and not module.KEEPS_ORIGIN:
        ending = form.title if isinstance(form, catalog.FolderKind) else form.suffix
        steps.say(f"{target.name}: {lost_origin(splats.origin, ending)}")
        splats = replace(splats, origin=no_origin())
    if (ordered := getattr(module, "in_order", None)) is not None:  # so that rows can be compared
        splats = ordered(splats)
    kept = splats.with_degree(module.MOST_DEGREE)
    place = target.folder("Splats") or target
    with (
        place.writing(steps, kept, **options) as written,
        steps.phase("measuring the loss"),
        io.blame(target.name),
        memory.scope(),
    ):
        if isinstance(form, catalog.FolderKind):
            steps.say(f"{place.path}: {kept}, {written.size:,} bytes")
            found: Splats = io.load_folder(written.path, Splats)
        elif form.library:
            found = form.load_stored_module().stored(kept, **options)
        else:
            own = form.load_splat_module()
            found = own.decode(memoryview(b"".join(own.encode(kept, **options))))
        loss = measure_splats(splats, found)
    left_out = "".join(f"; not read: {part}" for part in _not_read(splats))
    steps.say(f"{target.name}: {_loss_text(loss)}{left_out}")
    if (noted := getattr(module, "readers_note", None)) and (note := noted(**options)):
        steps.say(f"{target.name}: {note}")
    return found


def _not_read(splats: Splats) -> Iterator[str]:
    """Yield in a few words what of the file is not in these splats."""
    yield from splats.left_out
    if splats.dropped:
        yield plural(splats.dropped, "row")


def _loss_text(loss: SplatLoss) -> str:
    """The loss in a sentence."""
    errors = (loss.means, loss.scales, loss.rotations, loss.opacity, loss.colours)
    if not loss.dropped_bands and max(error.largest for error in errors) < _ROUNDING:
        return "nothing is lost but the rounding of float32"
    parts = (
        ("centres", loss.means, 1.0, " world units"),
        ("scales", loss.scales, 100.0, " %"),
        ("rotations", loss.rotations, 1.0, "°"),
        ("opacity", loss.opacity, 1.0, ""),
        ("colours", loss.colours, 1.0, "/255"),
    )
    losses = [f"{name} {each.largest * by:.2g} ({each.median * by:.2g}){unit}" for name, each, by, unit in parts]
    bands = f"; SH bands left out: {loss.dropped_bands}" if loss.dropped_bands else ""
    return f"largest (median) loss: {', '.join(losses)}{bands}"


def split_volume(
    source: AnySource,
    target: AnyTarget,
    *,
    in_up: Literal["y", "z"] | None = None,
    codec: str | None = None,
    half: bool = False,
    steps: Steps = SILENT,
) -> dict[str, Volume]:
    """Write each grid of a volume to its own file and return the volumes by file name. This is `convert --grid all`.

    Reads `source`. For a `target` NAME.nvdb, writes NAME.GRID.nvdb for each grid. Characters of GRID other than
    letters, digits, `.`, `-` and `_` become `_`. The other arguments are those of convert_file(). Raises NerfbakeError,
    before anything is written if one of the files cannot be written.

    >>> volume = nerfbake.build_vdb(nerfbake.load("octree.svo.npz"), grids=("density", "Cd"))
    >>> _ = nerfbake.save("smoke.vdb", volume)
    >>> list(split_volume("smoke.vdb", "smoke.nvdb"))
    ['smoke.density.nvdb', 'smoke.Cd.nvdb']
    """
    source, target = as_source(source), as_target(target)
    if target.path == io.STREAM or not _is_ending(target, "Volume"):
        endings = ", ".join(form.suffix for form in catalog.formats_of("Volume"))
        raise UsageError(f"cannot write one file per grid to {target.path}; allowed: a {endings}")
    whole = GridChoice(in_up=in_up).whole(steps, source, source.read(steps, Volume))
    names: list[str] = []
    for number, label in enumerate(whole.labels):
        name = _part_name(target, label)
        names.append(_part_name(target, f"{number}.{label}") if name in names else name)
        io.require_absent(names[-1], force=target.force)
    volumes = {}
    for number, name in enumerate(names):
        volume = _rounded(steps, source, target, whole.only([str(number)]), half=half)
        target._replace(path=name).write(steps, volume, codec=codec)
        volumes[name] = volume
    return volumes


def _part_name(target: Target, label: str) -> str:
    """Return the file name of a grid: NAME.GRID.nvdb for NAME.nvdb. The whole extension of the format is kept."""
    path = Path(target.path)
    stem = catalog.scene_name(target.path)
    part = re.sub(r"[^A-Za-z0-9._-]+", "_", label)[:_LONGEST_PART].strip("._") or "grid"
    return str(path.with_name(f"{stem}.{part}{path.name.removeprefix(stem)}"))


def _write_volume(
    steps: Steps, source: Source, target: Target, choice: GridChoice, codec: str | None, *, half: bool
) -> Volume:
    target.require("Volume", codec=codec)
    whole: Volume = choice.whole(steps, source, source.read(steps, Volume))
    volume = _rounded(steps, source, target, whole, half=half)
    target.write(steps, volume, codec=codec)
    return volume


def _rounded(steps: Steps, source: Source, target: Target, volume: Volume, *, half: bool) -> Volume:
    """Return the volume in a precision that the target's format can store."""

    from nerfbake.stages.vdb_to_vdb import cast_volume

    form = io.format_for(target.path, "Volume", to=target.to)
    if half or not form.load_volume_module().KEEPS_HALVES:
        with source.blamed(steps, "rounding"):
            volume = cast_volume(volume, dtype="float16" if half else "float32")
    warn_about_halves(steps, form, volume)
    return volume
