"""Reading stages: what is refused before OpenUSD sees it, and what happens if it crashes."""

from __future__ import annotations

import io
import signal
import zipfile
from pathlib import Path

import numpy as np
import pytest

from nerfbake import installation, memory_limit
from nerfbake.errors import InvalidFile, MemoryLimit, NerfbakeError, UsageError
from nerfbake.formats.splat.usdc import encode as encode_splats
from nerfbake.formats.wire.usd import _child, reading
from nerfbake.formats.wire.usd.content import has_type, is_usd
from nerfbake.formats.wire.usd.reading import read_stage
from tests.support.splats import splats
from tests.support.usd import in_this_process as in_this_process
from tests.support.usd import layer, package

SPLATS = _child.SPLATS
here = pytest.mark.usefixtures("in_this_process")
ONE = f'def {SPLATS} "s"\n{{\n point3f[] positions = [(1, 2, 3)]\n}}'


def read(data: bytes) -> reading.StageContent:
    return read_stage(memoryview(data))


def refusal(data: bytes) -> str:
    with pytest.raises(NerfbakeError) as error:
        read(data)
    assert "\n" not in str(error.value)
    return str(error.value)


def zipped(files: dict[str, bytes], *, method: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return file.getvalue()


# -- what is read ----------------------------------------------------------------------------------------------
def test_arrays_come_back_bit_for_bit() -> None:
    scene = splats(50, degree=1)
    (prim,) = read(b"".join(encode_splats(scene))).prims
    assert prim.values["scales"].tobytes() == scene.scales.tobytes()
    assert prim.values["orientations"][:, [3, 0, 1, 2]].tobytes() == scene.flipped().quats.tobytes()
    assert (prim.path, prim.kind) == ("/scene/splats", SPLATS)


@here
def test_places_are_in_metres_and_in_the_world() -> None:
    move = 'double3 xformOp:translate = (10, 0, 0)\nuniform token[] xformOpOrder = ["xformOp:translate"]'
    body = f'def Xform "x"\n{{\n{move}\n{ONE}\n}}'
    (prim,) = read(layer(body, metres=0.01)).prims
    assert np.allclose(prim.place, np.array([[0.01, 0, 0, 0.1], [0, 0.01, 0, 0], [0, 0, 0.01, 0], [0, 0, 0, 1]]))


@here
def test_layers_of_a_package_may_refer_to_each_other_and_a_zip_may_be_unaligned_or_deflated() -> None:
    root = layer('def "s" (\n references = @./parts/one.usda@</scene/s>\n)\n{\n}')
    for data in (
        package({"a.usda": root, "parts/one.usda": layer(ONE)}),
        zipped({"a.usda": root, "parts/one.usda": layer(ONE)}, method=zipfile.ZIP_DEFLATED),
    ):
        assert [prim.path for prim in read(data).prims] == ["/scene/s"]


@here
def test_what_is_hidden_and_other_types_are_left_out_with_a_note() -> None:
    others = 'def Sphere "a"\n{\n}\ndef Mesh "m"\n{\n token visibility = "invisible"\n}\n'
    others += 'def Mesh "g"\n{\n uniform token purpose = "guide"\n}\n'
    found = read(layer(ONE + "\n" + others))
    assert [prim.kind for prim in found.prims] == [SPLATS]
    assert found.notes == ("hidden prims are not read: 2", "prims of these types are not read: 1 Sphere")


@here
@pytest.mark.parametrize("moved", ["the prim", "a prim above", "a value"])
def test_what_moves_is_read_at_its_first_time_with_a_note(moved: str) -> None:
    """As Blender writes a camera with keyframes. What has one time only, as its other values, does not move."""

    def move(*times: int) -> str:
        places = ", ".join(f"{time}: ({time}, 0, 0)" for time in times)
        order = 'uniform token[] xformOpOrder = ["xformOp:translate"]'
        return f"double3 xformOp:translate.timeSamples = {{{places}}}\n{order}\n"

    lenses = "1: 20, 2: 30" if moved == "a value" else "1: 20"
    camera = f'def Camera "c"\n{{\nfloat focalLength.timeSamples = {{{lenses}}}\n'
    camera += move(*((1, 2) if moved == "the prim" else (1,))) + "}"
    above = move(*((1, 2) if moved == "a prim above" else (1,)))
    found = read(layer(f'def Xform "x"\n{{\n{above}{camera}\ndef Camera "still"\n{{\n}}\n}}'))
    assert [prim.place[0, 3] for prim in found.prims] == [2, 1]
    assert found.prims[0].values["focalLength"] == 20
    count = 2 if moved == "a prim above" else 1
    assert found.notes == (f"prims that move or change are read at the first time only: {count}",)


# -- what is refused -------------------------------------------------------------------------------------------
@here
def test_no_file_outside_is_opened(tmp_path: Path) -> None:
    secret = tmp_path / "secret.usda"
    secret.write_bytes(layer(ONE))
    for reference in (str(secret), f"../{secret.name}", "./beside.usda", "beside.usda", "https://x/y.usda"):
        for arc in ("references", "payload", "inherits"):
            if arc == "inherits":
                data = layer(ONE).replace(b'upAxis = "Y"', f'upAxis = "Y"\n subLayers = [@{reference}@]'.encode())
            else:
                data = layer(f'def "s" (\n {arc} = @{reference}@\n)\n{{\n}}')
            assert refusal(data).startswith(f"stage.usda refers to {reference[:60]}")
            assert "; allowed: layers in the same .usdz; `usdcat --flatten` of OpenUSD makes one layer" in refusal(data)
    for name in (str(secret), "../x.usda", "b/../../x.usda"):
        data = package({"a.usda": layer(f'def "s" (\n references = @{name}@\n)\n{{\n}}'), "b/c.usda": layer(ONE)})
        assert f"a.usda refers to {name[:60]}" in refusal(data)


@here
def test_value_clips_are_refused() -> None:
    clips = 'def "s" (\n clips = {\n dictionary default = {\n asset[] assetPaths = [@/x.usd@]\n }\n }\n)\n{\n}'
    assert "stage.usda has value clips at /scene/s" in refusal(layer(clips))


@here
@pytest.mark.parametrize("name", ["../a.png", "/a.png", "b//a.png", "b/./a.png", "C:a.png", "a\\b.png", "a\n.png"])
def test_names_that_lead_out_of_a_package_are_refused(name: str) -> None:
    said = refusal(zipped({"a.usda": layer(ONE), name: b"x"}))
    assert "the package has a file named" in said or "not a complete zip" in said


@here
def test_packages_that_are_none_are_refused() -> None:
    assert "the package starts with a.png; allowed: a layer as the first file" in refusal(
        zipped({"a.png": b"x", "a.usda": layer(ONE)})
    )
    assert "has the package b.usdz" in refusal(zipped({"a.usda": layer(ONE), "b.usdz": b"x"}))
    assert "is not a complete zip archive" in refusal(package({"a.usda": layer(ONE)})[:-30])
    assert "does not start as a layer of USD" in refusal(b"#usd 1.0")


def test_a_bomb_in_a_package_is_refused_before_it_is_unpacked() -> None:
    data = zipped({"a.usda": b"#usda 1.0\n" + bytes(50_000_000)}, method=zipfile.ZIP_DEFLATED)
    assert len(data) < 100_000
    with memory_limit(10_000_000), pytest.raises(MemoryLimit):
        read(data)


def test_broken_text_and_a_truncated_crate_are_one_line() -> None:
    """In the child, where a crash would be one line, too."""
    assert refusal(layer('def "s" {').replace(b"\n}", b"")).startswith("the stage cannot be read: ")
    crate = b"".join(encode_splats(splats(20)))
    for size in (80, len(crate) // 2, len(crate) - 1):
        assert refusal(crate[:size]).startswith("the stage ")


@here
def test_numbers_that_are_not_finite_or_make_no_unit_are_refused() -> None:
    assert "metersPerUnit is 0" in refusal(layer(ONE, metres=0.0))
    assert "metersPerUnit is inf" in refusal(layer(ONE, metres=float("inf")))
    place = 'double3 xformOp:translate = (nan, 0, 0)\n uniform token[] xformOpOrder = ["xformOp:translate"]\n'
    assert "/scene/s has a transform that is not affine" in refusal(layer(ONE.replace("{", "{\n" + place)))


def test_a_crash_of_openusd_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for number, said in ((signal.SIGSEGV, "ends OpenUSD with SIGSEGV"), (signal.SIGXCPU, "takes OpenUSD too long")):
        script = tmp_path / f"{number}.py"
        script.write_text(
            f"import os, signal\nsignal.signal({number:d}, signal.SIG_DFL)\nos.kill(os.getpid(), {number:d})"
        )
        with monkeypatch.context() as patch:
            patch.setattr(reading, "CHILD", script)
            assert said in refusal(layer(ONE))


@pytest.mark.slow
def test_a_stage_that_never_ends_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each level refers forty times to the level below it."""
    monkeypatch.setattr(reading, "_SECONDS", 1)
    levels = [
        f'class "c{i}"\n{{\n'
        + "".join(f'def "d{k}" (\n inherits = </c{i + 1}>\n)\n{{\n}}\n' for k in range(40))
        + "}\n"
        for i in range(5)
    ]
    data = b"#usda 1.0\n" + "".join(levels).encode() + b'class "c5"\n{\n}\ndef "x" (\n inherits = </c0>\n)\n{\n}\n'
    assert refusal(data) == "the stage takes OpenUSD too long; allowed: a stage that it reads"


def test_the_library_is_named_if_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    with pytest.raises(
        UsageError, match=r"reading USD needs pxr, which is not installed; allowed: .*install .*\[usd\]"
    ):
        read(layer(ONE))


def test_nothing_is_left_in_the_folder_for_temporary_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    read(layer(ONE))
    with pytest.raises(InvalidFile):
        read(layer("x"))
    assert list(tmp_path.iterdir()) == []


# -- content ---------------------------------------------------------------------------------------------------
def test_types_are_found_in_all_containers(tmp_path: Path) -> None:
    crate, text = b"".join(encode_splats(splats(3))), layer(ONE)
    for data in (crate, text, package({"a.usdc": crate}), package({"a.usda": layer(""), "b.usda": text})):
        assert has_type(memoryview(data), SPLATS)
        assert not has_type(memoryview(data), "Mesh")
        assert is_usd(memoryview(data))
    assert not has_type(memoryview(package({"a.usda": text})[:100]), SPLATS)
    assert not is_usd(memoryview(zipped({"a.npy": b""})))


def test_tokens_of_crates_that_openusd_compressed_are_found(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usdc"))
    for i in range(300):
        UsdGeom.Camera.Define(stage, f"/scene_{i}/camera_of_the_scene_{i}/camera_{i}")
    stage.Save()
    data = (tmp_path / "a.usdc").read_bytes()
    assert b"camera_of_the_scene_299" not in data  # it is compressed
    assert has_type(memoryview(data), "camera_of_the_scene_299")
    assert has_type(memoryview(data), "Camera")
    for size in range(80, len(data), 97):
        has_type(memoryview(data[:size] + b"\xff" * 50), "Camera")
