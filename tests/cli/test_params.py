"""What arguments and options may be: sizes, and none that would change nothing."""

from __future__ import annotations

from pathlib import Path

import click
import pytest
from click.types import FloatParamType

from nerfbake import catalog
from nerfbake.cli.main import cli, run
from nerfbake.cli.params import ByteSize
from nerfbake.jobs import fits, hulls, lattices, reading_options
from nerfbake.scene.camera import MAX_SAMPLES
from tests.conftest import Shell

REFUSED = [
    ("atlas in out --nodes 7", "--nodes has no effect with --method kmeans; allowed: --nodes with --method grid"),
    ("atlas in out --method affine --centres snapped", "--centres has no effect with --method affine"),
    ("atlas in out --method grid --clusters 9", "--clusters has no effect with --method grid; allowed: --nodes"),
    ("atlas in out --method grid --seed 0", "--seed has no effect with --method grid"),
    ("atlas in out --transforms t.json", "--transforms has no effect with --direction-set fibonacci"),
    ("atlas in out --cameras t.json", "--cameras has no effect without --min-psnr"),
    ("atlas-error out in --held-out --directions 100", "--directions has no effect with --held-out"),
    ("svo a.npz a.svo.pb --cameras t.json", "allowed: --cameras with --min-psnr"),
    ("svo a.npz a.svo.pb --samples 2", "--samples has no effect without --min-psnr; allowed: --samples with"),
    ("vdb a.npz a.vdb --samples 1", "--samples has no effect without --min-psnr"),
    ("lod a.svo.pb b.svo.pb --level 1 --samples 1", "--samples has no effect without --min-psnr"),
    ("compress a.npz a.svoq --samples 2", "--samples has no effect without --truth or --min-psnr"),
    ("atlas in out --samples 8", "--samples has no effect without --min-psnr"),
    ("lod a.svo.pb b.svo.pb --level 1 --cameras t.json", "--cameras has no effect"),
    ("vdb a.npz a.vdb --cameras t.json", "--cameras has no effect"),
    ("render a.npz --out a.png --composite stop", "--composite has no effect without a mesh"),
    ("render a.npz --out a.png --frame 0", "--frame has no effect without cameras to choose from"),
    ("render a.npz --out turn.gif --turntable 5 --all", "--all has no effect without cameras"),
    ("render a.npz --out views --cameras t.json --all --frame 0", "--frame has no effect with --all"),
    ("compare a.npz b.npz --force", "--force has no effect without --sheet or --html"),
    ("bench formats a.npz --force", "--force has no effect without -o or --plot"),
    ("info a.npz -q -v", "--verbose has no effect with --quiet"),
]


@pytest.mark.parametrize(("line", "named"), REFUSED)
def test_options_without_effect_are_refused(
    line: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)  # where there are no such files: nothing was read
    assert run(line.split()) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert named in said


# Such a path is an unset variable of a script. It would be the working folder, which --force would replace.
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["sample", "nerf2mesh", "", "--force"], "'OUT_DIR'"),
        (["atlas", "in", "", "--force"], "'[STAGE1_DIR] OUT_DIR'"),
        (["shaders", "", "--force"], "'[OUT_DIR]'"),
        (["lattice", "a.npz", "", "--force"], "'OUT_DIR'"),
        (["info", ""], "'[IN]'"),
        (["svo", "a.npz", ""], "'OUT'"),
        (["render", "a.npz", "--mesh", "", "--out", "a.png"], "'--mesh'"),
        (["compare", "a.npz", "a.npz", "--html", ""], "'--html'"),
        (["batch", "svo {in} {stem}.svo.pb", "a.npz", ""], "'[INPUTS]...'"),
        (["batch", "svo {in} {stem}.svo.pb", "a.npz", "--state", ""], "'--state'"),
    ],
    ids=" ".join,
)
def test_an_empty_path_is_refused(
    arguments: list[str],
    named: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "kept").touch()
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert f"Invalid value for {named}: the path is empty; allowed: a path" in said
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


# `mesh` and `splats` measure on held-out views, with the rays of those.
ON_VIEWS = {"mesh", "splats"}
JUDGING = [
    name
    for name, each in cli.commands.items()
    if any(p.name == "min_psnr" for p in each.params) and name not in ON_VIEWS
]


@pytest.mark.parametrize("name", ["render", *JUDGING])
@pytest.mark.parametrize("value", ["0", "-1", str(MAX_SAMPLES + 1), "nan", "1e99", "9" * 400, "2.5", ""])
def test_every_command_that_renders_knows_how_many_rays_a_pixel_may_have(
    name: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert {"compare", "compress", "svo", "lod", "vdb", "atlas"} <= set(JUDGING)
    assert run([name, "--samples", value]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "'--samples'" in said
    (option,) = (param for param in cli.commands[name].params if param.name == "samples")
    assert (option.type.min, option.type.max) == (1, MAX_SAMPLES)  # type: ignore[attr-defined]


FLOATS = [
    (name, param.opts[-1])
    for name, command in cli.commands.items()
    for param in command.params
    if isinstance(param.type, FloatParamType | click.FloatRange)
]


@pytest.mark.parametrize(("name", "option"), FLOATS)
def test_nan_is_no_number(name: str, option: str, capsys: pytest.CaptureFixture[str]) -> None:
    """It is not outside of any range: --max-loss nan worked for seconds, and then blamed the input's colour_step."""
    assert run([name, option, "nan"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert f"'{option}': NaN is not allowed" in said


@pytest.mark.parametrize(("text", "size"), [("100", 100), ("1.5KiB", 1536), ("2 MB", 2_000_000), ("4gib", 4 << 30)])
def test_sizes(text: str, size: int) -> None:
    assert ByteSize().convert(text, None, None) == size


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (["info", "a.npz", "--max-memory", "9" * 400], "is not a size"),
        (["render", "a.npz", "--out", "a.png", "--size", "1" * 5000 + "x2"], "is not a size; allowed: WxH"),
        (["render", "a.npz", "--out", "a.png", "--background", "1" * 5000 + ",0,0"], "is not a colour"),
        (["svo", "a.npz", "b.svo.pb", "--resolution", "1" * 5000], "is not a resolution"),
        (["batch", "run", "list.txt", "--shard", "1" * 5000 + "/3", "--", "info", "{}"], "is not a shard"),
    ],
)
def test_numbers_of_thousands_of_digits_are_refused(
    line: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(line) == 2
    assert said in capsys.readouterr().err


def help_of(command: str) -> str:
    found = cli.commands[command]
    return " ".join(found.get_help(click.Context(found, terminal_width=1000)).split())


def test_what_the_help_repeats_is_what_the_jobs_have() -> None:
    """Commands import their jobs when they run, so that the help stays fast: it cannot use the jobs' constants."""
    assert f"[default: {hulls.LEVEL};" in help_of("hull")
    assert f"voxels are fitted (splats only). [default: {reading_options.EPOCHS}]" in help_of("svo")
    assert f"its finest, at most {lattices.FINEST}]" in help_of("lattice")
    written = ", ".join(dict.fromkeys(form.name for scene in fits.KINDS for form in catalog.formats_of(scene)))
    assert f"if its extension names none: {written}." in help_of("fit")


@pytest.mark.usefixtures("tree_file")
def test_quiet_and_verbose(shell: Shell) -> None:
    assert shell("svo", "a.npz", "b.svo.pb", "-q").stderr == b""
    words = shell("svo", "a.npz", "c.svo.pb", "-v").stderr.decode().splitlines()
    assert [line.split(":")[0] for line in words] == [
        "reading a.npz",
        "building the octree",
        "writing c.svo.pb",
        "c.svo.pb",
    ]


@pytest.mark.usefixtures("tree_file")
def test_every_command_takes_progress(shell: Shell) -> None:
    assert shell("svo", "a.npz", "b.svo.pb", "--progress", "json").stderr.count(b"\n") == 1
    assert (
        b"--progress has no effect with --quiet"
        in shell("svo", "a.npz", "c.svo.pb", "-q", "--progress", "plain").stderr
    )
