"""The shaders of the package for Unity: a compiler reads every pass, and fragments are what `nerfbake render` draws."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Camera, Image, build_field, build_octree, orbit_cameras, render_field, sample_n3tree
from nerfbake.jobs.shaders import shader_text
from tests.support.csharp import PACKAGE
from tests.support.shaders import Runner, runner_of
from tests.support.unity_shaders import SHADERS, STUBS, Matrix, View, drawn, passes

pytestmark = pytest.mark.tools
INCLUDED = sorted((SHADERS / "Include").glob("*.hlsl"))
STAGES = [
    (f"{each.name}-{keyword}-{stage}", f"#define {keyword} 1\n{each.code}", stage[:4], entry)
    for each in passes()
    for stage, entry in each.entries.items()
    for keyword in each.keywords or ["ANY"]
]
EDGE = 64


# -- what the folder holds -------------------------------------------------------------------------------------
@pytest.mark.parametrize("path", INCLUDED, ids=lambda path: path.name)
def test_an_include_is_the_twin_to_the_byte(path: Path) -> None:
    assert path.read_text() == shader_text(f"hlsl/{path.name}"), "the README of engines/unity says how to copy it anew"


@pytest.mark.parametrize(("name", "code", "stage", "entry"), STAGES, ids=[name for name, *_ in STAGES])
def test_a_compiler_reads_every_pass(name: str, code: str, stage: str, entry: str, tmp_path: Path) -> None:
    program = shutil.which("glslangValidator")
    if program is None:
        pytest.skip("no glslangValidator: `make tools` installs glslang-tools")
    (tmp_path / f"{name}.hlsl").write_text(code)
    options = ["-D", "-V", "--amb", "-e", entry, "-S", stage, "-o", "code.spv", f"-I{SHADERS}", f"-I{STUBS}"]
    done = subprocess.run(
        [program, *options, f"{name}.hlsl"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def test_scripts_and_shaders_call_things_by_the_same_names() -> None:
    scripts = "".join(path.read_text() for path in PACKAGE.rglob("*.cs"))
    code = "".join(path.read_text() for path in SHADERS.rglob("*.hlsl"))
    for shader in SHADERS.glob("*.shader"):
        text = shader.read_text()
        assert text.count("{") == text.count("}")
        (name,) = re.findall(r'(?m)^Shader "(.*)"', text)
        assert f'"{name}"' in scripts or name in scripts
        code += text.partition("SubShader")[2]
        for name in re.findall(r'(?m)^\s+(?:\[\w+\] )?(\w+) \(".*", .*\) =', text):
            assert re.search(rf"\b{name}\b", code), name
    for name in re.findall(r'(?:PropertyToID|SetVector|SetFloat|SetTexture)\("(\w+)"', scripts):
        assert re.search(rf"\b{name}\b", code), name


# -- what it draws ---------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def hlsl(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    return runner_of("hlsl", tmp_path_factory.mktemp("hlsl"))


@pytest.fixture(scope="module")
def view() -> View:
    """SH9 in a box that is no cube, compact, with leaves of several sizes."""
    octree = build_octree(sample_n3tree(resolution=32), resolution=(30, 32, 17)).with_layout("compact")
    camera = orbit_cameras(build_field(octree), frames=3, width=EDGE, height=EDGE).cameras[1]
    return View(octree, camera, np.eye(4))


@pytest.fixture(scope="module")
def image(view: View) -> Image:
    return render_field(build_field(view.octree), view.camera)


def elsewhere() -> Matrix:
    """Turned about two axes, 2.5 times as large, moved."""
    place, c, s = np.eye(4), np.cos(0.7), np.sin(0.7)
    place[:3, :3] = 2.5 * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    place[:3, 3] = [3, -1, 0.5]
    return place


BLEND, DEPTH = "return blended(hull);", "return marched(rayTo(hull.world), 1e30).depth;"


@pytest.mark.slow
@pytest.mark.parametrize("place", [np.eye(4), elsewhere()], ids=["as it is", "moved, turned and scaled"])
def test_a_picture_is_the_one_of_render(hlsl: Runner, view: View, image: Image, place: Matrix) -> None:
    own = view._replace(place=place)
    found = drawn(hlsl, own, "Octree-0", BLEND)
    assert (np.abs(found[:, :3] + 1 - found[:, 3:] - image.colour.reshape(-1, 3)) > 1 / 255).mean() <= 1e-3
    solid = image.alpha.ravel() > 0.99
    assert 0.05 < solid.mean() < 0.9
    ends = drawn(hlsl, own, "Octree-0", DEPTH)[:, 0]
    np.testing.assert_allclose(ends[solid], own.scale * image.depth.ravel()[solid], rtol=2e-3)


def test_rays_end_at_the_depth_that_the_camera_drew(hlsl: Runner, view: View, image: Image) -> None:
    solid, forward = image.alpha.ravel() > 0.99, -view.camera.pose[:3, 2]
    wall = float(np.median(image.depth.ravel()[solid]))
    found = drawn(hlsl, view._replace(wall=wall), "Octree-0", BLEND)[:, 3]
    # A flat wall is farther away along rays to the side.
    along = wall / (view.camera.rays()[1] @ forward)
    stops = drawn(hlsl, view._replace(wall=wall), "Octree-0", "return meshAlong(rayTo(hull.world), hull.screen);")[:, 0]
    np.testing.assert_allclose(stops, along, rtol=1e-4)
    assert along.max() > 1.02 * wall
    hidden, free = (solid & (image.depth.ravel() > 1.05 * along), solid & (image.depth.ravel() < 0.95 * along))
    assert min(hidden.sum(), free.sum()) > 20
    assert found[hidden].mean() < 0.2
    assert found[free].mean() > 0.9


def test_a_cutout_is_opaque_where_the_field_nearly_is(hlsl: Runner, view: View, image: Image) -> None:
    code = "float depth; float4 colour = opaque(hull, depth); return float4(colour.rgb, clipped < 0.0 ? -1.0 : depth);"
    found = drawn(hlsl, view, "OctreeCutout-0", code)
    kept, clear = found[:, 3] >= 0, np.abs(image.alpha.ravel() - 0.5) > 0.01
    assert ((kept != (image.alpha.ravel() > 0.5)) & clear).sum() == 0
    solid = image.alpha.ravel() > 0.99
    np.testing.assert_allclose(found[solid, :3], image.colour.reshape(-1, 3)[solid], atol=0.02)
    cosine = view.camera.rays()[1] @ -view.camera.pose[:3, 2]
    np.testing.assert_allclose(found[solid, 3], (image.depth.ravel() * cosine)[solid], rtol=2e-3)


def test_the_share_of_a_shadow_is_the_opacity(hlsl: Runner, view: View, image: Image) -> None:
    code = "caster(hull); return float4(clipped, marched(rayTo(hull.world), 1e30).transmittance, 0, 0);"
    found = drawn(hlsl, view, "Octree-1", code)
    np.testing.assert_allclose(1 - found[:, 1], image.alpha.ravel(), atol=5e-3)
    shadow, alpha = found[:, 0] >= 0, image.alpha.ravel()
    assert shadow[alpha > 0.999].all()
    assert not shadow[alpha < 1e-3].any()
    assert shadow.mean() == pytest.approx(alpha.mean(), abs=0.02)


def test_a_light_whose_rays_are_parallel_sees_what_a_far_camera_sees(hlsl: Runner, view: View) -> None:
    """And does so from wherever Unity puts its eye: a ray starts at the pixel."""
    near = view.camera
    pose, here = near.pose.copy(), float(np.linalg.norm(near.pose[:3, 3]))
    away = here + 500
    pose[:3, 3] += 500 * pose[:3, 2]
    camera = Camera(EDGE, EDGE, near.fx * away / here, pose)
    alpha = render_field(build_field(view.octree), camera).alpha.ravel()
    parallel = view._replace(camera=camera, orthographic=True, reach=away)
    found = drawn(hlsl, parallel, "Octree-0", "return 1.0 - marched(rayTo(hull.world), 1e30).transmittance;")[:, 0]
    assert 0.05 < alpha.mean() < 0.9
    assert (np.abs(found - alpha) > 0.05).mean() < 0.02
