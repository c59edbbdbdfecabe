"""The catalog lists every format, the stubs list every stage and scene, and their entries are correct."""

from __future__ import annotations

import ast
from importlib import import_module

import pytest

import nerfbake
from nerfbake import catalog, jobs
from tests.support.source import PACKAGE, modules, parsed, public_names, public_names_of


def formats() -> list[str]:
    """The modules of `formats` that define encode() or decode(). Their helper modules define neither."""
    found = []
    for path in modules():
        place = path.relative_to(PACKAGE.parent).with_suffix("")
        functions = {node.name for node in parsed(path).body if isinstance(node, ast.FunctionDef)}
        if "formats" in place.parts and "wire" not in place.parts and functions & {"encode", "decode"}:
            found.append(".".join(place.parts))
    return found


def test_every_format_and_stage_has_its_line() -> None:
    def files(folder: str, pattern: str = "*") -> set[str]:
        return {f"nerfbake.{folder}.{path.stem}" for path in (PACKAGE / folder).glob(f"[!_]{pattern}.py")}

    lines = catalog.FORMATS + catalog.FOLDERS + catalog.DIALECTS
    assert {f"nerfbake.formats.{form.module}" for form in lines} == set(formats())
    assert set(public_names_of("stages").values()) == files("stages", "*_to_*")
    assert set(public_names_of("scene").values()) <= files("scene")


def test_every_line_of_the_catalog_is_true() -> None:
    scenes = public_names_of("scene")
    for form in catalog.FORMATS:
        assert form.scene in scenes
        assert form.name == form.suffix.removeprefix(".")
    for kind in catalog.FOLDERS:
        assert kind.scene in scenes
    for dialect in catalog.DIALECTS:
        module = dialect.load_module()
        assert all(callable(getattr(module, name)) for name in ("recognise", "decode"))
        assert hasattr(module, "encode") == bool(dialect.written_as)
    for package in ("nerfbake", "nerfbake.jobs"):
        for name, home in public_names(package).items():
            assert callable(getattr(import_module(home), name))


def test_longer_endings_come_first() -> None:
    """Of readable formats, and of those that write one scene type. Others may share an extension: content decides."""
    readable = [form for form in catalog.FORMATS if form.readable]
    for forms in (readable, *(catalog.formats_of(scene) for scene in public_names_of("scene"))):
        endings = [form.suffix for form in forms]
        for i, ending in enumerate(endings):
            assert not any(ending.endswith(earlier) and ending != earlier for earlier in endings[:i])
    for scene in public_names_of("scene"):
        endings = [form.suffix for form in catalog.formats_of(scene)]
        assert len(set(endings)) == len(endings)


def test_public_names_are_there() -> None:
    assert sorted([*public_names(), "jobs"]) == nerfbake.__all__  # type: ignore[attr-defined]
    for name in public_names():
        assert callable(getattr(nerfbake, name))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = nerfbake.nonsense  # type: ignore[attr-defined]


def test_public_jobs_are_there() -> None:
    written = {
        node.name
        for path in (PACKAGE / "jobs").glob("[!_]*.py")
        for node in parsed(path).body
        if isinstance(node, ast.FunctionDef) and any(argument.arg == "steps" for argument in node.args.kwonlyargs)
    }
    assert written < set(public_names("nerfbake.jobs"))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = jobs.nonsense  # type: ignore[attr-defined]


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
