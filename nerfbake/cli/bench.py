"""`nerfbake bench`: comparisons on one's own scene and machine."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

import nerfbake
from nerfbake import io
from nerfbake.cli.params import Input, Resolution, Size, speaks
from nerfbake.cli.words import Words
from nerfbake.errors import OutputError, UsageError


@dataclass(frozen=True)
class Target:
    """Where a report goes, and as what."""

    kind: str
    output: str | None
    plot: str | None
    force: bool

    def require(self) -> None:
        """Raises, before anything is measured, if it could not be written."""
        if self.plot and Path(self.plot).suffix not in (".png", ".svg"):
            raise UsageError(f"the ending of {self.plot!r} names no picture; allowed: .png, .svg")
        for target in filter(None, (self.output, self.plot)):
            io.require_absent(target, force=self.force)

    def write(self, reports: list[Any], chart: Callable[[Any, str], bytes]) -> None:
        """All reports as one document, and the first one's chart."""
        from nerfbake.bench.report import WRITERS, joined

        text = joined([WRITERS[self.kind](report) for report in reports], self.kind)
        if self.output:
            self._replace(self.output, text.encode())
        else:
            click.echo(text, nl=False)
        if self.plot:
            self._replace(self.plot, chart(reports[0], Path(self.plot).suffix))

    def _replace(self, path: str, content: bytes) -> None:
        with io.blame(path, OutputError), io.replacing(Path(path), force=self.force) as file:
            file.write(content)


def reports(*, plot: str, rounds: int, most: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Adds --rounds and where the report goes; the command gets `rounds` and a `target` that can be written."""

    def add(function: Callable[..., Any]) -> Callable[..., Any]:
        @click.option(
            "--rounds", type=click.IntRange(1, most), default=rounds, show_default=True, help="Runs that count."
        )
        @click.option("--format", "kind", type=click.Choice(["md", "csv", "json"]), default="md", show_default=True)
        @click.option("-o", "--output", type=click.Path(), help="A file for the report.  [default: stdout]")
        @click.option("--plot", type=click.Path(), help=f"A chart of {plot}, .png or .svg.")
        @click.option("--force", is_flag=True, help="Replace files that exist.")
        @speaks
        @functools.wraps(function)
        def command(*args: Any, kind: str, output: str | None, plot: str | None, force: bool, **others: Any) -> Any:
            target = Target(kind, output, plot, force)
            target.require()
            return function(*args, target=target, **others)

        return command

    return add


class Resolutions(click.ParamType[tuple[int, ...]]):
    """Voxels an axis, one or several."""

    name = "R,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        edges = value.split(",")
        if not all(edge.isdecimal() and len(edge) < 5 and 1 <= int(edge) <= 4096 for edge in edges):
            self.fail(f"{value!r} are no resolutions; allowed: R,R,..., each 1 to 4096", param, ctx)
        return tuple(dict.fromkeys(map(int, edges)))


@click.group()
def bench() -> None:
    """Compare on your own scene and machine."""


@bench.command()
@click.argument("scenes", metavar="SCENE...", nargs=-1, required=True, type=click.Path(allow_dash=True))
@click.option("--resolution", type=Resolution(), help="For a PlenOctree: voxels an axis.  [default: the tree's finest]")
@click.option("--formats", metavar="NAME,...", default="", help="Only rows that start so: svo.pb,json.  [default: all]")
@click.option("--max-memory", type=Size(), default="4GiB", show_default=True, help="Most that a SCENE may declare.")
@reports(plot="size against time, of the first SCENE", rounds=5, most=1000)
def formats(scenes: tuple[str, ...], words: Words, target: Target, rounds: int, **options: Any) -> None:
    """Write each SCENE in every octree format, read it again, and say what it took.

    \b
      nerfbake bench formats chair.npz --resolution 128
      nerfbake bench formats a.svo.pb --formats svo.fb,svo.capnp --plot formats.svg
    """
    from nerfbake.bench import formats as benchmark

    names = [name.strip() for name in options["formats"].split(",") if name.strip()]
    benchmark.chosen(names)
    found = []
    for path in scenes:
        octree = _octree(Input(path, options["max_memory"]), words, options["resolution"])
        found.append(benchmark.compare(octree, Path(path).name, rounds=rounds, formats=names, progress=words.phase))
    target.write(found, benchmark.chart)


@bench.command()
@click.argument("folder", metavar="STAGE1_DIR", type=click.Path())
@reports(plot="error against bytes", rounds=1, most=100)
def atlas(folder: str, rounds: int, target: Target, words: Words) -> None:
    """Bake STAGE1_DIR in every method and many sizes, beside the K-means thesis' table 2 and scikit-learn.

    \b
      nerfbake bench atlas mesh_stage1 --plot error.svg
    """
    from nerfbake.bench import atlas as benchmark

    io.load_folder(folder, nerfbake.Stage1)
    target.write([benchmark.compare(folder, rounds=rounds, progress=words.phase)], benchmark.chart)


@bench.command()
@click.argument("path", metavar="SCENE", type=click.Path(allow_dash=True))
@click.option("--resolution", type=Resolutions(), help="For a PlenOctree: voxels an axis.  [default: 128,320,512]")
@click.option("--rays", metavar="TRANSFORMS", help="Count the samples along these cameras' rays, at 400x400.")
@click.option(
    "--max-memory",
    type=Size(),
    default="4GiB",
    show_default=True,
    help="Most that SCENE, its grids, or a row may take.",
)
@reports(plot="time against memory", rounds=3, most=1000)
def access(
    path: str,
    resolution: tuple[int, ...] | None,
    rays: str | None,
    max_memory: int,
    rounds: int,
    target: Target,
    words: Words,
) -> None:
    """Read SCENE trilinearly as dense array, octree and VDB, beside NanoVDB and Warp: PlenVDB's table 3.

    \b
      nerfbake bench access chair.npz --plot access.svg
      nerfbake bench access chair.npz --resolution 128,800 --rays transforms.json
    """
    from nerfbake.bench import access as benchmark

    source = Input(path, max_memory)
    scene = source.read(words, nerfbake.N3Tree, nerfbake.SparseVoxelOctree)
    cameras = io.load(rays, nerfbake.Cameras).cameras if rays else ()
    with io.blame(io.reading_name(path)):
        report = benchmark.compare(
            scene,
            Path(path).name,
            resolutions=resolution,
            rounds=rounds,
            max_memory=max_memory,
            cameras=cameras,
            progress=words.phase,
        )
    target.write([report], benchmark.chart)


def _octree(source: Input, words: Words, resolution: Any) -> Any:
    scene = source.read(words)
    if isinstance(scene, nerfbake.SparseVoxelOctree):
        return scene
    with source.blamed(words, "building the octree"):
        return nerfbake.build_octree(scene, resolution=resolution, max_memory=source.max_memory)
