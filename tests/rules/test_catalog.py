"""Every format, stage and scene has its line in the catalog, and every line is true."""

from __future__ import annotations

import ast
from importlib import import_module

import pytest

import nerfbake
from nerfbake import catalog, jobs
from tests.support.source import PACKAGE, modules


def formats() -> list[str]:
    """The modules of `formats` that say encode() or decode(): what they import from their family says neither."""
    found = []
    for path in modules():
        place = path.relative_to(PACKAGE.parent).with_suffix("")
        functions = {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}
        if "formats" in place.parts and "wire" not in place.parts and functions & {"encode", "decode"}:
            found.append(".".join(place.parts))
    return found


def test_every_format_and_stage_has_its_line() -> None:
    def files(folder: str) -> set[str]:
        return {f"nerfbake.{folder}.{path.stem}" for path in (PACKAGE / folder).glob("[!_]*.py")}

    assert {f"nerfbake.formats.{form.module}" for form in catalog.FORMATS + catalog.FOLDERS} == set(formats())
    assert set(catalog.STAGES.values()) == files("stages")
    assert set(catalog.SCENES.values()) <= files("scene")


def test_every_line_of_the_catalog_is_true() -> None:
    for form in catalog.FORMATS:
        assert form.scene in catalog.SCENES
        assert form.name == form.suffix.removeprefix(".")
    for kind in catalog.FOLDERS:
        assert kind.scene in catalog.SCENES
    for name, home in (catalog.STAGES | catalog.SCENES).items():
        assert callable(getattr(import_module(home), name))


def test_longer_endings_come_first() -> None:
    """Of what is read, and of what one type of scene is written as: pages of two types have the same ending."""
    readable = [form for form in catalog.FORMATS if form.readable]
    for forms in (readable, *(catalog.formats_of(scene) for scene in catalog.SCENES)):
        endings = [form.suffix for form in forms]
        for i, ending in enumerate(endings):
            assert not any(ending.endswith(earlier) for earlier in endings[:i])


def test_public_names_are_there() -> None:
    for name in nerfbake.__all__:
        assert callable(getattr(nerfbake, name))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = nerfbake.nonsense


def test_public_jobs_are_there() -> None:
    written = {
        node.name
        for path in (PACKAGE / "jobs").glob("[!_]*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and any(argument.arg == "steps" for argument in node.args.kwonlyargs)
    }
    assert set(jobs.JOBS) == written
    for name in jobs.__all__:
        assert callable(getattr(jobs, name))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = jobs.nonsense


def test_a_scene_is_named_by_its_file_without_the_endings() -> None:
    names = (
        "a/chair.npz",
        "chair.svo.pb.zst",
        "chair.vdb.npz",
        "CHAIR.SVO.PB",
        "folder",
        "x/mesh_stage1",
        "my.scene.glb",
        ".npz",
    )
    assert [catalog.scene_name(name) for name in names] == [
        "chair", "chair", "chair", "CHAIR", "folder", "mesh_stage1", "my.scene", ".npz",
    ]  # fmt: skip
