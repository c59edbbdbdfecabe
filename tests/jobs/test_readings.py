"""Every command takes every scene that has voxels or becomes voxels, and says the same about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import (
    LatticeField,
    Meshes,
    SparseVoxelOctree,
    Splats,
    Volume,
    build_n3tree,
    build_octree,
    build_vdb,
    jobs,
    load,
    sample_n3tree,
    save,
)
from nerfbake.errors import NerfbakeError, UsageError
from nerfbake.jobs.readings import FIELDS, TAKEN, Reading
from nerfbake.jobs.steps import SILENT
from tests.jobs.listener import Listener
from tests.support.brick_fields import some_shelled_field
from tests.support.compression import with_fewer_rays
from tests.support.functions import soft_file
from tests.support.lattices import SHAPE, svox2, svox2_file
from tests.support.scenes import assert_same_octree
from tests.support.splats import ball_of_splats

FAST = {
    "nerfbake.jobs.splat_voxels.RESOLUTION": 8,
    "nerfbake.jobs.splat_voxels._FRAMES": 2,
    "nerfbake.jobs.splat_voxels._EDGE": 16,
    "nerfbake.jobs.splat_voxels._JUDGES": 1,
    "nerfbake.jobs.readings._EDGE": 16,
    "nerfbake.jobs.function_voxels.RESOLUTION": 16,
    "nerfbake.jobs.function_voxels._EDGE": 4,
    "nerfbake.scene.function_field._COARSE_GRID": 16,
    "nerfbake.stages.function_to_part._RESOLUTION": 16,
    "nerfbake.stages.function_to_image.STEPS": 32,
}
SCENES = ("tree.npz", "octree.svo.npz", "own.vdb", "smoke.vdb", "grid.npz", "ball.ply", "soft.tar")
REFIT, STEP = jobs.RefitOptions(epochs=1, samples=1), jobs.CompressionGoal(step=0.5)
LIKE = jobs.RefitReference(like="tree.npz", frames=2, edge=16)
LOOK, TINY = jobs.MeshViews(frames=2, edge=16), jobs.MeshOptions(triangles=(100,), texture=64)
FEW, FIFTY = jobs.SplatsViews(frames=2, edge=16), jobs.SplatsOptions(splats=50, epochs=1)

# command: the job from a file and the name of the output, the output's ending, and its type
Job = Callable[[str, str, Listener], Any]
COMMANDS: dict[str, tuple[Job, str, type]] = {
    "svo": (lambda a, b, s: jobs.bake_octree(a, b, steps=s), ".svo.npz", SparseVoxelOctree),
    "convert": (lambda a, b, s: jobs.convert_file(a, b, steps=s), ".svo.pb", SparseVoxelOctree),
    "vdb": (lambda a, b, s: jobs.bake_volume(a, b, grids="density", steps=s), ".vdb", Volume),
    "lattice": (lambda a, b, s: jobs.bake_lattice(a, b, rounds=1, steps=s), "", LatticeField),
    "compress": (lambda a, b, s: jobs.compress_file(a, b, goal=STEP, steps=s), ".svoq", SparseVoxelOctree),
    "hull": (lambda a, b, s: jobs.bake_hull(a, b, level=2, steps=s), ".obj", Meshes),
    "mesh": (lambda a, b, s: jobs.bake_mesh(a, b, pictures=LOOK, options=TINY, steps=s), ".glb", Meshes),
    "splats": (lambda a, b, s: jobs.bake_splats(a, b, FEW, options=FIFTY, steps=s), ".ply", Splats),
    "refit": (lambda a, b, s: jobs.refit_file(a, b, LIKE, options=REFIT, steps=s), ".svo.npz", SparseVoxelOctree),
    "like": (
        lambda a, b, s: jobs.refit_file("octree.svo.npz", b, replace(LIKE, like=a), options=REFIT, steps=s),
        ".svo.npz",
        SparseVoxelOctree,
    ),
}  # fmt: skip
# These alone need more than a density.
COLOURS = {"compress", "refit"}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny file of each kind of scene."""
    folder = tmp_path_factory.mktemp("readings")
    tree = sample_n3tree(resolution=8, basis="SH1")
    octree = build_octree(tree)
    save(folder / "tree.npz", tree)
    save(folder / "octree.svo.npz", octree)
    save(folder / "own.vdb", build_vdb(octree, grids=("density", "sh")))
    save(folder / "smoke.vdb", replace(build_vdb(octree, grids=("density", "Cd")), frame=None))
    (folder / "grid.npz").write_bytes(svox2_file(svox2(size=4) | {"radius": np.array(SHAPE) / 10}))
    save(folder / "ball.ply", ball_of_splats(60))
    (folder / "soft.tar").write_bytes(soft_file())
    save(folder / "room.npz", build_n3tree(some_shelled_field(basis=1)))
    return folder


@pytest.fixture
def fast(scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(scenes)
    with_fewer_rays(monkeypatch)
    for name, value in FAST.items():
        monkeypatch.setattr(name, value)


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize(("scene", "command"), list(product(SCENES, COMMANDS)))
def test_every_command_takes_every_scene(scene: str, command: str, tmp_path: Path, listener: Listener) -> None:
    job, ending, made = COMMANDS[command]
    out = str(tmp_path / f"out{ending}")
    if scene == "smoke.vdb" and command in COLOURS:
        with pytest.raises(NerfbakeError, match=r"^smoke\.vdb: .*; allowed: "):
            job(scene, out, listener)
        return
    job(scene, out, listener)
    load(out, made)
    said = [line for line in listener.said if line.startswith(f"{scene}: ")]
    told = {"grid.npz": "dB against pictures of the lattice", "ball.ply": "pictures of the splats"}
    told["soft.tar"] = "pictures of the field itself"
    stay = (scene, command) == ("ball.ply", "splats")  # splats that become fewer do not become voxels
    if scene in told and not stay and (command != "like" or scene == "soft.tar"):
        assert sum(told[scene] in line for line in said) == 1
    if scene == "smoke.vdb":
        by_density = "the octree gets the density only, without Cd"
        assert any(by_density in line for line in said) == (command in ("svo", "convert", "vdb", "lattice"))


@pytest.mark.usefixtures("fast")
def test_splats_are_converted_to_the_octree_of_svo_with_their_axis(tmp_path: Path) -> None:
    made = jobs.convert_file("ball.ply", tmp_path / "a.svo.npz", choice=jobs.GridChoice(in_up="y"))
    same = jobs.bake_octree("ball.ply", tmp_path / "b.svo.npz", options=jobs.ReadingOptions(in_up="y"))
    assert isinstance(made, SparseVoxelOctree)
    assert_same_octree(made, same)
    kept = jobs.convert_file("ball.ply", tmp_path / "c.svo.npz")
    assert isinstance(kept, SparseVoxelOctree)
    assert (kept.node_data[-8:] != same.node_data[-8:]).any()
    with pytest.raises(UsageError, match="`in_up` is 'w'; allowed: x, -x, y, -y, z, -z"):
        jobs.convert_file("ball.ply", tmp_path / "d.svo.npz", choice=jobs.GridChoice(in_up="w"))


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("command", ["svo", "convert", "vdb", "lattice", "compress", "refit"])
def test_what_is_left_of_a_scenery_is_told_by_all_in_the_same_words(command: str) -> None:
    class Told(Exception):
        pass

    class First(Listener):
        def say(self, text: str) -> None:
            raise Told(text)

    with pytest.raises(Told, match=r"^room\.npz: uses the inner cube of 64\^3 and leaves out the scenery around it$"):
        COMMANDS[command][0]("room.npz", f"none{COMMANDS[command][1]}", First())


@pytest.mark.usefixtures("fast")
def test_a_hull_and_a_page_tell_what_becomes_of_the_scenery(tmp_path: Path, listener: Listener) -> None:
    jobs.bake_hull("room.npz", tmp_path / "a.obj", level=1, steps=listener)
    assert listener.said[0] == "room.npz: uses all of the scene, also the scenery around the inner cube"
    listener.said.clear()
    jobs.view_file("room.npz", tmp_path / "a.html", data="exact", steps=listener)
    assert listener.said[0] == "room.npz: uses the inner cube of 64^3 and shows the scenery around it as walls"


OTHER: dict[str, Any] = {
    "resolution": 8, "sigma_min": 1.0, "dtype": "float16", "resample": "nearest",
}  # fmt: skip
READ: dict[str, Any] = {
    "basis": "SH4", "scale": 2.0, "in_up": "y", "epochs": 0, "opacity_min": 0.5, "box": "all",
}  # fmt: skip

FUNCTIONS: dict[str, Any] = {
    "resolution": 16, "box": (0.0, 0.0, 0.0, 1.0, 1.0, 1.0), "basis": "SH4", "scenery": False, "world": "trained",
    "seen_from": "transforms.json",
}  # fmt: skip


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("scene", SCENES)
def test_options_are_refused_where_they_have_no_effect(scene: str) -> None:
    reading = Reading(SILENT, jobs.Source(scene))
    nothing: dict[str, Any] = dict.fromkeys(OTHER)
    reading.require(**nothing)
    reading.require(resample="mean", dtype="float32")
    assert isinstance(reading.scene, FIELDS)
    for name, value in OTHER.items():
        if isinstance(reading.scene, TAKEN[name]):
            reading.require(**{name: value})
        else:
            with pytest.raises(UsageError, match=f"^`{name}` has no effect on (a|an|splats).*; allowed: with "):
                reading.require(**{name: value})
    for name, value in FUNCTIONS.items():
        reading = Reading(SILENT, jobs.Source(scene), functions=jobs.FunctionVoxels(**{name: value}))
        if scene == "soft.tar":
            reading.require()
        else:
            with pytest.raises(UsageError, match=f"^`{name}` has no effect on .*; allowed: with a trained field$"):
                reading.require()
    for name, value in READ.items():
        reading = Reading(SILENT, jobs.Source(scene), options=jobs.ReadingOptions(**{name: value}))
        if isinstance(reading.scene, TAKEN[name]):
            reading.require()
        else:
            with pytest.raises(UsageError, match=f"^`{name}` has no effect on (a|an|splats).*; allowed: with "):
                reading.require()
