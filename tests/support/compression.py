"""Compression and judging of small scenes in less time: few rays find the same as many if there are few leaves."""

from __future__ import annotations

import os

import pytest

from nerfbake.jobs import bake_mesh, bake_splats, refit_file

LOADED = bake_mesh, bake_splats, refit_file  # before EDGE changes, the default of their options
SWITCH = "NERFBAKE_TEST_FEWER_RAYS"
EDGES = {
    "nerfbake.jobs.budgets.EDGE": 64,
    "nerfbake.stages.loss._EDGE": 40,
    "nerfbake.stages.octree_to_lattice._EDGE": 64,
    "nerfbake.stages.octree_to_compression._EDGE": 60,
}


def with_fewer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the pictures smaller that measure and judge results, here and in the commands of `shell`."""
    for name, edge in EDGES.items():
        monkeypatch.setattr(name, edge)
    monkeypatch.setenv(SWITCH, "1")


def obey_switch() -> None:
    """The same in the process of a command, if its environment says so."""
    if SWITCH in os.environ:
        with_fewer_rays(pytest.MonkeyPatch())
