"""The arguments and options that commands share, each said once. TR-24-01: docs/sources.md."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import click
from click.core import ParameterSource
from click.types import FloatParamType

from nerfbake import catalog, memory
from nerfbake.cli.paths import Capture, Output, Reads, Stage1AndFolder
from nerfbake.cli.words import Mode, Words
from nerfbake.errors import format_size
from nerfbake.jobs.budgets import Budget
from nerfbake.jobs.files import FolderTarget, Source, Stage1Source, Target

CAPTURE = "a transforms.json, or a folder that holds one, a COLMAP model, or the poses of LLFF or NSVF"


class Number(FloatParamType):
    """Any number; NaN, which is no limit that anything could keep to, is none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        return _told(self, super().convert(value, param, ctx), param, ctx)


class NumberRange(click.FloatRange):
    """A number in a range; NaN, which is neither below nor above it, is none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        return _told(self, super().convert(value, param, ctx), param, ctx)


def _told(
    kind: click.ParamType[float], number: float, param: click.Parameter | None, ctx: click.Context | None
) -> float:
    if math.isnan(number):
        kind.fail("NaN is not allowed; allowed: a number", param, ctx)
    return number


class Size(click.ParamType[int]):
    """A number of bytes: 512MB, 4GiB, 1000000."""

    name = "size"
    units = {"": 1, "b": 1} | {f"{k}b": 1000**i for i, k in enumerate("kmgt", 1)}
    units |= {f"{k}ib": 1024**i for i, k in enumerate("kmgt", 1)}

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        number = value.lower().rstrip("bkmgti ")
        unit = self.units.get(value.lower()[len(number) :].strip())
        if unit is None or not number.replace(".", "", 1).isdecimal() or not float(number) * unit >= 1:
            self.fail(f"{value!r} is no size; allowed: 4GiB, 512MB, 1000000, ...", param, ctx)
        return int(float(number) * unit)


class Resolution(click.ParamType[tuple[int, int, int]]):
    """R, or WxHxD, each 1 to 4096 voxels."""

    name = "R|WxHxD"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int, int]:
        if isinstance(value, tuple):
            return value
        edges = value.lower().split("x")
        if len(edges) not in (1, 3) or not all(e.isdecimal() and len(e) < 5 and 1 <= int(e) <= 4096 for e in edges):
            self.fail(f"{value!r} is no resolution; allowed: R or WxHxD, each 1 to 4096", param, ctx)
        w, h, d = (int(edge) for edge in (edges * 3 if len(edges) == 1 else edges))
        return w, h, d


class PixelSize(click.ParamType[tuple[int, int]]):
    """WxH pixels."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        edges = value.lower().split("x") if isinstance(value, str) else ()
        if len(edges) != 2 or not all(edge.isdecimal() and 1 <= int(edge) <= 16384 for edge in edges):
            self.fail(f"{value!r} is no size; allowed: WxH, each 1 to 16384", param, ctx)
        return int(edges[0]), int(edges[1])


Command = Callable[..., Any]


def without_effect(*names: str, here: str, allowed: str) -> None:
    """Raises if one of these options was given, be it as its default: it would change nothing here."""
    context = click.get_current_context()
    for option in context.command.params:
        source = context.get_parameter_source(option.name) if option.name in names else None
        if source not in (None, ParameterSource.DEFAULT, ParameterSource.DEFAULT_MAP):
            raise click.UsageError(f"{option.opts[-1]} has no effect {here}; allowed: {allowed}")


def _limit_memory(ctx: click.Context, param: click.Parameter, value: int) -> None:
    ctx.with_resource(memory.memory_limit(value))


# Holds for all that the command does; no function has to hand it on.
max_memory = click.option(
    "--max-memory",
    type=Size(),
    default=format_size(memory.DEFAULT).replace(".0 ", ""),
    show_default=True,
    callback=_limit_memory,
    expose_value=False,
    help="The most memory that all files and everything made of them may take together.",
)


def reads(function: Command) -> Command:
    """Adds the argument IN and --max-memory; the command gets `source`, a Source."""

    @click.argument("source", metavar="IN", type=Reads(allow_dash=True))
    @max_memory
    @functools.wraps(function)
    def command(*args: Any, source: str, **others: Any) -> Any:
        return function(*args, source=Source(source), **others)

    return command


def bakes_stage1(function: Command) -> Command:
    """Adds the arguments [STAGE1_DIR] OUT_DIR, --feature, --mlp and --force; the command gets `source` and `target`."""

    @click.argument("folders", metavar="[STAGE1_DIR] OUT_DIR", nargs=-1, type=Stage1AndFolder())
    @click.option(
        "--feature", "features", multiple=True, type=Reads(), help="A feature texture; once for each cascade."
    )
    @click.option("--mlp", type=Reads(), help="The mlp.json of --feature; both together replace STAGE1_DIR.")
    @click.option("--transforms", type=Reads(), help="A transforms.json: the training cameras in the mesh's world.")
    @click.option("--force", is_flag=True, help="Replace OUT_DIR and everything in it.")
    @max_memory
    @functools.wraps(function)
    def command(
        *args: Any,
        folders: tuple[str, ...],
        features: tuple[str, ...],
        mlp: str | None,
        transforms: str | None,
        force: bool,
        **others: Any,
    ) -> Any:
        if bool(features) != bool(mlp) or len(folders) != 2 - bool(mlp):
            raise click.UsageError("give STAGE1_DIR and OUT_DIR, or OUT_DIR with --feature and --mlp")
        source = Stage1Source("" if mlp else folders[0], features, mlp, transforms)
        return function(*args, source=source, target=FolderTarget(folders[-1], force), **others)

    return command


def writes(*scenes: str, required: bool = True) -> Callable[[Command], Command]:
    """Adds the argument OUT, --to and --force for scenes of these types; the command gets `target`, a Target, or None
    where it is not required and nobody names one."""
    names = ", ".join(form.name for scene in scenes for form in catalog.formats_of(scene))

    def add(function: Command) -> Command:
        @click.argument(
            "target", metavar="OUT" if required else "[OUT]", required=required, type=Output(allow_dash=True)
        )
        @click.option(
            "--to",
            metavar="FORMAT",
            help=f"The format of OUT if its ending names none: {names}. Add .zst to any of them to compress it.",
        )
        @click.option("--force", is_flag=True, help="Replace OUT if it exists.")
        @functools.wraps(function)
        def command(*args: Any, target: str | None, to: str | None, force: bool, **others: Any) -> Any:
            if target is None:
                without_effect("to", "force", here="where no file is named", allowed="with an OUT")
            return function(*args, target=None if target is None else Target(target, to, force), **others)

        return command

    return add


seed = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="The same seed gives the same bytes."
)
sh_basis = click.option(
    "--basis",
    type=click.Choice(["SH1", "SH4", "SH9", "SH16", "SH25"]),
    default="SH9",
    show_default=True,
    help="The spherical harmonics that hold the colours.",
)
samples = click.option(
    "--samples",
    type=click.IntRange(1, 8),
    help="Rays along each edge of a pixel: N x N, averaged.  [default: the cameras', else 1]",
)


def judges(function: Command) -> Command:
    """Adds --min-psnr, --cameras and --samples; the command gets `budget`."""

    @click.option("--min-psnr", type=Number(), help="The least PSNR in dB: below it OUT becomes OUT.rejected (exit 3).")
    @click.option(
        "--cameras",
        metavar="CAPTURE",
        type=Capture(),
        help=f"The views to judge: {CAPTURE}.  [default: 8 views around IN]",
    )
    @samples
    @functools.wraps(function)
    def command(*args: Any, min_psnr: float | None, cameras: str | None, samples: int | None, **others: Any) -> Any:
        if min_psnr is None:
            for name in ("cameras", "samples"):
                without_effect(name, here="where nothing is judged", allowed=f"--{name} with --min-psnr")
        return function(*args, budget=Budget(min_psnr, cameras, samples), **others)

    return command


def speaks(function: Command) -> Command:
    """Adds -q, -v and --progress; the command gets `words`."""

    @click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
    @click.option("-v", "--verbose", is_flag=True, help="Print how long each step took.")
    @click.option(
        "--progress",
        type=click.Choice(["auto", "plain", "json"]),
        default="auto",
        show_default=True,
        help="How long steps are shown on stderr: auto: a bar on a terminal, nothing elsewhere; plain: a line every ten"
        " seconds; json: an object a line, every second.",
    )
    @functools.wraps(function)
    def command(*args: Any, quiet: bool, verbose: bool, progress: Mode, **others: Any) -> Any:
        if quiet:
            without_effect("verbose", "progress", here="with --quiet", allowed="one of them")
        return function(*args, words=Words(quiet=quiet, verbose=verbose, mode=progress), **others)

    return command


as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON to stdout.")


def writes_octree(*others: str) -> Callable[[Command], Command]:
    """Adds what `writes` adds, for other scenes, too, and how an octree is spelled: --profile, --voxel-type and
    --no-child."""

    def add(function: Command) -> Command:
        @writes("SparseVoxelOctree", *others)
        @click.option(
            "--profile",
            type=click.Choice(["report", "bulk"]),
            help="report: lists of numbers, as the report TR-24-01 writes them; bulk: one block of memory an array."
            "  [default: bulk, but report for svo.pb]",
        )
        @click.option(
            "--voxel-type",
            type=click.Choice(["number", "struct"]),
            help="What OUT calls the type of its values: number: float32 or float16; struct: the type of a whole voxel,"
            " SH9Voxel and its like, in which each coefficient has a name.  [default: number]",
        )
        @click.option(
            "--no-child",
            type=click.Choice(["0", "-1"]),
            default="0",
            show_default=True,
            callback=lambda ctx, param, value: int(value) or None,  # 0 is what formats write by themselves
            help="The number that stands for 'no child' in OUT.",
        )
        @functools.wraps(function)
        def command(*args: Any, target: Target, profile: str | None, voxel_type: str | None, **others: Any) -> Any:
            return function(*args, target=target._replace(profile=profile, voxel_type=voxel_type), **others)

        return command

    return add
