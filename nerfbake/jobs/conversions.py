"""The same octree or the same volume in another file: another format, another layout, or one as the other."""

from __future__ import annotations

from typing import Literal

import nerfbake
from nerfbake import catalog
from nerfbake.errors import InvalidScene, Problem, UsageError
from nerfbake.jobs.files import AnySource, AnyTarget, Source, Target, as_source, as_target
from nerfbake.jobs.grids import AS_IT_IS, Choice, tell_of_halves
from nerfbake.jobs.lattices import octree_of
from nerfbake.jobs.steps import SILENT, Steps


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
            raise UsageError("a volume has no child slots; allowed: no --layout and no --no-child")
        return _write_volume(steps, source, target, choice, codec, half=half)
    target.require("SparseVoxelOctree", no_child=no_child, codec=codec)
    read = source.read(steps, nerfbake.SparseVoxelOctree, nerfbake.Volume, nerfbake.LatticeField)
    if isinstance(read, nerfbake.LatticeField):
        read = octree_of(steps, source, read)
    if half and not isinstance(read, nerfbake.Volume):
        raise UsageError("--half is for volumes; allowed: `nerfbake svo --dtype float16`")
    octree: nerfbake.SparseVoxelOctree | nerfbake.Volume = choice.of(steps, source, read)
    if isinstance(octree, nerfbake.Volume):
        octree = _octree_of(steps, source, octree, choice, half=half)
    octree = octree.with_layout(layout or octree.layout)
    target.write(steps, octree, no_child=no_child, codec=codec)
    return octree


def _is_volume(target: Target) -> bool:
    ending = target.path if target.to is None else f".{target.to.removeprefix('.')}"
    return catalog.is_ending(ending, "Volume")


def _write_volume(
    steps: Steps, source: Source, target: Target, choice: Choice, codec: str | None, *, half: bool
) -> nerfbake.Volume:
    form = target.require("Volume", codec=codec)
    volume: nerfbake.Volume = choice.whole(steps, source, source.read(steps, nerfbake.Volume))
    if half or not form.load_volume_module().KEEPS_HALVES:
        with source.blamed(steps, "rounding"):
            volume = nerfbake.cast_volume(volume, dtype="float16" if half else "float32")
    tell_of_halves(steps, form, volume)
    target.write(steps, volume, codec=codec)
    return volume


def _octree_of(
    steps: Steps, source: Source, volume: nerfbake.Volume, choice: Choice, *, half: bool
) -> nerfbake.SparseVoxelOctree:
    foreign = volume.frame is None or bool(choice.grids)
    if not foreign and choice.up:
        raise UsageError("the octree in IN stands where it stood; allowed: no --up, or --grid for a density alone")
    with source.blamed(steps, "making the octree"):
        if foreign and len(volume.grids) + len(volume.unread) > 1:
            found = f"has the grids {', '.join(volume.labels)}"
            raise InvalidScene(Problem("the volume", found, "--grid NAME for an octree of that density alone"))
        if half:
            volume = nerfbake.cast_volume(volume, dtype="float16")
        return nerfbake.octree_of_density(volume) if foreign else nerfbake.octree_of_volume(volume)
