"""Write a rig in the camera files of other tools. The writers follow the page of each format, not our readers."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.support.captures import Rig, quaternion, world_to_camera, write_pictures

Floats = npt.NDArray[np.float64]
Writer = Callable[[Path, Rig], str]  # returns the path of the file in the capture


def camera_to_world(pose: Floats) -> Floats:
    """(4, 4) in OpenCV's axes."""
    return np.asarray(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))


def numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def axis_angle(turn: Floats) -> list[float]:
    w, x, y, z = quaternion(turn)
    angle = 2 * math.atan2(math.sqrt(x * x + y * y + z * z), w)
    axis = np.array([x, y, z]) / (math.sin(angle / 2) or 1)
    return [float(value) for value in axis * angle]


def placed(folder: Path, path: str, content: str | bytes) -> str:
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    (folder / path).write_bytes(content.encode() if isinstance(content, str) else content)
    return path


SCALE, TURN, SHIFT = 2.5, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([3.0, -2.0, 1.0])


def metashape_chunk(made: Rig, *, calibration: str = "", cameras: str = "") -> str:
    """A chunk whose component is turned, scaled and moved, with b1 for the other focal length."""
    shots = ""
    for i, (name, pose) in enumerate(zip(made.names, made.poses, strict=True)):
        world, inside = camera_to_world(pose), np.eye(4)
        inside[:3, :3] = TURN.T @ world[:3, :3]
        inside[:3, 3] = TURN.T @ (world[:3, 3] - SHIFT) / SCALE
        shots += f'<camera id="{i}" sensor_id="0" component_id="7" label="{name}">'
        shots += f"<transform>{numbers(inside)}</transform></camera>\n"
    off = made.cx - made.width / 2, made.cy - made.height / 2
    return f"""<chunk label="Chunk 1" enabled="true">
 <sensors><sensor id="0" label="rig" type="frame"><resolution width="{made.width}" height="{made.height}"/>
  <calibration type="frame" class="initial"><f>1</f></calibration>
  <calibration type="frame" class="adjusted"><resolution width="{made.width}" height="{made.height}"/>
   <f>{made.fy!r}</f><cx>{off[0]!r}</cx><cy>{off[1]!r}</cy><b1>{made.fx - made.fy!r}</b1>{calibration}</calibration>
 </sensor></sensors>
 <components><component id="7"><transform><rotation>{numbers(TURN)}</rotation>
  <translation>{numbers(SHIFT)}</translation><scale>{SCALE!r}</scale></transform></component></components>
 <cameras><group id="0" label="a group">{shots}</group>{cameras}</cameras>
</chunk>
"""


_XML = "<?xml version='1.0' encoding='UTF-8'?>\n"


def write_metashape(folder: Path, made: Rig, **more: str) -> str:
    chunk = metashape_chunk(made, **more)
    return placed(folder, "cameras.xml", f'{_XML}<document version="1.5.0">\n{chunk}</document>\n')


def write_metashape_project(folder: Path, made: Rig) -> str:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("doc.xml", _XML + metashape_chunk(made))
    placed(folder, "scan.files/0/chunk.zip", stream.getvalue())
    return placed(folder, "scan.psx", f'{_XML}<document version="1.2.0" path="{{projectname}}.files/project.zip"/>\n')


def write_realitycapture(folder: Path, made: Rig) -> str:
    edge = max(made.width, made.height)
    for name, pose in zip(made.names, made.poses, strict=True):
        turn, _ = world_to_camera(pose)
        content = f"""<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description xcr:Version="3" xcr:DistortionModel="brown3" xcr:FocalLength35mm="{made.fx / edge * 36!r}"
   xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="{(made.cx - made.width / 2) / edge!r}"
   xcr:PrincipalPointV="{(made.cy - made.height / 2) / edge!r}" xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
   <xcr:Rotation>{numbers(turn)}</xcr:Rotation>
   <xcr:Position>{numbers(pose[:3, 3])}</xcr:Position>
   <xcr:DistortionCoeficients>0 0 0 0 0 0</xcr:DistortionCoeficients>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
"""
        placed(folder, f"images/{name}.xmp", content)
    return f"images/{made.names[0]}.xmp"


def write_realitycapture_csv(folder: Path, made: Rig) -> str:
    """Heading, pitch and roll of Rz(-h) Rx(p) Ry(r)."""
    edge, lines = (
        max(made.width, made.height),
        ["#cameras 3", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"],
    )
    for name, pose in zip(made.names, made.poses, strict=True):
        R = pose[:3, :3]
        pitch = math.asin(R[2, 1])
        heading, roll = math.atan2(R[0, 1], R[1, 1]), math.atan2(-R[2, 0], R[2, 2])
        angles = [math.degrees(angle) for angle in (heading, pitch, roll)]
        inside = [made.fx / edge * 36, (made.cx - made.width / 2) / edge, (made.cy - made.height / 2) / edge]
        values = [*pose[:3, 3], *angles, *inside, *[0.0] * 6]
        lines.append(",".join([f"{name}.png", *(repr(float(value)) for value in values)]))
    return placed(folder, "export.csv", "\n".join(lines) + "\n")


def write_gaussians(folder: Path, made: Rig) -> str:
    entries = []
    for i, (name, pose) in enumerate(zip(made.names, made.poses, strict=True)):
        world = camera_to_world(pose)
        fields = {"id": i, "img_name": name, "width": made.width, "height": made.height}
        fields |= {"position": world[:3, 3].tolist(), "rotation": world[:3, :3].tolist(), "fx": made.fx, "fy": made.fy}
        entries.append(fields)
    return placed(folder, "cameras.json", json.dumps(entries))


def write_polycam(folder: Path, made: Rig) -> str:
    write_pictures(folder / "keyframes" / "corrected_images", made)
    for name, pose in zip(made.names, made.poses, strict=True):
        fields = {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
        fields |= {"fx": made.fx, "fy": made.fy, "cx": made.cx, "cy": made.cy}
        fields |= {"width": made.width, "height": made.height, "blur_score": 142.1}
        placed(folder, f"keyframes/corrected_cameras/{name}.json", json.dumps(fields))
    return f"keyframes/corrected_cameras/{made.names[0]}.json"


def write_record3d(folder: Path, made: Rig) -> str:
    poses = []
    for i, pose in enumerate(made.poses):
        w, x, y, z = quaternion(pose[:3, :3])
        poses.append([x, y, z, w, *pose[:3, 3]])
        write_picture(folder / "rgb" / f"{i}.png", made)
    K = [made.fx, 0, 0, 0, made.fy, 0, made.cx, made.cy, 1]
    fields = {"w": made.width, "h": made.height, "fps": 30, "K": K, "poses": poses, "initPose": [0, 0, 0, 1, 9, 9, 9]}
    return placed(folder, "metadata.json", json.dumps(fields))


def write_picture(path: Path, made: Rig) -> None:
    from PIL import Image as Pillow

    path.parent.mkdir(parents=True, exist_ok=True)
    Pillow.new("RGB", (made.width, made.height)).save(path)


def _opensfm_camera(made: Rig) -> dict[str, Any]:
    edge = max(made.width, made.height)
    fields: dict[str, Any] = {"projection_type": "brown", "width": made.width, "height": made.height}
    fields |= {
        "focal_x": made.fx / edge,
        "focal_y": made.fy / edge,
        "k1": 0.0,
        "k2": 0.0,
        "k3": 0.0,
        "p1": 0.0,
        "p2": 0.0,
    }
    return fields | {"c_x": (made.cx - made.width / 2) / edge, "c_y": (made.cy - made.height / 2) / edge}


POINT = np.array([0.25, -0.5, 0.125])


def write_opensfm(folder: Path, made: Rig) -> str:
    shots = {}
    for name, pose in zip(made.names, made.poses, strict=True):
        turn, shift = world_to_camera(pose)
        shots[f"{name}.png"] = {"rotation": axis_angle(turn), "translation": shift.tolist(), "camera": "v2 rig"}
    points = {"5": {"coordinates": POINT.tolist(), "color": [1.0, 2.0, 3.0]}}
    whole = [{"cameras": {"v2 rig": _opensfm_camera(made)}, "shots": shots, "points": points}]
    placed(folder, "tracks.csv", "OPENSFM_TRACKS_VERSION_v1\nr_0.png\t5\t1\t0.125\t-0.25\t0.001\t1\t2\t3\n")
    return placed(folder, "reconstruction.json", json.dumps(whole))


def write_opendronemap(folder: Path, made: Rig) -> str:
    features = []
    for name, pose in zip(made.names, made.poses, strict=True):
        turn, _ = world_to_camera(pose)
        shot = {"filename": f"{name}.png", "camera": "v2 rig", "width": made.width, "height": made.height}
        shot |= {"rotation": axis_angle(turn), "translation": pose[:3, 3].tolist()}
        features.append(
            {"type": "Feature", "properties": shot, "geometry": {"type": "Point", "coordinates": [2.1, 41, 9]}}
        )
    placed(folder, "cameras.json", json.dumps({"rig": _opensfm_camera(made)}))
    return placed(folder, "odm_report/shots.geojson", json.dumps({"type": "FeatureCollection", "features": features}))


def write_meshroom(folder: Path, made: Rig, version: tuple[int, int, int] = (1, 2, 6), **inside: Any) -> str:
    """Numbers are texts. What the fields of an intrinsic mean depends on the version."""
    sensor, views, poses = 36.0, [], []
    for i, (name, pose) in enumerate(zip(made.names, made.poses, strict=True)):
        turn, _ = world_to_camera(pose)
        views.append(
            {"viewId": str(100 + i), "poseId": str(200 + i), "intrinsicId": "9", "path": f"C:\\scan\\{name}.png"}
        )
        transform = {
            "rotation": [repr(float(v)) for v in turn.T.ravel()],
            "center": [repr(float(v)) for v in pose[:3, 3]],
        }
        poses.append({"poseId": str(200 + i), "pose": {"transform": transform, "locked": "0"}})
    middle = (0.0, 0.0) if version < (1, 2, 1) else (made.width / 2, made.height / 2)
    principal = numbers([made.cx - middle[0], made.cy - middle[1]]).split()
    fields: dict[str, Any] = {"intrinsicId": "9", "width": str(made.width), "height": str(made.height)}
    fields |= {"type": "radial3", "principalPoint": principal, "distortionParams": ["0", "0", "0"]}
    if version < (1, 2, 0):
        fields["pxFocalLength"] = repr(made.fx)
    elif version < (1, 2, 2):
        fields["pxFocalLength"] = [repr(made.fx), repr(made.fy)]
    else:
        ratio = made.fx / made.fy if version < (1, 2, 5) else made.fy / made.fx
        fields |= {
            "sensorWidth": repr(sensor),
            "focalLength": repr(made.fx * sensor / made.width),
            "pixelRatio": repr(ratio),
        }
    whole = {
        "version": [str(part) for part in version],
        "views": views,
        "intrinsics": [fields | inside],
        "poses": poses,
    }
    return placed(folder, "cameras.sfm", json.dumps(whole))


def write_neus(folder: Path, made: Rig) -> str:
    """P is scaled by a negative number, which must not matter; camera_mat is not K."""
    arrays: dict[str, Floats] = {}
    K = np.array([[made.fx, 0, made.cx], [0, made.fy, made.cy], [0, 0, 1]])
    for i, pose in enumerate(made.poses):
        turn, shift = world_to_camera(pose)
        P = np.eye(4)
        P[:3] = -2.0 * K @ np.column_stack([turn, shift])
        arrays |= {f"world_mat_{i}": P, f"scale_mat_{i}": 3 * np.eye(4), f"camera_mat_{i}": np.eye(4)}
    for i in range(len(made.poses)):
        write_picture(folder / "image" / f"{i:06d}.png", made)
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    return placed(folder, "cameras_sphere.npz", stream.getvalue())


def write_bundler(folder: Path, made: Rig) -> str:
    lines = ["# Bundle file v0.3", f"{len(made.poses) + 1} 1"]
    for pose in [None, *made.poses]:
        if pose is None:  # not registered
            lines += ["0 0 0", "0 0 0", "0 0 0", "0 0 0", "0 0 0"]
            continue
        turn = pose[:3, :3].T  # axes right, up, back are OpenGL's
        shift = -turn @ pose[:3, 3]
        lines += [f"{made.fx!r} 0 0", *(numbers(row) for row in turn), numbers(shift)]
    lines += [numbers(POINT), "1 2 3", "2 0 5 9 9 1 7 1.5 -2.5"]
    placed(
        folder, "list.txt", "\n".join(["images/none.png", *(f"images/{name}.png 0 532" for name in made.names)]) + "\n"
    )
    return placed(folder, "bundle.out", "\n".join(lines) + "\n")


def write_nvm(folder: Path, made: Rig, r: float = 0.0, seen: str = "2 0 5 9.5 4.25 2 6 1 2") -> str:
    lines = ["NVM_V3", "", f"{len(made.poses)}"]
    for name, pose in zip(made.names, made.poses, strict=True):
        turn, _ = world_to_camera(pose)
        lines.append(f"images/{name}.png\t{made.fx!r} {numbers(quaternion(turn))} {numbers(pose[:3, 3])} {r!r} 0")
    lines += ["", "1", f"{numbers(POINT)} 1 2 3 {seen}", "0"]
    return placed(folder, "scan.nvm", "\n".join(lines) + "\n")


def write_openmvg(folder: Path, made: Rig) -> str:
    """(0, 0) is the centre of the first pixel. The second intrinsic names its class by the id alone."""
    views, poses = [], []
    for i, (name, pose) in enumerate(zip(made.names, made.poses, strict=True)):
        turn, _ = world_to_camera(pose)
        data = {"local_path": "", "filename": f"{name}.png", "width": made.width, "height": made.height}
        data |= {"id_view": i, "id_intrinsic": i % 2, "id_pose": i}
        views.append({"key": i, "value": {"polymorphic_id": 1 << 30, "ptr_wrapper": {"id": 7 + i, "data": data}}})
        poses.append({"key": i, "value": {"rotation": turn.tolist(), "center": pose[:3, 3].tolist()}})
    inside: dict[str, Any] = {"width": made.width, "height": made.height, "focal_length": made.fx}
    inside |= {"principal_point": [made.cx - 0.5, made.cy - 0.5]}
    first = {"polymorphic_id": (1 << 31) + 1, "polymorphic_name": "pinhole_radial_k3"}
    classes = [first | {"ptr_wrapper": {"data": {**inside, "disto_k3": [0, 0, 0]}}}]
    classes.append({"polymorphic_id": 1, "ptr_wrapper": {"data": {"value0": inside, "disto_k3": [0, 0, 0]}}})
    seen = [{"key": 0, "value": {"id_feat": 3, "x": [4.0, 2.0]}}]
    structure = [{"key": 0, "value": {"X": POINT.tolist(), "observations": seen}}]
    whole = {"sfm_data_version": "0.3", "root_path": "/capture", "views": views}
    whole |= {"intrinsics": [{"key": i, "value": value} for i, value in enumerate(classes)]}
    return placed(folder, "sfm_data.json", json.dumps(whole | {"extrinsics": poses, "structure": structure}))


def write_mvsnet(folder: Path, made: Rig) -> str:
    for name, pose in zip(made.names, made.poses, strict=True):
        turn, shift = world_to_camera(pose)
        rows = "\n".join(numbers(row) for row in np.column_stack([turn, shift]))
        K = f"{made.fx!r} 0 {made.cx!r}\n0 {made.fy!r} {made.cy!r}\n0 0 1"
        placed(folder, f"cams/{name}_cam.txt", f"extrinsic\n{rows}\n0 0 0 1\n\nintrinsic\n{K}\n\n425.0 2.5\n")
    return f"cams/{made.names[0]}_cam.txt"


def _intrinsics(folder: Path, made: Rig) -> None:
    placed(folder, "intrinsics.txt", f"{made.fx!r} 0 {made.cx!r}\n0 {made.fy!r} {made.cy!r}\n0 0 1\n")


def write_tum(folder: Path, made: Rig) -> str:
    _intrinsics(folder, made)
    lines, pictures = ["# timestamp tx ty tz qx qy qz qw"], ["# timestamp filename"]
    for i, (name, pose) in enumerate(zip(made.names, made.poses, strict=True)):
        w, x, y, z = quaternion(camera_to_world(pose)[:3, :3])
        lines.append(f"{1311868163.0 + i:.4f} {numbers(pose[:3, 3])} {numbers([x, y, z, w])}")
        pictures.append(f"{1311868163.0 + i + 0.01:.4f} images/{name}.png")
    placed(folder, "rgb.txt", "\n".join(pictures) + "\n")
    return placed(folder, "groundtruth.txt", "\n".join(lines) + "\n")


def write_kitti(folder: Path, made: Rig) -> str:
    P = np.array([[made.fx, 0, made.cx, 0], [0, made.fy, made.cy, 0], [0, 0, 1, 0]])
    placed(folder, "calib.txt", f"P0: {numbers(P)}\nP1: {numbers(P + 1)}\n")
    lines = [numbers(camera_to_world(pose)[:3]) for pose in made.poses]
    return placed(folder, "00.txt", "\n".join(lines) + "\n")


def write_seven_scenes(folder: Path, made: Rig) -> str:
    _intrinsics(folder, made)
    for name, pose in zip(made.names, made.poses, strict=True):
        placed(folder, f"{name}.pose.txt", "\n".join(numbers(row) for row in camera_to_world(pose)) + "\n")
        write_picture(folder / f"{name}.color.png", made)
    return f"{made.names[0]}.pose.txt"


def write_open3d(folder: Path, made: Rig) -> str:
    _intrinsics(folder, made)
    lines = []
    for i, pose in enumerate(made.poses):
        lines += [f"{i}\t{i}\t{i + 1}", *(numbers(row) for row in camera_to_world(pose))]
    return placed(folder, "trajectory.log", "\n".join(lines) + "\n")


def write_open3d_json(folder: Path, made: Rig) -> str:
    entries = []
    for pose in made.poses:
        turn, shift = world_to_camera(pose)
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([turn, shift])
        K = np.array([[made.fx, 0, made.cx], [0, made.fy, made.cy], [0, 0, 1]])
        inside = {"width": made.width, "height": made.height, "intrinsic_matrix": K.T.ravel().tolist()}
        entries.append(
            {"class_name": "PinholeCameraParameters", "extrinsic": matrix.T.ravel().tolist(), "intrinsic": inside}
        )
    return placed(
        folder, "trajectory.json", json.dumps({"class_name": "PinholeCameraTrajectory", "parameters": entries})
    )


def write_kapture(folder: Path, made: Rig) -> str:
    """The first picture is taken by a sensor of a rig, half a unit beside it."""
    inside = f"PINHOLE, {made.width}, {made.height}, {made.fx!r}, {made.fy!r}, {made.cx!r}, {made.cy!r}"
    records, poses = ["# kapture format: 1.1"], ["# kapture format: 1.1"]
    for i, (name, pose) in enumerate(zip(made.names, made.poses, strict=True)):
        turn, shift = world_to_camera(pose)
        shift = shift - [0.5, 0, 0] if i == 0 else shift
        device = "rig" if i == 0 else "other"
        poses.append(f"{i}, {device}, {numbers([*quaternion(turn), *shift]).replace(' ', ', ')}")
        records.append(f"{i}, {'left' if i == 0 else 'other'}, {name}.png")
        write_picture(folder / "sensors" / "records_data" / f"{name}.png", made)
    placed(folder, "sensors/records_camera.txt", "\n".join(records) + "\n")
    placed(folder, "sensors/trajectories.txt", "\n".join(poses) + "\n")
    placed(folder, "sensors/rigs.txt", "# kapture format: 1.1\nrig, left, 1, 0, 0, 0, 0.5, 0, 0\n")
    sensors = [f"{name}, , camera, {inside}" for name in ("left", "other")]
    return placed(
        folder, "sensors/sensors.txt", "\n".join(["# kapture format: 1.1", *sensors, "gps, , gnss, EPSG:4326"]) + "\n"
    )


# By the module of the reader: how it is written, and whether it keeps two focal lengths and a principal point.
BODY = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])  # EuRoC's T_BS


def write_euroc(folder: Path, made: Rig) -> str:
    """The body is where the camera is not; the last row of the ground truth belongs to no picture."""
    write_pictures(folder / "mav0" / "cam0" / "data", made)
    rows, shots = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], ..."], ["#t,filename"]
    for i, (name, pose) in enumerate(zip(made.names, made.poses, strict=True)):
        body = camera_to_world(pose) @ np.linalg.inv(BODY)
        time = 1403636579763555584 + i * 50_000_000
        rows.append(
            ",".join([str(time + 2_000_000), *map(repr, map(float, [*body[:3, 3], *quaternion(body[:3, :3])]))])
        )
        shots.append(f"{time},{name}.png")
    rows.append("1403636999000000000,0,0,0,1,0,0,0")
    data = ", ".join(repr(float(value)) for value in BODY.ravel())
    sensor = f"""#Default camera sensor yaml file
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{data}]
resolution: [{made.width}, {made.height}]
camera_model: pinhole
intrinsics: [{made.fx!r}, {made.fy!r}, {made.cx!r}, {made.cy!r}]
distortion_model: radial-tangential
distortion_coefficients: [0.0, 0.0, 0.0, 0.0]
"""
    placed(folder, "mav0/cam0/sensor.yaml", sensor)
    placed(folder, "mav0/cam0/data.csv", "\n".join(shots) + "\n")
    return placed(folder, "mav0/state_groundtruth_estimate0/data.csv", "\n".join(rows) + "\n")


def write_gltf(folder: Path, made: Rig) -> str:
    """Cameras below a node that turns, and one without a node."""
    above = np.eye(4)
    above[:3, :3], above[:3, 3] = TURN, SHIFT
    nodes: list[dict[str, Any]] = [
        {"children": [1 + i for i in range(len(made.poses))], "matrix": above.T.ravel().tolist()}
    ]
    for name, pose in zip(made.names, made.poses, strict=True):
        inside = np.linalg.inv(above) @ pose
        nodes.append({"name": name, "camera": 0, "matrix": inside.T.ravel().tolist()})
    optics = {"yfov": 2 * math.atan(made.height / 2 / made.fy), "aspectRatio": made.width / made.height, "znear": 0.1}
    document = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes}
    document["cameras"] = [{"type": "perspective", "perspective": optics}]
    return placed(folder, "scene.gltf", json.dumps(document))


TOOLS: dict[str, tuple[Writer, str]] = {
    "metashape": (write_metashape, "all"),
    "realitycapture_xmp": (write_realitycapture, "centre"),
    "realitycapture_csv": (write_realitycapture_csv, "centre"),
    "gaussian_cameras": (write_gaussians, "focal"),
    "polycam": (write_polycam, "all"),
    "record3d": (write_record3d, "all"),
    "opensfm": (write_opensfm, "all"),
    "opendronemap": (write_opendronemap, "all"),
    "meshroom": (write_meshroom, "all"),
    "neus": (write_neus, "all"),
    "bundler": (write_bundler, ""),
    "tum": (write_tum, "all"),
    "kitti": (write_kitti, "all"),
    "seven_scenes": (write_seven_scenes, "all"),
    "mvsnet": (write_mvsnet, "all"),
    "openmvg": (write_openmvg, "centre"),
    "nvm": (write_nvm, ""),
    "open3d": (write_open3d, "all"),
    "open3d_json": (write_open3d_json, "all"),
    "kapture": (write_kapture, "all"),
    "euroc": (write_euroc, "all"),
    "gltf": (write_gltf, ""),
}


def kept_by(tool: str, made: Rig) -> Rig:
    """The rig with the intrinsics that the tool's file can store."""
    kept = TOOLS[tool][1]
    fy = made.fy if kept in ("all", "focal") else made.fx
    cx, cy = (made.cx, made.cy) if kept in ("all", "centre") else (made.width / 2, made.height / 2)
    return Rig(made.width, made.height, made.fx, fy, cx, cy, made.poses)
