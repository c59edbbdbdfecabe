"""Shaders as files: what is asked for and what that needs, whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from nerfbake import jobs
from nerfbake.cli import main
from nerfbake.errors import UsageError
from nerfbake.jobs.shaders import NEEDS
from tests.conftest import REPOSITORY


def test_every_file_of_every_language_is_written(tmp_path: Path) -> None:
    home = REPOSITORY / "nerfbake" / "shaders"
    own = {path.relative_to(home) for name in ("glsl", "hlsl", "wgsl", "pnanovdb") for path in (home / name).iterdir()}
    jobs.write_shaders(tmp_path / "out")
    found = {path.relative_to(tmp_path / "out"): path.read_text() for path in (tmp_path / "out").glob("*/*")}
    assert found.keys() == own | {Path("hlsl/harmonics.hlsl")}
    assert {path.stem for path in own} == {"common", *NEEDS}
    for path, text in found.items():
        if path.suffix == ".glsl":  # WebGL has no #include
            assert "#include" not in text
        elif path in own:
            assert text == (home / path).read_text()
    assert found[Path("hlsl/harmonics.hlsl")].count("float3") == 3  # made of the GLSL, whose type is vec3


def test_what_a_file_needs_stands_before_it_and_is_written_once(tmp_path: Path) -> None:
    sizes = jobs.write_shaders(tmp_path / "out", languages=["wgsl"], what=["march", "octree", "march"])
    assert list(sizes) == ["README.md", *(f"wgsl/{name}.wgsl" for name in ("common", "harmonics", "march", "octree"))]


@pytest.mark.parametrize(
    "wrong", [{"languages": ["metal"]}, {"what": ["noise"]}, {"languages": ["wgsl"], "what": ["nanovdb"]}]
)
def test_what_there_is_not_is_refused_before_anything_is_written(wrong: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="allowed: "):
        jobs.write_shaders(tmp_path / "out", **wrong)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_replaced_only_when_told_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shaders").mkdir()
    assert main.run(["shaders", "--what", "atlas", "-q"]) == 0
    (tmp_path / "shaders" / "mine.hlsl").touch()
    assert main.run(["shaders", "--what", "world"]) == 4
    assert capsys.readouterr().err.count("\n") == 1
    assert main.run(["shaders", "--what", "world", "--force", "-q"]) == 4
    (tmp_path / "shaders" / "mine.hlsl").unlink()
    assert main.run(["shaders", "--what", "world", "--force", "-q"]) == 0
    assert sorted(path.name for path in (tmp_path / "shaders").iterdir()) == ["README.md", "glsl", "hlsl", "wgsl"]
