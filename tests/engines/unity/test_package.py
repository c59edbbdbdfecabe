"""The package for Unity: its scripts compiled and run on stubs of Unity's types, its folder as Unity wants it."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from nerfbake import load
from nerfbake.scene.octree import SparseVoxelOctree
from tests.conformance.case import HOME
from tests.support.csharp import PACKAGE, READER, compile_csharp, require_mono
from tests.support.pages import broken_links
from tests.support.unity_meta import imported, meta_of, meta_text

pytestmark = pytest.mark.tools
HERE = Path(__file__).parent
OCTREE = HOME / "octree" / "sh9_float16.svo.pb"


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What the whole package, compiled with its tests and its sample, prints of two files."""
    require_mono()
    folder = tmp_path_factory.mktemp("package")
    scripts = sorted(path for path in PACKAGE.rglob("*.cs") if path not in READER)
    program, other = folder / "check.exe", folder / "notes.pb"
    said = compile_csharp(program, *READER, *scripts, HERE / "UnityStubs.cs", HERE / "CheckPackage.cs")
    # Fields that Unity fills in by itself look as if nobody did.
    warnings = [line for line in said.splitlines() if "warning CS" in line]
    assert [line for line in warnings if "CS0649" not in line] == []
    other.write_bytes(OCTREE.read_bytes())
    done = subprocess.run(["mono", program, OCTREE, other], capture_output=True, text=True, check=False, timeout=60)
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_its_own_tests_pass(lines: list[str]) -> None:
    passed = {line.removeprefix("passed ") for line in lines if line.startswith("passed ")}
    assert passed == {"AVoxelHasItsValues", "AFileThatIsCutOffIsRefused", "AnAssetIsDrawnInItsBox"}


def test_an_octree_is_imported_and_another_pb_is_not(lines: list[str]) -> None:
    assert f"imported SH9 octree of 4x3x4, {load(OCTREE, SparseVoxelOctree).n} nodes" in lines
    (refused,) = [line for line in lines if line.startswith("refused ")]
    assert refused.endswith("notes.pb: the name ends with .pb; allowed: .svo.pb")


def test_the_box_stands_where_the_octree_does_and_is_seen_from_outside(lines: list[str]) -> None:
    octree = load(OCTREE, SparseVoxelOctree)
    text = next(line for line in lines if line.startswith("box ")).removeprefix("box ")
    vertices = np.array(text.split("|")[0].split(), float).reshape(8, 3)
    triangles = np.array(text.split("|")[1].split(), int).reshape(12, 3)
    rows = np.array(next(line for line in lines if line.startswith("rows ")).split()[1:], float).reshape(3, 4)
    # Left-handed with y up to the octree's own axes, then to voxels: opposite corners are 0 and the size.
    voxels = vertices[:, [0, 2, 1]] @ rows[:, :3].T + rows[:, 3]
    np.testing.assert_allclose(voxels.min(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(voxels.max(axis=0), octree.size, atol=1e-5)
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    outward = ((a + b + c) / 3 - vertices.mean(axis=0)) * np.cross(b - a, c - a)
    assert (outward.sum(axis=1) > 0).all()  # a cross product is Unity's normal, by its left hand
    sides = np.abs(np.cross(b - a, c - a)).sum(axis=0) / 2
    edges = np.ptp(vertices, axis=0)
    np.testing.assert_allclose(sides, 2 * edges[[1, 2, 0]] * edges[[2, 0, 1]], rtol=1e-5)


def test_a_hull_that_unity_mirrored_is_turned_back(lines: list[str]) -> None:
    # In the file it is (1, 2, 3), z up: Unity's left hand wants (1, 3, 2).
    assert "turned 1 3 2|" in lines


def test_the_folder_is_a_package() -> None:
    told = json.loads((PACKAGE / "package.json").read_text())
    assert told["name"].count(".") == 2
    for sample in told["samples"]:
        assert (PACKAGE / sample["path"]).is_dir()
    homes = {path.parent for path in PACKAGE.rglob("*.asmdef")}
    assert len(homes) == 3
    for script in PACKAGE.rglob("*.cs"):
        assert "Samples~" in script.parts or homes & set(script.parents), script
    for definition in PACKAGE.rglob("*.asmdef"):
        assert json.loads(definition.read_text())["name"].startswith("Nerfbake")


def test_links_of_its_page_lead_somewhere() -> None:
    assert broken_links(PACKAGE / "README.md") == []


def test_every_asset_keeps_its_guid() -> None:
    """Scenes refer to scripts and shaders by GUID: one that changes breaks every scene that is shared."""
    metas = {path: meta_of(path).read_text() for path in imported()}
    assert {path: text for path, text in metas.items() if text != meta_text(path)} == {}
    assert len({text.split()[3] for text in metas.values()}) == len(metas)
    assert set(PACKAGE.rglob("*.meta")) == {meta_of(path) for path in metas}
    # One GUID by hand: md5 of com.nerfbake.unity/Shaders/Octree.shader.
    assert "guid: 99f8253b018b87a7065e09a404575629\n" in metas[PACKAGE / "Shaders" / "Octree.shader"]
