"""The same octree or the same volume in another file: another format, another layout, or one as the other."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import nerfbake
from nerfbake import catalog, io
from nerfbake.errors import InvalidScene, Problem, UsageError
from nerfbake.jobs.files import AnySource, AnyTarget, Source, Target, as_source, as_target
from nerfbake.jobs.grids import AS_IT_IS, Choice, tell_of_halves
from nerfbake.jobs.lattices import octree_of
from nerfbake.jobs.steps import SILENT, Steps

_LONGEST_PART = 100  # characters of a grid's name in a file's name


def convert_file(
    source: AnySource,
    target: AnyTarget,
    *,
    layout: Literal["full", "compact"] | None = None,
    no_child: int | None = None,
    choice: Choice = AS_IT_IS,
    codec: str | None = None,
    half: bool = False,
    steps: Steps = SILENT,
) -> nerfbake.SparseVoxelOctree | nerfbake.Volume:
    """Writes an octree or a volume in another format, and gives what it wrote; `nerfbake convert`.

    Another program's lattice becomes an octree first.

    Reads `source`, writes `target`, whose format says whether an octree or a volume is wanted.

    layout    of an octree: child slots for every node (full), or none for those of the last level (compact)
    no_child  how an octree's file spells 'no child', 0 or -1
    choice    which grids of a volume, and its axis that points up
    codec     of a volume's format: none or zip
    half      a volume's values are float16

    What is None is as in `source`, or as is usual for the format. Raises NerfbakeError.

    >>> convert_file("octree.svo.npz", "compact.svo.json", layout="compact").layout
    'compact'
    """
    source, target = as_source(source), as_target(target)
    if _is_volume(target):
        if layout or no_child:
            raise UsageError("a volume has no child slots; allowed: no `layout` and no `no_child`")
        return _write_volume(steps, source, target, choice, codec, half=half)
    target.require("SparseVoxelOctree", no_child=no_child, codec=codec)
    read = source.read(steps, nerfbake.SparseVoxelOctree, nerfbake.Volume, nerfbake.LatticeField)
    if isinstance(read, nerfbake.LatticeField):
        read = octree_of(steps, source, read)
    if half and not isinstance(read, nerfbake.Volume):
        raise UsageError("`half` is for volumes; allowed: `nerfbake svo --dtype float16`")
    octree: nerfbake.SparseVoxelOctree | nerfbake.Volume = choice.of(steps, source, read)
    if isinstance(octree, nerfbake.Volume):
        octree = _octree_of(steps, source, octree, choice, half=half)
    octree = octree.with_layout(layout or octree.layout)
    target.write(steps, octree, no_child=no_child, codec=codec)
    return octree


def _is_volume(target: Target) -> bool:
    ending = target.path if target.to is None else f".{target.to.removeprefix('.')}"
    return catalog.is_ending(ending, "Volume")


def split_volume(
    source: AnySource,
    target: AnyTarget,
    *,
    up: Literal["y", "z"] | None = None,
    codec: str | None = None,
    half: bool = False,
    steps: Steps = SILENT,
) -> dict[str, nerfbake.Volume]:
    """Writes each grid of a volume to a file of its own, and gives them by their files' names; `convert --grid all`.

    Reads `source`. Writes NAME.GRID.nvdb for each grid where `target` is NAME.nvdb; characters of GRID other than
    letters, digits, `.`, `-` and `_` become `_`. Options as convert_file() has them. Raises NerfbakeError, before
    anything is written if one of the files cannot be written.

    >>> volume = nerfbake.build_vdb(nerfbake.load("octree.svo.npz"), grids=("density", "Cd"))
    >>> _ = nerfbake.save("smoke.vdb", volume)
    >>> list(split_volume("smoke.vdb", "smoke.nvdb"))
    ['smoke.density.nvdb', 'smoke.Cd.nvdb']
    """
    source, target = as_source(source), as_target(target)
    if target.path == io.STREAM or not _is_volume(target):
        endings = ", ".join(form.suffix for form in catalog.formats_of("Volume"))
        raise UsageError(f"{target.path} is no place for each grid of a volume; allowed: a {endings}")
    whole = Choice(up=up).whole(steps, source, source.read(steps, nerfbake.Volume))
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
    """NAME.GRID.nvdb of NAME.nvdb: what follows the name is the format's whole ending."""
    path = Path(target.path)
    stem = catalog.scene_name(target.path)
    part = re.sub(r"[^A-Za-z0-9._-]+", "_", label)[:_LONGEST_PART].strip("._") or "grid"
    return str(path.with_name(f"{stem}.{part}{path.name.removeprefix(stem)}"))


def _write_volume(
    steps: Steps, source: Source, target: Target, choice: Choice, codec: str | None, *, half: bool
) -> nerfbake.Volume:
    target.require("Volume", codec=codec)
    whole: nerfbake.Volume = choice.whole(steps, source, source.read(steps, nerfbake.Volume))
    volume = _rounded(steps, source, target, whole, half=half)
    target.write(steps, volume, codec=codec)
    return volume


def _rounded(steps: Steps, source: Source, target: Target, volume: nerfbake.Volume, *, half: bool) -> nerfbake.Volume:
    """The volume in the precision that the target's format keeps."""
    form = io.format_for(target.path, "Volume", to=target.to)
    if half or not form.load_volume_module().KEEPS_HALVES:
        with source.blamed(steps, "rounding"):
            volume = nerfbake.cast_volume(volume, dtype="float16" if half else "float32")
    tell_of_halves(steps, form, volume)
    return volume


def _octree_of(
    steps: Steps, source: Source, volume: nerfbake.Volume, choice: Choice, *, half: bool
) -> nerfbake.SparseVoxelOctree:
    foreign = volume.frame is None or bool(choice.grids)
    if not foreign and choice.up:
        raise UsageError("the octree in IN stands where it stood; allowed: no `up`, or `grid` for a density alone")
    with source.blamed(steps, "making the octree"):
        if foreign:
            _tell_of_others(steps, source, volume)
        if half:
            volume = nerfbake.cast_volume(volume, dtype="float16")
        return nerfbake.octree_of_density(volume) if foreign else nerfbake.octree_of_volume(volume)


def _tell_of_others(steps: Steps, source: Source, volume: nerfbake.Volume) -> None:
    """Says which grids an octree of `density` leaves out. Raises InvalidScene where several grids have no such name."""
    labels = [*volume.labels, *(problem.place for problem in volume.unread)]
    if len(labels) == 1:
        return
    if "density" not in labels:
        found = f"has the grids {', '.join(labels)}"
        raise InvalidScene(Problem("the volume", found, "`grid=NAME` for an octree of that density alone"))
    others = ", ".join(label for label in labels if label != "density")
    steps.say(f"{source.name}: an octree of density alone, without {others}")
