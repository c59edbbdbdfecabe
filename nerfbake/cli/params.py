"""The arguments and options that commands share, each said once. TR-24-01: docs/sources.md."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

import nerfbake
from nerfbake import catalog, io, memory
from nerfbake.cli.words import Words
from nerfbake.errors import UsageError, format_size

BUDGET_FRAMES, BUDGET_EDGE = 8, 400  # the views around a scene that a budget is judged from

CAPTURE = "a transforms.json, or a folder that holds one, a COLMAP model, or the poses of LLFF or NSVF"


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


@dataclass(frozen=True)
class Input:
    """A file to read, or stdin."""

    path: str

    def read(self, words: Words, *kinds: type) -> Any:
        return self.read_with_format(words, *kinds)[0]

    def read_with_format(self, words: Words, *kinds: type) -> tuple[Any, catalog.Format, int]:
        """The scene, its file's format and its size in bytes (of a stream: of what was read)."""
        with words.phase(f"reading {io.reading_name(self.path)}"):
            return io.load_with_format(self.path, *kinds)

    def views(
        self, words: Words, scene: Any, cameras: str | None, size: tuple[int, int] | None, *, frames: int, edge: int
    ) -> Any:
        """The cameras of a file, or of an orbit of this scene with so many frames; in another size, if one is given."""
        if cameras is None:
            width, height = size or (edge, edge)
            with self.blamed(words, "framing"):
                return nerfbake.orbit_cameras(scene, frames=frames, width=width, height=height)
        read = read_cameras(words, cameras)
        return nerfbake.Cameras(tuple(camera.resized(*size) for camera in read.cameras)) if size else read

    @contextmanager
    def blamed(self, words: Words, phase: str) -> Iterator[None]:
        """A step of the work whose errors are this file's."""
        with words.phase(phase), io.blame(io.reading_name(self.path)):
            yield


def read_cameras(words: Words, path: str) -> Any:
    """The cameras of a file or a folder; says which file of a folder it took, and what it took for granted."""
    with words.phase(f"reading {path}"):
        read = io.load(path, nerfbake.Cameras)
    if read.source:
        words.say(f"{path}: {read} from {read.source}")
    for note in read.notes:
        words.say(f"{path}: {note}")
    return read


@dataclass(frozen=True)
class Output:
    """A file to write, or stdout."""

    path: str
    to: str | None
    force: bool
    profile: str | None = None

    def require(self, scene: str) -> None:
        """Raises, before any work is done, if a scene of this type could not be written here."""
        form = io.format_for(self.path, scene, to=self.to)
        if self.profile and not form.profiles:
            raise UsageError(f"{form.name} is written in one way only; allowed: no --profile")
        io.require_absent(self.path, force=self.force)

    def write(self, words: Words, scene: Any, **options: Any) -> None:
        if self.profile:
            options["profile"] = self.profile
        with words.phase(f"writing {self.path}"):
            size = io.save(self.path, scene, to=self.to, force=self.force, **options)
        words.say(f"{'stdout' if self.path == io.STREAM else self.path}: {scene}, {size:,} bytes")


@dataclass(frozen=True)
class Budget:
    """What an output may cost, judged from the file or folder as it was written."""

    min_psnr: float | None
    cameras: str | None

    def require(self, target: Output) -> None:
        """Raises, before any work is done, if there would be no file to judge."""
        if self.min_psnr is not None and target.path == io.STREAM:
            raise click.UsageError("--min-psnr judges a file; allowed: an OUT other than '-'")

    def judge(self, words: Words, source: Input, scene: Any, target: Output, *, up: str = "z") -> None:
        """Renders what was written beside the scene it was made from; moves it to OUT.rejected if it costs too much.
        up: the axis of a volume's world that the scene's z became."""
        if self.min_psnr is None:
            return
        # A field is built once, for the cameras and for the pictures.
        seen = scene if isinstance(scene, nerfbake.Stage1) else nerfbake.build_field(scene)
        views = source.views(words, seen, self.cameras, None, frames=BUDGET_FRAMES, edge=BUDGET_EDGE)
        written = Input(target.path)
        with written.blamed(words, "judging"), io.rejected_unless_good(target.path):
            made = written.read(words)
            found = nerfbake.compare_scenes(seen, made.turned() if up == "y" else made, views, keep_pictures=False)
            found.require(min_psnr=self.min_psnr)
        words.say(f"{target.path}: {found.means['a_b']['psnr']:.2f} dB against {source.path}")


@dataclass(frozen=True)
class Stage1Input:
    """A stage-1 folder, or feature textures and an MLP from anywhere."""

    folder: str
    features: tuple[str, ...]
    mlp: str | None
    transforms: str | None

    @property
    def name(self) -> str:
        return self.folder or ", ".join(self.features)

    def read(self, words: Words) -> Any:
        with self.blamed(words, f"reading {self.name}"):
            named = {"transforms.json": self.transforms, "mlp.json": self.mlp}
            named |= {f"feat1_{c}{Path(path).suffix.lower()}": path for c, path in enumerate(self.features)}
            given = {name: path for name, path in named.items() if path is not None}
            files = io.load_files(given)
            if self.folder:
                return io.load_folder(self.folder, nerfbake.Stage1, more=files)
            return io.decode_files(files, nerfbake.Stage1)

    @contextmanager
    def blamed(self, words: Words, phase: str) -> Iterator[None]:
        """A step of the work whose errors are this input's."""
        with words.phase(phase), io.blame(self.name):
            yield


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
    """Adds the argument IN and --max-memory; the command gets `source`, an Input."""

    @click.argument("source", metavar="IN", type=click.Path(allow_dash=True))
    @max_memory
    @functools.wraps(function)
    def command(*args: Any, source: str, **others: Any) -> Any:
        return function(*args, source=Input(source), **others)

    return command


def bakes_stage1(function: Command) -> Command:
    """Adds the arguments [STAGE1_DIR] OUT_DIR, --feature, --mlp and --force; the command gets `source` and `target`."""

    @click.argument("folders", metavar="[STAGE1_DIR] OUT_DIR", nargs=-1, type=click.Path())
    @click.option(
        "--feature", "features", multiple=True, type=click.Path(), help="A feature texture; once for each cascade."
    )
    @click.option("--mlp", type=click.Path(), help="The mlp.json of --feature; both together replace STAGE1_DIR.")
    @click.option(
        "--transforms", type=click.Path(), help="A transforms.json: the training cameras in the mesh's world."
    )
    @click.option("--force", is_flag=True, help="Replace OUT_DIR and everything in it.")
    @max_memory
    @functools.wraps(function)
    def command(
        *args: Any,
        folders: tuple[str, ...],
        features: tuple[str, ...],
        mlp: str | None,
        transforms: str | None,
        **others: Any,
    ) -> Any:
        if bool(features) != bool(mlp) or len(folders) != 2 - bool(mlp):
            raise click.UsageError("give STAGE1_DIR and OUT_DIR, or OUT_DIR with --feature and --mlp")
        source = Stage1Input("" if mlp else folders[0], features, mlp, transforms)
        return function(*args, source=source, target=folders[-1], **others)

    return command


def writes(*scenes: str) -> Callable[[Command], Command]:
    """Adds the argument OUT, --to and --force for scenes of these types; the command gets `target`, an Output."""
    names = ", ".join(form.name for scene in scenes for form in catalog.formats_of(scene))

    def add(function: Command) -> Command:
        @click.argument("target", metavar="OUT", type=click.Path(allow_dash=True))
        @click.option(
            "--to",
            metavar="FORMAT",
            help=f"The format of OUT if its ending names none: {names}. Add .zst to any of them to compress it.",
        )
        @click.option("--force", is_flag=True, help="Replace OUT if it exists.")
        @functools.wraps(function)
        def command(*args: Any, target: str, to: str | None, force: bool, **others: Any) -> Any:
            return function(*args, target=Output(target, to, force), **others)

        return command

    return add


def judges(function: Command) -> Command:
    """Adds --min-psnr and --cameras; the command gets `budget`."""

    @click.option("--min-psnr", type=float, help="The least PSNR in dB: below it OUT becomes OUT.rejected (exit 3).")
    @click.option("--cameras", metavar="CAPTURE", help=f"The views to judge: {CAPTURE}.  [default: 8 views around IN]")
    @functools.wraps(function)
    def command(*args: Any, min_psnr: float | None, cameras: str | None, **others: Any) -> Any:
        if min_psnr is None:
            without_effect("cameras", here="where nothing is judged", allowed="--cameras with --min-psnr")
        return function(*args, budget=Budget(min_psnr, cameras), **others)

    return command


def speaks(function: Command) -> Command:
    """Adds -q and -v; the command gets `words`."""

    @click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
    @click.option("-v", "--verbose", is_flag=True, help="Print how long each step took.")
    @functools.wraps(function)
    def command(*args: Any, quiet: bool, verbose: bool, **others: Any) -> Any:
        if quiet:
            without_effect("verbose", here="with --quiet", allowed="one of them")
        return function(*args, words=Words(quiet=quiet, verbose=verbose), **others)

    return command


as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON to stdout.")


def writes_octree(*others: str) -> Callable[[Command], Command]:
    """Adds what `writes` adds, for other scenes, too, and how an octree is spelled: --profile and --no-child."""

    def add(function: Command) -> Command:
        @writes("SparseVoxelOctree", *others)
        @click.option(
            "--profile",
            type=click.Choice(["report", "bulk"]),
            help="report: lists of numbers, as the report TR-24-01 writes them; bulk: one block of memory an array."
            "  [default: bulk, but report for svo.pb]",
        )
        @click.option(
            "--no-child",
            type=click.Choice(["0", "-1"]),
            default="0",
            show_default=True,
            callback=lambda ctx, param, value: int(value),
            help="The number that stands for 'no child' in OUT.",
        )
        @functools.wraps(function)
        def command(*args: Any, target: Output, profile: str | None, **others: Any) -> Any:
            return function(*args, target=replace(target, profile=profile), **others)

        return command

    return add
