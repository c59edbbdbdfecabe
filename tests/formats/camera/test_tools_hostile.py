"""Hostile camera files of other tools: one line, exit 1, soon, in little memory, and nothing outside the folder."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Cameras, catalog, load, memory_limit
from nerfbake.errors import InvalidFile, MemoryLimit, NerfbakeError
from nerfbake.formats.wire.xml import MAX_DEPTH, parse_xml
from tests.support import camera_tools as tools
from tests.support.camera_tools import TOOLS, kept_by, placed
from tests.support.captures import Rig, rig, write_pictures

XML = ("metashape", "realitycapture_xmp")
JSON = (
    "gaussian_cameras",
    "polycam",
    "record3d",
    "opensfm",
    "opendronemap",
    "meshroom",
    "openmvg",
    "open3d_json",
    "gltf",
)
TEXT = ("realitycapture_csv", "bundler", "tum", "kitti", "seven_scenes", "mvsnet", "nvm", "open3d", "kapture", "euroc")
FAST = 2.0  # CPU seconds


@pytest.fixture(scope="module")
def made() -> Rig:
    return rig(odd=True)


def capture(tool: str, folder: Path, made: Rig) -> Path:
    kept = kept_by(tool, made)
    write_pictures(folder / "images", kept)
    return folder / TOOLS[tool][0](folder, kept)


def refused(path: Path) -> str:
    """The error of a file, which has to come soon and fit on a line."""
    start = time.process_time()
    with memory_limit(256 << 20), pytest.raises(NerfbakeError) as found:
        load(path, Cameras)
    assert time.process_time() - start < FAST
    assert found.value.exit_code == 1
    line = str(found.value)
    assert "\n" not in line
    assert "allowed" in line
    return line


def told(path: Path) -> str:
    """The error of a file, '' if it can be read."""
    try:
        load(path, Cameras)
    except NerfbakeError as error:
        return str(error)
    return ""


# -- XML -------------------------------------------------------------------------------------------------------
BOMB = '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
EXTERNAL = '<!DOCTYPE a [<!ENTITY a SYSTEM "secret.txt">]>'
PARAMETER = '<!DOCTYPE a SYSTEM "secret.dtd">'


@pytest.mark.parametrize("tool", XML)
@pytest.mark.parametrize("doctype", [BOMB, EXTERNAL, PARAMETER])
def test_a_document_type_is_refused(doctype: str, tool: str, made: Rig, tmp_path: Path) -> None:
    path = capture(tool, tmp_path, made)
    (tmp_path / "secret.txt").write_text("secret")
    text = path.read_text()
    text = text.replace("?>\n", f"?>\n{doctype}", 1) if text.startswith("<?xml") else doctype + text
    path.write_text(text.replace(' label="rig"', ' label="&b;"'))
    assert "has a document type (<!DOCTYPE>); allowed: XML without one" in refused(path)
    assert "secret" not in refused(path)


def test_an_entity_without_a_document_type_is_refused() -> None:
    with pytest.raises(InvalidFile, match=r"is not XML \(undefined entity"):
        parse_xml(b"<a>&b;</a>", "a.xml")


def test_elements_are_limited_in_depth_and_number() -> None:
    deep = b"<a>" * 100_000 + b"</a>" * 100_000
    with pytest.raises(InvalidFile, match=f"has elements in more than {MAX_DEPTH} others"):
        parse_xml(deep, "a.xml")
    with memory_limit(64 << 20), pytest.raises(MemoryLimit):
        parse_xml(b"<a>" + b"<b/>" * 1_000_000 + b"</a>", "a.xml")


def test_any_text_that_is_no_xml_is_refused() -> None:
    for data in (b"", b"<a>", b"<a></b>", b"<?xml version='1.0' encoding='no-such'?><a/>", b"\x00\xff", b"<a b=1/>"):
        with pytest.raises(InvalidFile, match="is not XML"):
            parse_xml(data, "a.xml")
    assert parse_xml("<?xml version='1.0' encoding='utf-16'?><a>é</a>".encode("utf-16"), "a.xml").text == "é"


# -- JSON ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("tool", JSON)
def test_json_of_great_depth_is_refused(tool: str, made: Rig, tmp_path: Path) -> None:
    path = capture(tool, tmp_path, made)
    text = path.read_text()
    path.write_text(text[:-1] + ', "deep": ' * text.startswith("{") + "," * text.startswith("[") + "[" * 100_000)
    refused(path)


@pytest.mark.parametrize("tool", JSON)
def test_nan_in_json_is_refused(tool: str, made: Rig, tmp_path: Path) -> None:
    path = capture(tool, tmp_path, made)
    text = path.read_text()
    number = next(part for part in ("17.5", "0.5", "-2.", "-1.", "0.") if part in text)
    path.write_text(text.replace(number, "NaN", 1))
    refused(path)


@pytest.mark.parametrize("tool", JSON)
def test_any_value_of_another_kind_is_a_line(tool: str, made: Rig, tmp_path: Path) -> None:
    """Each value of the document is replaced by text, null, a list, a huge number and an object, one at a time."""
    path = capture(tool, tmp_path, made)
    document = json.loads(path.read_text())
    places = list(_places(document))
    for at, (holder, key) in enumerate(places):
        kept = holder[key]
        values: tuple[tuple[Any, Any], ...] = (("x", None), ([], 1e300), ({}, -1), (10**30, True))
        for value in values[at % 4]:
            holder[key] = value
            path.write_text(json.dumps(document))
            assert "\n" not in told(path)
        holder[key] = kept


def _places(value: object):  # type: ignore[no-untyped-def]
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in list(items):
        yield value, key
        yield from _places(each)


# -- text ------------------------------------------------------------------------------------------------------
COUNTS = {
    "bundler": ("4 1\n", "1000000000 1\n", "has 1,000,000,000 cameras; allowed: 1 to 100,000"),
    "nvm": ("\n3\n", "\n1000000000\n", "has 1,000,000,000 cameras; allowed: 1 to 100,000"),
}


@pytest.mark.parametrize("tool", COUNTS)
def test_counts_of_a_thousand_million_are_refused(tool: str, made: Rig, tmp_path: Path) -> None:
    path = capture(tool, tmp_path, made)
    old, new, said = COUNTS[tool]
    text = path.read_text()
    path.write_text(text.replace(old, new, 1))
    assert said in refused(path)
    points = {"bundler": ("4 1\n", "4 1000000000\n"), "nvm": ("\n1\n", "\n1000000000\n")}[tool]
    path.write_text(text.replace(*points, 1))
    assert "line" in refused(path)
    seen = {"bundler": "2 0 5 9 9", "nvm": "1 2 3 2 0 5"}[tool]
    path.write_text(text.replace(seen, seen.replace("2 0 5", "1000000000 0 5"), 1))
    assert "numbers" in refused(path)


@pytest.mark.parametrize("word", ["nan", "inf", "1e400", "x", ""])
@pytest.mark.parametrize("tool", [*TEXT, *XML])
def test_a_number_that_is_none_is_refused(tool: str, word: str, made: Rig, tmp_path: Path) -> None:
    path = capture(tool, tmp_path, made)
    if tool == "kapture":
        path = path.with_name("trajectories.txt")
    text = path.read_text()
    number = tools.numbers(made.poses[1][1, 3]) if tool != "metashape" else tools.numbers(made.fy)
    words = re.findall(r"(?<=[ >,\n])-?[0-9]\.[0-9]{6,}", text)
    number = number if number in text else words[0]
    path.write_text(text.replace(number, word, 1))
    file = path.with_name("sensors.txt") if tool == "kapture" else path
    if tool == "kapture" and not word:
        return  # an empty position is allowed, and is no pose
    assert "file of unknown kind" not in refused(file)


@pytest.mark.parametrize("tool", [*TEXT, *XML, *JSON, "neus"])
def test_a_file_that_is_cut_off_anywhere_is_a_line_or_fewer_cameras(tool: str, made: Rig, tmp_path: Path) -> None:
    path = capture(tool, tmp_path, made)
    data = path.read_bytes()
    for at in range(0, len(data), max(1, len(data) // 25)):
        path.write_bytes(data[:at])
        assert "\n" not in told(path)


def test_lines_without_an_end_are_refused(made: Rig, tmp_path: Path) -> None:
    for tool in ("tum", "kitti", "open3d"):
        path = capture(tool, tmp_path / tool, made)
        path.write_text(path.read_text() + "1 " * 100_000)
        assert "allowed: up to 8,192" in refused(path)


TEXTS = ("nan " * 8 + "\n", "inf " * 12 + "\n", "1e308 " * 8 + "\n", "1e308 " * 12 + "\n", "1 1 1\n" + "1e200 " * 4)


@pytest.mark.parametrize("form", catalog.DIALECTS, ids=lambda form: form.name)
def test_nobody_recognises_noise(form: catalog.Dialect) -> None:
    noise = np.random.default_rng(0)
    recognise = form.load_module().recognise
    for ending in form.endings:
        for data in (*(noise.bytes(size) for size in (0, 1, 7, 64, 5000)), *(text.encode() for text in TEXTS)):
            assert not recognise(f"a{ending}", data)


# -- the rest --------------------------------------------------------------------------------------------------
def test_matrices_of_neus_that_are_singular_or_not_finite_are_refused(made: Rig, tmp_path: Path) -> None:
    path = capture("neus", tmp_path, made)
    for value, said in ((0.0, "is singular"), (np.nan, "is not 4 x 4 finite numbers"), (1.0, "is singular")):
        np.savez(path, world_mat_0=np.full((4, 4), value), scale_mat_0=np.eye(4))
        assert said in refused(path)
    np.savez(path, world_mat_0=np.eye(3), scale_mat_0=np.eye(4))
    assert "world_mat_0 has dtype float64, shape (3, 3)" in refused(path)
    np.savez(path, world_mat_0=np.array([{}], object), scale_mat_0=np.eye(4))
    assert "holds Python objects" in refused(path)


def test_a_project_of_metashape_without_its_chunk_is_refused(made: Rig, tmp_path: Path) -> None:
    path = tmp_path / tools.write_metashape_project(tmp_path, made)
    chunk = tmp_path / "scan.files" / "0" / "chunk.zip"
    data = chunk.read_bytes()
    chunk.write_bytes(data[: len(data) // 2])
    assert "is not a complete zip archive" in refused(path)
    chunk.unlink()
    assert "scan.files has no chunk" in refused(path)


def test_a_scale_and_a_focal_length_of_metashape_are_above_0(made: Rig, tmp_path: Path) -> None:
    path = tmp_path / tools.write_metashape(tmp_path, made)
    text = path.read_text()
    for old, new, said in (
        ("<scale>2.5</scale>", "<scale>-1</scale>", "has the scale -1; allowed: a number above 0"),
        (f"<f>{made.fy!r}</f>", "<f>-5</f>", "has the focal length -5; allowed: a number of pixels above 0"),
        ('sensor_id="0"', 'sensor_id="3"', "has the sensor 3; allowed: a sensor of the chunk"),
        (f'width="{made.width}"', 'width="1e9"', "width is 1e+09; allowed: 1 to"),
    ):
        path.write_text(text.replace(old, new))
        assert said in refused(path)


def test_a_link_in_place_of_a_file_is_no_way_out(made: Rig, tmp_path: Path) -> None:
    """Album looks names up in the folder; a name with .. or from / is reduced to its last part."""
    home = tmp_path / "capture"
    write_pictures(tmp_path / "outside", made)
    for label in ("/etc/passwd", "../outside/r_0.png", "C:\\secret\\r_0.png", "a/../../outside/r_0.png", "..", "/"):
        fields: dict[str, Any] = {"id": 0, "img_name": label, "width": 14, "height": 10, "fx": 5, "fy": 5}
        fields |= {"position": [0, 0, 0], "rotation": np.eye(3).tolist()}
        (camera,) = load(home / placed(home, "cameras.json", json.dumps([fields])), Cameras).cameras
        assert not camera.picture.startswith(("/", ".."))
        assert "outside" not in camera.picture


@pytest.mark.parametrize(
    ("path", "content", "said"),
    [
        ("a_cam.txt", "extrinsic\n", "a_cam.txt: has 1 words; allowed: extrinsic"),
        (
            "mav0/state_groundtruth_estimate0/data.csv",
            "#timestamp,p_RS_R_x\n1,2\n",
            "mav0/state_groundtruth_estimate0/data.csv: line 2 has 2 columns; allowed: 8 or more",
        ),
        ("cameras.txt", "1 PINHOLE\n", "cameras.txt: line 1 has 2 entries; allowed: 5 or more"),
        ("images.txt", "\n", "images.txt: cameras.txt: line 1 has 2 entries; allowed: 5 or more"),
    ],
)
def test_a_file_that_is_given_itself_is_named_once(
    path: str, content: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    placed(tmp_path, "images.txt", "\n")
    placed(tmp_path, "cameras.txt", "1 PINHOLE\n")
    placed(tmp_path, path, content)
    monkeypatch.chdir(tmp_path)
    assert refused(Path(path)).startswith(said)
