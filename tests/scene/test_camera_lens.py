"""Rays through a lens, put back through the published formulas: each comes out at its own pixel."""

from __future__ import annotations

import json
from math import atan2, hypot
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from nerfbake import Camera, Cameras, load, save
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.camera.colmap_writer import text_model
from nerfbake.scene.lens import Lens, all_round
from tests.support.captures import Rig, rig, write_colmap_binary, write_colmap_text, write_instant_ngp, write_nerfstudio
from tests.support.reprojection import in_pycolmap

Parameters = tuple[float, ...]


def seen_by_colmap(model: str, v: Parameters, X: float, Y: float, Z: float) -> tuple[float, float]:
    """Where COLMAP's model sees a point of the camera's own axes (x right, y down, z ahead): its sensor/models.h."""
    u, w = X / Z, Y / Z
    r = hypot(u, w)
    r2 = r * r
    if "FISHEYE" in model:
        theta = atan2(r, 1)
        k = (*(v[3:] if "RADIAL" in model else v[4:]), 0.0, 0.0, 0.0)
        bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        u, w = (u * bent / r, w * bent / r) if r > 0 else (u, w)
    elif model in ("SIMPLE_RADIAL", "RADIAL"):
        k = (*v[3:], 0.0)
        u, w = (value * (1 + k[0] * r2 + k[1] * r2 * r2) for value in (u, w))
    elif model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2, k3, k4, k5, k6 = (*v[4:], 0.0, 0.0, 0.0, 0.0)[:8]
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        u, w = (
            u * radial + 2 * p1 * u * w + p2 * (r2 + 2 * u * u),
            w * radial + 2 * p2 * u * w + p1 * (r2 + 2 * w * w),
        )
    one = model.startswith(("SIMPLE", "RADIAL"))
    fx, fy, cx, cy = (v[0], v[0], v[1], v[2]) if one else v[:4]
    return fx * u + cx, fy * w + cy


MODELS: dict[str, tuple[int, Parameters]] = {
    "SIMPLE_PINHOLE": (0, (17.5, 6.5, 5.25)),
    "PINHOLE": (1, (17.5, 16.0, 6.5, 5.25)),
    "SIMPLE_RADIAL": (2, (17.5, 6.5, 5.25, -0.2)),
    "RADIAL": (3, (17.5, 6.5, 5.25, -0.25, 0.08)),
    "OPENCV": (4, (17.5, 16.0, 6.5, 5.25, 0.12, -0.03, 0.01, -0.02)),
    "OPENCV_FISHEYE": (5, (8.5, 8.0, 6.5, 5.25, 0.03, -0.01, 0.002, -0.0003)),
    "FULL_OPENCV": (6, (17.5, 16.0, 6.5, 5.25, 0.3, -0.1, 0.01, -0.02, 0.02, 0.4, 0.05, 0.001)),
    "SIMPLE_RADIAL_FISHEYE": (8, (8.5, 6.5, 5.25, 0.05)),
    "RADIAL_FISHEYE": (9, (8.5, 6.5, 5.25, 0.05, -0.01)),
}


def assert_seen_at_their_pixels(made: Rig, read: Cameras, model: str, parameters: Parameters) -> None:
    for i, camera in enumerate(read.cameras):
        place, directions = camera.rays()
        assert_allclose(place, made.poses[i, :3, 3], atol=1e-12)
        own = directions @ made.poses[i, :3, :3] @ np.diag([1, -1, -1])
        assert_allclose(np.linalg.norm(own, axis=1), 1, rtol=1e-12)
        seen = [seen_by_colmap(model, parameters, *ray) for ray in own]
        pixels = [(x + 0.5, y + 0.5) for y in range(made.height) for x in range(made.width)]
        assert_allclose(seen, pixels, rtol=0, atol=1e-10)


@pytest.mark.parametrize("model", MODELS)
def test_colmaps_models(model: str, tmp_path: Path) -> None:
    made, (number, parameters) = rig(odd=True), MODELS[model]
    binary = load(write_colmap_binary(tmp_path / "bin", made, number, parameters), Cameras)
    text = load(write_colmap_text(tmp_path / "txt", made, model, parameters), Cameras)
    for read in (binary, text):
        assert_seen_at_their_pixels(made, read, model, parameters)
    # And what is written of them: the same to the bit.
    save(tmp_path / "again.json", binary)
    again = load(tmp_path / "again.json", Cameras)
    for one, other in zip(binary.cameras, again.cameras, strict=True):
        assert one.rays()[1].tobytes() == other.rays()[1].tobytes()
        assert one.lens == other.lens


def test_lenses_of_a_transforms_json(tmp_path: Path) -> None:
    made = rig(odd=True)
    pinhole = made.fx, made.fy, made.cx, made.cy
    k = {"k1": 0.12, "k2": -0.03, "p1": 0.01, "p2": -0.02}
    read = load(write_instant_ngp(tmp_path, made, **k), Cameras)
    assert_seen_at_their_pixels(made, read, "OPENCV", (*pinhole, *k.values()))
    k = {"k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": -0.0003}
    read = load(write_instant_ngp(tmp_path, made, is_fisheye=True, **k), Cameras)
    assert_seen_at_their_pixels(made, read, "OPENCV_FISHEYE", (*pinhole, *k.values()))
    read = load(write_nerfstudio(tmp_path, made, camera_model="OPENCV_FISHEYE", **k), Cameras)
    assert_seen_at_their_pixels(made, read, "OPENCV_FISHEYE", (*pinhole, *k.values()))
    listed = [0.12, -0.03, 0.004, 0.0, 0.01, -0.02]
    read = load(write_nerfstudio(tmp_path, made, distortion_params=listed), Cameras)
    full = (*pinhole, 0.12, -0.03, 0.01, -0.02, 0.004, 0.0, 0.0, 0.0)
    assert_seen_at_their_pixels(made, read, "FULL_OPENCV", full)


def test_nerfstudios_k4_is_no_denominator(tmp_path: Path) -> None:
    made = rig(odd=False)
    read = load(write_nerfstudio(tmp_path, made, k4=0.3), Cameras)
    _, directions = read.cameras[0].rays()
    own = directions @ made.poses[0, :3, :3]
    x, y = -own[:, 0] / own[:, 2], own[:, 1] / own[:, 2]
    bent = x * (1 + 0.3 * (x * x + y * y) ** 4)
    assert_allclose(bent.reshape(10, 14)[0], (np.arange(14) + 0.5 - 7) / 17.5, atol=1e-12)


def bent(plane: npt.NDArray[np.float64], k: list[float], p: tuple[float, float]) -> npt.NDArray[np.float64]:
    """Where a polynomial lens shows points (m, 2) of the plane: Brown's model, written out."""
    x, y = plane.T
    r2 = x * x + y * y
    radial = 1 + sum(value * r2 ** (i + 1) for i, value in enumerate(k))
    u = x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x)
    v = y * radial + 2 * p[1] * x * y + p[0] * (r2 + 2 * y * y)
    return np.stack([u, v], axis=1)


coefficients = st.floats(-0.4, 0.4)


@given(st.lists(coefficients, min_size=1, max_size=4), st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02)))
def test_what_is_found_is_right_and_the_nearest(k: list[float], p: tuple[float, float]) -> None:
    lens = Lens("polynomial", tuple(k), p)
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, 21), np.linspace(-0.7, 0.7, 15))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    looks, fine = lens.looks(points)
    plane = looks[fine, :2] / looks[fine, 2:]
    assert_allclose(bent(plane, k, p), points[fine], atol=2e-12)
    assert fine[np.linalg.norm(points, axis=1) < 0.2].all()  # these lenses cover at least so much
    # On the way there from the middle nothing folds: what is seen moves outwards all the way.
    for target in plane[:: len(plane) // 5 + 1] if not any(p) else ():
        way = np.linalg.norm(bent(np.linspace(0, 1, 50)[:, None] * target, k, p), axis=1)
        assert (np.diff(way) >= 0).all()


def test_a_lens_that_does_not_cover_its_picture_is_refused() -> None:
    # r (1 - r^2) is greatest at r = 1 / sqrt 3, where it is 0.385: nothing is seen farther out than that.
    lens = Lens("polynomial", (-1.0,))
    camera = Camera(100, 100, 100.0, np.eye(4), "r_0", lens=lens)
    said = "camera r_0 shows nothing at pixel 0, 0: its polynomial distortion cannot be inverted there"
    with pytest.raises(InvalidScene, match=said):
        camera.rays()
    with pytest.raises(InvalidScene, match=said):
        Cameras((camera,)).require_covered()
    assert said in str(Cameras((camera,)).problems()[0])
    inside = Camera(100, 100, 190.0, np.eye(4), lens=lens)
    assert Cameras((inside,)).problems() == []
    _, directions = inside.rays()
    x, y = -directions[0, 0] / directions[0, 2], directions[0, 1] / directions[0, 2]
    assert x * (1 - x * x - y * y) == pytest.approx(-49.5 / 190)


def test_a_fisheye_sees_behind_itself() -> None:
    camera = Camera(5, 1, 1.0, np.eye(4), lens=Lens("fisheye"))
    _, directions = camera.rays()
    # Pixels are one radian apart: the outermost look two radians to the side.
    assert_allclose(directions[:, 0], np.sin([-2, -1, 0, 1, 2]), atol=1e-15)
    assert_allclose(directions[:, 2], -np.cos([-2, -1, 0, 1, 2]), atol=1e-15)
    with pytest.raises(InvalidScene, match="fisheye distortion cannot be inverted"):
        Camera(9, 1, 1.0, np.eye(4), lens=Lens("fisheye")).rays()  # four radians: more than there is


@pytest.mark.parametrize(
    ("model", "k", "p"),
    [
        ("polynomial", (1.0,) * 5, (0.0, 0.0)),
        ("polynomial", (np.nan,), (0.0, 0.0)),
        ("polynomial", (1e300,), (0.0, 0.0)),
        ("rational", (0.0,), (np.inf, 0.0)),
        ("fisheye", (0.1,), (0.1, 0.0)),
    ],
)
def test_lenses_that_there_are_not(model: str, k: Parameters, p: tuple[float, float]) -> None:
    with pytest.raises(InvalidScene, match="allowed"):
        Lens(model, k, p)  # type: ignore[arg-type]


CLOSED = {"FOV": (0.8,), "SIMPLE_DIVISION": (-0.1,), "DIVISION": (-0.1,), "EUCM": (0.6, 1.1)}


@pytest.mark.slow
def test_lenses_with_a_formula_are_those_of_pycolmap(tmp_path: Path) -> None:
    """Its own cam_from_img() and img_from_cam() of the same parameters, in a process of its own."""
    made = rig(odd=True)
    places = np.array([[x + 0.5, y + 0.5] for y in range(made.height) for x in range(made.width)])
    sent, ours = {}, {}
    for model, k in CLOSED.items():
        focal = (made.fx,) if model == "SIMPLE_DIVISION" else (made.fx, made.fy)
        parameters = (*focal, made.cx, made.cy, *k)
        (camera, *_) = load(write_colmap_text(tmp_path / model, made, model, parameters), Cameras).cameras
        assert camera.lens is not None
        looks, fine = camera.lens.looks((places - [camera.cx, camera.cy]) / [camera.fx, camera.fy])
        assert fine.all()
        ours[model] = looks
        sent[model] = [made.width, made.height, list(parameters), places.tolist(), looks.tolist()]
    code = """
import json, sys, numpy as np, pycolmap
for model, (width, height, parameters, places, looks) in json.load(sys.stdin).items():
    camera = pycolmap.Camera(model=model, width=width, height=height, params=parameters)
    seen, found = camera.cam_from_img(np.array(places)), camera.img_from_cam(np.array(looks))
    print(json.dumps([model, seen.tolist(), found.tolist()]))
"""
    for line in in_pycolmap(code, sent).splitlines():
        model, seen, found = json.loads(line)
        looks = ours.pop(model)
        assert np.abs(looks[:, :2] / looks[:, 2:] - seen).max() < 1e-12
        assert np.abs(np.array(found) - places).max() < 1e-9
    assert not ours


PRISMS = {
    "THIN_PRISM_FISHEYE": (8.5, 8.0, 6.5, 5.25, 0.03, -0.01, 0.01, -0.02, 0.002, -0.0003, 0.013, -0.007),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *(8.5, 8.0, 6.5, 5.25, 0.03, -0.01, 0.002, -0.0003, 0.0001, -0.00002),
        *(0.01, -0.02, 0.013, 0.002, -0.007, -0.001),
    ),
    "EQUIRECTANGULAR": (14.0, 10.0),
}


@pytest.mark.slow
def test_prisms_and_panoramas_are_those_of_pycolmap(tmp_path: Path) -> None:
    """Its own projection of our rays is at the pixels, to 1e-9; and what is written is the same model."""
    made = rig(odd=False)
    sent, places = {}, np.array([[x + 0.5, y + 0.5] for y in range(made.height) for x in range(made.width)])
    for model, parameters in PRISMS.items():
        read = load(write_colmap_text(tmp_path / model, made, model, parameters), Cameras)
        camera = read.cameras[0]
        own = camera.rays()[1] @ camera.pose[:3, :3] * [1, -1, -1]
        sent[model] = [made.width, made.height, list(parameters), places.tolist(), own.tolist()]
        again = dict(text_model(read))["cameras.txt"]
        assert next(iter(again)).split()[1:] == f"{model} 14 10 {' '.join(map(repr, parameters))}".encode().split()
    code = """
import json, sys, numpy as np, pycolmap
for model, (width, height, parameters, places, looks) in json.load(sys.stdin).items():
    camera = pycolmap.Camera(model=model, width=width, height=height, params=parameters)
    print(json.dumps([model, camera.img_from_cam(np.array(looks), check_cheirality=False).tolist()]))
"""
    for line in in_pycolmap(code, sent).splitlines():
        model, found = json.loads(line)
        away = np.abs(np.array(found) - places)
        assert away.max() < 1e-9, model
        del sent[model]
    assert not sent


def test_a_panorama_looks_to_all_sides(tmp_path: Path) -> None:
    """By hand: eight columns are 45 degrees apart, and four rows 45, from the lower left behind to the right."""
    focal, centre, lens = all_round(8, 4)
    camera = Camera(8, 4, focal, np.eye(4), "round", centre, lens)
    own = camera.rays()[1].reshape(4, 8, 3)
    east, up = np.radians(-157.5 + 45 * np.arange(8)), np.radians(67.5 - 45 * np.arange(4))
    assert_allclose(own[..., 1], np.broadcast_to(np.sin(up)[:, None], (4, 8)), atol=1e-15)
    assert_allclose(own[..., 0], np.cos(up)[:, None] * np.sin(east), atol=1e-15)
    assert_allclose(own[..., 2], -np.cos(up)[:, None] * np.cos(east), atol=1e-15)
    save(tmp_path / "round.json", Cameras((camera,)))
    fields = json.loads((tmp_path / "round.json").read_text())
    assert fields["camera_model"] == "EQUIRECTANGULAR"
    assert fields["fl_x"] == pytest.approx(4)  # nerfstudio's: the height
    assert_allclose(load(tmp_path / "round.json", Cameras).cameras[0].rays()[1].reshape(4, 8, 3), own, atol=1e-15)
    del fields["fl_x"], fields["fl_y"]
    (tmp_path / "round.json").write_text(json.dumps(fields))
    assert_allclose(load(tmp_path / "round.json", Cameras).cameras[0].rays()[1].reshape(4, 8, 3), own, atol=1e-15)
    fields["k1"] = 0.1
    (tmp_path / "round.json").write_text(json.dumps(fields))
    with pytest.raises(InvalidFile, match=r"k1 is 0\.1; allowed: 0 for EQUIRECTANGULAR"):
        load(tmp_path / "round.json", Cameras)


def test_pixels_that_a_formula_does_not_reach_are_not_fine() -> None:
    """FOV ends at omega r = 90 degrees, a division at 1 + k r^2 = 0, EUCM where its root ends."""
    points = np.array([[0.0, 0.0], [1.9, 0.0], [2.1, 0.0]])
    for lens in (Lens("fov", (np.pi / 4,)), Lens("division", (-0.25,)), Lens("eucm", (1.0, 0.25))):
        looks, fine = lens.looks(points)
        assert fine.tolist() == [True, True, False]
        assert np.abs((looks * looks).sum(axis=1) - 1).max() < 1e-15
        assert looks[0].tolist() == [0, 0, 1]
    assert Lens("fov").looks(points)[0][1, 0] == pytest.approx(1.9 / np.sqrt(1 + 1.9**2))
