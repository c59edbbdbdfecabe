"""`nerfbake mesh`: what it writes, what it prints, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import trimesh

from nerfbake import Meshes, Stage1, build_field, build_octree, load, measure_silhouettes, sample_n3tree, save
from nerfbake.cli.main import run
from nerfbake.cli.mesh import TriangleCounts
from nerfbake.cli.paths import declared
from nerfbake.jobs import write_sample_capture
from nerfbake.jobs.views import picture_views
from nerfbake.stages.scene_to_cameras import orbit_cameras
from tests.cli.telling import told
from tests.support import environments

SMALL = ["--frames", "12", "--edge", "64", "--triangles", "1k", "--texture", "128"]
TEXTURED = ["--views", "photographs", "--triangles", "1k", "--texture", "128"]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    tree = sample_n3tree(resolution=32)
    save(folder / "a.npz", tree)
    save(folder / "a.svo.pb", build_octree(tree))
    save(folder / "empty.npz", replace(tree, data=np.zeros_like(tree.data)))
    write_sample_capture(folder / "photographs", frames=16, edge=64)
    write_sample_capture(folder / "elsewhere", frames=16, edge=64)
    cameras = json.loads((folder / "elsewhere" / "transforms.json").read_text())
    for frame in cameras["frames"]:
        frame["transform_matrix"][0][3] += 100.0
    (folder / "elsewhere" / "transforms.json").write_text(json.dumps(cameras))
    return folder


@pytest.fixture(autouse=True)
def there(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in scenes.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)


def last_line(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().err.strip().splitlines()[-1]


def test_materials_are_told_and_written(capsys: pytest.CaptureFixture[str]) -> None:
    Path("light.hdr").write_bytes(environments.runs())
    facts = told(["mesh", "a.npz", "a.glb", *SMALL, "--environment", "light.hdr"], capsys)
    assert (facts["ssim"], facts["worst"]) == (None, None)
    assert facts["psnr"] > 10
    assert sum(each["share"] for each in facts["materials"]) == pytest.approx(1)
    content = Path("a.glb").read_bytes()
    assert b"KHR_materials_specular" in content
    assert b"KHR_materials_unlit" not in content
    assert run(["mesh", "a.npz", "b.glb", *SMALL, "--environment", "light.hdr"]) == 0
    said = capsys.readouterr().err
    assert said.count("b.glb: material ") == len(facts["materials"])
    assert "dB under the map on the pixels that the mesh covers" in said.strip().splitlines()[-1]
    assert Path("b.glb").read_bytes() == content
    assert run(["mesh", "a.npz", "a.obj", *SMALL, "--environment", "light.hdr"]) == 2
    assert last_line(capsys) == "error: .obj stores no materials; allowed: a format that does, glTF"


def test_a_black_map_is_told_before_the_work_by_its_own_name(capsys: pytest.CaptureFixture[str]) -> None:
    """It was told after the work, as a fault of IN."""
    Path("black.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n" + bytes(32))
    assert run(["mesh", "nothing.npz", "a.glb", *SMALL, "--environment", "black.hdr"]) == 1
    assert last_line(capsys) == "error: black.hdr: the environment map is black; allowed: some light"
    Path("link.hdr").symlink_to("gone.hdr")
    assert run(["mesh", "nothing.npz", "a.glb", *SMALL, "--environment", "link.hdr"]) == 1
    assert last_line(capsys).startswith("error: link.hdr: is a broken link to gone.hdr; allowed: an existing file")


def test_a_glb_looks_like_its_field_and_is_the_same_again(capsys: pytest.CaptureFixture[str]) -> None:
    facts = told(["mesh", "a.npz", "a.glb", *SMALL], capsys)
    assert (facts["in"], facts["file"], facts["bytes"]) == ("a.npz", "a.glb", Path("a.glb").stat().st_size)
    assert (len(facts["views"]), facts["diffuse"]) == (8, None)
    assert facts["psnr"] == pytest.approx(sum(view["psnr"] for view in facts["views"]) / 8)
    assert facts["worst"] == min(facts["views"], key=lambda view: view["psnr"])["name"]
    assert facts["psnr"] > 22
    assert facts["iou"] > 0.95
    (mesh,) = load("a.glb", Meshes).meshes
    assert facts["triangles"] == [len(mesh.faces)]
    assert len(mesh.faces) <= 1000
    assert mesh.texture is not None
    assert mesh.texture.shape == (128, 128, 3)
    assert run(["mesh", "a.npz", "b.glb", *SMALL]) == 0
    assert "on 8 pictures of a.npz, 2x2 rays a pixel; worst view 000" in last_line(capsys)
    assert Path("b.glb").read_bytes() == Path("a.glb").read_bytes()
    assert told(["mesh", "a.svo.pb", "c.glb", *SMALL], capsys)["psnr"] == pytest.approx(facts["psnr"], abs=1)


def test_a_surface_without_so_many_triangles_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    save("small.npz", sample_n3tree(resolution=8))
    small = ["--frames", "4", "--edge", "16", "--triangles", "50k", "--texture", "256"]
    assert run(["mesh", "small.npz", "small.glb", *small]) == 0
    (mesh,) = load("small.glb", Meshes).meshes
    said = f"small.glb: has {len(mesh.faces):,} triangles, not 50,000: its surface has no more"
    assert said in capsys.readouterr().err.splitlines()


def test_every_kind_of_output_stands_where_the_field_does(capsys: pytest.CaptureFixture[str]) -> None:
    field = build_field(load("a.npz"))
    views = picture_views(field, orbit_cameras(field, frames=2, width=64, height=64), 1)
    for name, options in (
        ("a.obj", []),
        ("a.ply", []),
        ("a.glb", ["--lit", "--image", "webp"]),
        ("b.glb", ["--in-up", "y"]),
        ("stage1", ["--seed", "3"]),
    ):
        assert run(["mesh", "a.npz", name, *TEXTURED, *options]) == 0, capsys.readouterr().err
        said = last_line(capsys)
        assert said.startswith(f"{name}: ")
        assert "on 2 pictures with alpha, 2x2 rays a pixel; worst view " in said
        assert ("without highlights" in said) == (name == "stage1")
        scene: Any = load(name)
        meshes = Meshes(tuple(mesh for mesh in scene.meshes if mesh is not None))
        assert min(measure_silhouettes(meshes, views)) > 0.8  # the photographs show a finer scene
        assert (meshes.meshes[0].texture is None) == (name == "a.ply")
        assert (meshes.meshes[0].colours is None) == (name != "a.ply")
    assert run(["compare", "a.npz", "b.glb", "--size", "32x32", "--min-psnr", "15"]) == 0
    assert {path.name for path in Path().glob("a.*")} >= {"a.obj", "a.mtl", "a.jpg", "a.ply", "a.glb"}
    assert isinstance(load("stage1"), Stage1)


def test_what_other_programs_find_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["mesh", "a.npz", "a.glb", *SMALL]) == 0
    found: Any = trimesh.load("a.glb", force="mesh", process=False)
    corners = found.vertices[found.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.min() > 0
    assert found.volume > 0  # counter-clockwise from outside
    turned = load("a.glb", Meshes).meshes[0].positions
    np.testing.assert_allclose(found.vertices @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]], turned, atol=1e-5)


def test_an_atlas_is_baked_of_the_folder() -> None:
    assert run(["mesh", "a.npz", "stage1", *TEXTURED]) == 0
    assert run(["atlas", "stage1", "atlas", "--clusters", "4", "--map-size", "8", "--directions", "9"]) == 0
    for name in ("stage1", "atlas"):
        assert run(["render", name, "--out", f"{name}.png", "--size", "32x32"]) == 0
        assert run(["view", name, f"{name}.html"]) == 0


def test_levels_of_detail_are_in_one_file(capsys: pytest.CaptureFixture[str]) -> None:
    facts = told(["mesh", "a.npz", "a.glb", *SMALL[:4], "--texture", "256", "--lods", "1k,500,.1k"], capsys)
    assert len(facts["triangles"]) == 3
    for found, asked in zip(facts["triangles"], (1000, 500, 100), strict=True):
        assert asked / 2 < found <= asked
    content = Path("a.glb").read_bytes()
    whole = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    assert whole["nodes"][0]["extensions"] == {"MSFT_lod": {"ids": [1, 2]}}


def test_a_bad_mesh_is_rejected_with_its_texture(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["mesh", "a.npz", "a.obj", *SMALL, "--min-psnr", "80", "--json"]) == 3
    out, err = capsys.readouterr()
    assert "the mesh has a mean PSNR of" in err.strip().splitlines()[-1]
    assert json.loads(out)["psnr"] < 80
    assert not Path("a.obj").exists()
    assert load("a.obj.rejected/a.obj", Meshes).meshes[0].texture is not None
    assert run(["mesh", "a.npz", "s", *SMALL, "--min-psnr", "80"]) == 3
    assert Path("s.rejected/mlp.json").exists()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("a.npz a.stl", 2, "'a.stl' has no file extension for a mesh; allowed: .obj, .glb, .ply"),
        ("a.npz -", 2, "mesh measures the file that it wrote; allowed: an OUT other than '-'"),
        ("a.npz a.ply --image png", 2, "ply takes no option 'image'"),
        ("a.npz a.obj --image webp", 2, "option 'image' of obj is 'webp'; allowed: png, jpeg"),
        ("a.npz a.obj --lit", 2, "obj takes no option 'lit'"),
        ("a.npz folder --lit", 2, "folder is a folder, for which --lit have no effect; allowed: with a file"),
        ("a.npz a.obj --lods 20,10", 2, ".obj stores one level of detail"),
        ("a.npz a.glb --lods 10,20", 2, "--triangles are 10, 20; allowed: 4 or more, each level fewer than the one"),
        ("a.npz a.glb --lods 10 --triangles 5k", 2, "--triangles has no effect with --lods, which has its own"),
        ("a.npz a.glb --triangles 3", 2, "'3' is not a number of triangles; allowed: 20k, 20000, ..., each 4 or more"),
        ("a.npz a.glb --test photographs", 2, "--test has no effect without --views"),
        ("a.npz a.glb --views photographs --edge 9", 2, "--edge has no effect with --views"),
        ("empty.npz a.glb", 1, "empty.npz: the field has no leaf with a density; allowed: at least one"),
        ("a.npz a.glb --box 5,5,5,6,6,6 --frames 4 --edge 16", 1, "a.npz: "),
        ("a.npz a.glb --views elsewhere", 1, "dB on the photographs of elsewhere, where pictures of a single colour"),
        ("gone.npz a.glb", 1, "gone.npz"),
        ("photographs a.glb", 1, "photographs: holds cameras"),
    ],
)
def test_what_cannot_be_is_one_line(words: str, code: int, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(Path().iterdir())
    assert run(["mesh", *words.split()]) == code
    error = last_line(capsys)
    assert error.startswith("error: ")
    assert said in error
    assert sorted(Path().iterdir()) == before


def test_nothing_is_replaced_without_force_not_even_a_texture(capsys: pytest.CaptureFixture[str]) -> None:
    Path("a.jpg").write_bytes(b"mine")
    assert run(["mesh", "a.npz", "a.obj", *SMALL]) == 4
    assert last_line(capsys) == "error: a.jpg: exists already; allowed: a new file, or --force"
    assert Path("a.jpg").read_bytes() == b"mine"


def test_numbers_of_triangles() -> None:
    kind = TriangleCounts(several=True)
    assert kind.convert("50k,12.5k,1.5M,7", None, None) == (50_000, 12_500, 1_500_000, 7)
    for wrong in ("", "k", "1.5", "0", "-5", "1e4", "5k,", "nan", "99999999M", "\uff11"):
        with pytest.raises(click.BadParameter, match="is not a number of triangles"):
            kind.convert(wrong, None, None)


def test_a_batch_knows_the_files_beside_an_obj() -> None:
    from nerfbake.cli.mesh import mesh

    found = declared(mesh, ["a.npz", "out/b.obj", "--views", "photographs"])
    assert (found.reads, found.albums, found.writes) == (("a.npz",), ("photographs",), ("out/b.obj",))
    assert found.spare == ("out/b.mtl", "out/b.png", "out/b.jpg")
    assert declared(mesh, ["a.npz", "b.glb"]).spare == ()
