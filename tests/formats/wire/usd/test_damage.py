"""Damaged stages are read or refused in one line, whatever OpenUSD makes of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from nerfbake.errors import NerfbakeError
from nerfbake.formats.camera import usda as camera_usda
from nerfbake.formats.mesh import usdc as mesh_usdc
from nerfbake.formats.mesh import usdz as mesh_usdz
from nerfbake.formats.splat import usdc as splat_usdc
from nerfbake.formats.wire.usd import reading
from nerfbake.scene.mesh import Meshes
from tests.support.hostile import damaged
from tests.support.meshes import cube, painted
from tests.support.splats import splats
from tests.support.usd import in_forks as in_forks
from tests.support.views import sample_views

pytestmark = pytest.mark.usefixtures("in_forks")
FILES: dict[str, tuple[Any, Callable[[], Any]]] = {
    "splats.usdc": (splat_usdc, lambda: splats(5, degree=1)),
    "mesh.usdc": (mesh_usdc, lambda: Meshes((cube(),))),
    "mesh.usdz": (mesh_usdz, painted),
    "cameras.usda": (camera_usda, lambda: sample_views(frames=2, width=8, height=8).cameras),
}


@pytest.mark.long
@pytest.mark.parametrize("name", FILES)
def test_a_damaged_stage_is_read_or_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of what is damaged; a whole one for each kind of file takes ten CPU seconds."""
    monkeypatch.setattr(reading, "_SECONDS", 1)
    module, make = FILES[name]
    lines = []
    for _, broken in [*damaged(b"".join(module.encode(make())), flips=150)][::3]:
        try:
            module.decode(memoryview(broken or b"\0"))
        except NerfbakeError as error:
            lines.append(error.line)
    assert len(lines) > 20
    assert [line for line in lines if "\n" in line or len(line) > 300] == []
