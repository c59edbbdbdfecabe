"""`nerfbake atlas`: whole runs, and whatever is wrong said in one line."""

from __future__ import annotations

import io
import json
import struct
import zlib
from pathlib import Path

import pytest
from PIL import Image

from nerfbake import Stage1, load, orbit_cameras, save
from nerfbake.cli.main import run
from nerfbake.formats.wire.picture import encode_texture
from tests.support.atlas_scenes import mlp_json, stage1_folder, texture


def png(mode: str) -> bytes:
    file = io.BytesIO()
    Image.fromarray(texture()).convert(mode).save(file, "PNG")
    return file.getvalue()


def bomb(width: int, height: int) -> bytes:
    """A small PNG that declares a huge image."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(10_000_000), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def changed_mlp(key: str, value: object) -> bytes:
    """mlp.json with one entry replaced."""
    return json.dumps({**json.loads(mlp_json()), key: value}).encode()


def weights(rows: int, columns: int, value: float = 0.5) -> list[list[float]]:
    return [[value] * columns for _ in range(rows)]


WHOLE = encode_texture(texture())


HOSTILE: dict[str, tuple[dict[str, bytes | None], str]] = {
    "no MLP": ({"mlp_json": None}, "mlp.json is missing"),
    "no feature": ({"feat1_0_png": None}, "feat1_0 is missing"),
    "a cascade is missing": ({"mlp_json": mlp_json(cascade=2)}, "feat1_1 is missing"),
    "both endings": ({"feat1_0_jpg": WHOLE}, "exists as .png and as .jpg"),
    "no JSON": ({"mlp_json": b"{"}, "cannot be parsed"),
    "deep JSON": ({"mlp_json": b"[" * 100_000}, "cannot be parsed"),
    "a list": ({"mlp_json": b"[]"}, "holds a list"),
    "no weights": ({"mlp_json": b"{}"}, "has no net.0.weight"),
    "text as weights": ({"mlp_json": changed_mlp("net.0.weight", "x")}, "net.0.weight"),
    "ragged weights": ({"mlp_json": changed_mlp("net.0.weight", [[1], [1, 2]])}, "is not a table of numbers"),
    "wrong inputs": ({"mlp_json": changed_mlp("net.0.weight", weights(7, 8))}, "has shape (7, 8)"),
    "wrong outputs": ({"mlp_json": changed_mlp("net.1.weight", weights(8, 4))}, "has shape (8, 4); allowed: (8, 3)"),
    "widths apart": ({"mlp_json": changed_mlp("net.1.weight", weights(9, 3))}, "has shape (9, 3); allowed: (8, 3)"),
    "NaN": (
        {"mlp_json": changed_mlp("net.1.weight", weights(8, 3, float("nan")))},
        "net.1.weight[0, 0] is NaN; allowed",
    ),
    "infinity": ({"mlp_json": changed_mlp("net.0.weight", weights(6, 8, 1e300))}, "net.0.weight[0, 0] is 1e+300"),
    "a bias": ({"mlp_json": changed_mlp("net.0.bias", [0])}, "has net.0.bias"),
    "no cascades": ({"mlp_json": mlp_json(cascade=0)}, "cascade is 0; allowed: a whole number from 1 to 16"),
    "cascades as text": ({"mlp_json": mlp_json(cascade="many")}, "cascade is many"),
    "alpha": ({"feat1_0_png": png("RGBA")}, "holds RGBA texels; allowed: RGB"),
    "grey": ({"feat1_0_png": png("L")}, "holds L texels"),
    "a palette": ({"feat1_0_png": png("P")}, "holds P texels"),
    "no picture": ({"feat1_0_png": b"GIF89a"}, "cannot be read"),
    "an empty picture": ({"feat1_0_png": b""}, "cannot be read"),
    "a bomb": ({"feat1_0_png": bomb(13000, 13000)}, "feat1_0.png needs 1.1 GiB"),
    "a wider bomb": ({"feat1_0_png": bomb(2**30, 2**30)}, "feat1_0.png declares more than 178 million"),
    "binary mesh": ({"mesh_0_obj": bytes(range(256))}, "mesh_0.obj has no faces"),
    "empty mesh": ({"mesh_0_obj": b""}, "mesh_0.obj"),
    "no coordinates": ({"mesh_0_obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"}, "has no texture coordinates"),
    "corners elsewhere": ({"mesh_0_obj": b"v 0 0 0\nvt 0 0\nf 1/1 2/1 3/1\n"}, "mesh_0.obj"),
    "NaN in the mesh": (
        {"mesh_0_obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"},
        "mesh positions[0, 0] is nan",
    ),
    "far coordinates": (
        {"mesh_0_obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 9\nf 1/1 2/2 3/3\n"},
        "mesh uvs[2, 1] is -8; allowed: 0 to 1",
    ),
}


@pytest.mark.parametrize("harm", HOSTILE)
def test_hostile_input_is_one_line(harm: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changed, named = HOSTILE[harm]
    folder = stage1_folder(tmp_path / "in", **changed)
    assert run(["atlas", str(folder), str(tmp_path / "out"), "--clusters", "3", "--max-memory", "500MB"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {folder}")
    assert named in line
    assert names(tmp_path) == ["in"]


def test_a_picture_cut_anywhere_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = stage1_folder(tmp_path / "in", feat1_0_png=None)
    jpeg = io.BytesIO()
    Image.fromarray(texture()).save(jpeg, "JPEG")
    for name, content in (("feat1_0.png", WHOLE), ("feat1_0.jpg", jpeg.getvalue())):
        for percent in range(0, 95, 5):
            (folder / name).write_bytes(content[: len(content) * percent // 100])
            assert run(["atlas", str(folder), str(tmp_path / "out"), "--clusters", "3"]) == 1
            (line,) = capsys.readouterr().err.splitlines()
            assert f"{name} cannot be read" in line or f"{name} ends within a chunk" in line
        (folder / name).unlink()


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (["--clusters", "0"], 2),
        (["--clusters", "100000"], 1),
        (["--map-size", "1"], 2),
        (["--border", "40"], 1),
        (["--map-size", "1024", "--max-memory", "1GB"], 1),
    ],
)
def test_clusters_and_sizes_out_of_range(
    options: list[str], code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = stage1_folder(tmp_path / "in")
    assert run(["atlas", str(folder), str(tmp_path / "out"), *options]) == code
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert names(tmp_path) == ["in"]


def test_an_atlas_is_replaced_when_asked_for_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = stage1_folder(tmp_path / "in"), tmp_path / "out"
    arguments = ["atlas", str(folder), str(out), "--clusters", "3", "--map-size", "8"]
    out.mkdir()
    (out / "labels_9.png").touch()
    (out / "atlas.json").touch()
    assert run(arguments) == 4
    assert "exists already; allowed: a new or empty folder, or --force" in capsys.readouterr().err
    assert names(out) == ["atlas.json", "labels_9.png"]
    assert run([*arguments, "--force"]) == 0
    assert "labels_9.png" not in names(out)
    assert names(tmp_path) == ["in", "out"]


def test_from_a_texture_and_an_mlp_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = stage1_folder(tmp_path / "in"), str(tmp_path / "out")
    parts = ["--feature", str(folder / "feat1_0.png"), "--mlp", str(folder / "mlp.json")]
    assert run(["atlas", out, *parts, "--clusters", "3", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert set(told["files"]) == {"atlas_0.png", "labels_0.png", "atlas.json"}
    assert run(["atlas", out, *parts[:2]]) == 2
    assert run(["atlas", out]) == 2


def test_an_atlas_that_misses_its_budget_is_kept_as_rejected(
    sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(sample / "cameras.json", orbit_cameras(load(sample / "in", Stage1), frames=2, width=40, height=40), force=True)
    arguments = ["atlas", str(sample / "in"), str(tmp_path / "out"), "--clusters", "2", "--map-size", "8"]
    arguments += ["--cameras", str(sample / "cameras.json")]
    for force in ([], ["--force"]):  # the second time there is a rejected one already
        assert run([*arguments, "--min-psnr", "80", *force]) == 3
        last = capsys.readouterr().err.splitlines()[-1]
        assert last.startswith(f"error: {tmp_path}/out: the picture has a mean PSNR of ")
        assert [path.name for path in tmp_path.iterdir()] == ["out.rejected"]
    assert (tmp_path / "out.rejected" / "atlas.json").exists()
    assert run([*arguments, "--min-psnr", "10"]) == 4
    assert f"{tmp_path}/out.rejected: exists already" in capsys.readouterr().err
    assert run([*arguments, "--min-psnr", "10", "--force"]) == 0
    assert f"dB against {sample}/in" in capsys.readouterr().err


def test_without_a_mesh_no_budget_is_promised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = stage1_folder(tmp_path / "in", mesh_0_obj=None)
    assert run(["atlas", str(folder), str(tmp_path / "out"), "--clusters", "3", "--min-psnr", "10"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {folder}: mesh_0.obj is missing; allowed: ")
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_a_broken_diffuse_texture_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = stage1_folder(tmp_path / "in", feat0_0_png=b"\x89PNG")
    assert run(["atlas", str(folder), str(tmp_path / "out"), "--clusters", "3"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {folder}: feat0_0.png cannot be read")
