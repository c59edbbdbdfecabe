"""`nerfbake bench`: measure formats, atlases, lookups, compression and fits on your own scene and machine."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import click

from nerfbake import io
from nerfbake.cli.params import CAPTURE, Resolution, console_options, max_memory, source_argument, without_effect
from nerfbake.cli.paths import Capture, PhotographsPath, Reads, StateFolder
from nerfbake.cli.reports import Destination, Names, Resolutions, report_options
from nerfbake.console import Console
from nerfbake.errors import UsageError
from nerfbake.jobs.files import Source


@click.group()
def bench() -> None:
    """Measure speed and size on your own files."""


@bench.command()
@click.argument("scenes", metavar="SCENE...", nargs=-1, required=True, type=Reads(allow_dash=True))
@click.option(
    "--resolution", type=Resolution(), help="Voxels along each axis of a PlenOctree.  [default: the finest of the tree]"
)
@click.option(
    "--formats",
    metavar="NAME,...",
    default="",
    help="Measure only formats whose names start with one of these, for example svo.pb,json.  [default: all]",
)
@report_options(rounds=5, chart="size against time for the first SCENE")
@max_memory
@console_options
def formats(
    scenes: tuple[str, ...],
    resolution: Any,
    formats: str,
    rounds: int,
    destination: Destination,
    console: Console,
) -> None:
    """Measure size and speed of octree formats.

    Writes each SCENE in every octree format, reads it back, and reports sizes and times.

    \b
      nerfbake bench formats chair.npz --resolution 128
      nerfbake bench formats a.svo.pb --formats svo.fb,svo.capnp --plot formats.svg
    """
    from nerfbake.bench.formats.comparison import chart_formats, chosen, compare_formats

    names = [name.strip() for name in formats.split(",") if name.strip()]
    chosen(names)  # before anything is read
    found = []
    for path in scenes:
        octree = _octree(Source(path), console, resolution, only=len(scenes) == 1)
        found.append(compare_formats(octree, Path(path).name, rounds=rounds, formats=names, progress=console.phase))
    destination.write(found, chart_formats)


@bench.command()
@click.argument("folder", metavar="STAGE1_DIR", type=Reads())
@report_options(rounds=1, chart="error against bytes")
@max_memory
@console_options
def atlas(folder: str, rounds: int, destination: Destination, console: Console) -> None:
    """Measure error and time of atlas methods.

    Bakes STAGE1_DIR with every method in many sizes, and compares them with table 2 of the K-means thesis and with
    scikit-learn.

    \b
      nerfbake bench atlas mesh_stage1 --plot error.svg
    """

    from nerfbake.bench.atlas import chart_atlases, compare_atlases
    from nerfbake.scene.stage1 import Stage1

    io.load_folder(folder, Stage1)
    destination.write([compare_atlases(folder, rounds=rounds, progress=console.phase)], chart_atlases)


@bench.command()
@source_argument
@click.option(
    "--resolution", type=Resolutions(), help="Voxels along each axis of a PlenOctree.  [default: 128,320,512]"
)
@click.option(
    "--rays",
    metavar="CAPTURE",
    type=Capture(),
    help="Also count the samples along the rays of these cameras, at 400x400.",
)
@report_options(rounds=3, chart="time against memory")
@console_options
def access(
    source: Source,
    resolution: tuple[int, ...] | None,
    rays: str | None,
    rounds: int,
    destination: Destination,
    console: Console,
) -> None:
    """Measure trilinear reads of a volume.

    Times reads of IN as a dense array, an octree and a VDB, and compares them with NanoVDB and Warp (table 3 of the
    PlenVDB paper).

    \b
      nerfbake bench access chair.npz --plot access.svg
      nerfbake bench access chair.npz --resolution 128,800 --rays transforms.json
    """

    from nerfbake.bench.access.comparison import chart_access, compare_access
    from nerfbake.jobs.views import read_cameras
    from nerfbake.scene.n3tree import N3Tree
    from nerfbake.scene.octree import SparseVoxelOctree

    scene = source.read(console, N3Tree, SparseVoxelOctree)
    with source.blamed(console, "reading"):
        report = compare_access(
            scene,
            Path(source.path).name,
            resolutions=resolution,
            rounds=rounds,
            cameras=read_cameras(console, rays).cameras if rays else (),
            progress=console.phase,
        )
    destination.write([report], chart_access)


@bench.command()
@source_argument
@click.option("--cameras", metavar="CAPTURE", type=Capture(), help=f"Cameras for --truth: {CAPTURE}.")
@click.option(
    "--truth",
    type=Reads(),
    help="Folder with a photograph NAME.png for each camera, to measure the loss instead of predicting it.",
)
@report_options(rounds=1, chart="loss against bytes")
@console_options
def compress(
    source: Source,
    cameras: str | None,
    truth: str | None,
    rounds: int,
    destination: Destination,
    console: Console,
) -> None:
    """Measure the size and loss of compression.

    Measures the rate-distortion curve of `nerfbake compress` for the PlenOctree or octree IN, and compares it with
    general-purpose compressors, palettes and the median cut of PlenOctrees.

    \b
      nerfbake bench compress chair.npz --plot curve.svg
      nerfbake bench compress chair.npz --cameras transforms.json --truth photographs
    """
    from nerfbake.bench.compress import chart_compression, compare_compression
    from nerfbake.jobs.compressions import GroundTruth

    GroundTruth(cameras=cameras, truth=truth).require()
    if truth is None:
        without_effect("cameras", here="without --truth", allowed="--cameras with --truth")
    octree, name = _octree(source, console, None, only=False), Path(source.path).name
    with source.blamed(console, "compressing"):
        found = compare_compression(octree, name, cameras=cameras, truth=truth, rounds=rounds, progress=console.phase)
    destination.write([found], chart_compression)


@bench.command()
@click.argument("dataset", metavar="DATASET", type=PhotographsPath())
@click.option("--scenes", metavar="NAME,...", type=Names(), default="", help="Scenes of DATASET.  [default: all]")
@click.option(
    "--preset",
    "presets",
    metavar="NAME,...",
    type=Names("fast", "balanced", "best"),
    default="best",
    show_default=True,
    help="Schedules, as in `nerfbake fit`: fast, balanced, best.",
)
@click.option(
    "--table",
    type=click.Choice(["published", "own"]),
    default="published",
    show_default=True,
    help="published: put the fits beside the published figures of other methods. own: only the fits.",
)
@click.option(
    "--state",
    metavar="DIR",
    type=StateFolder(),
    help="Keep fitted files and checkpoints in this folder. After an interruption, the same command resumes.",
)
@report_options(rounds=None, chart="PSNR against minutes")
@max_memory
@console_options
def fit(
    dataset: str,
    scenes: tuple[str, ...],
    presets: tuple[str, ...],
    table: Literal["published", "own"],
    state: str | None,
    destination: Destination,
    console: Console,
) -> int:
    """Measure fits of NeRF-Synthetic.

    Fits the scenes of DATASET, NeRF-Synthetic as downloaded, and measures the written files on all test views: the
    protocol of the papers. Reports PSNR, SSIM, time, memory and size beside the published figures of other methods.
    DATASET can also be the folder of one scene.

    \b
      nerfbake bench fit nerf_synthetic --scenes chair,lego --state run --plot papers.svg
      nerfbake bench fit nerf_synthetic --preset fast,balanced,best --state run --format json

    Exit codes: 0 all fits are done, 1 some are not.
    """
    from nerfbake.bench.fit.comparison import chart_papers, compare_papers

    if destination.plot and table == "own":
        raise UsageError("--plot shows published figures; allowed: --table published")
    with ExitStack() as stack:
        folder = state or stack.enter_context(TemporaryDirectory(prefix="nerfbake-bench-"))
        options: dict[str, Any] = {"scenes": scenes, "presets": presets, "published": table == "published"}
        report, batch = compare_papers(dataset, state=folder, steps=console, **options)
    if report is None:
        onward = f"run the same command to resume from {state}" if state else "without --state nothing is kept"
        console.say(f"{batch.summary}; {onward}")
    else:
        destination.write([report], chart_papers)
    return batch.exit_code


def _octree(source: Source, console: Console, resolution: Any, *, only: bool) -> Any:
    """Return the octree to measure. only: it is the only scene, so --resolution is an error if it is an octree."""

    from nerfbake.scene.n3tree import N3Tree
    from nerfbake.scene.octree import SparseVoxelOctree
    from nerfbake.stages.n3tree_to_octree import build_octree

    scene = source.read(console, N3Tree, SparseVoxelOctree)
    if isinstance(scene, SparseVoxelOctree):
        if only:
            allowed = "--resolution with a PlenOctree"
            without_effect("resolution", here="on an octree, which has its own", allowed=allowed)
        return scene
    with source.blamed(console, "building the octree"):
        return build_octree(scene, resolution=resolution)
