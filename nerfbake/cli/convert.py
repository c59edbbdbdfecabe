"""`nerfbake convert`: the same octree, or the same volume, in another format or layout."""

from __future__ import annotations

from typing import Any, Literal

import click

import nerfbake
from nerfbake.cli.params import reads, speaks, writes_octree
from nerfbake.cli.volumes import chooses_grids, codec_option, is_volume, tell_of_halves
from nerfbake.cli.words import Words
from nerfbake.errors import InvalidScene, Problem, UsageError
from nerfbake.jobs.files import Source, Target
from nerfbake.jobs.grids import Choice


@click.command()
@reads
@writes_octree("Volume")
@click.option(
    "--layout",
    type=click.Choice(["full", "compact"]),
    help="full: child slots for every node; compact: none for the nodes of the last level.  [default: as in IN]",
)
@chooses_grids
@codec_option
@click.option("--half", is_flag=True, help="Store the values of a volume as float16.")
@speaks
def convert(
    source: Source,
    target: Target,
    layout: Literal["full", "compact"] | None,
    no_child: int | None,
    choice: Choice,
    codec: str | None,
    half: bool,
    words: Words,
) -> None:
    """Write the octree IN as OUT, in another format or layout; or the volume IN as .vdb, .nvdb or .vdb.npz. No loss.

    A volume becomes an octree where `nerfbake vdb` wrote it with the grids `index` or `density,sh`; of any other fog
    the octree has the density alone.

    \b
      nerfbake convert chair.svo.pb chair.svo.npz
      nerfbake convert chair.svo.pb - --to svo.npz --layout compact > chair.svo.npz
      nerfbake convert chair.nvdb chair.svo.pb
      nerfbake convert smoke.vdb smoke.nvdb --grid density
      nerfbake convert smoke.vdb smoke.svo.npz --grid density --up y
    """
    if is_volume(target):
        if layout or no_child:
            raise UsageError("a volume has no child slots; allowed: no --layout and no --no-child")
        _to_volume(source, target, choice, codec, half=half, words=words)
        return
    target.require("SparseVoxelOctree", no_child=no_child, codec=codec)
    octree = source.read(words, nerfbake.SparseVoxelOctree, nerfbake.Volume)
    if half and not isinstance(octree, nerfbake.Volume):
        raise UsageError("--half is for volumes; allowed: `nerfbake svo --dtype float16`")
    octree = choice.of(words, source, octree)
    if isinstance(octree, nerfbake.Volume):
        octree = _octree(source, octree, choice, half=half, words=words)
    target.write(words, octree.with_layout(layout or octree.layout), no_child=no_child, codec=codec)


def _to_volume(source: Source, target: Target, choice: Choice, codec: str | None, *, half: bool, words: Words) -> None:
    form = target.require("Volume", codec=codec)
    volume = choice.whole(words, source, source.read(words, nerfbake.Volume))
    if half or not form.load_volume_module().KEEPS_HALVES:
        with source.blamed(words, "rounding"):
            volume = nerfbake.cast_volume(volume, dtype="float16" if half else "float32")
    tell_of_halves(words, form, volume)
    target.write(words, volume, codec=codec)


def _octree(source: Source, volume: Any, choice: Choice, *, half: bool, words: Words) -> Any:
    foreign = volume.frame is None or bool(choice.grids)
    if not foreign and choice.up:
        raise UsageError("the octree in IN stands where it stood; allowed: no --up, or --grid for a density alone")
    with source.blamed(words, "making the octree"):
        if foreign and len(volume.grids) + len(volume.unread) > 1:
            found = f"has the grids {', '.join(volume.labels)}"
            raise InvalidScene(Problem("the volume", found, "--grid NAME for an octree of that density alone"))
        if half:
            volume = nerfbake.cast_volume(volume, dtype="float16")
        return nerfbake.octree_of_density(volume) if foreign else nerfbake.octree_of_volume(volume)
