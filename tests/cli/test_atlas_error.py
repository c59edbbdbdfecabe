"""`nerfbake atlas-error`: the error that is printed, and atlases that are none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nerfbake.cli.main import run
from nerfbake.formats.wire.picture import encode_texture
from tests.cli.telling import told
from tests.support.atlas_scenes import stage1_folder, texture

WHOLE = encode_texture(texture())


def test_the_error_that_is_printed_is_the_error_that_was_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = str(tmp_path / "in"), str(tmp_path / "out")
    assert run(["sample", "nerf2mesh", source, "--resolution", "64"]) == 0
    for method in ("kmeans", "affine", "grid"):
        assert run(["atlas", source, out, "--method", method, "--map-size", "32", "--force"]) == 0
        written = json.loads((tmp_path / "out" / "atlas.json").read_text())["errors"]
        assert told(["atlas-error", out, source], capsys) == {"version": 1, "errors": written}
        held_out = told(["atlas-error", out, source, "--held-out"], capsys)["errors"][0]["mae"]
        assert held_out != written[0]["mae"]
        assert held_out == pytest.approx(written[0]["mae"], rel=0.2)


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("atlas.json", b"{}", "is not an atlas description"),
        ("atlas.json", b'{"nerfbake_atlas": 1, "cascades": [{"method": "magic"}]}', "method is magic"),
        ("atlas.json", b'{"nerfbake_atlas": 1, "cascades": [{"method": "kmeans", "maps": -1}]}', "maps is -1"),
        ("atlas_0.png", WHOLE, "has 32x24 texels"),
        ("labels_0.png", encode_texture(np.full((24, 32, 3), 255, np.uint8)), "is 65535; allowed: 0 to 2"),
    ],
)
def test_a_broken_atlas_is_one_line(
    name: str, content: bytes, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = stage1_folder(tmp_path / "in"), tmp_path / "out"
    assert run(["atlas", str(folder), str(out), "--clusters", "3", "--map-size", "8"]) == 0
    (out / name).write_bytes(content)
    capsys.readouterr()
    assert run(["atlas-error", str(out), str(folder)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert named in line
