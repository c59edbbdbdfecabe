"""What a good engineer guesses of each tool's file, and what is true: small texts whose numbers are checked by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Camera, Cameras, load
from nerfbake.errors import NerfbakeError
from nerfbake.formats.camera import realitycapture_csv, turns
from nerfbake.formats.camera.colmap_writer import quaternion_of
from nerfbake.scene.lens import Lens
from tests.support import camera_tools as tools
from tests.support.camera_tools import placed
from tests.support.captures import Rig, rig, write_pictures
from tests.support.reprojection import reprojection_errors


@pytest.fixture(scope="module")
def made() -> Rig:
    return rig(odd=True)


def first(path: Path) -> Camera:
    return load(path, Cameras).cameras[0]


def lens_of(camera: Camera) -> tuple[tuple[float, ...], tuple[float, float]]:
    assert camera.lens is not None
    return camera.lens.k, camera.lens.p


def test_p1_and_p2_of_metashape_are_exchanged(made: Rig, tmp_path: Path) -> None:
    file = tools.write_metashape(tmp_path, made, calibration="<k1>1e-3</k1><k4>2e-3</k4><p1>3e-3</p1><p2>4e-3</p2>")
    assert lens_of(first(tmp_path / file)) == ((1e-3, 0, 0, 2e-3), (4e-3, 3e-3))


def test_a_rolling_shutter_of_metashape_is_said_with_its_pixels(made: Rig, tmp_path: Path) -> None:
    """A turn of 0.01 about z moves a corner, 7.09 and 4.5 px from the axis of a square pixel, by about 0.084 px."""
    turn = "1 -0.01 0 0.01 1 0 0 0 1"
    pose = tools.numbers(tools.camera_to_world(made.poses[0]))
    moved = f'<camera id="8" sensor_id="0" label="r_0"><transform>{pose}</transform>'
    moved += f"<rolling_shutter><rotation>{turn}</rotation></rolling_shutter></camera>"
    read = load(tmp_path / tools.write_metashape(tmp_path, made, cameras=moved), Cameras)
    (note,) = [note for note in read.notes if "rolling" in note]
    assert "by up to 0.1 px" in note
    assert "middle row" in note


def test_cameras_of_metashape_that_are_not_aligned_are_counted(made: Rig, tmp_path: Path) -> None:
    more = '<camera id="9" sensor_id="0" label="lost"/><camera id="10" sensor_id="0" master_id="1" label="slave"/>'
    read = load(tmp_path / tools.write_metashape(tmp_path, made, cameras=more), Cameras)
    assert len(read.cameras) == 3
    assert "1 camera of 4 not aligned, and left out" in read.notes
    assert any(note.startswith("1 camera of a rig left out") for note in read.notes)


def test_equal_labels_of_two_cards_get_no_picture(made: Rig, tmp_path: Path) -> None:
    pose = tools.numbers(tools.camera_to_world(made.poses[0]))
    more = f'<camera id="9" sensor_id="0" label="r_1"><transform>{pose}</transform></camera>'
    write_pictures(tmp_path / "images", made)
    read = load(tmp_path / tools.write_metashape(tmp_path, made, cameras=more), Cameras)
    assert [camera.picture for camera in read.cameras] == ["images/r_0.png", "", "images/r_2.png", ""]
    assert "warning: 2 cameras name the picture images/r_1.png, so it belongs to none of them" in read.notes


def test_other_sensors_of_metashape_are_refused(made: Rig, tmp_path: Path) -> None:
    file = tmp_path / tools.write_metashape(tmp_path, made)
    file.write_text(file.read_text().replace('label="rig" type="frame"', 'label="rig" type="fisheye"'))
    with pytest.raises(NerfbakeError, match="sensor 0 is of the type fisheye; allowed: frame or spherical"):
        load(file, Cameras)


def test_a_spherical_sensor_of_metashape_sees_all_round(made: Rig, tmp_path: Path) -> None:
    """The first pixel is behind the camera, and above it; the middle of the picture is ahead."""
    file = tmp_path / tools.write_metashape(tmp_path, made)
    file.write_text(file.read_text().replace('label="rig" type="frame"', 'label="rig" type="spherical"'))
    read = load(file, Cameras)
    camera = read.cameras[0]
    assert camera.lens == Lens("equirectangular")
    assert (camera.fx, camera.cx, camera.cy) == (made.width / (2 * np.pi), made.width / 2, made.height / 2)
    assert camera.fy == made.height / np.pi
    own = camera.rays()[1] @ camera.pose[:3, :3]
    assert own[0, 1] > 0.9
    assert own[0, 2] > 0
    assert "warning: spherical cameras are read by the manual of Metashape" in read.notes[0]


def test_the_heading_of_realitycapture_turns_clockwise() -> None:
    """Heading 90, pitch 90, roll 0 looks along +x with z up; pitch 0 looks straight down."""
    east = realitycapture_csv.turn_of_heading(90, 90, 0)
    assert -east[:, 2] == pytest.approx([1, 0, 0], abs=1e-15)
    assert east[:, 1] == pytest.approx([0, 0, 1], abs=1e-15)
    down = realitycapture_csv.turn_of_heading(0, 0, 0)
    assert -down[:, 2] == pytest.approx([0, 0, -1], abs=1e-15)


def test_omega_phi_kappa_of_realitycapture_are_not_photogrammetric() -> None:
    """Ry(kappa) Rx(phi) Rz(-omega): omega alone turns about z, clockwise."""
    turn = realitycapture_csv.turn_of_omega(90, 0, 0)
    assert turn @ [1, 0, 0] == pytest.approx([0, -1, 0], abs=1e-15)
    assert realitycapture_csv.turn_of_omega(0, 0, 90) @ [0, 0, 1] == pytest.approx([1, 0, 0], abs=1e-15)


def test_lengths_of_realitycapture_are_of_the_longer_edge(tmp_path: Path, made: Rig) -> None:
    """Portrait: 10 x 14 pixels, so f = 36 mm is 14 pixels."""
    tall = Rig(10, 14, 14.0, 14.0, 5.5, 7.0, made.poses)
    write_pictures(tmp_path / "images", tall)
    file = tmp_path / tools.write_realitycapture_csv(tmp_path, tall)
    assert ",36.0," in file.read_text()
    camera = first(file)
    assert (camera.width, camera.height, camera.fx, camera.cx) == (10, 14, 14.0, 5.5)


def test_tangential_terms_of_realitycapture_are_noted_and_division_refused(tmp_path: Path, made: Rig) -> None:
    write_pictures(tmp_path / "images", made)
    file = tmp_path / tools.write_realitycapture(tmp_path, made)
    text = file.read_text()
    file.write_text(text.replace("brown3", "brown3t2").replace(">0 0 0 0 0 0<", ">0 0 0 0 1e-3 2e-3<"))
    read = load(file, Cameras)
    assert lens_of(read.cameras[0])[1] == (2e-3, 1e-3)
    assert any("was not checked on pictures" in note for note in read.notes)
    file.write_text(text.replace("brown3", "division"))
    with pytest.raises(NerfbakeError, match="DistortionModel is division; allowed: perspective, brown3"):
        load(file, Cameras)
    file.write_text(text.replace('Skew="0"', 'Skew="0.5"'))
    with pytest.raises(NerfbakeError, match=r"Skew is 0\.5; allowed: 0"):
        load(file, Cameras)


def test_sidecars_before_the_alignment_are_no_cameras(tmp_path: Path, made: Rig) -> None:
    write_pictures(tmp_path / "images", made)
    file = tmp_path / tools.write_realitycapture(tmp_path, made)
    start, rest = file.read_text().split("<xcr:Rotation>")
    file.write_text(start + rest.split("</xcr:Rotation>")[1])
    read = load(tmp_path, Cameras)
    assert [camera.name for camera in read.cameras] == ["r_1", "r_2"]
    assert "1 sidecar without Rotation left out" in read.notes


def test_lengths_of_opensfm_are_of_the_longer_edge(tmp_path: Path, made: Rig) -> None:
    tall = Rig(10, 14, 14.0, 14.0, 5.5, 7.0, made.poses)
    camera = first(tmp_path / tools.write_opensfm(tmp_path, tall))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((14, 14, 5.5, 7))


def test_a_point_of_opensfm_is_where_its_track_says(tmp_path: Path, made: Rig) -> None:
    points = load(tmp_path / tools.write_opensfm(tmp_path, made), Cameras).points
    assert points is not None
    assert points.positions.tolist() == [tools.POINT.tolist()]
    assert points.pixel.tolist() == [[7 + 14 * 0.125, 5 - 14 * 0.25]]
    assert (points.camera.tolist(), points.point.tolist()) == ([0], [0])


@pytest.mark.parametrize("kind", ["fisheye62", "fisheye624", "dual", "spherical"])
def test_other_lenses_of_opensfm_are_refused(kind: str, tmp_path: Path, made: Rig) -> None:
    file = tmp_path / tools.write_opensfm(tmp_path, made)
    file.write_text(file.read_text().replace('"brown"', f'"{kind}"'))
    with pytest.raises(NerfbakeError, match=f"projection_type is {kind}; allowed: perspective"):
        load(file, Cameras)


def test_the_largest_reconstruction_of_opensfm_is_read(tmp_path: Path, made: Rig) -> None:
    file = tmp_path / tools.write_opensfm(tmp_path, made)
    (whole,) = json.loads(file.read_text())
    file.write_text(json.dumps([{**whole, "shots": dict(list(whole["shots"].items())[:1])}, whole]))
    read = load(file, Cameras)
    assert len(read.cameras) == 3
    assert read.notes == ("reads the largest of 2 reconstructions, with 3 shots",)


@pytest.mark.parametrize("version", [(1, 0, 0), (1, 2, 0), (1, 2, 1), (1, 2, 2), (1, 2, 4), (1, 2, 5), (1, 2, 9)])
def test_every_version_of_meshroom_has_the_same_intrinsics(version: tuple[int, int, int], tmp_path: Path) -> None:
    made = rig(odd=version >= (1, 2, 0))
    camera = first(tmp_path / tools.write_meshroom(tmp_path, made, version))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(
        (made.fx, made.fy, made.cx, made.cy), rel=1e-14
    )


def test_lenses_of_meshroom(tmp_path: Path, made: Rig) -> None:
    values = ["1e-3", "2e-3", "3e-3", "4e-3", "5e-3"]
    file = tools.write_meshroom(tmp_path, made, type="brown", distortionParams=values)
    assert lens_of(first(tmp_path / file)) == ((1e-3, 2e-3, 3e-3), (4e-3, 5e-3))
    newer: dict[str, Any] = {"type": "pinhole", "distortionType": "radialk3", "distortionParams": values[:3]}
    assert lens_of(first(tmp_path / tools.write_meshroom(tmp_path, made, **newer)))[0] == (1e-3, 2e-3, 3e-3)
    file = tools.write_meshroom(tmp_path, made, type="3deanamorphic4", distortionParams=values)
    with pytest.raises(NerfbakeError, match="the lens is 3deanamorphic4; allowed: none, pinhole, radial1"):
        load(tmp_path / file, Cameras)


def test_r_of_an_nvm_is_minus_k1_and_that_is_said(tmp_path: Path, made: Rig) -> None:
    plain = tools.kept_by("nvm", made)
    write_pictures(tmp_path / "images", plain)
    read = load(tmp_path / tools.write_nvm(tmp_path, plain, 0.06), Cameras)
    assert lens_of(read.cameras[0])[0] == (-0.06,)
    assert any("VisualSFM's manual defines it the other way round" in note for note in read.notes)
    assert read.points is not None
    assert read.points.pixel.tolist() == [[9.5, 4.25], [1, 2]]


def test_places_of_an_nvm_may_count_from_the_middle_downwards(tmp_path: Path, made: Rig) -> None:
    """TheiaSfM writes them so; COLMAP, whose file the test above has, counts from the corner."""
    plain = tools.kept_by("nvm", made)
    write_pictures(tmp_path / "images", plain)
    seen = "3 0 5 2.5 -0.75 2 6 -6 -3 1 7 1.5 2.5"
    read = load(tmp_path / tools.write_nvm(tmp_path, plain, seen=seen), Cameras)
    assert any("count from the middle of a picture" in note for note in read.notes)
    assert read.points is not None
    middle = np.array([plain.width, plain.height]) / 2
    assert (read.points.pixel - middle).tolist() == [[2.5, -0.75], [-6, -3], [1.5, 2.5]]
    plainly = load(tmp_path / tools.write_nvm(tmp_path, plain, seen="0"), Cameras)
    assert (plainly.notes, plainly.points is not None) == ((), True)


def test_places_of_bundler_count_from_the_middle_upwards(tmp_path: Path, made: Rig) -> None:
    plain = tools.kept_by("bundler", made)
    write_pictures(tmp_path / "images", plain)
    read = load(tmp_path / tools.write_bundler(tmp_path, plain), Cameras)
    assert read.notes == ("1 camera of 4 without a pose left out",)
    assert read.points is not None
    assert read.points.camera.tolist() == [0]  # camera 1 of the file; camera 0 has no pose
    assert read.points.pixel.tolist() == [[7 + 1.5, 5 + 2.5]]


def test_openmvg_counts_from_the_centre_of_the_first_pixel(tmp_path: Path, made: Rig) -> None:
    read = load(tmp_path / tools.write_openmvg(tmp_path, tools.kept_by("openmvg", made)), Cameras)
    assert read.points is not None
    assert read.points.pixel.tolist() == [[4.5, 2.5]]
    assert '"principal_point": [5.625, 5.0]' in (tmp_path / "sfm_data.json").read_text()
    assert (read.cameras[0].cx, read.cameras[0].cy) == (6.125, 5.5)


def test_a_picture_of_another_size_is_refused_for_mvsnet(tmp_path: Path, made: Rig) -> None:
    file = tmp_path / tools.write_mvsnet(tmp_path, made)
    write_pictures(tmp_path / "images", Rig(56, 40, 1, 1, 1, 1, made.poses))
    with pytest.raises(NerfbakeError, match=r"has its principal point at 6\.125, 5\.5 in a picture of 56x40"):
        load(file, Cameras)


def test_a_picture_of_tum_without_a_pose_in_time_is_left_out(tmp_path: Path, made: Rig) -> None:
    write_pictures(tmp_path / "images", made)
    file = tmp_path / tools.write_tum(tmp_path, made)
    rows = (tmp_path / "rgb.txt").read_text().splitlines()
    (tmp_path / "rgb.txt").write_text("\n".join([*rows[:-1], "1311868199.5 images/r_2.png"]))
    assert [camera.name for camera in load(file, Cameras).cameras] == ["r_0", "r_1"]


def test_cameras_json_is_whose_shape_it_has(tmp_path: Path, made: Rig) -> None:
    """3DGS writes a list; OpenDroneMap's file of this name has intrinsics alone."""
    tools.write_opendronemap(tmp_path, made)
    with pytest.raises(NerfbakeError, match="frames are missing"):
        load(tmp_path / "cameras.json", Cameras)
    assert load(tmp_path, Cameras).dialect == "OpenDroneMap"


def test_polycam_without_corrected_pictures_says_that_they_are_distorted(tmp_path: Path, made: Rig) -> None:
    file = tools.write_polycam(tmp_path, made)
    keyframes = tmp_path / "keyframes"
    for old, new in (("corrected_cameras", "cameras"), ("corrected_images", "images")):
        (keyframes / old).rename(keyframes / new)
    read = load(tmp_path / file.replace("corrected_", ""), Cameras)
    assert read.cameras[0].picture == "keyframes/images/r_0.png"
    assert any("their distortion is in no file" in note for note in read.notes)


def test_polycam_of_2025_leaves_the_size_to_the_corrected_picture(tmp_path: Path, made: Rig) -> None:
    file = tmp_path / tools.write_polycam(tmp_path, made)
    whole = load(file, Cameras)
    for path in file.parent.iterdir():
        fields = json.loads(path.read_text())
        del fields["width"], fields["height"]
        path.write_text(json.dumps(fields))
    read = load(file, Cameras)
    assert {(camera.width, camera.height) for camera in read.cameras} == {(made.width, made.height)}
    assert [camera.focal for camera in read.cameras] == [camera.focal for camera in whole.cameras]
    (tmp_path / "keyframes/corrected_images/r_0.png").unlink()
    with pytest.raises(NerfbakeError, match=r"r_0\.json: width is missing"):
        load(file, Cameras)


def test_test_frames_of_scannet_are_held_out(tmp_path: Path) -> None:
    frame = {"file_path": "a.jpg", "transform_matrix": np.eye(4).tolist()}
    fields = {"w": 4, "h": 3, "fl_x": 5.0, "frames": [frame, frame], "test_frames": [{**frame, "file_path": "b.jpg"}]}
    read = load(tmp_path / placed(tmp_path, "transforms.json", json.dumps(fields)), Cameras)
    assert [camera.picture for camera in read.cameras] == ["a.jpg", "a.jpg", "b.jpg"]
    assert read.held_out == (2,)


def test_p_is_taken_apart_whatever_its_sign_and_scale() -> None:
    """K = [[2, 0.5, 3], [0, 4, 5], [0, 0, 1]], a quarter turn about x, C = (1, 2, 3)."""
    K = np.array([[2, 0.5, 3], [0, 4, 5], [0, 0, 1]])
    R = turns.turn_about(0, 90)
    C = np.array([1.0, 2, 3])
    for times in (1.0, -7.0, 1e-6):
        found = turns.taken_apart(times * K @ np.column_stack([R, -R @ C]), "P")
        for one, other in zip(found, (K, R, C), strict=True):
            assert np.abs(one - other).max() < 1e-12


def test_rotations_agree_with_each_other() -> None:
    for axis in range(3):
        turn = turns.turn_about(axis, 30)
        half = math.radians(15)
        q = [math.cos(half), *(math.sin(half) * (i == axis) for i in range(3))]
        assert turns.turn_of_quaternion(q[0], q[1], q[2], q[3], "") == pytest.approx(turn, abs=1e-15)
        assert turns.turn_of_axis_angle(*(math.radians(30) * (i == axis) for i in range(3))) == pytest.approx(
            turn, abs=1e-15
        )
        assert quaternion_of(turn) == pytest.approx(q, abs=1e-15)
    assert turns.turn_about(2, 90) @ [1, 0, 0] == pytest.approx([0, 1, 0], abs=1e-15)
    assert turns.turn_of_axis_angle(0, 0, 0).tolist() == np.eye(3).tolist()


def test_a_model_that_is_written_has_its_points_where_they_were(tmp_path: Path, made: Rig) -> None:
    """Observations at the exact places: their errors are rounding."""
    read = load(tmp_path / tools.write_openmvg(tmp_path, tools.kept_by("openmvg", made)), Cameras)
    assert read.points is not None
    errors = reprojection_errors(read)
    camera = read.cameras[0]
    seen = (tools.POINT - camera.pose[:3, 3]) @ camera.pose[:3, :3] * [1, -1, -1]
    wanted = seen[:2] / seen[2] * camera.fx + [camera.cx, camera.cy]
    assert errors == pytest.approx([float(np.hypot(*(wanted - [4.5, 2.5])))], rel=1e-12)


def test_a_scene_with_meshes_is_one_of_cameras_only_if_these_are_wanted(made: Rig, tmp_path: Path) -> None:
    file = tmp_path / tools.write_gltf(tmp_path, made)
    document = json.loads(file.read_text())
    assert isinstance(load(file), Cameras)
    document["meshes"] = []
    file.write_text(json.dumps(document))
    assert load(file, Cameras).dialect == "glTF"
    with pytest.raises(NerfbakeError, match="no known format"):
        load(file)
    document["cameras"][0]["type"] = "orthographic"
    file.write_text(json.dumps(document))
    with pytest.raises(NerfbakeError, match="has no node with a perspective camera"):
        load(file, Cameras)


def test_cameras_may_stand_behind_the_data_of_a_gltf(made: Rig, tmp_path: Path) -> None:
    """VTK sorts the keys: accessors, asset, buffers, cameras."""
    file = tmp_path / tools.write_gltf(tmp_path, made)
    document = json.loads(file.read_text())
    size = 99_999
    document["buffers"] = [{"byteLength": size, "uri": "data:application/octet-stream;base64," + "AAAA" * (size // 3)}]
    file.write_text(json.dumps(document, sort_keys=True))
    assert len(load(file, Cameras).cameras) == len(made.poses)


def test_yfov_is_that_of_the_height(made: Rig, tmp_path: Path) -> None:
    """90 degrees over 800 pixels: a focal length of 400. Without pictures, the size is assumed, and a note says so."""
    file = tmp_path / tools.write_gltf(tmp_path, made)
    document = json.loads(file.read_text())
    document["cameras"][0]["perspective"] = {"yfov": np.pi / 2, "aspectRatio": 1.5, "znear": 0.1}
    file.write_text(json.dumps(document))
    read = load(file, Cameras)
    camera = read.cameras[0]
    assert (camera.width, camera.height) == (1200, 800)
    assert (camera.fx, camera.fy) == pytest.approx((400, 400))
    assert read.notes == ("3 of 3 cameras tell no size of a picture; 800 pixels along the height are assumed",)


def test_cameras_that_an_animation_moves_are_noted(made: Rig, tmp_path: Path) -> None:
    """As Blender writes a camera with keyframes; its node has the pose of one frame."""
    file = tmp_path / tools.write_gltf(tmp_path, made)
    document = json.loads(file.read_text())
    cameras = [index for index, node in enumerate(document["nodes"]) if "camera" in node]
    document["nodes"].append({"children": [cameras[1]]})
    above = len(document["nodes"]) - 1
    roots = document["scenes"][0]["nodes"]
    document["scenes"][0]["nodes"] = [above if index == cameras[1] else index for index in roots]
    for targets, count in (
        ([], 0),
        ([{"node": cameras[0], "path": "weights"}, {"node": 99, "path": "scale"}, {"node": [0], "path": "scale"}], 0),
        ([{"node": cameras[0], "path": "rotation"}], 1),
        ([{"node": cameras[0], "path": "rotation"}, {"node": above, "path": "translation"}, {"path": "scale"}], 2),
    ):
        document["animations"] = [{"channels": [{"sampler": 0, "target": target} for target in targets]}]
        file.write_text(json.dumps(document))
        said = (f"animations are not read, which move {count} of 3 cameras",) if count else ()
        assert load(file, Cameras).notes[1:] == said


def test_an_aspect_ratio_other_than_that_of_the_picture_is_noted(made: Rig, tmp_path: Path) -> None:
    """As trimesh writes it, which divides the angles."""
    file = tmp_path / tools.write_gltf(tmp_path, made)
    tools.write_picture(tmp_path / f"{made.names[0]}.png", made)
    assert load(file, Cameras).notes[1:] == ()
    document = json.loads(file.read_text())
    document["cameras"][0]["perspective"]["aspectRatio"] /= 1.25
    file.write_text(json.dumps(document))
    read = load(file, Cameras)
    camera = next(each for each in read.cameras if each.width == made.width)
    assert camera.fx / camera.fy == pytest.approx(1.25)
    told = "1 of 3 cameras have another aspectRatio than their pictures, so that pixels are not square"
    assert read.notes[-1] == told


def test_the_lens_and_the_times_of_euroc(made: Rig, tmp_path: Path) -> None:
    file = tmp_path / tools.write_euroc(tmp_path, made)
    sensor = file.parents[1] / "cam0" / "sensor.yaml"
    text = sensor.read_text().replace("[0.0, 0.0, 0.0, 0.0]", "[-0.28, 0.07, 0.0002, 1.7e-05]")
    sensor.write_text(text)
    assert load(file, Cameras).cameras[0].lens == Lens("polynomial", (-0.28, 0.07), (0.0002, 1.7e-05))
    sensor.write_text(text.replace("radial-tangential", "equidistant"))
    assert load(tmp_path, Cameras).cameras[0].lens == Lens("fisheye", (-0.28, 0.07, 0.0002, 1.7e-05))
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:2], *lines[3:]]) + "\n")
    read = load(file, Cameras)
    assert len(read.cameras) == 2
    assert read.notes == ("1 picture without a pose within 20 ms left out",)
    sensor.write_text(text.replace("pinhole", "omni"))
    with pytest.raises(NerfbakeError, match="is of the model omni with the distortion radial-tangential; allowed"):
        load(file, Cameras)
