"""nerfacto's checkpoints: the program's own answers, its formulas in every layout, its settings, what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Cameras, FunctionField, load
from nerfbake.errors import NerfbakeError
from nerfbake.formats.field import nerfstudio as reader
from nerfbake.formats.field.nerfacto import field_of_nerfacto
from nerfbake.formats.field.nerfstudio import NerfstudioModel
from nerfbake.formats.field.run_files import Run, read_run
from nerfbake.kernels.maths.affine import rotate, transform_points
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.memory import memory_limit
from tests.support.hostile import refused_as_it_is
from tests.support.nerfs import vanilla_nerf, vanilla_nerf_file
from tests.support.nerfstudio import (
    APPEARANCE,
    KEYS,
    LEVELS,
    LOG2,
    MOST,
    contracted,
    nerfacto,
    nerfstudio_file,
    ngp,
    reference,
    run_files,
)

POINTS = np.random.default_rng(0).uniform(-3, 3, (60, 3))
DIRECTIONS = fibonacci(60)
ASSUMED = Run({})


def read(root: dict[str, Any], run: Run = ASSUMED) -> FunctionField:
    return reader.field_of(memoryview(nerfstudio_file(root)), run)


def written(place: Path, files: dict[str, bytes]) -> Path:
    for name, data in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(data)
    return place


def mean_of(root: dict[str, Any]) -> Any:
    return root["pipeline"]["_model.field.embedding_appearance.embedding.weight"].mean(axis=0)


@pytest.mark.data
@pytest.mark.parametrize("given", ["", "nerfstudio_models/step-000001499.ckpt"])
def test_a_real_run_has_the_answers_of_the_program(data: Path, given: str) -> None:
    """6,000 points, with the program's density and colour. Measured: 8e-6 relative, 3e-7."""
    folder = data / "fields" / "nerfacto_object"
    answers, field = np.load(folder / "answers.npz"), load(folder / given, FunctionField)
    assert_array_equal(field.frame, answers["scale"] * answers["transform"].astype(np.float64))
    assert (field.background, field.near, field.far) == ((0.0, 0.0, 0.0), 0.05, 1000.0)  # random: black, when evaluated
    assert_array_equal(field.network.encoding.scale, answers["scalings"])  # type: ignore[attr-defined]
    trained = field.in_trained_world()
    density, features = trained.density(answers["points"].astype(np.float64))
    assert_allclose(density, answers["density"], rtol=1e-5)
    assert_allclose(trained.colour(features, answers["dirs"].astype(np.float64)), answers["rgb"], atol=1e-6)
    back = rotate(answers["points"][:50] - field.frame[:, 3], field.frame[:, :3].T / field.scale**2)
    assert_allclose(field.density(back)[0], field.scale * answers["density"][:50], rtol=2e-3)  # float32 positions


@pytest.mark.data
@pytest.mark.parametrize("name", ["transforms.json", "capture_transforms.json"])
def test_cameras_of_a_real_capture_are_where_the_program_had_them(name: str, data: Path, tmp_path: Path) -> None:
    folder = data / "fields" / "nerfacto_object"
    files = {name: (folder / name).read_bytes() for name in ("config.yml", "dataparser_transforms.json")}
    files[name] = (folder / "capture_transforms.json").read_bytes()
    files["nerfstudio_models/step-000000001.ckpt"] = nerfstudio_file()
    field: object = load(written(tmp_path, files))  # a run, although it has a transforms.json
    assert isinstance(field, FunctionField)
    if name == "transforms.json":
        assert len(load(tmp_path, Cameras).cameras) == 24
    cameras = field.in_trained_world().cameras
    assert cameras is not None
    found = np.stack([camera.pose[:3] for camera in cameras.cameras])
    for pose in np.load(folder / "answers.npz")["all_c2w"]:  # of the 22 pictures that it was trained with
        assert np.abs(found - pose).max(axis=(1, 2)).min() < 1e-6


@pytest.mark.parametrize("layout", KEYS)
def test_every_layout_follows_its_formula(layout: str) -> None:
    root = nerfacto(layout)
    sizes = {"num_levels": LEVELS, "log2_hashmap_size": LOG2, "max_res": MOST}  # in 0.1 only in the configuration
    field = read(root, Run(sizes) if layout == "tcnn 0.1" else ASSUMED)
    density, features = field.density(POINTS)
    expected, colours = reference(layout, root, contracted(POINTS), DIRECTIONS, mean_of(root))
    assert_allclose(density, expected, rtol=2e-5)
    assert_allclose(field.colour(features, DIRECTIONS), colours, atol=2e-6)
    assert len(root["pipeline"]["_model.field.embedding_appearance.embedding.weight"][0]) == APPEARANCE


def test_the_density_is_scaled_since_1_0() -> None:
    new, old = nerfacto(), nerfacto("torch 0.3")
    plain = read(new).density(POINTS)[0]
    for run, factor in (
        (Run(), 0.01),  # what nerfacto's configuration writes
        (Run({"average_init_density": 0.5}), 0.5),
        (Run({}), 1.0),  # a configuration of a version without it
    ):
        assert_allclose(read(new, run).density(POINTS)[0], factor * plain, rtol=1e-6)
    assert_allclose(read(old, Run()).density(POINTS)[0], plain, rtol=1e-6)


def test_the_last_level_of_the_default_has_2047_cells() -> None:
    root = nerfacto()
    root["pipeline"] |= {
        "_model.field.num_levels": np.array(16),
        "_model.field.max_res": np.array(2048),
        "_model.field.mlp_base.model.0.hash_table": np.zeros((16 << LOG2, 1), np.float32),
        "_model.field.mlp_base.model.1.layers.0.weight": np.zeros((16, 16), np.float32),
    }
    assert read(root, Run()).network.encoding.scale[[0, 1, -1]].tolist() == [16, 22, 2047]  # type: ignore[attr-defined]


def test_appearance_is_the_mean_or_zeros() -> None:
    root = nerfacto("tcnn")
    features = read(root).density(POINTS)[1]
    for settings, appearance in (({}, mean_of(root)), ({"use_average_appearance_embedding": False}, np.zeros(5))):
        field = read(root, Run(settings))
        colours = reference("tcnn", root, contracted(POINTS), DIRECTIONS, appearance.astype(np.float32))[1]
        assert_allclose(field.colour(features, DIRECTIONS), colours, atol=2e-6)
    none = nerfacto("tcnn", appearance=0)
    colours = reference("tcnn", none, contracted(POINTS), DIRECTIONS, np.zeros(0, np.float32))[1]
    assert_allclose(read(none).colour(features, DIRECTIONS), colours, atol=2e-6)


def test_keys_after_training_on_several_gpus_are_the_same() -> None:
    for prefix in ("_model.", "_model.module."):
        assert_allclose(read(nerfacto(prefix=prefix)).density(POINTS)[0], read(nerfacto()).density(POINTS)[0])


def test_without_contraction_the_box_is_all() -> None:
    root = nerfacto("tcnn")
    root["pipeline"]["_model.field.aabb"] = np.array([[-1, -2, -1], [1, 1, 3]], np.float32)
    field = read(root, Run({"disable_scene_contraction": True, "average_init_density": 2.0}))
    low, high = root["pipeline"]["_model.field.aabb"]
    inside = np.logical_and(low < POINTS, high > POINTS).all(axis=1)
    places = ((POINTS.astype(np.float32) - low) / (high - low)).astype(np.float32)
    expected = 2 * reference("tcnn", root, places[inside], DIRECTIONS[inside], mean_of(root))[0]
    density = field.density(POINTS)[0]
    assert_allclose(density[inside], expected, rtol=2e-5)
    assert inside.any()
    assert not density[~inside].any()
    assert_array_equal(field.box, [low, high])


def test_instant_ngp_has_no_appearance_no_scale_and_an_occupancy() -> None:
    root = ngp()
    field = read(root, Run({"alpha_thre": 0.02, "average_init_density": 7.0}))
    assert field.dialect == "nerfstudio's instant-ngp"
    assert field.background == (0.0, 0.0, 0.0)
    assert any("0.02 opacity" in note for note in field.notes)
    #            cell 1, 2, 3 of the first box,  another,            0, 3, 1 of the second,  outside of both
    points = np.array([[-0.25, 0.25, 0.75], [0.25, 0.25, 0.75], [-1.5, 1.5, -0.5], [-2.5, 0.0, 0.0]])
    density, features = field.density(points)
    expected, colours = reference("tcnn", root, contracted(points), DIRECTIONS[:4], np.zeros(APPEARANCE, np.float32))
    assert_allclose(density, expected * [1, 0, 1, 0], rtol=2e-5)
    assert_allclose(field.colour(features, DIRECTIONS[:4])[[0, 2]], colours[[0, 2]], atol=2e-6)


# -- runs ------------------------------------------------------------------------------------------------------
def test_a_run_is_its_last_checkpoint_with_its_files(tmp_path: Path) -> None:
    files = run_files(average_init_density=0.25, background_color="white", far_plane=50)
    files["nerfstudio_models/step-000000008.ckpt"] = b"an older one"
    files["nerfstudio_models/step-9.ckpt.part"] = b"no checkpoint"
    folder = written(tmp_path / "run", files)
    for given in (folder, folder / "nerfstudio_models" / "step-000000009.ckpt"):
        field = load(given, FunctionField)
        assert field.network.activation.scale == 0.25  # type: ignore[attr-defined]
        assert field.background == (1.0, 1.0, 1.0)
        assert field.far == 50.0
        #             0.5 (y + 0.5), 0.5 z, 0.5 (x - 0.25)
        assert_allclose(transform_points(np.array([1.0, 2.0, 3.0]), field.frame), [1.25, 1.5, 0.375])
        assert len(field.notes) == 1
    alone = written(tmp_path / "alone", {"a.ckpt": files["nerfstudio_models/step-000000009.ckpt"]}) / "a.ckpt"
    field = load(alone, FunctionField)
    assert_array_equal(field.frame, np.eye(3, 4))
    assert [note.split(" of")[0] for note in field.notes] == [
        "without config.yml",
        "without dataparser_transforms.json",
    ]


def test_files_of_a_run_also_count_for_vanilla_nerf(tmp_path: Path) -> None:
    files = run_files(collider_params="{far_plane: 3.0, near_plane: 1.0}", background_color="black")
    files["nerfstudio_models/step-000000009.ckpt"] = vanilla_nerf_file(vanilla_nerf())
    field = load(written(tmp_path, files), FunctionField)
    assert (field.dialect, field.near, field.far, field.background) == ("vanilla-nerf", 1.0, 3.0, (0.0, 0.0, 0.0))
    assert field.scale == pytest.approx(0.5)
    assert_allclose(field.box, [[-0.75] * 3, [0.75] * 3])


def test_the_world_is_that_of_the_cameras() -> None:
    """transform and scale hold what ns-process-data had applied before; cameras are after it."""
    frame = '"frames": [{"file_path": "a.png", "transform_matrix": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}]'
    lens = '"fl_x": 10, "w": 4, "h": 4'
    files = {name: memoryview(data) for name, data in run_files().items()}
    # The trained coordinates that nerfstudio gives this camera: with its own M0 and s0, before A and a are put in.
    for more, own, scale in (
        ("", [[0, 1, 0, 0.5], [0, 0, 1, 0], [1, 0, 0, -0.25]], 0.5),
        # A: (x, y, z) -> (y, x, -z + 1). M0 A = M, so M0 p = (x + 0.5, 1 - z, y - 0.25).
        (
            '"applied_transform": [[0,1,0,0],[1,0,0,0],[0,0,-1,1]], "applied_scale": 2,',
            [[1, 0, 0, 0.5], [0, 0, -1, 1], [0, 1, 0, -0.25]],
            0.25,
        ),
    ):
        run = read_run(files | {"transforms.json": memoryview(f"{{{more} {lens}, {frame}}}".encode())})
        assert run.cameras is not None
        position = run.cameras.cameras[0].pose[:3, 3]
        assert_allclose(transform_points(position, run.frame), scale * transform_points(position, np.array(own, float)))
        assert not run.notes
    colmap = read_run(
        files
        | {
            "transforms.json": memoryview(f"{{{lens}, {frame}}}".encode()),
            "colmap/sparse/0/cameras.bin": memoryview(b""),
        }
    )
    # A: (x, y, z) -> (y, x, -z), so M A^-1 p = (x + 0.5, -z, y - 0.25).
    assert_allclose(transform_points(np.array([1.0, 2.0, 3.0]), colmap.frame), [0.75, -1.5, 0.875])


def _without(*keys: str) -> dict[str, Any]:
    root = nerfacto("tcnn")
    for key in keys:
        del root["pipeline"][f"_model.field.{key}"]
    return root


def _with(layout: str = "tcnn", **state: Any) -> dict[str, Any]:
    root = nerfacto(layout)
    root["pipeline"] |= {f"_model.field.{key.replace('__', '.')}": value for key, value in state.items()}
    return root


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "2^63 rows": (
        _with(log2_hashmap_size=np.array(63)),
        "field.log2_hashmap_size is 63; allowed: a whole number from 1",
    ),
    "2^63 rows, torch": (_with("torch", log2_hashmap_size=np.array(63)), "field.log2_hashmap_size is 63"),
    "billions of levels": (_with(num_levels=np.array(1 << 40)), "field.num_levels is 1,099,511,627,776"),
    "levels that are no number": (_with(num_levels=np.zeros(2)), "field.num_levels has dtype float64, shape (2,)"),
    "nodes without end": (_with(max_res=np.array(1 << 62)), "field.max_res is 4,611,686,018,427,387,904"),
    "too few parameters": (
        _with(mlp_base__model__params=np.zeros(100, np.float32)),
        "has 100 numbers; allowed: a network",
    ),
    "a parameter too many": (
        _with(mlp_base__model__params=np.append(nerfacto("tcnn")["pipeline"]["_model.field.mlp_base.model.params"], 0)),
        "numbers; allowed: a network and a hash grid of",
    ),
    "a head of another size": (_with(mlp_head__tcnn_encoding__params=np.zeros(900, np.float32)), "has 900 numbers"),
    "a table of other levels": (_with("torch", num_levels=np.array(4)), "allowed: 32,768 rows, for 4 levels of 2^13"),
    "no head": (_without("mlp_head.tcnn_encoding.params"), "has no field.mlp_head.tcnn_encoding.params"),
    "no box": (_without("aabb"), "has no field.aabb"),
    "no field": ({"pipeline": {"_model.mlp.weight": np.zeros(1, np.float32)}}, "holds a model that is not known (mlp)"),
    "instant-ngp with an older occupancy": (
        {"pipeline": nerfacto("tcnn 0.1")["pipeline"] | {"_model.occupancy_grid._binary": np.zeros((2, 2, 2), bool)}},
        "is an instant-ngp of nerfstudio before 0.3",
    ),
    "an appearance of another width": (
        _with("torch", embedding_appearance__embedding__weight=np.zeros((2, 7), np.float32)),
        "is 36 x 16 x 16 x 3, after 6 x 16 x 16; allowed: 16 + 15 + 7 inputs",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_sizes_are_checked_before_anything_is_allocated(what: str) -> None:
    root, said = REFUSED[what]
    data = memoryview(nerfstudio_file(root))
    with memory_limit(1 << 20), pytest.raises(NerfbakeError) as error:
        reader.decode(data)
    assert said in str(error.value)
    assert len(str(error.value)) <= 300


def test_weights_that_are_not_finite_and_boxes_without_size_are_problems() -> None:
    root = nerfacto("tcnn")
    root["pipeline"]["_model.field.mlp_base.model.params"][[3, -1]] = np.nan, np.inf
    assert [str(problem).split("[")[0] for problem in read(root).problems()] == ["the hash grid", "the network"]
    flat = _with(aabb=np.zeros((2, 3), np.float32))
    found = read(flat, Run({"disable_scene_contraction": True})).problems()
    assert str(found[0]).startswith("the field's box")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("config.yml", b"pipeline:\n  model:\n    base_res: 0\n", "config.yml: pipeline.model.base_res is 0"),
        ("config.yml", b"pipeline:\n  model:\n    average_init_density: .nan\n", "average_init_density is nan"),
        ("config.yml", b"pipeline:\n  model:\n    near_plane: !!python/object/apply:os.f [x]\n", "near_plane is a"),
        ("config.yml", b"pipeline:\n  model:\n    background_color: {a: b}\n", "background_color is an object"),
        ("config.yml", b"pipeline:\n  model:\n    disable_scene_contraction: 1\n", "is 1; allowed: true or false"),
        ("config.yml", b"pipeline: 3\n", "config.yml has no pipeline.model"),
        ("config.yml", b"a: &a [x]\nb: &b [*a, *a]\nc: [*b, *c]\n", "config.yml at line 3"),
        ("dataparser_transforms.json", b'{"transform": [[1,0,0,0]], "scale": 1}', "transform has shape (1, 4)"),
        ("dataparser_transforms.json", b'{"transform": [[1,0,0,0],[0,1,0,0],[0,0,1,0]], "scale": 0}', "scale is 0"),
        ("dataparser_transforms.json", b'{"transform": [[1,0,0,0],[0,2,0,0],[0,0,1,0]], "scale": 1}', "no rotation"),
        ("transforms.json", b'{"frames": [], "applied_transform": [[0,0,0,0],[0,0,0,0],[0,0,0,0]]}', "has no inverse"),
        ("nerfstudio_models/step-000000009.ckpt", b"nonsense", "step-000000009.ckpt: "),
        ("nerfstudio_models/step-000000009.ckpt", None, "nerfstudio_models has no checkpoint"),
    ],
)  # fmt: skip
def test_a_run_with_a_wrong_file_is_refused_by_its_name(
    name: str, content: bytes | None, said: str, tmp_path: Path
) -> None:
    files = run_files()
    if content is None:
        del files[name]
    else:
        files[name] = content
    with pytest.raises(NerfbakeError) as error:
        load(written(tmp_path, files), FunctionField)
    assert said in str(error.value)
    assert "allowed" in str(error.value)
    assert str(error.value).isprintable()


def test_a_checkpoint_is_described_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = _with(num_levels=np.array(0))
    line = refused_as_it_is(tmp_path / "step-000000001.ckpt", nerfstudio_file(bad), capsys)
    assert "field.num_levels is 0" in line
    assert field_of_nerfacto(NerfstudioModel(memoryview(nerfstudio_file())), Run()).dialect == "nerfacto"
