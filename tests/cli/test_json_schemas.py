"""What commands print for scripts is what schemas/json says, and the schemas are strict enough to notice more."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from jsonschema import Draft202012Validator

from nerfbake import Meshes, build_field, build_octree, jobs, orbit_cameras, sample_n3tree, save
from nerfbake.cli import main
from tests.batch.conftest import folder as folder
from tests.cli.test_batch import TEMPLATE, inputs
from tests.cli.test_jobs import commands
from tests.conformance.case import HOME
from tests.conformance.case import SUFFIX as EXPECTED
from tests.conformance.gaussian_splatting.files import HOME as SET
from tests.support.meshes import sphere
from tests.support.outputs import SCHEMAS, SUFFIX, read_output, validator
from tests.support.rooms import write_room
from tests.support.source import PACKAGE, imports
from tests.support.usd import in_this_process as in_this_process
from tests.support.videos import write_video

ATLAS = "--map-size 8 --directions 9 --json"
MESH = "--frames 8 --edge 32 --triangles 500 --texture 64 --json"
FIT = "--epochs cells=32,epochs=1 --basis SH1 --json"
# Each line with the exit code that it ends with; OUT is a new name. Lines of one command have the same schema.
LINES = {
    "check a.npz --json": 0,
    "check broken.npz --json": 1,
    "check gone.npz --json": 1,
    "info a.npz --json": 0,
    "info in --json": 0,
    "info baked --json": 0,
    "info twice.json --json": 0,
    "info a.glb --max-memory 600kB --json": 0,
    "info --devices --json": 0,
    "compare a.npz a.svo.pb --size 9x9 --json": 0,
    "compare a.npz coarse.svo.pb --cameras c.json --truth truth --json": 0,
    "compare a.npz coarse.svo.pb --size 9x9 --min-psnr 90 --json": 3,
    "compare in baked --size 9x9 --json": 0,
    f"atlas in OUT --clusters 3 {ATLAS}": 0,
    f"atlas in OUT --method affine --clusters 3 {ATLAS}": 0,
    f"atlas in OUT --method grid --nodes 2 {ATLAS}": 0,
    f"atlas in OUT --clusters 2 --min-psnr 90 {ATLAS}": 3,
    "atlas-error baked in --directions 9 --json": 0,
    "atlas-error baked in --held-out --json": 0,
    "compress a.npz OUT.svoq --max-size 4kB --json": 0,
    "compress a.npz OUT.svoq --max-loss 0.5 --cameras c.json --truth truth --json": 0,
    "compress a.npz OUT.svoq --max-loss 0.5 --cameras c.json --truth truth --min-psnr 90 --json": 3,
    f"fit photographs OUT.npz {FIT}": 0,
    f"fit photographs OUT.svo.pb --holdout 5 {FIT}": 0,
    f"fit photographs OUT.svo.pb --test photographs {FIT}": 0,
    f"mesh a.npz OUT.glb {MESH}": 0,
    f"mesh a.npz OUT.ply {MESH} --min-psnr 90": 3,
    f"mesh a.npz OUT {MESH}": 0,
    "frames a.mkv OUT --count 3 --json": 0,
    "poses room --json": 0,
    "refit coarse.svo.pb OUT.svo.pb --like a.npz --frames 4 --edge 24 --epochs 1 --json": 0,
    "refit coarse.svo.pb OUT.svo.pb --views photographs --epochs 1 --json": 0,
    "ship a.npz OUT --for unity --json": 0,
    "splats a.npz OUT.ply --count 300 --frames 4 --edge 24 --epochs 1 --json": 0,
    "splats a.npz OUT.spz --count 300 --views photographs --epochs 1 --min-psnr 90 --json": 3,
    "batch 'svo {in} out/{stem}.svo.pb --min-psnr 30' a.npz --plan --json": 0,
    "batch 'fit {in} out.npz --state state' photographs --plan --json": 0,
    "bench formats a.svo.pb --formats raw --rounds 1 --format json": 0,
    "bench formats a.svo.pb coarse.svo.pb --formats raw --rounds 2 --format json": 0,
}
SLOW = ("bench", "compress", "poses")
WRITTEN = (EXPECTED, ".html", ".gif", "volume.usda", "volume.usdc", ".yaml")  # what is not read on its own
FROZEN = sorted(path for path in HOME.glob("*/*") if not path.name.endswith(WRITTEN) and path.parent != SET)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small scene of every kind that LINES names."""
    folder = tmp_path_factory.mktemp("scenes")
    tree = sample_n3tree(resolution=16, basis="SH4")
    octree = build_octree(tree)
    save(folder / "a.npz", tree)
    save(folder / "a.svo.pb", octree)
    save(folder / "coarse.svo.pb", build_octree(tree, resolution=8))
    tree.data[tree.leaf_mask] = np.nan
    save(folder / "broken.npz", tree)
    save(folder / "a.glb", Meshes((sphere(),)))
    cameras = orbit_cameras(build_field(octree), frames=2, width=24, height=20)
    save(folder / "c.json", cameras)
    save(folder / "twice.json", replace(cameras, samples=2))
    shots = jobs.ViewSelection(cameras=str(folder / "c.json"), every=True)
    jobs.render_views(folder / "coarse.svo.pb", jobs.PictureOutputs(out=str(folder / "truth")), shots)
    jobs.write_sample_stage1(folder / "in", resolution=32)
    jobs.bake_atlas_folder(folder / "in", folder / "baked", clusters=3, map_size=8)
    jobs.write_sample_capture(folder / "photographs", frames=10, edge=32)
    write_room(folder / "room")
    write_video(folder / "a.mkv", list(np.random.default_rng(0).random((5, 16, 16, 3))))
    return folder


def schema_of(line: str) -> str:
    return line.split()[0] + ("-plan" if " --plan" in line else "")


def prints_json(command: click.Command) -> bool:
    formats = [each.type for each in command.params if isinstance(each.type, click.Choice) and each.name != "progress"]
    choices = [choice for each in formats for choice in each.choices]
    return "json" in choices or any("--json" in each.opts for each in command.params)


def places(value: Any, *path: str | int) -> Iterator[tuple[str | int, ...]]:
    """The paths of all that an output holds; of a list only the first entry."""
    entries = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    for key, entry in entries:
        yield (*path, key)
        yield from places(entry, *path, key)


def damaged(facts: Any) -> Iterator[tuple[str, Any]]:
    """The same output with one fault: a key more, a key less, or something else in one place."""
    yield "a key more", {**facts, "one_more": 1}
    for key in facts:
        if key != "samples" or facts.get("kind") != "cameras":  # told only where there are several
            yield f"no {key}", {name: value for name, value in facts.items() if name != key}
    for path in places(facts):
        broken = deepcopy(facts)
        reduce(getitem, path[:-1], broken)[path[-1]] = {"one_more": [None]}
        yield f"an object as {path}", broken


def require_strict(name: str, facts: Any) -> None:
    for fault, broken in damaged(facts):
        assert not validator(name).is_valid(broken), fault


@pytest.mark.usefixtures("fewer_rays")
@pytest.mark.parametrize(
    "line", [pytest.param(line, marks=pytest.mark.slow if line.startswith(SLOW) else ()) for line in LINES]
)
def test_an_output_is_what_its_schema_says(
    line: str, scenes: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(scenes)
    words = [word.replace("OUT", f"out{list(LINES).index(line)}") for word in shlex.split(line)]
    assert main.run(words) == LINES[line]
    facts = read_output(schema_of(line), capsys.readouterr().out)
    assert next(iter(facts)) == "version"
    require_strict(schema_of(line), facts)


@pytest.mark.usefixtures("in_this_process")
def test_info_of_every_frozen_file_is_what_its_schema_says(capsys: pytest.CaptureFixture[str]) -> None:
    found: dict[str, Any] = {}
    for path in FROZEN:
        assert main.run(["info", str(path), "--json"]) == 0
        facts = read_output("info", capsys.readouterr().out)
        found[facts["kind"]] = facts
    keys = [each.get("properties", {}) for each in validator("info").schema["$defs"].values()]
    assert found.keys() == {each["kind"]["const"] for each in keys if "kind" in each}
    for facts in found.values():
        require_strict("info", facts)


def test_every_event_of_a_batch_is_what_its_schema_says(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def events(*arguments: str, code: int) -> list[Any]:
        assert main.run(["batch", *arguments, "--state", "run", "--json", "-q"]) == code
        return [read_output("batch", line) for line in capsys.readouterr().out.splitlines()]

    names = [inputs(word, word=word)[0] for word in ("fine", "broken", "poor", "killed")]
    template = f"{TEMPLATE} --min-psnr 30"
    first = events(template, *names, "in/gone", code=1)
    assert {event["status"] for event in first} == {"done", "failed", "rejected", "killed"}
    again = events(template, *names, code=1)
    assert {event["event"] for event in again} == {"end", "skip"}
    inputs("fine", word="changed")
    judged = events(code=1)
    assert {event["status"] for event in judged} == {"waiting", "failed", "rejected", "killed"}
    for event in (*first, *again, *judged):
        require_strict("batch", event)


def test_every_command_that_prints_json_is_here_and_every_output_has_a_schema() -> None:
    printing = {name.split()[0] for name, command in commands(main.cli).items() if prints_json(command)}
    assert printing == {line.split()[0] for line in LINES}
    assert {*map(schema_of, LINES), "batch", "progress"} == {
        path.name.removesuffix(SUFFIX) for path in SCHEMAS.iterdir()
    }


def test_no_command_prints_json_without_a_version() -> None:
    for path in (PACKAGE / "cli").glob("*.py"):
        assert not {"json", "orjson"} & imports(path), f"{path.name}: io.print_json() prints with a version"


@pytest.mark.parametrize("name", [path.name.removesuffix(SUFFIX) for path in sorted(SCHEMAS.iterdir())])
def test_a_schema_is_one_and_describes_every_key(name: str) -> None:
    schema = validator(name).schema
    Draft202012Validator.check_schema(schema)
    assert schema["$schema"] == Draft202012Validator.META_SCHEMA["$id"]
    assert "version" in schema["required"]
    assert isinstance(schema["properties"]["version"]["const"], int)
    for path in places(schema):
        if path[-2:-1] == ("properties",) and path[-1] != "kind" and path[0] in ("properties", "$defs"):
            key = reduce(getitem, path, schema)
            by_reference = schema.get("$defs", {}).get(key.get("$ref", "").rpartition("/")[2], {})
            assert "description" in by_reference | key, path
