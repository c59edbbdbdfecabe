"""Arguments, options and parameter types that several commands share.

TR-24-01 is a report, see docs/sources.md.
"""

from __future__ import annotations

import functools
import math
import re
import sys
from collections.abc import Callable, Collection
from importlib import import_module
from inspect import signature
from typing import TYPE_CHECKING, Any, Literal

import click
from click.core import ParameterSource
from click.types import FloatParamType

from nerfbake import catalog, memory
from nerfbake.cli.paths import Capture, JudgedOutput, MeshOutput, Reads, Writes
from nerfbake.console import Console, Mode
from nerfbake.errors import format_size
from nerfbake.jobs.budgets import Budget
from nerfbake.jobs.files import FolderTarget, Source, Target

if TYPE_CHECKING:
    from click import ParamType as ParamType
else:

    class ParamType(click.ParamType):
        """click's class, which is generic since click 8.5: with an older one, ParamType[int] is ParamType."""

        def __class_getitem__(cls, value):
            return cls


codec_option = click.option(
    "--codec",
    type=click.Choice(["none", "zip"]),
    help="Compression codec of a .vdb or .nvdb.  [default: zip for .vdb, none for .nvdb]",
)
Command = Callable[..., Any]
ALL = "all"
CAPTURE = "a transforms.json, cameras of COLMAP or of another tool, or a folder with them"


class Number(FloatParamType):
    """A number. NaN is refused, because no value is below or above it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        return _require_number(self, super().convert(value, param, ctx), param, ctx)


class NumberRange(click.FloatRange):
    """A number in a range. NaN is refused: click accepts it, since it is neither below nor above the range."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        return _require_number(self, super().convert(value, param, ctx), param, ctx)


def _require_number(
    kind: click.ParamType[float], number: float, param: click.Parameter | None, ctx: click.Context | None
) -> float:
    if math.isnan(number):
        kind.fail("NaN is not allowed; allowed: a number", param, ctx)
    return number


def is_whole(word: str, low: int, high: int) -> bool:
    """Return whether a word is a whole number from low to high, with no more digits than high."""
    return word.isdecimal() and len(word) <= len(str(high)) and low <= int(word) <= high


class ByteSize(ParamType[int]):
    """A number of bytes: 512MB, 4GiB or 1000000."""

    name = "size"
    units = {"": 1, "b": 1} | {f"{k}b": 1000**i for i, k in enumerate("kmgt", 1)}
    units |= {f"{k}ib": 1024**i for i, k in enumerate("kmgt", 1)}

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        number = value.lower().rstrip("bkmgti ")
        unit = self.units.get(value.lower()[len(number) :].strip())
        size = float(number) * (unit or 0) if number.replace(".", "", 1).isdecimal() else 0.0
        if not 1 <= size <= sys.maxsize:
            self.fail(f"{value!r} is not a size; allowed: 4GiB, 512MB, 1000000, ...", param, ctx)
        return int(size)


class Resolution(ParamType[tuple[int, int, int]]):
    """R or WxHxD voxels, each from 1 to 4096."""

    name = "R|WxHxD"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int, int]:
        if isinstance(value, tuple):
            return value
        edges = value.lower().split("x")
        if len(edges) not in (1, 3) or not all(is_whole(edge, 1, 4096) for edge in edges):
            self.fail(f"{value!r} is not a resolution; allowed: R or WxHxD, each 1 to 4096", param, ctx)
        w, h, d = (int(edge) for edge in (edges * 3 if len(edges) == 1 else edges))
        return w, h, d


class Box(ParamType[tuple[float, ...]]):
    """Two opposite corners of a box in world coordinates."""

    name = "x0,y0,z0,x1,y1,z1"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        try:
            corners = tuple(map(float, value.split(",")))
        except ValueError:
            corners = ()
        fine = len(corners) == 6 and all(
            -1e15 < low < high < 1e15 for low, high in zip(corners, corners[3:], strict=False)
        )
        if not fine:
            self.fail(f"{value!r} is not a box; allowed: x0,y0,z0,x1,y1,z1 with x0 < x1, y0 < y1, z0 < z1", param, ctx)
        return corners


class PartBox(Box):
    """inner, all, or a box."""

    name = "inner|all|x0,y0,z0,x1,y1,z1"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return value if value in ("inner", ALL) else super().convert(value, param, ctx)


def parse_count(word: str) -> int:
    """Return a number like 20000, 20k or 1.5M; 0 if the word is none."""
    match = re.fullmatch(r"([0-9]{1,9}(?:\.[0-9]{1,6})?|\.[0-9]{1,6})([kKmM]?)", word)
    factor = {"": 1, "k": 1_000, "m": 1_000_000}
    return round(float(match[1]) * factor[match[2].lower()]) if match else 0


class PixelSize(ParamType[tuple[int, int]]):
    """WxH pixels, each from 1 to 16384."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        edges = value.lower().split("x") if isinstance(value, str) else ()
        if len(edges) != 2 or not all(is_whole(edge, 1, 16384) for edge in edges):
            self.fail(f"{value!r} is not a size; allowed: WxH, each 1 to 16384", param, ctx)
        return int(edges[0]), int(edges[1])


def without_effect(*names: str, here: str, allowed: str) -> None:
    """Raise click.UsageError if one of these options is on the command line, even with its default value.

    here: the reason why the option changes nothing; allowed: where it does.
    """
    context = click.get_current_context()
    for option in context.command.params:
        source = context.get_parameter_source(option.name) if option.name in names else None
        if source not in (None, ParameterSource.DEFAULT, ParameterSource.DEFAULT_MAP):
            raise click.UsageError(f"{option.opts[-1]} has no effect {here}; allowed: {allowed}")


def bundled(
    name: str,
    kind: str,
    *options: Callable[[Command], Command],
    check: Callable[[Any], None] | None = None,
    without: Collection[str] = (),
    **defaults: object,
) -> Callable[[Command], Command]:
    """Add these options; pass the command one value `name` instead of the values of the options.

    kind      class of this value, for example jobs.budgets.Budget. It is imported when the command runs, so that
              --help stays fast. Each of its fields takes the value of the option with the same name; a field without
              an option, or with one that is None, keeps its default
    check     is called with the value, and raises an error for options that have no effect or contradict each other
    without   fields that keep their default, because the option of that name is another one of the command's
    defaults  of fields, in place of those of the class
    """
    module, _, class_name = kind.rpartition(".")

    def add(function: Command) -> Command:
        @functools.wraps(function)
        def command(*args: object, **others: object) -> object:
            make = getattr(import_module(f"nerfbake.{module}"), class_name)
            names = [field for field in signature(make).parameters if field in others and field not in without]
            fields = {field: others.pop(field) for field in names}
            value = make(**defaults | {field: given for field, given in fields.items() if given is not None})
            if check is not None:
                check(value)
            return function(*args, **{name: value}, **others)

        wrapped: Command = command
        for option in reversed(options):
            wrapped = option(wrapped)
        return wrapped

    return add


def _limit_memory(ctx: click.Context, param: click.Parameter, value: int) -> None:
    ctx.with_resource(memory.memory_limit(value))


# memory_limit() is a context variable: it applies to the whole command without being passed on.
max_memory = click.option(
    "--max-memory",
    type=ByteSize(),
    default=format_size(memory.DEFAULT).replace(".0 ", ""),
    show_default=True,
    callback=_limit_memory,
    expose_value=False,
    help="Memory limit for all data: files, their decoded contents, and results.",
)


def source_argument(function: Command) -> Command:
    """Add the argument IN and --max-memory; pass the command `source`, a Source."""

    @click.argument("source", metavar="IN", type=Reads(allow_dash=True))
    @max_memory
    @functools.wraps(function)
    def command(*args: object, source: str, **others: object) -> object:
        return function(*args, source=Source(source), **others)

    return command


def folder_argument(output: type[Writes] = Writes) -> Callable[[Command], Command]:
    """Add the argument OUT_DIR and --force; pass the command `target`, a FolderTarget. output: the type of its path."""

    def add(function: Command) -> Command:
        @click.argument("target", metavar="OUT_DIR", type=output())
        @click.option("--force", is_flag=True, help="Replace OUT_DIR if nerfbake wrote all that it contains.")
        @functools.wraps(function)
        def command(*args: object, target: str, force: bool, **others: object) -> object:
            return function(*args, target=FolderTarget(target, force), **others)

        return command

    return add


def target_argument(
    *scenes: str, required: bool = True, output: type[JudgedOutput] = JudgedOutput
) -> Callable[[Command], Command]:
    """Add the argument OUT, --to and --force for scenes of these types; pass the command `target`, a Target.

    If the argument is not required and not given, `target` is None. output: the type of its path.
    """
    names = ", ".join(dict.fromkeys(form.name for scene in scenes for form in catalog.formats_of(scene)))

    def add(function: Command) -> Command:
        @click.argument(
            "target",
            metavar="OUT" if required else "[OUT]",
            required=required,
            type=output(allow_dash=True),
        )
        @click.option(
            "--to",
            metavar="FORMAT",
            help=f"Format of OUT if its extension names none: {names}. Append .zst to compress with Zstandard.",
        )
        @click.option("--force", is_flag=True, help="Replace OUT if it exists.")
        @functools.wraps(function)
        def command(*args: object, target: str | None, to: str | None, force: bool, **others: object) -> object:
            if target is None:
                without_effect("to", "force", here="without OUT", allowed="with an OUT")
            return function(*args, target=None if target is None else Target(target, to, force), **others)

        return command

    return add


seed = click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Random seed. The same seed gives the same bytes.",
)
sh_bases = click.Choice(["SH1", "SH4", "SH9", "SH16", "SH25"])
samples = click.option(
    "--samples",
    type=click.IntRange(1, 8),
    help="Rays along each edge of a pixel: N x N per pixel, averaged.  [default: from the cameras, else 1]",
)

sigma_min = click.option(
    "--sigma-min", type=NumberRange(min=0), help="Treat leaves below this density (1/world unit) as empty."
)
min_psnr = click.option(
    "--min-psnr",
    type=Number(),
    help="Lowest allowed PSNR against the input in dB. Below it, OUT is renamed to OUT.rejected (exit code 3).",
)
max_size = click.option("--max-size", type=ByteSize(), help="Largest allowed size of OUT, for example 2MB.")
lookup = click.option(
    "--lookup",
    type=click.Choice(["nearest", "trilinear"]),
    default="nearest",
    show_default=True,
    help="nearest: constant values in each cell; trilinear: values interpolated between cell centres.",
)


def max_loss(default: str) -> Callable[[Command], Command]:
    """Add --max-loss with this text about its default."""
    text = f"Largest allowed loss of PSNR against photographs, in dB.  [default: {default}]"
    return click.option("--max-loss", type=NumberRange(min=0.001, max=20), help=text)


def truth(of: str) -> Callable[[Command], Command]:
    """Add --truth, photographs of the cameras that `of` names."""
    text = f"Folder with a photograph NAME.png for each {of}, to measure the loss instead of predicting it."
    return click.option("--truth", type=Reads(), help=text)


def grid_options(*, splats: bool = False) -> Callable[[Command], Command]:
    """Add --grid and --in-up; pass the command `choice`, a GridChoice. splats: --in-up applies to splats, too."""
    return bundled(
        "choice",
        "jobs.grids.GridChoice",
        click.option(
            "--grid",
            "grids",
            multiple=True,
            metavar="NAME",
            help="Use only this grid of a volume: a name, or a number from 0. Repeat for more grids.",
        ),
        click.option(
            "--in-up",
            type=click.Choice(["y", "z", "-y", "-z", "x", "-x"] if splats else ["y", "z"]),
            help="Up axis of the volume. y: the volume is rotated so that y becomes z."
            + (" Or the axis of splats that points up: it becomes the up axis of OUT." if splats else ""),
        ),
    )


def reading_options(
    *options: Callable[[Command], Command], in_up: Literal["stated"] | None
) -> Callable[[Command], Command]:
    """Add these options, --opacity-min, --in-up and --epochs; pass the command `options`, a ReadingOptions.

    in_up: the default; stated: the axis of splats that the file states, else -y; None: keep their world.
    """
    default_text = "keep the world of IN" if in_up is None else "the axis that IN states, else -y"
    return bundled(
        "options",
        "jobs.reading_options.ReadingOptions",
        *options,
        click.option(
            "--opacity-min",
            type=NumberRange(0, 1),
            help="Leave out splats of a lower opacity (splats only).  [default: 1/255]",
        ),
        click.option(
            "--in-up",
            type=click.Choice(["x", "-x", "y", "-y", "z", "-z"]),
            help="Up axis of splats, which becomes z (splats only): -y in every .spz and in most other files.  "
            f"[default: {default_text}]",
        ),
        click.option(
            "--epochs",
            type=click.IntRange(0, 100),
            help="Passes over pictures of the splats, to which the voxels are fitted (splats only).  [default: 1]",
        ),
        in_up=in_up,
    )


device_option = click.option(
    "--device",
    default="auto",
    show_default=True,
    metavar="auto|cpu|gpu|NAME",
    help="What does the work. auto: a graphics card if there is one; NAME: a part of a name in `info --devices`.",
)


def _check_budget(budget: Budget) -> None:
    if budget.min_psnr is None:
        for name in ("cameras", "samples", "device"):
            without_effect(name, here="without --min-psnr", allowed=f"--{name} with --min-psnr")


def _budget_options(*more: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Add --min-psnr, --cameras, --samples and more; pass the command `budget`, a Budget."""
    return bundled(
        "budget",
        "jobs.budgets.Budget",
        min_psnr,
        click.option(
            "--cameras",
            metavar="CAPTURE",
            type=Capture(),
            help=f"Cameras for --min-psnr: {CAPTURE}.  [default: 8 views around IN]",
        ),
        samples,
        *more,
        check=_check_budget,
    )


budget_options = _budget_options(device_option)
surface_budget_options = _budget_options()  # of commands that render no field


def console_options(function: Command) -> Command:
    """Add -q, -v and --progress; pass the command `console`, a Console."""

    @click.option("-q", "--quiet", is_flag=True, help="Print only errors.")
    @click.option("-v", "--verbose", is_flag=True, help="Print the time of each step.")
    @click.option(
        "--progress",
        type=click.Choice(["auto", "plain", "json"]),
        default="auto",
        show_default=True,
        help="Progress of long steps, on stderr. auto: a bar on a terminal, nothing elsewhere; plain: a line every ten"
        " seconds; json: a JSON object per line, every second.",
    )
    @functools.wraps(function)
    def command(*args: object, quiet: bool, verbose: bool, progress: Mode, **others: object) -> object:
        if quiet:
            without_effect("verbose", "progress", here="with --quiet", allowed="one of them")
        return function(*args, console=Console(quiet=quiet, verbose=verbose, mode=progress), **others)

    return command


as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON to stdout.")


def octree_target_argument(*others: str) -> Callable[[Command], Command]:
    """Add target_argument() for octrees and for scenes of these other types, and the options of octree formats.

    These options are --profile, --voxel-type and --no-child.
    """

    def add(function: Command) -> Command:
        @target_argument("SparseVoxelOctree", *others, output=MeshOutput)
        @click.option(
            "--profile",
            type=click.Choice(["report", "bulk"]),
            help="Encoding of arrays. report: lists of numbers, as in the report TR-24-01; bulk: one block of bytes"
            " per array.  [default: report for svo.pb, else bulk]",
        )
        @click.option(
            "--voxel-type",
            type=click.Choice(["number", "struct"]),
            help="Type name that OUT declares for its values. number: float32 or float16; struct: the type of a whole"
            " voxel, such as SH9Voxel, which names each coefficient.  [default: number]",
        )
        @click.option(
            "--no-child",
            type=click.Choice(["0", "-1"]),
            default="0",
            show_default=True,
            callback=lambda ctx, param, value: int(value) or None,  # 0 is the default of every format
            help="Child index that means 'no child' in OUT.",
        )
        @functools.wraps(function)
        def command(
            *args: object, target: Target, profile: str | None, voxel_type: str | None, **others: object
        ) -> object:
            return function(*args, target=target._replace(profile=profile, voxel_type=voxel_type), **others)

        return command

    return add
