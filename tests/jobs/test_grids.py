"""Which grids of a volume a job works on."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import N3Tree, Volume, build_octree, build_vdb, load
from nerfbake.catalog import formats_of
from nerfbake.errors import NerfbakeError, UsageError
from nerfbake.jobs import GridChoice, Source
from nerfbake.jobs.grids import require_grids
from nerfbake.jobs.steps import SILENT


@pytest.mark.usefixtures("folder")
def test_grids_by_name_and_an_axis() -> None:
    octree = build_octree(load(Path("a.npz"), N3Tree))
    volume, source = build_vdb(octree, grids=("density", "Cd")), Source("a.vdb")
    assert GridChoice().of(SILENT, source, volume) is volume
    chosen = GridChoice(("Cd",)).of(SILENT, source, volume)
    assert isinstance(chosen, Volume)
    assert [grid.name for grid in chosen.grids] == ["Cd"]
    assert (GridChoice(up="y").of(SILENT, source, volume).transform != volume.transform).any()
    with pytest.raises(NerfbakeError, match=r"^a.vdb: "):
        GridChoice(("nothing",)).of(SILENT, source, volume)
    with pytest.raises(UsageError, match=r"a\.vdb is not a volume; allowed: no `grid` and no `up`"):
        GridChoice(("Cd",)).of(SILENT, source, octree)


def test_an_empty_list_of_grids_is_not_the_default() -> None:
    for form in formats_of("Volume"):
        assert require_grids(form, None, half=False) == form.load_volume_module().DEFAULT_GRIDS
        with pytest.raises(UsageError, match="`grids` are ''; allowed: some of density, Cd, sh, or index alone"):
            require_grids(form, "", half=False)
