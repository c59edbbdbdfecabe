"""Splats as octrees, volumes and pages: what is left out, what is fitted, and what is told about the loss."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import SparseVoxelOctree, Splats, Volume, load, orbit_cameras, save
from nerfbake.errors import BudgetMissed, InvalidFile, InvalidScene, MemoryLimit, NerfbakeError, UsageError
from nerfbake.jobs import (
    RefitReference,
    bake_mesh,
    bake_octree,
    bake_volume,
    compare_files,
    compress_file,
    convert_file,
    describe_file,
    mesh_options,
    refit_file,
    splat_voxels,
    view_file,
)
from nerfbake.jobs.budgets import Budget
from nerfbake.jobs.comparisons import ComparedViews
from nerfbake.jobs.compressions import CompressionGoal
from nerfbake.jobs.reading_options import ReadingOptions
from nerfbake.memory import memory_limit
from nerfbake.scene.radiance_field import RadianceField
from tests.jobs.listener import Listener
from tests.support.scenes import n3tree
from tests.support.splats import ball_of_splats

SMALL = ComparedViews(size=(64, 64))
DIRECT = ReadingOptions(epochs=0)


@pytest.fixture
def ball(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fewer_rays: None) -> Splats:
    """ball.ply, with few and small pictures to fit to."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(splat_voxels, "_FRAMES", 24)
    monkeypatch.setattr(splat_voxels, "_JUDGES", 3)
    monkeypatch.setattr(splat_voxels, "_EDGE", 64)
    save("ball.ply", ball_of_splats())
    return load("ball.ply", Splats)


def fog(n: int, *, scale: float) -> Splats:
    """Splats of one size that fill a cube of edge 2."""
    made, random = ball_of_splats(n), np.random.default_rng(0)
    made.means[:] = random.uniform(-1, 1, (n, 3))
    made.scales[:] = scale
    return made


def decibels(path: str) -> float:
    return float(compare_files("ball.ply", path, seen=SMALL).found.means["a_b"]["psnr"])


@pytest.mark.usefixtures("ball")
def test_voxels_are_fitted_to_pictures_of_the_splats(listener: Listener) -> None:
    bake_octree("ball.ply", "direct.svo.npz", resolution=32, options=DIRECT)
    octree = bake_octree("ball.ply", "fitted.svo.npz", resolution=32, steps=listener)
    assert octree.size == (32, 32, 32)
    direct, fitted = decibels("direct.svo.npz"), decibels("fitted.svo.npz")
    assert fitted > direct + 1.5
    assert fitted > 30
    [told, _] = listener.said
    assert told.startswith("ball.ply: in 32x32x32 voxels, ")
    assert told.endswith(" dB against 3 pictures of the splats")
    assert abs(float(told.split()[4]) - fitted) < 2
    assert [phase for phase in listener.phases if "splats" in phase or "voxels" in phase] == [
        "cutting the splats",
        "rendering pictures of the splats",
        "filling voxels",
        "fitting the voxels to them",
    ]


@pytest.mark.usefixtures("ball")
def test_the_same_bytes_every_time() -> None:
    bake_octree("ball.ply", "one.svo.npz", resolution=16)
    bake_octree("ball.ply", "two.svo.npz", resolution=(16, 16, 16))
    assert Path("one.svo.npz").read_bytes() == Path("two.svo.npz").read_bytes()


@pytest.mark.usefixtures("ball")
def test_large_splats_have_fewer_voxels(listener: Listener) -> None:
    save("fog.ply", fog(100, scale=0.25))
    octree = bake_octree("fog.ply", "fog.svo.npz", options=DIRECT, steps=listener)
    assert max(octree.size) == 28  # half as wide as a splat, in a box of 3.5
    assert listener.said[-2].startswith("fog.ply: in 28x28x28 voxels, ")
    assert bake_octree("fog.ply", "finer.svo.npz", resolution=40, options=DIRECT).size == (40, 40, 40)


@pytest.mark.usefixtures("ball")
@pytest.mark.parametrize("options", [DIRECT, ReadingOptions()], ids=["direct", "fitted"])
def test_voxels_that_do_not_fit_into_memory_are_larger(options: ReadingOptions, listener: Listener) -> None:
    """A set of 563 splats filled 6,999,813 voxels of 256^3 and was refused: fitting them needed 1.7 GiB."""
    save("fog.ply", fog(2000, scale=0.06))
    with memory_limit(8 << 20):
        octree = bake_octree("fog.ply", "fog.svo.npz", options=options, steps=listener)
        assert 16 <= max(octree.size) <= 56  # 78 are half as wide as a splat
        [told] = [line for line in listener.said if " dB against 3 pictures" in line]
        assert re.match(r"fog.ply: in (\d+)x\1x\1 voxels \(the finest that fit into memory\), \d+", told)
        with pytest.raises(MemoryLimit, match=r"fog\.ply"):
            bake_octree("fog.ply", "other.svo.npz", resolution=78, options=options)
    with memory_limit(1 << 18), pytest.raises(MemoryLimit):
        bake_octree("fog.ply", "other.svo.npz", options=options)


class Shown(Exception):
    """What a mesh would be fitted to."""


@pytest.mark.usefixtures("ball")
def test_a_mesh_is_fitted_to_pictures_of_the_splats_not_of_their_voxels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(splat_voxels, "RESOLUTION", 16)

    def show(scene: Any, *, framed: Any, **options: Any) -> None:
        raise Shown(scene, framed)

    monkeypatch.setattr(mesh_options, "render_split", show)
    with pytest.raises(Shown) as caught:
        bake_mesh("ball.ply", "ball.glb")
    scene, framed = caught.value.args
    assert isinstance(scene, Splats)
    assert isinstance(framed, RadianceField)
    # -y of the splats is up in both: green is y, so the highest splat has none.
    assert scene.sh[np.argmax(scene.means[:, 2]), 0, 1] < -1.5
    assert_allclose(framed.world(framed.box.mean(axis=0)), 0, atol=0.2)


@pytest.mark.usefixtures("ball")
def test_cameras_that_nobody_gave_are_not_blamed() -> None:
    far = fog(50, scale=0.1)
    save("far.ply", replace(far, means=far.means * np.float32(2e14), scales=far.scales * np.float32(1e14)))
    bakers: list[tuple[Callable[..., Any], str]]
    bakers = [(bake_volume, "a.vdb"), (bake_octree, "a.svo.npz"), (view_file, "a.html")]
    for bake, name in bakers:
        with pytest.raises(InvalidScene, match=r"^far.ply: the scene is \S+ world units wide, around .*; allowed: one"):
            bake("far.ply", name)


def test_what_is_left_out_is_told(ball: Splats, listener: Listener) -> None:
    ball.means[:3] += 100
    ball.opacity[10:14] = 0.001
    save("far.ply", ball)
    bake_octree("far.ply", "a.svo.npz", resolution=16, options=DIRECT, steps=listener)
    assert listener.said[0].startswith("far.ply: leaves out 3 splats of 400 outside the box -1.")
    assert listener.said[1] == "far.ply: leaves out 4 splats of an opacity below 0.0039"
    whole = bake_octree("far.ply", "b.svo.npz", resolution=16, options=replace(DIRECT, box="all"))
    assert whole.voxel_size[0] > 6
    half = bake_octree("far.ply", "c.svo.npz", resolution=16, options=replace(DIRECT, box=(0, -2, -2, 2, 2, 2)))
    assert_allclose(half.origin, [0, -2, -2])
    assert half.size == (8, 16, 16)
    with pytest.raises(InvalidScene, match=r"far.ply: the box is 5, 5, 5, 6, 6, 6, without a splat"):
        bake_octree("far.ply", "d.svo.npz", options=ReadingOptions(box=(5, 5, 5, 6, 6, 6)))
    with pytest.raises(InvalidScene, match=r"far.ply: the splats have opacities up to 0.95"):
        bake_octree("far.ply", "d.svo.npz", options=ReadingOptions(opacity_min=0.99))


def colour_at(octree: SparseVoxelOctree, point: list[float]) -> np.ndarray:
    found = octree.sample([point])[0]
    assert found[-1] > 0
    return np.asarray(1 / (1 + np.exp(-0.28209479 * found[:3])))


@pytest.mark.usefixtures("ball")
def test_up_turns_the_world() -> None:
    own = bake_octree("ball.ply", "own.svo.npz", resolution=32, options=DIRECT)
    turned = bake_octree("ball.ply", "turned.svo.npz", resolution=32, options=replace(DIRECT, in_up="-y"))
    # Red, green and blue are x, y and z of the splats.
    assert_allclose(colour_at(own, [0, 0, 1]), [0.5, 0.5, 1], atol=0.1)
    assert_allclose(colour_at(turned, [0, 0, 1]), [0.5, 0, 0.5], atol=0.1)
    assert_allclose(colour_at(turned, [0, 1, 0]), [0.5, 0.5, 1], atol=0.1)
    assert_allclose(colour_at(turned, [1, 0, 0]), [1, 0.5, 0.5], atol=0.1)


@pytest.mark.usefixtures("ball")
@pytest.mark.parametrize(("up", "top"), [("z", [0, 0, 1]), ("y", [0, 1, 0])])
def test_a_volume_stands_upright(up: Literal["y", "z"], top: list[int]) -> None:
    bake_volume("ball.ply", "ball.vdb", resolution=32, up=up, options=replace(DIRECT, in_up="-y"))
    volume = load("ball.vdb", Volume)
    density, colour = volume.grid("density"), volume.grid("Cd")
    coords = density.topology.coords
    places = coords @ volume.transform[:, :3].T + volume.transform[:, 3]
    assert_allclose(colour.topology.coords, coords)
    # Green is y of the splats, which points down. The transform leads to the centres of voxels.
    towards = (places * top).sum(axis=1)
    dense = density.values[:, 0] > 1
    assert_allclose(colour.values[dense & (towards > 0.9), 1], 0, atol=0.1)
    assert_allclose(colour.values[dense & (towards < -0.9), 1], 1, atol=0.1)
    radius = np.sqrt((places**2).sum(axis=1))
    assert_allclose((density.values[:, 0] * radius).sum() / density.values.sum(), 1, atol=0.02)


def stated(name: str, axis: str, ball: Splats) -> None:
    save(name, ball)
    content = Path(name).read_bytes()
    line = f"comment Vertical axis: {axis}\n".encode()
    Path(name).write_bytes(content.replace(b"element vertex", line + b"element vertex", 1))


def test_the_axis_that_a_file_states_is_up_unless_another_is_given(ball: Splats, listener: Listener) -> None:
    stated("z.ply", "0 0 1", ball)
    stated("old.ply", "y", ball)
    usual = ReadingOptions(epochs=0, in_up="stated")
    for name, splats, top in (
        ("z.ply", usual, [0.5, 0.5, 1]),  # z is blue
        ("old.ply", usual, [0.5, 0, 0.5]),
        ("z.ply", replace(usual, in_up="-y"), [0.5, 0, 0.5]),
    ):
        octree = bake_octree(name, "a.svo.npz", resolution=16, options=splats, steps=listener)
        assert_allclose(colour_at(octree, [0, 0, 1]), top, atol=0.15)
        Path("a.svo.npz").unlink()
    assert [line for line in listener.said if "points up" in line] == ["z.ply: z points up, as the file says"]
    # Splats that are not turned fit the cameras of their capture.
    with pytest.raises(UsageError, match="until -y is z"):
        bake_octree("old.ply", "b.svo.npz", options=usual, budget=Budget(min_psnr=20, cameras="cameras.json"))
    with pytest.raises(InvalidFile, match=r"cameras\.json"):
        bake_octree(
            "z.ply", "b.svo.npz", resolution=8, options=usual, budget=Budget(min_psnr=20, cameras="cameras.json")
        )


def test_a_page_stands_as_the_file_states(ball: Splats, listener: Listener, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(splat_voxels, "RESOLUTION", 8)
    stated("z.ply", "0 0 1", ball)
    view_file("z.ply", "a.html", data="exact", steps=listener)
    assert "z.ply: z points up, as the file says" in listener.said
    assert orbit_cameras(load("z.ply", Splats)).cameras[0].pose[2, 3] > 0.5  # pictures are taken from above
    assert orbit_cameras(ball).cameras[0].pose[1, 3] < -0.5


UTM = np.array([453000.125, 5012345.625, 120.25])


def test_voxels_stand_at_the_origin_of_splats_on_a_map(ball: Splats, listener: Listener) -> None:
    save("far.ply", replace(ball, origin=UTM))
    origin = load("far.ply", Splats).origin
    near = bake_octree("ball.ply", "near.svo.npz", resolution=16, options=DIRECT)
    found = bake_octree("far.ply", "far.svo.npz", resolution=16, options=DIRECT, steps=listener)
    told = "positions are relative to the origin 453000 5012346 120, which voxels cannot keep"
    assert listener.said[0] == f"far.ply: {told}"
    assert_allclose(found.origin, near.origin + UTM - origin, atol=1e-5)
    # A box is in the world of the file; the -y of a volume's splats becomes z.
    box = (*(UTM - [0, 2, 2]).tolist(), *(UTM + 2).tolist())
    half = bake_octree("far.ply", "half.svo.npz", resolution=16, options=replace(DIRECT, box=box))
    assert_allclose(half.origin, np.array([0, -2, -2]) + UTM - origin, atol=1e-5)
    bake_volume("far.ply", "far.vdb", resolution=8, options=ReadingOptions(epochs=0, in_up="stated"), steps=listener)
    assert any("origin 453000 120 -5012346, which" in line for line in listener.said)


def test_values_that_are_not_finite_are_told_with_the_name_of_the_file(ball: Splats) -> None:
    save("a.glb", ball)
    content = Path("a.glb").read_bytes()
    node = b'"nodes":[{"name":"splats","mesh":0}]'
    worse = b'"nodes":[{"mesh":0,"scale":[1e308,1e308,1e308]}]'
    size = int.from_bytes(content[12:16], "little")
    text = content[20 : 20 + size].rstrip().replace(node, worse)
    text += b" " * (-len(text) % 4)
    Path("a.glb").write_bytes(
        content[:8] + (len(content) - size + len(text)).to_bytes(4, "little") + len(text).to_bytes(4, "little")
        + content[16:20] + text + content[20 + size :]
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for job in (
            lambda: bake_octree("a.glb", "b.svo.npz"),
            lambda: convert_file("a.glb", "b.ply"),
            lambda: compress_file("a.glb", "b.svoq"),
        ):
            with pytest.raises(NerfbakeError, match=r"^a\.glb: "):
                job()
        with pytest.raises(NerfbakeError, match=r"^a\.glb: "):
            describe_file("a.glb")
    assert not list(Path().glob("b.*"))


@pytest.mark.usefixtures("ball")
def test_a_missed_budget_is_measured_against_the_splats() -> None:
    with pytest.raises(BudgetMissed, match=r"^b.svo.npz: the picture has a mean PSNR of"):
        bake_octree("ball.ply", "b.svo.npz", resolution=8, options=DIRECT, budget=Budget(min_psnr=40))
    assert Path("b.svo.npz.rejected").exists()
    bake_octree("ball.ply", "c.svo.npz", resolution=32, budget=Budget(min_psnr=20))


@pytest.mark.usefixtures("ball")
def test_other_commands_read_splats(listener: Listener, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(splat_voxels, "RESOLUTION", 16)
    compress_file("ball.ply", "ball.svoq", goal=CompressionGoal(step=0.2))
    assert load("ball.svoq", SparseVoxelOctree).size == (16, 16, 16)
    view_file("ball.ply", "ball.html", min_psnr=20, steps=listener)
    assert any("dB against 3 pictures of the splats" in line for line in listener.said)
    assert any(line.endswith("dB against ball.ply") for line in listener.said)


@pytest.mark.usefixtures("ball")
def test_an_octree_is_refitted_to_splats() -> None:
    bake_octree("ball.ply", "direct.svo.npz", resolution=32, options=DIRECT)
    found = refit_file("direct.svo.npz", "fitted.svo.npz", RefitReference(like="ball.ply", frames=12, edge=64))
    before, after = found.psnr
    assert after > before + 1


@pytest.mark.usefixtures("ball")
def test_options_without_effect_are_refused() -> None:
    save("a.npz", n3tree())
    with pytest.raises(UsageError, match="`box` of six numbers has no effect on a PlenOctree; allowed: with splats"):
        bake_octree("a.npz", "b.svo.npz", options=ReadingOptions(box=(0, 0, 0, 1, 1, 1)))
    with pytest.raises(UsageError, match="`opacity_min` has no effect on a PlenOctree; allowed: with splats"):
        bake_octree("a.npz", "b.svo.npz", options=ReadingOptions(opacity_min=0.5))
    with pytest.raises(UsageError, match="`in_up` has no effect"):
        bake_octree("a.npz", "b.svo.npz", options=ReadingOptions(in_up="y"))
    with pytest.raises(UsageError, match="`epochs` has no effect"):
        bake_volume("a.npz", "b.vdb", options=DIRECT)
    with pytest.raises(UsageError, match="`box` has no effect"):
        bake_volume("a.npz", "b.vdb", options=ReadingOptions(box="all"))
    with pytest.raises(UsageError, match="`scale` has no effect on splats; allowed: with a lattice"):
        bake_octree("ball.ply", "b.svo.npz", options=ReadingOptions(scale=2.0))
    with pytest.raises(UsageError, match="the voxels of splats are cubes; allowed: one number as `resolution`"):
        bake_octree("ball.ply", "b.svo.npz", resolution=(16, 16, 8))
    with pytest.raises(UsageError, match="splats are turned until -y is z, and `cameras` are not"):
        bake_octree(
            "ball.ply",
            "b.svo.npz",
            options=ReadingOptions(in_up="-y"),
            budget=Budget(min_psnr=20, cameras="cameras.json"),
        )
    assert not Path("b.svo.npz").exists()
