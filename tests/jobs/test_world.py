"""The world of cameras in metres: by a distance, by GPS positions, by the ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake import Cameras, load, save
from nerfbake.errors import InvalidScene, UsageError
from nerfbake.io import PhotographMetadata, load_metadata
from nerfbake.jobs import FitOptions, WorldOptions, convert_cameras, fit_scene
from nerfbake.jobs.world import find_world
from nerfbake.scene.world import EarthPlace, World
from tests.jobs.listener import Listener
from tests.support.gravity import write_drone, write_upright
from tests.support.photographs import write_scene

PLACE = EarthPlace(46.8, -91.99, 200.0)
METRE = 1 / 111_170  # degrees of latitude at 46.8 degrees north, to 0.1 %


def write_place(path: Path, place: EarthPlace | None, **tags: object) -> Path:
    """Write a picture that was taken at this place."""
    exif = Pillow.Exif()
    if place is not None:
        gps = exif.get_ifd(0x8825)
        for number, value, sides in ((1, place.latitude, "SN"), (3, place.longitude, "WE")):
            minutes, seconds = divmod(abs(value) * 3600, 60)
            degrees, minutes = divmod(minutes, 60)
            gps[number], gps[number + 1] = sides[int(value > 0)], (degrees, minutes, seconds)
        gps[5], gps[6] = (b"\x01" if place.altitude < 0 else b"\x00"), abs(place.altitude)
        gps.update({int(key[1:]): value for key, value in tags.items()})
    picture = path.with_suffix(".jpg")
    picture.parent.mkdir(parents=True, exist_ok=True)
    Pillow.new("RGB", (8, 6)).save(picture, exif=exif)
    return picture


@pytest.fixture
def cameras(tmp_path: Path) -> Cameras:
    capture = write_scene(tmp_path / "drawn", frames=10)
    return load(capture / "transforms_train.json", Cameras)


def placed(folder: Path, cameras: Cameras, *, metres: float = 10.0) -> list[Path | None]:
    """Photographs at the places of these cameras, whose unit is `metres`; x is up, y east and z north."""
    found: list[Path | None] = []
    across = METRE / np.cos(np.radians(PLACE.latitude))
    for camera in cameras.cameras:
        up, east, north = metres * camera.pose[:3, 3]
        place = EarthPlace(PLACE.latitude + north * METRE, PLACE.longitude + east * across, PLACE.altitude + up)
        found.append(write_place(folder / camera.name, place))
    return found


@pytest.mark.parametrize("place", [PLACE, EarthPlace(-33.9, 18.4, -3.5)])
def test_the_place_of_a_photograph_is_read(place: EarthPlace, tmp_path: Path) -> None:
    assert load_metadata(write_place(tmp_path / "a", place)).place == pytest.approx(place, abs=1e-6)


def test_damaged_places_are_none(tmp_path: Path) -> None:
    assert load_metadata(write_place(tmp_path / "a", None)).place is None
    for tags in ({"t2": (1.0, 2.0)}, {"t2": (500.0, 0.0, 0.0)}, {"t6": 1e6}, {"t4": (0.0,) * 4}):
        assert load_metadata(write_place(tmp_path / "b", PLACE, **tags)).place is None
    cut = tmp_path / "c.jpg"
    data = write_place(tmp_path / "a", PLACE).read_bytes()
    for length in range(0, len(data), 29):
        cut.write_bytes(data[:length])
        load_metadata(cut)


def test_each_photograph_is_read_once(cameras: Cameras, tmp_path: Path) -> None:
    up = np.array([0.48, -0.6, 0.64])
    photographs: list[Path | None] = [write_upright(tmp_path / c.name, c.pose, up) for c in cameras.cameras]
    found: list[Path | None] = []

    def read(path: Path) -> PhotographMetadata:
        found.append(path)
        return load_metadata(path)

    moved = find_world(Listener(), "in", cameras, WorldOptions(), photographs, automatic=True, read=read)
    assert moved is not None
    assert moved.world.upright
    assert found == photographs


@pytest.mark.parametrize("distance", ["", "1km", "-1m", "0", "nan"])
def test_a_length_that_is_none_is_named(distance: str) -> None:
    with pytest.raises(UsageError, match=f"the distance of `scale` is '{distance}'; allowed: .* with m, cm or mm"):
        WorldOptions(scale=f"a,b={distance}")


@pytest.mark.parametrize("text", ["1.2m", "a=1m", "a,b", ",b=1", ""])
def test_what_is_no_distance_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"allowed: gps, none, or POINT,POINT=1\.2m"):
        WorldOptions(scale=text)


@pytest.mark.parametrize(("text", "metres"), [("1.2m", 1.2), ("35 cm", 0.35), ("2", 2.0), (".5mm", 0.0005)])
def test_a_distance_scales_the_world(text: str, metres: float, cameras: Cameras) -> None:
    listener = Listener()
    options = WorldOptions(scale=f"{cameras.names[0]},{cameras.names[3]}={text}")
    moved = find_world(listener, "in", cameras, options, [])
    assert moved is not None
    eyes = moved.apply(cameras).eyes
    assert np.linalg.norm(eyes[0] - eyes[3]) == pytest.approx(metres)
    assert moved.world == World(metres=True)
    assert listener.said == [f"in: world: metres; by {metres:g} m between {cameras.names[0]} and {cameras.names[3]}"]


def test_a_name_that_is_no_camera_is_refused(cameras: Cameras) -> None:
    for name, found in (("nobody", "names no camera"), (cameras.names[0], "at the same place")):
        with pytest.raises((UsageError, InvalidScene), match=found):
            find_world(Listener(), "in", cameras, WorldOptions(scale=f"{name},{cameras.names[0]}=1m"), [])


@pytest.mark.parametrize("scale", ["gps", None])
def test_gps_gives_metres_and_the_axes(scale: str | None, cameras: Cameras, tmp_path: Path) -> None:
    listener = Listener()
    photographs = placed(tmp_path, cameras)
    moved = find_world(listener, "in", cameras, WorldOptions(scale=scale), photographs, automatic=True)
    assert moved is not None
    assert moved.world[:2] == (True, True)
    assert moved.frame.matrix[:, :3] == pytest.approx(10 * np.eye(3)[[1, 2, 0]], abs=0.1)
    (said,) = listener.said
    assert "metres, z up, x east, its origin at 46.8" in said
    assert "by the GPS positions of 10 of 10 photographs" in said


def test_few_or_rough_positions_are_used_only_if_asked(cameras: Cameras, tmp_path: Path) -> None:
    few: list[Path | None] = [*placed(tmp_path, cameras)[:2], *[None] * 8]
    assert find_world(Listener(), "in", cameras, WorldOptions(), few, automatic=True) is None
    with pytest.raises(InvalidScene, match="in 2 of 10 files; allowed: 3 or more"):
        find_world(Listener(), "in", cameras, WorldOptions(scale="gps"), few)
    random = np.random.default_rng(0)
    rough: list[Path | None] = [
        write_place(tmp_path / f"{i}", EarthPlace(*(np.array(PLACE) + random.normal(size=3) * METRE)))
        for i in range(10)
    ]
    listener = Listener()
    assert find_world(listener, "in", cameras, WorldOptions(), rough, automatic=True) is None
    assert "the GPS positions are not used" in listener.said[0]
    assert find_world(listener, "in", cameras, WorldOptions(scale="gps"), rough) is not None
    assert "warning: the GPS positions are" in listener.said[1]
    assert find_world(Listener(), "in", cameras, WorldOptions(scale="none"), placed(tmp_path, cameras)) is None


def test_gravity_tells_what_is_up(cameras: Cameras, tmp_path: Path) -> None:
    up = np.array([0.48, -0.6, 0.64])
    photographs: list[Path | None] = [write_upright(tmp_path / c.name, c.pose, up) for c in cameras.cameras]
    write_drone(tmp_path / cameras.names[4], 45, 90)  # one is wrong
    listener = Listener()
    options = WorldOptions(scale=f"{cameras.names[0]},{cameras.names[3]}=2m")
    moved = find_world(listener, "in", cameras, options, photographs, automatic=True)
    assert moved is not None
    assert moved.world == World(metres=True, upright=True)
    assert moved.frame.turn @ up == pytest.approx([0, 0, 1], abs=1e-3)
    assert "; z is up by gravity in 9 photographs, 0.0 degrees off" in listener.said[0]
    eyes = moved.apply(cameras).eyes
    assert np.linalg.norm(eyes[0] - eyes[3]) == pytest.approx(2)
    for kept in (WorldOptions(scale="none"), WorldOptions()):
        assert find_world(Listener(), "in", cameras, kept, photographs, automatic=kept.scale == "none") is None


def test_positions_tell_what_is_up_before_gravity_does(cameras: Cameras, tmp_path: Path) -> None:
    photographs = placed(tmp_path, cameras)
    for camera, path in zip(cameras.cameras, photographs, strict=True):
        assert path is not None
        packet = write_upright(tmp_path / "up.jpg", camera.pose, np.array([0, 0, 1.0]))
        with Pillow.open(packet) as turned, Pillow.open(path) as picture:
            picture.save(path, exif=picture.getexif(), xmp=turned.info["xmp"])
    listener = Listener()
    moved = find_world(listener, "in", cameras, WorldOptions(), photographs, automatic=True)
    assert moved is not None
    assert moved.frame.turn == pytest.approx(np.eye(3)[[1, 2, 0]], abs=0.01)
    assert "gravity" not in listener.said[0]


def test_directions_that_differ_are_not_gravity(cameras: Cameras, tmp_path: Path) -> None:
    photographs: list[Path | None] = [write_drone(tmp_path / c.name, 0, 40 * i) for i, c in enumerate(cameras.cameras)]
    listener = Listener()
    assert find_world(listener, "in", cameras, WorldOptions(), photographs, automatic=True) is None
    assert "in: gravity is not used: the directions of gravity differ by" in listener.said[0]
    assert "allowed: up to 5 degrees" in listener.said[0]
    few: list[Path | None] = [*photographs[:2], *[None] * 8]
    assert find_world(listener, "in", cameras, WorldOptions(), few, automatic=True) is None
    assert len(listener.said) == 1


def test_the_world_is_kept_in_transforms_json(cameras: Cameras, tmp_path: Path) -> None:
    photographs = placed(tmp_path / "drawn" / "train", cameras)
    capture = tmp_path / "drawn" / "cameras.json"
    save(capture, cameras)
    for path in photographs:
        assert path is not None
        path.with_suffix(".png").unlink(missing_ok=True)
    written = convert_cameras(capture, tmp_path / "metres.json", world=WorldOptions(scale="gps"))
    again = load(tmp_path / "metres.json", Cameras)
    assert again.world == written.world
    assert again.world.place == pytest.approx(PLACE, abs=20)
    assert np.array_equal(again.eyes, written.eyes)
    assert again.notes == (f"its world: {again.world}",)


def test_a_fit_is_in_metres(tmp_path: Path) -> None:
    capture = write_scene(tmp_path, frames=6)
    options = FitOptions(epochs="cells=8,prune=0.03/cells=8,rays=1,prune=0.02", basis="SH1")
    first, second = (camera.picture for camera in load(capture / "transforms_train.json", Cameras).cameras[:2])
    plain = fit_scene(capture, options=options)
    metres = fit_scene(capture, options=options, world=WorldOptions(scale=f"{first},{second}=100m"))
    eyes = load(capture / "transforms_train.json", Cameras).eyes
    scale = 100 / np.linalg.norm(eyes[0] - eyes[1])
    assert plain.invradius / metres.invradius == pytest.approx(np.full(3, scale), rel=1e-3)
