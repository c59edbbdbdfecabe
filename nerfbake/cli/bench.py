"""`nerfbake bench`: comparisons on one's own scene and machine."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

import nerfbake
from nerfbake import io
from nerfbake.cli.params import (
    CAPTURE,
    Command,
    Input,
    Resolution,
    max_memory,
    read_cameras,
    reads,
    speaks,
    without_effect,
)
from nerfbake.cli.words import Words
from nerfbake.errors import OutputError, UsageError


@dataclass(frozen=True)
class Target:
    """Where a report goes, spelled how, and its chart."""

    kind: str
    output: str | None
    plot: str | None
    force: bool

    def require(self) -> None:
        """Raises, before anything is measured, if it could not be written."""
        if self.plot and Path(self.plot).suffix not in (".png", ".svg"):
            raise UsageError(f"the ending of {self.plot!r} names no picture; allowed: .png, .svg")
        for path in filter(None, (self.output, self.plot)):
            io.require_absent(path, force=self.force)

    def write(self, reports: Sequence[Any], chart: Callable[[Any, str], bytes]) -> None:
        """All reports as one document, and the chart of the first."""
        from nerfbake.bench.report import document

        text = document(reports, self.kind)
        if self.output:
            self._save(self.output, text.encode())
        else:
            io.print_text(text.removesuffix("\n"))
        if self.plot:
            self._save(self.plot, chart(reports[0], Path(self.plot).suffix))

    def _save(self, path: str, content: bytes) -> None:
        with io.blame(path, OutputError), io.replacing(Path(path), force=self.force) as file:
            file.write(content)


def reports(*, rounds: int, chart: str) -> Callable[[Command], Command]:
    """Adds --rounds, and --format, -o, --plot and --force, which the command gets as `target`."""

    def add(function: Command) -> Command:
        @click.option(
            "--rounds", type=click.IntRange(1, 1000), default=rounds, show_default=True, help="Runs that count."
        )
        @click.option("--format", "kind", type=click.Choice(["md", "csv", "json"]), default="md", show_default=True)
        @click.option("-o", "--output", type=click.Path(), help="A file for the report.  [default: stdout]")
        @click.option("--plot", type=click.Path(), help=f"A chart of {chart}, .png or .svg.")
        @click.option("--force", is_flag=True, help="Replace files that exist.")
        @functools.wraps(function)
        def command(*args: Any, kind: str, output: str | None, plot: str | None, force: bool, **others: Any) -> Any:
            if not (output or plot):
                without_effect("force", here="where no file is written", allowed="--force with -o or --plot")
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
@reports(rounds=5, chart="size against time, of the first SCENE")
@max_memory
@speaks
def formats(
    scenes: tuple[str, ...],
    resolution: Any,
    formats: str,
    rounds: int,
    target: Target,
    words: Words,
) -> None:
    """Write each SCENE in every octree format, read it again, and say what it took.

    \b
      nerfbake bench formats chair.npz --resolution 128
      nerfbake bench formats a.svo.pb --formats svo.fb,svo.capnp --plot formats.svg
    """
    from nerfbake.bench import formats as benchmark

    names = [name.strip() for name in formats.split(",") if name.strip()]
    benchmark.chosen(names)
    found = []
    for path in scenes:
        octree = _octree(Input(path), words, resolution, only=len(scenes) == 1)
        found.append(benchmark.compare(octree, Path(path).name, rounds=rounds, formats=names, progress=words.phase))
    target.write(found, benchmark.chart)


@bench.command()
@click.argument("folder", metavar="STAGE1_DIR", type=click.Path())
@reports(rounds=1, chart="error against bytes")
@speaks
def atlas(folder: str, rounds: int, target: Target, words: Words) -> None:
    """Bake STAGE1_DIR in every method and many sizes, beside the K-means thesis' table 2 and scikit-learn.

    \b
      nerfbake bench atlas mesh_stage1 --plot error.svg
    """
    from nerfbake.bench import atlas as benchmark

    io.load_folder(folder, nerfbake.Stage1)
    target.write([benchmark.compare(folder, rounds=rounds, progress=words.phase)], benchmark.chart)


@bench.command()
@reads
@click.option("--resolution", type=Resolutions(), help="For a PlenOctree: voxels an axis.  [default: 128,320,512]")
@click.option("--rays", metavar="CAPTURE", help="Count the samples along these cameras' rays, at 400x400.")
@reports(rounds=3, chart="time against memory")
@speaks
def access(
    source: Input,
    resolution: tuple[int, ...] | None,
    rays: str | None,
    rounds: int,
    target: Target,
    words: Words,
) -> None:
    """Read IN trilinearly as dense array, octree and VDB, beside NanoVDB and Warp: PlenVDB's table 3.

    \b
      nerfbake bench access chair.npz --plot access.svg
      nerfbake bench access chair.npz --resolution 128,800 --rays transforms.json
    """
    from nerfbake.bench import access as benchmark

    scene = source.read(words, nerfbake.N3Tree, nerfbake.SparseVoxelOctree)
    with source.blamed(words, "reading"):
        report = benchmark.compare(
            scene,
            Path(source.path).name,
            resolutions=resolution,
            rounds=rounds,
            cameras=read_cameras(words, rays).cameras if rays else (),
            progress=words.phase,
        )
    target.write([report], benchmark.chart)


@bench.command()
@reads
@click.option("--cameras", metavar="CAPTURE", help=f"{CAPTURE}.  [default: 8 views around IN]")
@reports(rounds=3, chart="time a frame against memory")
@speaks
def render(source: Input, cameras: str | None, rounds: int, target: Target, words: Words) -> None:
    """Render the PlenOctree or octree IN as every structure that it can become, at 400x400 and 800x800.

    \b
      nerfbake bench render chair.npz --cameras transforms.json --plot frames.svg
    """
    from nerfbake.bench import render as benchmark

    scene = source.read(words, nerfbake.N3Tree, nerfbake.SparseVoxelOctree)
    views = read_cameras(words, cameras) if cameras else None
    name = Path(source.path).name
    with source.blamed(words, "rendering"):
        found = benchmark.compare(scene, name, views, rounds=rounds, progress=words.phase)
    target.write([found], benchmark.chart)


def _octree(source: Input, words: Words, resolution: Any, *, only: bool) -> Any:
    """The octree to measure; only: there is no other scene that --resolution could be for."""
    scene = source.read(words)
    if isinstance(scene, nerfbake.SparseVoxelOctree):
        if only:
            allowed = "--resolution with a PlenOctree"
            without_effect("resolution", here="on an octree, which has its own", allowed=allowed)
        return scene
    with source.blamed(words, "building the octree"):
        return nerfbake.build_octree(scene, resolution=resolution)
