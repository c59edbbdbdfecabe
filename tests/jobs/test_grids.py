"""Which grids of a volume a job works on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from nerfbake import N3Tree, VdbTree, Volume, build_field, build_octree, build_vdb, load, save
from nerfbake.catalog import formats_of
from nerfbake.errors import NerfbakeError, UsageError
from nerfbake.jobs import (
    ComparedViews,
    GridChoice,
    PictureOutputs,
    Source,
    ViewSelection,
    bake_hull,
    compare_files,
    render_views,
    view_file,
)
from nerfbake.jobs.grids import require_grids, tell_unused
from nerfbake.jobs.steps import SILENT
from tests.jobs.listener import Listener
from tests.support.scenes import n3tree


@pytest.mark.usefixtures("folder")
def test_grids_by_name_and_an_axis() -> None:
    octree = build_octree(load(Path("a.npz"), N3Tree))
    volume, source = build_vdb(octree, grids=("density", "Cd")), Source("a.vdb")
    assert GridChoice().of(SILENT, source, volume) is volume
    chosen = GridChoice(grids=("Cd",)).of(SILENT, source, volume)
    assert isinstance(chosen, Volume)
    assert [grid.name for grid in chosen.grids] == ["Cd"]
    assert (GridChoice(in_up="y").of(SILENT, source, volume).transform != volume.transform).any()
    with pytest.raises(NerfbakeError, match=r"^a.vdb: "):
        GridChoice(grids=("nothing",)).of(SILENT, source, volume)
    with pytest.raises(UsageError, match=r"a\.vdb is not a volume; allowed: no `grid` and no `in_up`"):
        GridChoice(grids=("Cd",)).of(SILENT, source, octree)


def named(*names: str) -> Volume:
    """Grids of the same voxels: a colour where the name is one's, else a density."""
    made = build_vdb(build_octree(n3tree()), grids=("density", "Cd"))
    density, colour = made.grids
    assert isinstance(density, VdbTree)
    assert isinstance(colour, VdbTree)
    grids = [replace(colour if name in ("Cd", "color", "velocity") else density, name=name) for name in names]
    return replace(made, grids=tuple(grids), frame=None)


@pytest.mark.parametrize(
    ("names", "left_out"),
    [
        (("density", "Cd"), ""),
        (("density", "density"), "1 grid: density[1]"),
        (("heat", "density", "Cd", "Cd", "color"), "3 grids: heat, Cd[1], color"),
        (("density", "velocity", "flame"), "2 grids: velocity, flame"),
        (("density", *(f"p{i}" for i in range(12))), "12 grids: p0, p1, p2, p3, p4, p5, p6, p7, p8, p9 and 2 more"),
    ],
)
def test_grids_that_a_field_leaves_out_are_told(names: tuple[str, ...], left_out: str, listener: Listener) -> None:
    volume = named(*names)
    tell_unused(listener, Source("a.vdb"), volume)
    assert listener.said == ([f"a.vdb: leaves out {left_out}"] if left_out else [])
    build_field(volume)
    tell_unused(listener, Source("a.npz"), build_octree(n3tree()))


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("ending", ["vdb", "nvdb"])
def test_every_command_tells_the_second_density(ending: str, listener: Listener) -> None:
    save("two.vdb", named("density", "density"))
    if ending == "nvdb":
        for name in ("one.nvdb", "other.nvdb"):
            save(name, named("density"))
        Path("two.nvdb").write_bytes(Path("one.nvdb").read_bytes() + Path("other.nvdb").read_bytes())
    name = f"two.{ending}"
    commands: list[Callable[[], Any]] = [
        lambda: bake_hull(name, "a.obj", steps=listener),
        lambda: render_views(name, PictureOutputs(out="a.png"), ViewSelection(size=(8, 8)), steps=listener),
        lambda: view_file(name, "a.html", steps=listener),
        lambda: compare_files(name, name, seen=ComparedViews(size=(8, 8)), steps=listener),
    ]
    for number, command in enumerate(commands):
        command()
        told = f"{name}: leaves out 1 grid: density[1]"
        assert listener.said.count(told) == (1 if number < 3 else 2), number
        listener.said.clear()


def test_an_empty_list_of_grids_is_not_the_default() -> None:
    for form in formats_of("Volume"):
        assert require_grids(form, None, half=False) == form.load_volume_module().DEFAULT_GRIDS
        with pytest.raises(UsageError, match="`grids` are ''; allowed: some of density, Cd, sh, or index alone"):
            require_grids(form, "", half=False)
