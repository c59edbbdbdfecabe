"""Write sets of cameras in the formats of other programs. The writers follow the documentation of each program."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Rig:
    """Cameras with the same pinhole intrinsics. poses: (n, 4, 4) camera to world, OpenGL axes."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    poses: Floats

    @property
    def names(self) -> list[str]:
        return [f"r_{i}" for i in range(len(self.poses))]

    def directions(self, i: int) -> Floats:
        """(height * width, 3) unit directions in world coordinates through the pixel centres of a pinhole camera."""
        found = []
        for row in range(self.height):
            for column in range(self.width):
                x, y = (column + 0.5 - self.cx) / self.fx, (row + 0.5 - self.cy) / self.fy
                seen = self.poses[i, :3, :3] @ [x, -y, -1]
                found.append(seen / np.linalg.norm(seen))
        return np.array(found)


def rig(*, odd: bool) -> Rig:
    """Three cameras with random poses. odd: with non-square pixels and an off-centre principal point."""
    random = np.random.default_rng(7)
    poses = np.tile(np.eye(4), (3, 1, 1))
    for pose in poses:
        q, _ = np.linalg.qr(random.normal(0, 1, (3, 3)))
        pose[:3, :3] = q * np.sign(np.linalg.det(q))
        pose[:3, 3] = random.normal(0, 3, 3)
    return Rig(14, 10, 17.5, 16.25, 6.125, 5.5, poses) if odd else Rig(14, 10, 17.5, 17.5, 7, 5, poses)


def quaternion(turn: Floats) -> Floats:
    """(w, x, y, z) of a rotation matrix, by Bar-Itzhack's eigenvector method, as in COLMAP's script."""
    xx, yx, zx, xy, yy, zy, xz, yz, zz = turn.flat
    K = np.array(
        [
            [xx - yy - zz, 0, 0, 0],
            [yx + xy, yy - xx - zz, 0, 0],
            [zx + xz, zy + yz, zz - xx - yy, 0],
            [yz - zy, zx - xz, xy - yx, xx + yy + zz],
        ]
    )
    values, vectors = np.linalg.eigh(K / 3)
    found: Floats = vectors[[3, 0, 1, 2], np.argmax(values)]
    return found


def world_to_camera(pose: Floats) -> tuple[Floats, Floats]:
    """COLMAP's R and t (OpenCV axes) for a camera-to-world matrix with OpenGL axes."""
    turn = (pose[:3, :3] @ np.diag([1, -1, -1])).T
    return turn, -turn @ pose[:3, 3]


def write_pictures(folder: Path, made: Rig, ending: str = ".png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in made.names:
        Pillow.new("RGB", (made.width, made.height)).save(folder / f"{name}{ending}")


def write_nerf_synthetic(folder: Path, made: Rig) -> Path:
    """The file has no sizes: they come from the pictures."""
    write_pictures(folder / "test", made)
    frames = [
        {"file_path": f"./test/{name}", "rotation": 0.01, "transform_matrix": pose.tolist()}
        for name, pose in zip(made.names, made.poses, strict=True)
    ]
    fields = {"camera_angle_x": 2 * np.arctan(made.width / 2 / made.fx), "frames": frames}
    (folder / "transforms_test.json").write_text(json.dumps(fields))
    return folder


def write_instant_ngp(folder: Path, made: Rig, **fields: Any) -> Path:
    """Field of view in degrees, which takes precedence; float sizes, comments, backslashes, and two poses per frame."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = [
        {
            "file_path": f"images\\{name}.jpg",
            "transform_matrix_start": pose.tolist(),
            "transform_matrix_end": pose.tolist(),
        }
        for name, pose in zip(made.names, made.poses, strict=True)
    ]
    whole = {
        "x_fov": np.degrees(2 * np.arctan(made.width / 2 / made.fx)),
        "y_fov": np.degrees(2 * np.arctan(made.height / 2 / made.fy)),
        "fl_x": 1.0,  # ignored, because x_fov takes precedence
        "camera_angle_x": 0.1,
        **{"cx": made.cx, "cy": made.cy, "w": float(made.width), "h": float(made.height), "k1": 0, "k2": 0.0},
        **{"p1": 0, "p2": 0, "is_fisheye": False, "aabb_scale": 16, "scale": 0.33, "offset": [0.5, 0.5, 0.5]},
        **fields,
        "frames": frames,
    }
    (folder / "transforms.json").write_text("// made by hand\n" + json.dumps(whole, indent=1) + "\n/* end */")
    return folder


def write_nerfstudio(folder: Path, made: Rig, **fields: Any) -> Path:
    """All fields are stored per frame, except the camera model."""
    folder.mkdir(parents=True, exist_ok=True)
    own = {"fl_x": made.fx, "fl_y": made.fy, "cx": made.cx, "cy": made.cy, "w": made.width, "h": made.height, **fields}
    frames = [
        {"file_path": f"images/{name}.png", "transform_matrix": pose.tolist(), "colmap_im_id": i, **own}
        for i, (name, pose) in enumerate(zip(made.names, made.poses, strict=True))
    ]
    applied = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]]
    whole = {"camera_model": fields.get("camera_model", "OPENCV"), "frames": frames, "applied_transform": applied}
    (folder / "transforms.json").write_text(json.dumps(whole))
    return folder


def write_colmap_binary(folder: Path, made: Rig, number: int = 1, parameters: tuple[float, ...] = ()) -> Path:
    """Write sparse/0. IDs differ from indices, and the images are not sorted by name."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    parameters = parameters or (made.fx, made.fy, made.cx, made.cy)
    cameras = struct.pack("<Q", 2)
    cameras += struct.pack("<IiQQ3d", 3, 0, 99, 99, 1.0, 2.0, 3.0)  # a camera without images
    cameras += struct.pack(f"<IiQQ{len(parameters)}d", 42, number, made.width, made.height, *parameters)
    images = struct.pack("<Q", len(made.poses))
    for i in reversed(range(len(made.poses))):
        turn, shift = world_to_camera(made.poses[i])
        images += struct.pack("<I7dI", 7 + i, *quaternion(turn), *shift, 42) + made.names[i].encode() + b".png\0"
        images += struct.pack("<Q", i) + i * struct.pack("<ddq", 1.5, 2.5, -1)
    (model / "cameras.bin").write_bytes(cameras)
    (model / "images.bin").write_bytes(images)
    return folder


def write_colmap_text(folder: Path, made: Rig, model: str = "PINHOLE", parameters: tuple[float, ...] = ()) -> Path:
    """Write sparse/*.txt. The second line of an image, its points, may be empty."""
    place = folder / "sparse"
    place.mkdir(parents=True, exist_ok=True)
    values = " ".join(map(repr, parameters or (made.fx, made.fy, made.cx, made.cy)))
    lines = ["# Camera list with one line of data per camera:", f"42 {model} {made.width} {made.height} {values}"]
    (place / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for i, (name, pose) in enumerate(zip(made.names, made.poses, strict=True)):
        turn, shift = world_to_camera(pose)
        lines.append(" ".join(map(repr, [7 + i, *quaternion(turn).tolist(), *shift.tolist(), 42])) + f" {name}.png")
        lines.append("1.5 2.5 -1 " * i)
    (place / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_llff(folder: Path, made: Rig, *, shared: bool = False) -> Path:
    """shared: the variant with hwf_cxcy.npy, which stores both focal lengths and the principal point."""
    write_pictures(folder / "images", made, ".JPG")
    rows = []
    for pose in made.poses:
        right, up, back, place = pose[:3].T
        matrix = np.stack([-up, right, back, place, [made.height, made.width, made.fx]], axis=1)
        rows.append([*matrix[:, : 4 if shared else 5].reshape(-1), 0.5, 9.5])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    if shared:
        values = [made.height, made.width, made.fx, made.fy, made.cx, made.cy]
        np.save(folder / "hwf_cxcy.npy", np.array(values)[:, None])
    return folder


def write_nsvf(folder: Path, made: Rig, form: str = "4x4") -> Path:
    """form: the layout of intrinsics.txt."""
    write_pictures(folder / "rgb", made)
    (folder / "pose").mkdir(parents=True, exist_ok=True)
    for name, pose in zip(made.names, made.poses, strict=True):
        np.savetxt(folder / "pose" / f"{name}.txt", pose @ np.diag([1, -1, -1, 1]), fmt="%.17g")
    K = np.eye(4)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = made.fx, made.fy, made.cx, made.cy
    text = {
        "4x4": "\n".join(" ".join(map(repr, row)) for row in K.tolist()),
        "3x3": "\n".join(" ".join(map(repr, row)) for row in K[:3, :3].tolist()),
        "16": " ".join(map(repr, K.reshape(-1).tolist())),
        "line": f"{made.fx!r} {made.cx!r} {made.cy!r} 0.\n0. 0. 0.\n0.\n1.\n{made.height} {made.width}",
    }[form]
    (folder / "intrinsics.txt").write_text(text + "\n")
    (folder / "bbox.txt").write_text("-1 -1 -1 1 1 1 0.1\n")
    return folder
