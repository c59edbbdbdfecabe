"""`nerfbake splats`: what it writes, prints and refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Splats, build_octree, build_vdb, jobs, load, sample_n3tree, save
from nerfbake.cli.main import run
from nerfbake.scene.placement import Move, placement_matrix
from tests.cli.telling import told
from tests.support.outputs import read_output
from tests.support.splats import splats as some_splats

SMALL = "--count 300 --frames 4 --edge 32 --epochs 2"


@pytest.fixture(autouse=True)
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save("a.npz", sample_n3tree(resolution=16, basis="SH4"))


def test_everything_is_told_to_scripts(capsys: pytest.CaptureFixture[str]) -> None:
    facts = told(f"splats a.npz a.ply {SMALL}".split(), capsys)
    assert (facts["in"], facts["file"], facts["bytes"]) == ("a.npz", "a.ply", Path("a.ply").stat().st_size)
    assert facts["splats"] == load("a.ply", Splats).n <= 300
    assert len(facts["views"]) == 8
    assert facts["psnr"] == pytest.approx(sum(view["psnr"] for view in facts["views"]) / 8)
    assert facts["seconds"] > 0


def test_the_last_line_is_the_quality_of_the_file(capsys: pytest.CaptureFixture[str]) -> None:
    jobs.write_sample_capture("photographs", frames=10, edge=32)
    assert (
        run(["splats", "a.npz", "a.spz", "--count", "300", "--views", "photographs", "--epochs", "1", "--force"]) == 0
    )
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("a.spz: ")
    assert " dB, SSIM " in last
    assert load("a.spz", Splats).antialiased


@pytest.mark.parametrize("ending", ["spz", "ply", "glb", "sog"])
def test_a_field_stands_upright_in_every_format(ending: str, capsys: pytest.CaptureFixture[str]) -> None:
    few = "--count 100 --frames 2 --edge 16 --epochs 1"
    facts = told(f"splats a.npz up.{ending} {few}".split(), capsys)
    kept = told(f"splats a.npz kept.{ending} {few} --in-up=-y".split(), capsys)
    assert facts["psnr"] == pytest.approx(kept["psnr"], abs=0.05)  # formats round the turned numbers differently
    up, world = load(f"up.{ending}", Splats), load(f"kept.{ending}", Splats)
    box = np.stack([world.means.min(axis=0), world.means.max(axis=0)])
    # -y is up in every file that names no axis: x, y, z of the field are x, -z, y.
    assert np.allclose(up.means.min(axis=0), [box[0, 0], -box[1, 2], box[0, 1]], atol=0.01)
    assert np.allclose(up.means.max(axis=0), [box[1, 0], -box[0, 2], box[1, 1]], atol=0.01)


def test_splats_of_splats_are_turned_only_if_that_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    scene = replace(made("many.ply"), up="z")
    save("z.ply", scene)
    assert run(["splats", "z.ply", "kept.spz", "--edge", "16"]) == 0
    assert "z.ply: z points up, as the file says; only --in-up z turns the splats\n" in capsys.readouterr().err
    found = told(["splats", "z.ply", "turned.spz", "--edge", "16", "--in-up", "z", "--axes", "RDF"], capsys)
    kept, turned = load("kept.spz", Splats), load("turned.spz", Splats)
    assert (kept.axes, turned.axes) == ("RUB", "RDF")
    assert np.allclose(kept.with_up("z").means, turned.means, atol=1e-3)
    assert found["psnr"] > 35  # of the rounding alone: it is measured in the world of z.ply


def test_axes_are_of_splats_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(f"splats a.npz a.spz {SMALL} --in-axes RDF".split()) == 2
    assert "--in-axes has no effect on a PlenOctree; allowed: with splats" in capsys.readouterr().err
    assert run(f"splats a.npz a.ply {SMALL} --axes RDF".split()) == 2
    assert "ply takes no option 'axes'" in capsys.readouterr().err


def test_photographs_of_another_scene_are_refused_before_the_work(capsys: pytest.CaptureFixture[str]) -> None:
    jobs.write_sample_capture("elsewhere", frames=10, edge=32)
    path = Path("elsewhere/transforms.json")
    fields = json.loads(path.read_text())
    for frame in fields["frames"]:
        frame["transform_matrix"][0][3] += 100.0
    path.write_text(json.dumps(fields))
    assert run(["splats", "a.npz", "a.ply", "--views", "elsewhere"]) == 1
    said = "dB on the photographs of elsewhere, where pictures of a single colour have"
    assert said in capsys.readouterr().err.splitlines()[-1]
    assert not Path("a.ply").exists()


def test_below_the_limit_the_output_is_rejected(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(f"splats a.npz a.ply {SMALL} --min-psnr 60 --json".split()) == 3
    said = capsys.readouterr()
    assert read_output("splats", said.out)["psnr"] < 60
    assert "dB on 8 pictures with alpha; allowed: --min-psnr 60" in said.err
    assert Path("a.ply.rejected").exists()
    assert not Path("a.ply").exists()


@pytest.mark.parametrize("ending", ["npz", "svo.npz", "vdb"])
def test_a_scene_without_a_density_is_named(ending: str, capsys: pytest.CaptureFixture[str]) -> None:
    tree = sample_n3tree(resolution=8)
    empty = replace(tree, data=np.zeros_like(tree.data))
    octree = build_octree(empty)
    save(f"empty.{ending}", {"npz": empty, "svo.npz": octree, "vdb": build_vdb(octree)}[ending])
    assert run(f"splats empty.{ending} a.ply {SMALL}".split()) == 1
    said = f"error: empty.{ending}: the field has no leaf with a density; allowed: at least one"
    assert said in capsys.readouterr().err


def test_the_same_seed_gives_the_same_bytes() -> None:
    for name in ("a.ply", "b.ply"):
        assert run(f"splats a.npz {name} {SMALL} --seed 3 -q".split()) == 0
    assert Path("a.ply").read_bytes() == Path("b.ply").read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("splats a.npz a.ply --count 0", "'0' is not a number of splats; allowed: 1 to 20M, for example 150k"),
        ("splats a.npz a.ply --count 1e9", "'1e9' is not a number of splats"),
        ("splats a.npz a.ply --views c --frames 8", "--frames has no effect with --views"),
        ("splats a.npz a.ply --masks m", "--masks has no effect without --views; allowed: it with --views"),
        ("splats a.npz -", "splats measures the file that it wrote; allowed: an OUT other than '-'"),
        ("splats a.npz a.npz", "a.npz"),
        ("splats a.npz a.ply --floaters", "--floaters has no effect on a PlenOctree; allowed: with splats"),
        ("splats a.npz a.ply --largest", "--largest has no effect on a PlenOctree; allowed: with splats"),
        ("splats a.npz a.ply --box=0,0,0,1,1,1", "--box has no effect on a PlenOctree; allowed: with splats"),
        ("splats a.npz a.ply --epochs 0", "--epochs 0 has no effect on a field; allowed: with splats"),
        ("splats a.npz a.ply --epochs 0 --seed 1", "--seed has no effect with --epochs 0"),
        ("splats a.npz a.ply --place 1 t=1,0,0", "--place has no effect on a PlenOctree; allowed: with splats"),
        ("splats b.ply a.ply --place 2 t=1,0,0", "--place names input 2; allowed: 1 to 1"),
        ("splats b.ply a.ply --place 1 t=1,0,0 --place 1 s=2", "--place names input 1 twice; allowed: all steps of an"),
        ("splats b.ply a.ply --place 1 t=1,0", "'t=1,0' is no step; allowed: t=X,Y,Z, r=X,Y,Z in degrees"),
        ("splats b.ply a.ply --place 1 s=nan", "'s=nan' is no step"),
        ("splats b.ply a.ply --place 1 s=-1", "'s=-1' is a reflection; allowed: a factor above 0"),
        ("splats - - a.ply", "several inputs are stdin, which can be read once; allowed: '-' for one of them"),
    ],
)
def test_a_wrong_use_is_one_line(words: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words.split()) == 2
    assert message in capsys.readouterr().err
    assert not Path("a.ply").exists()


def made(name: str, n: int = 400) -> Splats:
    """Save a ball of splats."""
    scene = some_splats(n, degree=1)
    scene = replace(scene, scales=np.full((n, 3), 0.1, np.float32))
    save(name, scene)
    return scene


def test_splats_are_merged_and_judged_by_pictures_of_the_original(capsys: pytest.CaptureFixture[str]) -> None:
    made("many.ply")
    words = ["splats", "many.ply", "few.ply", "--count", "100", "--edge", "32", "--force"]
    found = [told([*words, *more], capsys) for more in (["--frames", "6"], ["--epochs", "0"])]
    assert [facts["splats"] for facts in found] == [100, 100]
    assert found[0]["psnr"] > found[1]["psnr"] + 1 > 15
    assert run(["splats", "many.ply", "few.ply", "--count", "100", "--frames", "6", "--edge", "32", "--force"]) == 0
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert " dB, SSIM " in last
    assert " on 8 pictures with alpha of many.ply; after " in last
    assert run(["compare", "many.ply", "few.ply", "--size", "32x32", "--json"]) == 0
    seen = json.loads(capsys.readouterr().out)["mean"]["a_b"]["psnr"]
    assert found[0]["psnr"] == pytest.approx(seen, abs=0.3)  # 8 bits of the original's pictures


def test_splats_that_are_not_merged_stay_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    scene = made("many.ply")
    assert told(["splats", "many.ply", "same.ply", "--edge", "16", "--count", "1k"], capsys)["splats"] == 400
    assert np.array_equal(load("same.ply", Splats).means, scene.means)
    same, before = load("same.ply", Splats), load("many.ply", Splats)
    assert np.allclose(same.quats, before.quats, rtol=1e-6)
    assert np.allclose(same.opacity, before.opacity, rtol=1e-6)  # a .ply holds its logit


def test_a_box_cuts_by_the_centre_and_says_how_many(capsys: pytest.CaptureFixture[str]) -> None:
    scene = made("many.ply")
    assert run(["splats", "many.ply", "part.ply", "--box=-1,-9,-9,0,9,9", "--edge", "16"]) == 0
    inside = (scene.means[:, 0] >= -1) & (scene.means[:, 0] <= 0)
    assert np.array_equal(load("part.ply", Splats).means, scene.means[inside])
    count = int(np.count_nonzero(inside))
    assert f"many.ply: leaves out {400 - count} of 400 splats outside the box\n" in capsys.readouterr().err


def test_several_files_are_joined_in_the_world_of_the_first(capsys: pytest.CaptureFixture[str]) -> None:
    first = made("one.ply")
    save("two.ply", replace(first, origin=np.array([3.0, 0, 0]), antialiased=True))
    facts = told(["splats", "one.ply", "two.ply", "both.ply", "--edge", "16"], capsys)
    assert (facts["in"], facts["joined"], facts["splats"]) == ("one.ply", ["two.ply"], 800)
    both = load("both.ply", Splats)
    assert np.allclose(both.means[400:], first.means + np.array([3, 0, 0], np.float32), atol=1e-6)
    assert not both.antialiased
    assert run(["splats", "one.ply", "two.ply", "more.ply", "--edge", "16"]) == 0
    said = capsys.readouterr().err
    assert "two.ply: is antialiased, and OUT is not antialiased, as one.ply" in said
    assert " of the joined splats; after " in said
    assert run(["splats", "one.ply", "a.npz", "no.ply"]) == 1
    assert "a.npz: holds a PlenOctree" in capsys.readouterr().err
    assert not Path("no.ply").exists()


def test_each_input_is_put_where_it_should_be(capsys: pytest.CaptureFixture[str]) -> None:
    first = made("one.ply")
    words = "splats one.ply one.ply both.ply --edge 16 --place 2 s=2+r=0,90,0+t=5,0,0 --place 1 t=0,0,1"
    assert told(words.split(), capsys)["splats"] == 800
    both = load("both.ply", Splats)
    assert np.allclose(both.means[:400], first.means + np.array([0, 0, 1], np.float32), atol=1e-6)
    x, y, z = first.means.T
    assert np.allclose(both.means[400:], np.stack([2 * z + 5, 2 * y, -2 * x], axis=1), atol=1e-5)
    assert np.allclose(both.scales[400:], 2 * first.scales, rtol=1e-5)
    assert np.abs(both.sh[400:, 1:] - first.sh[:, 1:]).max() > 0.1  # colours turn, too
    turned = first.with_degree(1).transformed(placement_matrix([Move("r", (0, 90, 0))]))
    assert np.allclose(both.sh[400:], turned.sh, atol=1e-6)


def test_floaters_and_parts_are_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    scene = made("many.ply")
    scene.means[7] = 60.0
    save("far.ply", scene)
    assert run(["splats", "far.ply", "kept.ply", "--floaters", "--largest", "--edge", "16"]) == 0
    assert load("kept.ply", Splats).n < 400
    said = capsys.readouterr().err
    assert " of 400 splats that float\n" in said
    assert " splats outside the largest part\n" in said


@pytest.mark.slow
def test_splats_are_fitted_to_photographs(capsys: pytest.CaptureFixture[str]) -> None:
    jobs.write_sample_capture("photographs", frames=10, edge=32)
    assert (
        run(f"splats a.npz first.ply {SMALL} --in-up=-y".split()) == 0  # in the world of the photographs
    )
    before = told(["splats", "first.ply", "same.ply", "--views", "photographs", "--epochs", "0"], capsys)
    after = told(["splats", "first.ply", "better.ply", "--views", "photographs", "--epochs", "4"], capsys)
    assert after["psnr"] > before["psnr"] + 0.5
    made("other.ply")
    assert run(["splats", "other.ply", "no.ply", "--views", "photographs"]) == 1
    said = "the splats have "
    assert said in capsys.readouterr().err.splitlines()[-1]


def test_a_fit_writes_splats(capsys: pytest.CaptureFixture[str]) -> None:
    jobs.write_sample_capture("photographs", frames=10, edge=32)
    assert run(["fit", "photographs", "fitted.ply", "--epochs", "cells=32,epochs=1", "--basis", "SH1"]) == 0
    assert "fitted.ply: " in capsys.readouterr().err.splitlines()[-1]
    assert load("fitted.ply", Splats).n > 100
