"""`nerfbake bench`: comparisons on one's own scene and machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import nerfbake
from nerfbake import io
from nerfbake.cli.params import CAPTURE, Resolution, max_memory, reads, speaks, without_effect
from nerfbake.cli.paths import Capture, Photographs, Reads
from nerfbake.cli.reports import Destination, Resolutions, reports
from nerfbake.cli.words import Words
from nerfbake.jobs.files import Source
from nerfbake.jobs.photographs import read_photographs
from nerfbake.jobs.views import read_cameras


@click.group()
def bench() -> None:
    """Measure speed and size on your own files."""


@bench.command()
@click.argument("scenes", metavar="SCENE...", nargs=-1, required=True, type=Reads(allow_dash=True))
@click.option(
    "--resolution", type=Resolution(), help="Voxels along each axis of a PlenOctree.  [default: the tree's finest]"
)
@click.option(
    "--formats",
    metavar="NAME,...",
    default="",
    help="Only rows whose names start with one of these, for example svo.pb,json.  [default: all]",
)
@reports(rounds=5, chart="size against time for the first SCENE")
@max_memory
@speaks
def formats(
    scenes: tuple[str, ...],
    resolution: Any,
    formats: str,
    rounds: int,
    destination: Destination,
    words: Words,
) -> None:
    """Measure size and speed of octree formats.

    Writes each SCENE in every octree format, reads it again, and reports sizes and times.

    \b
      nerfbake bench formats chair.npz --resolution 128
      nerfbake bench formats a.svo.pb --formats svo.fb,svo.capnp --plot formats.svg
    """
    from nerfbake.bench.formats.comparison import chart_formats, compare_formats
    from nerfbake.bench.formats.serializations import chosen

    names = [name.strip() for name in formats.split(",") if name.strip()]
    chosen(names)  # before anything is read
    found = []
    for path in scenes:
        octree = _octree(Source(path), words, resolution, only=len(scenes) == 1)
        found.append(compare_formats(octree, Path(path).name, rounds=rounds, formats=names, progress=words.phase))
    destination.write(found, chart_formats)


@bench.command()
@click.argument("folder", metavar="STAGE1_DIR", type=Reads())
@reports(rounds=1, chart="error against bytes")
@max_memory
@speaks
def atlas(folder: str, rounds: int, destination: Destination, words: Words) -> None:
    """Measure error and time of atlas methods.

    Bakes STAGE1_DIR with every method in many sizes, beside table 2 of the K-means thesis and scikit-learn.

    \b
      nerfbake bench atlas mesh_stage1 --plot error.svg
    """
    from nerfbake.bench.atlas.comparison import chart_atlases, compare_atlases

    io.load_folder(folder, nerfbake.Stage1)
    destination.write([compare_atlases(folder, rounds=rounds, progress=words.phase)], chart_atlases)


@bench.command()
@reads
@click.option(
    "--resolution", type=Resolutions(), help="Voxels along each axis of a PlenOctree.  [default: 128,320,512]"
)
@click.option(
    "--rays", metavar="CAPTURE", type=Capture(), help="Count the samples along the rays of these cameras, at 400x400."
)
@reports(rounds=3, chart="time against memory")
@speaks
def access(
    source: Source,
    resolution: tuple[int, ...] | None,
    rays: str | None,
    rounds: int,
    destination: Destination,
    words: Words,
) -> None:
    """Measure trilinear reads of a volume.

    Times reads of IN as a dense array, an octree and a VDB, beside NanoVDB and Warp (PlenVDB's table 3).

    \b
      nerfbake bench access chair.npz --plot access.svg
      nerfbake bench access chair.npz --resolution 128,800 --rays transforms.json
    """
    from nerfbake.bench.access.comparison import chart_access, compare_access

    scene = source.read(words, nerfbake.N3Tree, nerfbake.SparseVoxelOctree)
    with source.blamed(words, "reading"):
        report = compare_access(
            scene,
            Path(source.path).name,
            resolutions=resolution,
            rounds=rounds,
            cameras=read_cameras(words, rays).cameras if rays else (),
            progress=words.phase,
        )
    destination.write([report], chart_access)


@bench.command()
@reads
@click.option(
    "--cameras", metavar="CAPTURE", type=Capture(), help=f"The cameras: {CAPTURE}.  [default: 8 views around IN]"
)
@reports(rounds=3, chart="time a frame against memory")
@speaks
def render(source: Source, cameras: str | None, rounds: int, destination: Destination, words: Words) -> None:
    """Measure frames of a scene in every structure.

    Times frames of the PlenOctree or octree IN in every structure that it can become, at 400x400 and 800x800.

    \b
      nerfbake bench render chair.npz --cameras transforms.json --plot frames.svg
    """
    from nerfbake.bench.render import chart_rendering, compare_rendering

    scene = source.read(words, nerfbake.N3Tree, nerfbake.SparseVoxelOctree)
    views = read_cameras(words, cameras) if cameras else None
    name = Path(source.path).name
    with source.blamed(words, "rendering"):
        found = compare_rendering(scene, name, views, rounds=rounds, progress=words.phase)
    destination.write([found], chart_rendering)


@bench.command()
@click.argument("source", metavar="SOURCE", type=Photographs())
@click.option(
    "--fits",
    metavar="NAME,...",
    default="fast,balanced,best",
    show_default=True,
    help="What is fitted: presets, and numbers for as many minutes on two cores.",
)
@click.option(
    "--resolution",
    type=click.IntRange(32, 512),
    default=256,
    show_default=True,
    help="Voxels along each axis, as `nerfbake fit` has them.",
)
@click.option(
    "--samples", type=click.IntRange(1, 2), default=2, show_default=True, help="Rays along each edge of a pixel."
)
@reports(rounds=3, chart="PSNR over time")
@max_memory
@speaks
def fit(
    source: str, fits: str, resolution: int, samples: int, rounds: int, destination: Destination, words: Words
) -> None:
    """Measure the quality of a fit over time.

    Fits the photographs of SOURCE: PSNR over time, and the field as grids of its own, merged and in float16.

    \b
      nerfbake bench fit capture --plot curve.svg
      nerfbake bench fit capture --fits fast,2
    """
    from nerfbake.bench.fit.comparison import chart_fits, compare_fits

    courses = [name.strip() for name in fits.split(",") if name.strip()]
    views = read_photographs(words, Source(source)).judges
    found = compare_fits(
        source,
        views,
        courses=courses,
        samples=samples,
        resolution=resolution,
        rounds=rounds,
        progress=words.phase,
    )
    destination.write([found], chart_fits)


@bench.command()
@click.argument("scenes", metavar="SCENE...", nargs=-1, required=True, type=Reads(allow_dash=True))
@click.option(
    "--cameras",
    metavar="CAPTURE",
    type=Capture(),
    help=f"The cameras: {CAPTURE}.  [default: 5 views around each SCENE]",
)
@reports(rounds=5, chart="time a frame against memory for the first SCENE")
@max_memory
@speaks
def view(scenes: tuple[str, ...], cameras: str | None, rounds: int, destination: Destination, words: Words) -> None:
    """Measure frames of pages in a browser.

    Times frames of each SCENE in a headless Chromium at 400x400, which Playwright drives.

    A PlenOctree or an octree: as `nerfbake view` shows it, and as an octree whose shader goes down from the root. A
    stage-1 folder of nerf2mesh: the MLP with its weights in textures and as constants, and an atlas of each method.

    \b
      nerfbake bench view chair.npz
      nerfbake bench view mesh_stage1
      nerfbake bench view chair.npz ship.svo.pb --cameras transforms.json --plot frames.svg
    """
    from nerfbake.bench.view.browser import require_browser
    from nerfbake.bench.view.comparison import chart_pages, compare_pages
    from nerfbake.bench.view.surfaces import compare_surfaces

    require_browser()
    views = read_cameras(words, cameras).cameras if cameras else ()
    found = []
    for path in scenes:
        source = Source(path)
        scene = source.read(words, nerfbake.N3Tree, nerfbake.SparseVoxelOctree, nerfbake.Stage1)
        compare = compare_surfaces if isinstance(scene, nerfbake.Stage1) else compare_pages
        with source.blamed(words, "drawing pages"):
            found.append(compare(scene, Path(path).name, views, rounds=rounds, progress=words.phase))
    destination.write(found, chart_pages)


@bench.command()
@reads
@click.option("--cameras", metavar="CAPTURE", type=Capture(), help=f"The cameras of --truth: {CAPTURE}.")
@click.option("--truth", type=Reads(), help="A folder with a photograph NAME.png for each camera: measure.")
@reports(rounds=1, chart="loss against bytes")
@speaks
def compress(
    source: Source,
    cameras: str | None,
    truth: str | None,
    rounds: int,
    destination: Destination,
    words: Words,
) -> None:
    """Measure size against loss of compression.

    Draws the rate-distortion curve of `nerfbake compress` for the PlenOctree or octree IN, beside general compressors,
    palettes and PlenOctrees' median cut.

    \b
      nerfbake bench compress chair.npz --plot curve.svg
      nerfbake bench compress chair.npz --cameras transforms.json --truth photographs
    """
    from nerfbake.bench.compress.comparison import chart_compression, compare_compression
    from nerfbake.jobs.compressions import Photographs

    Photographs(cameras, truth).require()
    if truth is None:
        without_effect("cameras", here="where nothing is measured", allowed="--cameras with --truth")
    octree, name = _octree(source, words, None, only=False), Path(source.path).name
    with source.blamed(words, "compressing"):
        found = compare_compression(octree, name, cameras=cameras, truth=truth, rounds=rounds, progress=words.phase)
    destination.write([found], chart_compression)


def _octree(source: Source, words: Words, resolution: Any, *, only: bool) -> Any:
    """The octree to measure; only: there is no other scene that --resolution could be for."""
    scene = source.read(words)
    if isinstance(scene, nerfbake.SparseVoxelOctree):
        if only:
            allowed = "--resolution with a PlenOctree"
            without_effect("resolution", here="on an octree, which has its own", allowed=allowed)
        return scene
    with source.blamed(words, "building the octree"):
        return nerfbake.build_octree(scene, resolution=resolution)
