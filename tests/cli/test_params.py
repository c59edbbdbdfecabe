"""What arguments and options may be: sizes, and none that would change nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake.cli.main import run
from nerfbake.cli.params import Size

REFUSED = [
    ("atlas in out --nodes 7", "--nodes has no effect with --method kmeans; allowed: --nodes with --method grid"),
    ("atlas in out --method affine --centres snapped", "--centres has no effect with --method affine"),
    ("atlas in out --method grid --clusters 9", "--clusters has no effect with --method grid; allowed: --nodes"),
    ("atlas in out --method grid --seed 0", "--seed has no effect with --method grid"),
    ("atlas in out --transforms t.json", "--transforms has no effect where all directions count the same"),
    ("atlas in out --cameras t.json", "--cameras has no effect where nothing is judged"),
    ("atlas-error out in --held-out --directions 100", "--directions has no effect with --held-out"),
    ("svo a.npz a.svo.pb --cameras t.json", "allowed: --cameras with --min-psnr"),
    ("lod a.svo.pb b.svo.pb --level 1 --cameras t.json", "--cameras has no effect"),
    ("vdb a.npz a.vdb --cameras t.json", "--cameras has no effect"),
    ("render a.npz --out a.png --composite stop", "--composite has no effect without a mesh"),
    ("render a.npz --out a.png --frame 0", "--frame has no effect without cameras to choose from"),
    ("render a.npz --out turn.gif --turntable 5 --all", "--all has no effect without cameras"),
    ("render a.npz --out views --cameras t.json --all --frame 0", "--frame has no effect with --all"),
    ("compare a.npz b.npz --force", "--force has no effect where nothing is written"),
    ("bench formats a.npz --force", "--force has no effect where no file is written"),
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


@pytest.mark.parametrize(("text", "size"), [("100", 100), ("1.5KiB", 1536), ("2 MB", 2_000_000), ("4gib", 4 << 30)])
def test_sizes(text: str, size: int) -> None:
    assert Size().convert(text, None, None) == size
