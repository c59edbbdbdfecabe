"""`nerfbake splats`: turn a field into Gaussian splats."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from nerfbake import io
from nerfbake.cli.fit import training_picture_options
from nerfbake.cli.function_params import function_options
from nerfbake.cli.params import (
    Number,
    ParamType,
    as_json,
    console_options,
    parse_count,
    seed,
    source_argument,
    target_argument,
)
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target

if TYPE_CHECKING:
    from nerfbake.jobs.splats import SplatsResult

_MOST = 20_000_000


class SplatCount(ParamType[int]):
    """A number of splats: 150000, 150k or 1.5M."""

    name = "N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        count = parse_count(str(value))
        if not 1 <= count <= _MOST:
            self.fail(f"{str(value)[:40]!r} is not a number of splats; allowed: 1 to 20M, for example 150k", param, ctx)
        return count


@click.command()
@source_argument
@target_argument("Splats")
@click.option(
    "--count", type=SplatCount(), default="150k", show_default=True, help="Largest number of splats, for example 150k."
)
@training_picture_options("Photographs that OUT is fitted to", "jobs.splats.SplatsViews")
@click.option(
    "--epochs", type=click.IntRange(1, 100), default=4, show_default=True, help="Number of passes over the pictures."
)
@click.option(
    "--min-psnr",
    type=Number(),
    help="Lowest allowed PSNR on the held-out views in dB. Below it, OUT is renamed to OUT.rejected (exit code 3).",
)
@function_options()
@seed
@as_json
@console_options
def splats(
    source: Source,
    target: Target,
    count: int,
    epochs: int,
    seed: int,
    as_json: bool,
    console: Console,
    **options: Any,
) -> None:
    """Turn a scene into Gaussian splats.

    Starts with the leaves of the PlenOctree, octree, volume or lattice IN that contribute most to pictures, and fits
    them to photographs (--views) or to pictures of IN. Splats are antialiased: viewers that know the flag show them
    right at every size. Prints the PSNR and SSIM of OUT on held-out photographs, or on pictures of IN from other sides.

    \b
      nerfbake splats chair.npz chair.spz
      nerfbake splats chair.npz chair.ply --count 50k --epochs 5
      nerfbake splats chair.npz chair.spz --views photographs --min-psnr 34
    """

    from nerfbake.jobs.splats import SplatsOptions, bake_splats

    def report(found: SplatsResult) -> None:
        if as_json:
            io.print_json(_facts(source, found))

    bake_splats(
        source,
        target,
        options=SplatsOptions(splats=count, epochs=epochs, seed=seed),
        steps=console,
        report=report,
        **options,
    )


def _facts(source: Source, found: SplatsResult) -> dict[str, Any]:
    return {
        "in": source.path,
        "file": found.path,
        "content": found.content,
        "bytes": found.bytes,
        "splats": found.splats,
        "psnr": found.psnr,
        "ssim": found.ssim,
        "cpu_seconds": found.worked,
        "seconds": found.passed,
        "views": [view._asdict() for view in found.views],
    }
