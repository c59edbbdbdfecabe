"""`nerfbake splats`: turn a field into Gaussian splats, or splats into fewer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from nerfbake import io
from nerfbake.cli.function_params import function_options
from nerfbake.cli.params import (
    Box,
    ParamType,
    as_json,
    bundled,
    console_options,
    max_memory,
    parse_count,
    seed,
    target_argument,
    without_effect,
)
from nerfbake.cli.paths import Reads
from nerfbake.cli.picture_params import held_out_psnr, training_picture_options
from nerfbake.cli.splat_files import splat_file_options
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target

if TYPE_CHECKING:
    from nerfbake.jobs.splat_choice import SplatChoice
    from nerfbake.jobs.splat_parts import SplatParts
    from nerfbake.jobs.splats import SplatsResult
    from nerfbake.scene.placement import Move

_FARTHEST = 1e15  # of a number of a step
_MOST = 20_000_000


class SplatCount(ParamType[int]):
    """A number of splats: 150000, 150k or 1.5M."""

    name = "N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        count = parse_count(str(value))
        if not 1 <= count <= _MOST:
            self.fail(f"{str(value)[:40]!r} is not a number of splats; allowed: 1 to 20M, for example 150k", param, ctx)
        return count


class Moves(ParamType["tuple[Move, ...]"]):
    """Steps such as r=0,90,0+s=2+t=1,0,0."""

    name = "STEPS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[Move, ...]:
        from nerfbake.scene.placement import Move

        moves = []
        for step in str(value).split("+"):
            kind, _, text = step.partition("=")
            try:
                numbers = tuple(map(float, text.split(",")))
            except ValueError:
                numbers = ()
            count = {"t": 3, "r": 3, "s": 1}.get(kind)
            if len(numbers) != count or not all(abs(number) < _FARTHEST for number in numbers) or numbers == (0,):
                allowed = "t=X,Y,Z, r=X,Y,Z in degrees and s=FACTOR, with + between them"
                self.fail(f"{step[:40]!r} is no step; allowed: {allowed}", param, ctx)
            if kind == "s" and numbers[0] < 0:
                self.fail(f"{step[:40]!r} is a reflection; allowed: a factor above 0", param, ctx)
            moves.append(Move(kind, numbers))  # type: ignore[arg-type]  # one of the three
        return tuple(moves)


@click.command()
@click.argument("source", metavar="IN...", nargs=-1, required=True, type=Reads(allow_dash=True))
@target_argument("Splats")
@click.option(
    "--count",
    type=SplatCount(),
    help="Largest number of splats, for example 150k.  [default: 150k; all splats of IN]",
)
@click.option(
    "--levels",
    type=click.IntRange(1, 8),
    help="Levels of detail of a folder, each with a quarter of the splats of the one before (OUT FOLDER/lod-meta.json)."
    "  [default: 4]",
)
@click.option(
    "--place",
    metavar="N STEPS",
    type=(click.IntRange(min=1), Moves()),
    multiple=True,
    help="Where the splats of the Nth IN are put, by steps in their order: r=X,Y,Z (rotate, degrees, about x, then y, "
    "then z), s=FACTOR (scale), t=X,Y,Z (translate), with + between them. Repeatable.",
)
@bundled(
    "parts",
    "jobs.splat_parts.SplatParts",
    click.option(
        "--box",
        type=Box(),
        help="Keep the splats with their centre in this box (splats only): two opposite corners, in world coordinates.",
    ),
    click.option(
        "--floaters",
        is_flag=True,
        help="Drop isolated splats, faint clouds, and huge splats far outside (splats only).",
    ),
    click.option("--largest", is_flag=True, help="Keep the largest connected part (splats only)."),
)
@click.option(
    "--in-up",
    type=click.Choice(["y", "z", "-y", "-z", "x", "-x"]),
    help="Axis of IN that points up: it becomes the up axis of OUT. -y: keep the world of IN, for its cameras and "
    "`nerfbake compare`.  [default: z; of splats, keep their world]",
)
@splat_file_options
@training_picture_options("Photographs that OUT is fitted to", "jobs.splats.SplatsViews")
@click.option(
    "--epochs",
    type=click.IntRange(0, 100),
    default=4,
    show_default=True,
    help="Number of passes over the pictures. 0: splats of IN are merged, and not fitted.",
)
@held_out_psnr
@function_options("box")
@seed
@max_memory
@as_json
@console_options
def splats(
    source: tuple[str, ...],
    target: Target,
    count: int | None,
    levels: int | None,
    place: tuple[tuple[int, tuple[Move, ...]], ...],
    parts: SplatParts,
    epochs: int,
    splats: SplatChoice,
    seed: int,
    as_json: bool,
    console: Console,
    **options: Any,
) -> None:
    """Turn a scene into splats, or splats into fewer.

    Starts with the leaves of the PlenOctree, octree, volume or lattice IN that contribute most to pictures, and fits
    them to photographs (--views) or to pictures of IN. Splats are antialiased: viewers that know the flag show them
    right at every size. Prints the PSNR and SSIM of OUT on held-out photographs, or on pictures of IN from other sides.

    If IN is splats, several files are joined where they are, or where --place puts them. Then they are cut, and
    neighbours are merged until --count are left, which are fitted to the same pictures. If none have to be merged, they
    are only fitted if there are photographs.

    Splats of a field stand upright in OUT: z of the field becomes the up axis of the format.

    If OUT is FOLDER/lod-meta.json, the folder has levels of detail, which PlayCanvas' viewers load by distance
    ("streamed SOG"): OUT as above, then its splats merged to a quarter, and fitted, again and again. Prints the PSNR
    and SSIM of each level.

    \b
      nerfbake splats chair.npz chair.spz
      nerfbake splats chair.npz chair.ply --count 50k --epochs 5
      nerfbake splats chair.npz chair.spz --views photographs --min-psnr 34
      nerfbake splats chair.npz chair.ply --in-up=-y
      nerfbake splats scene.ply small.spz --count 100k --floaters
      nerfbake splats scene.ply web/lod-meta.json --levels 3
      nerfbake splats room.ply table.ply both.spz --box=-2,-2,-2,2,2,2
      nerfbake splats room.ply chair.spz both.spz --place 2 s=0.5+r=0,90,0+t=1.5,0,2
    """

    from nerfbake.jobs.splat_parts import Placement
    from nerfbake.jobs.splats import SplatsOptions, bake_splats

    if not epochs:
        without_effect("frames", "seed", here="with --epochs 0", allowed="with --epochs 1 or more")

    def report(found: SplatsResult) -> None:
        if as_json:
            io.print_json(_facts(source, found))

    bake_splats(
        [Source(path) for path in source],
        target,
        options=SplatsOptions(
            splats=count,
            levels=levels,
            place=tuple(Placement(*each) for each in place),
            parts=parts,
            epochs=epochs,
            seed=seed,
        ),
        choice=splats,
        steps=console,
        report=report,
        **options,
    )


def _facts(source: tuple[str, ...], found: SplatsResult) -> dict[str, Any]:
    return {
        "in": source[0],
        "joined": list(source[1:]),
        "file": found.path,
        "content": found.content,
        "bytes": found.bytes,
        "splats": found.splats,
        "psnr": found.psnr,
        "ssim": found.ssim,
        "levels": [level._asdict() for level in found.levels],
        "cpu_seconds": found.worked,
        "seconds": found.passed,
        "views": [view._asdict() for view in found.views],
    }
