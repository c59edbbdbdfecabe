"""`nerfbake sample`: scenes without a download."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake.cli.main import run


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    made = []
    for name, seed in (("a.npz", "1"), ("b.npz", "1"), ("c.npz", "2")):
        arguments = ["--resolution", "16", "--basis", "SH4", "--seed", seed, "-q"]
        assert run(["sample", "octree", str(tmp_path / name), *arguments]) == 0
        made.append((tmp_path / name).read_bytes())
    assert made[0] == made[1] != made[2]


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["octree", "a.npz", "--resolution", "100"], 1, "resolution is 100; allowed: a power of two"),
        (["octree", "a.npz", "--resolution", "64", "--max-memory", "1MB"], 1, "a tree of 32 cells an axis needs"),
        (["octree", "a.svo.pb"], 2, "has no file extension for a PlenOctree"),
        (["nerf2mesh", "in", "--resolution", "8"], 1, "resolution is 8; allowed: 16 to 8192 texels"),
        (["nerf2mesh", "in", "--max-memory", "1MB"], 1, "textures of 512x512 needs 44.0 MiB"),
        (["capture", "-", "--room"], 2, "stdout takes one file; allowed: a folder"),
        (["capture", "in", "--room", "--frames", "1"], 2, "1 is not in the range 2<=x<=1000"),
        (["capture", "in", "--room", "--object", "struts"], 2, "--object struts and --room are two scenes; allowed"),
        (["capture", "in", "--object", "bricks", "--max-memory", "1MB"], 1, "a picture of 400x400 pixels needs"),
        (["capture", "in", "--room", "--max-memory", "1MB"], 1, "a picture of 400x400 pixels needs 47.3 MiB"),
    ],
)
def test_what_goes_wrong_is_one_line(
    arguments: list[str],
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["sample", *arguments]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not list(tmp_path.iterdir())
