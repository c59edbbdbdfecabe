"""`nerfbake bench`: comparisons on one's own scene and machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import nerfbake
from nerfbake import io
from nerfbake.cli.params import Input, Resolution, Size, speaks
from nerfbake.cli.words import Words
from nerfbake.errors import OutputError, UsageError


@click.group()
def bench() -> None:
    """Compare on your own scene and machine."""


@bench.command()
@click.argument("scenes", metavar="SCENE...", nargs=-1, required=True, type=click.Path(allow_dash=True))
@click.option("--resolution", type=Resolution(), help="For a PlenOctree: voxels an axis.  [default: the tree's finest]")
@click.option("--rounds", type=click.IntRange(1, 1000), default=5, show_default=True, help="Runs that count.")
@click.option("--formats", metavar="NAME,...", default="", help="Only rows that start so: svo.pb,json.  [default: all]")
@click.option("--format", "kind", type=click.Choice(["md", "csv", "json"]), default="md", show_default=True)
@click.option("-o", "--output", type=click.Path(), help="A file for the report.  [default: stdout]")
@click.option("--plot", type=click.Path(), help="A chart of size against time, .png or .svg; of the first SCENE.")
@click.option("--force", is_flag=True, help="Replace files that exist.")
@click.option("--max-memory", type=Size(), default="4GiB", show_default=True, help="Most that a SCENE may declare.")
@speaks
def formats(scenes: tuple[str, ...], words: Words, kind: str, **options: Any) -> None:
    """Write each SCENE in every octree format, read it again, and say what it took.

    \b
      nerfbake bench formats chair.npz --resolution 128
      nerfbake bench formats a.svo.pb --formats svo.fb,svo.capnp --plot formats.svg
    """
    from nerfbake.bench import formats as benchmark
    from nerfbake.bench.report import WRITERS

    output, plot, force = options["output"], options["plot"], options["force"]
    if plot and Path(plot).suffix not in (".png", ".svg"):
        raise UsageError(f"the ending of {plot!r} names no picture; allowed: .png, .svg")
    for target in filter(None, (output, plot)):
        io.require_absent(target, force=force)
    names = [name.strip() for name in options["formats"].split(",") if name.strip()]
    benchmark.chosen(names)
    reports = []
    for path in scenes:
        octree = _octree(Input(path, options["max_memory"]), words, options["resolution"])
        report = benchmark.compare(
            octree, Path(path).name, rounds=options["rounds"], formats=names, progress=words.phase
        )
        reports.append(report)
    text = benchmark.joined([WRITERS[kind](report) for report in reports], kind)
    if output:
        _write(output, text.encode(), force=force)
    else:
        click.echo(text, nl=False)
    if plot:
        _write(plot, benchmark.chart(reports[0], Path(plot).suffix), force=force)


@bench.command()
@click.argument("folder", metavar="STAGE1_DIR", type=click.Path())
@click.option("--rounds", type=click.IntRange(1, 100), default=1, show_default=True, help="Runs of every atlas.")
@click.option("--format", "kind", type=click.Choice(["md", "csv", "json"]), default="md", show_default=True)
@click.option("-o", "--output", type=click.Path(), help="A file for the report.  [default: stdout]")
@click.option("--plot", type=click.Path(), help="A chart of error against bytes, .png or .svg.")
@click.option("--force", is_flag=True, help="Replace files that exist.")
@speaks
def atlas(folder: str, rounds: int, kind: str, output: str | None, plot: str | None, force: bool, words: Words) -> None:
    """Bake STAGE1_DIR in every method and many sizes, beside the K-means thesis' table 2 and scikit-learn.

    \b
      nerfbake bench atlas mesh_stage1 --plot error.svg
    """
    from nerfbake.bench import atlas as benchmark
    from nerfbake.bench.report import WRITERS

    if plot and Path(plot).suffix not in (".png", ".svg"):
        raise UsageError(f"the ending of {plot!r} names no picture; allowed: .png, .svg")
    for target in filter(None, (output, plot)):
        io.require_absent(target, force=force)
    io.load_folder(folder, nerfbake.Stage1)
    report = benchmark.compare(folder, rounds=rounds, progress=words.phase)
    text = WRITERS[kind](report)
    if output:
        _write(output, text.encode(), force=force)
    else:
        click.echo(text, nl=False)
    if plot:
        _write(plot, benchmark.chart(report, Path(plot).suffix), force=force)


def _octree(source: Input, words: Words, resolution: Any) -> Any:
    scene = source.read(words)
    if isinstance(scene, nerfbake.SparseVoxelOctree):
        return scene
    with source.blamed(words, "building the octree"):
        return nerfbake.build_octree(scene, resolution=resolution, max_memory=source.max_memory)


def _write(target: str, content: bytes, *, force: bool) -> None:
    with io.blame(target, OutputError), io.replacing(Path(target), force=force) as file:
        file.write(content)
