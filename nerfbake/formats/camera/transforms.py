"""Read and write transforms.json in the dialects of NeRF-Synthetic, instant-ngp and nerfstudio.

frames            [{file_path, transform_matrix: 4 x 4, camera to world, OpenGL axes}, ...]; a moving camera has
                  transform_matrix_start and _end; the start is used
x_fov, y_fov      degrees, else fl_x, fl_y: pixels, else camera_angle_x, camera_angle_y: radians; y defaults to x
cx, cy, w, h      pixels; default: the principal point in the centre, the size of the pictures
test_frames       frames like those of `frames`, on which the result is measured: ScanNet++
samples           nerfbake's extension: rays along each edge of a pixel, default 1
world             nerfbake's extension: {metres: true, upright: true, place: [latitude, longitude, altitude of the
                  origin]}, each of them optional
camera_model, is_fisheye, k1..k6, p1, p2, distortion_params ([k1, k2, k3, k4, p1, p2])
Except for frames and samples, each key may also be in a frame, which then takes precedence. A key whose value is null
counts as absent. instant-ngp files may contain comments. The poses do not include the transforms that instant-ngp and
nerfstudio apply to the world for training (scale, offset, aabb_scale, applied_transform).
Sources: instant-ngp's nerf_loader.cu and colmap2nerf.py; nerfstudio's nerfstudio_dataparser.py; and
docs/formats/cameras.md, "Dialects".
"""

from __future__ import annotations

import json
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.camera.capture import (
    DEFAULT_EDGE,
    MAX_FRAMES,
    CaptureFolder,
    PictureSizes,
    Size,
    inside_of,
    names_of,
    room_for,
    size_note,
)
from nerfbake.formats.wire.json import key_place, kind_of, number, parse_object, shorten, table, whole
from nerfbake.kernels.maths.elementary import arctan, tangent
from nerfbake.kernels.soundness import MAX_EDGE, plural
from nerfbake.scene.camera import FOCAL_LENGTHS, MAX_SAMPLES, Camera, Cameras
from nerfbake.scene.lens import Lens, LensModel, all_round
from nerfbake.scene.world import EarthPlace, World

# nerfstudio's names of COLMAP's models, with the lens model of k1, k2, ...
_MODELS: dict[str, LensModel] = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), "polynomial"),
    "FULL_OPENCV": "rational",
    **dict.fromkeys(("FISHEYE", "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "fisheye"),
    "EQUIRECTANGULAR": "equirectangular",
}
_WRITTEN = {
    "polynomial": "OPENCV",
    "rational": "FULL_OPENCV",
    "fisheye": "OPENCV_FISHEYE",
    "equirectangular": "EQUIRECTANGULAR",
}
_K = ("k1", "k2", "k3", "k4", "k5", "k6")
_P = ("p1", "p2")
_LIST = ("k1", "k2", "k3", "k4", "p1", "p2")  # nerfstudio's order
LENS_KEYS = (*_K, *_P, "camera_model", "is_fisheye", "distortion_params")


def lens_of(fields: Mapping[str, Any], where: str) -> Lens | None:
    """Parse lens distortion; None for a pinhole. Raises InvalidFile for an unknown model or field."""
    values = {key: _coefficient(fields, key, where) for key in (*_K, *_P) if key in fields}
    if "distortion_params" in fields:
        listed = fields["distortion_params"]
        if not isinstance(listed, list) or len(listed) != len(_LIST):
            raise InvalidFile(Problem(key_place(where, "distortion_params"), "is not a list of 6", ", ".join(_LIST)))
        named = dict(zip(_LIST, listed, strict=True))
        values |= {key: number(named, key, key_place(where, "distortion_params")) for key in named}
    model = _model(fields, where)
    if model is None and values.get("k4", 0) != 0:
        # Ambiguous: nerfstudio multiplies r^8 by k4, OpenCV uses it in the denominator, instant-ngp ignores it.
        raise InvalidFile(
            Problem(key_place(where, "k4"), f"is {values['k4']:g}", "0, or a camera_model that defines its meaning")
        )
    model = model or "polynomial"
    if model == "equirectangular":
        if bent := next((key for key, value in values.items() if value), ""):
            raise InvalidFile(Problem(key_place(where, bent), f"is {values[bent]:g}", "0 for EQUIRECTANGULAR"))
        return Lens(model)
    for key in ("k5", "k6") if model != "rational" else ():
        if values.get(key, 0) != 0:
            raise InvalidFile(Problem(key_place(where, key), f"is {values[key]:g}", "0, or camera_model FULL_OPENCV"))
    k = [values.get(key, 0.0) for key in (_K if model == "rational" else _K[:4])]
    lens = Lens(model, tuple(k), (values.get("p1", 0.0), values.get("p2", 0.0)))
    return lens if lens.bends else None


def _coefficient(fields: Mapping[str, Any], key: str, where: str) -> float:
    """Return k1 to p2. nerfstudio copies them as text from a .csv of RealityCapture."""
    if isinstance(text := fields[key], str):
        with suppress(ValueError):
            fields = {key: float(text)}
    return number(fields, key, where)


def lens_fields(lens: Lens | None) -> dict[str, Any]:
    """Return the fields that lens_of() reads. instant-ngp reads is_fisheye, k1, ...; nerfstudio also camera_model."""
    if lens is None:
        return {}
    if lens.all_round:
        return {"camera_model": _WRITTEN[lens.model]}
    if lens.model not in _WRITTEN:
        raise InvalidScene(Problem("the lens", f"is {lens.model}, which nerfstudio does not have", ", ".join(_WRITTEN)))
    k = dict(zip(_K, (*lens.k, *[0.0] * (4 - len(lens.k))), strict=False))
    return {
        "camera_model": _WRITTEN[lens.model],
        "is_fisheye": lens.model == "fisheye",
        **k,
        **dict(zip(_P, lens.p, strict=True)),
    }


def _model(fields: Mapping[str, Any], where: str) -> LensModel | None:
    named = fields.get("camera_model")
    if named is not None and (not isinstance(named, str) or named not in _MODELS):
        raise InvalidFile(Problem(key_place(where, "camera_model"), f"is {shorten(named)}", ", ".join(_MODELS)))
    model = None if named is None else _MODELS[named]
    fisheye = fields.get("is_fisheye")
    if fisheye not in (None, True, False, 0, 1):
        raise InvalidFile(Problem(key_place(where, "is_fisheye"), f"is {shorten(fisheye)}", "true or false"))
    if fisheye and model not in (None, "fisheye"):
        raise InvalidFile(Problem(key_place(where, "is_fisheye"), "is true", f"false with camera_model {named}"))
    return "fisheye" if fisheye else model


Frame = dict[str, Any]


def parse(view: memoryview) -> tuple[Frame, list[Frame], int]:
    """Return all fields, and the frames, without those that are null. Comments are skipped, as in instant-ngp.

    Also returns how many of the last frames are held out: those of test_frames, a second list that ScanNet++ has.
    """
    fields = parse_object(view, "the JSON", comments=True)
    frames, held_out = fields.get("frames"), fields.pop("test_frames", None)
    if held_out is not None and not isinstance(held_out, list):
        raise InvalidFile(Problem("test_frames", f"are {kind_of(held_out)}", "a list of frames"))
    if isinstance(frames, list) and held_out:
        frames = [*frames, *held_out]
    if not isinstance(frames, list) or not 1 <= len(frames) <= MAX_FRAMES:
        wrong = "are missing" if frames is None else "are not a list"
        found = f"are {len(frames):,}" if isinstance(frames, list) else wrong
        raise InvalidFile(Problem("frames", found, f"1 to {MAX_FRAMES:,} frames"))
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise InvalidFile(Problem(f"frames[{i}]", f"is {kind_of(frame)}", "an object with a transform_matrix"))
    for each in (fields, *frames):
        for key in [key for key, value in each.items() if value is None]:
            del each[key]
    return fields, frames, len(held_out or [])


def poses_of(frames: list[Frame]) -> npt.NDArray[np.float64]:
    """Return the poses, (n, 4, 4) camera to world, OpenGL axes. A camera that moves has its start pose."""
    keys = [_key(frame) for frame in frames]
    matrices = [frame.get(key) for frame, key in zip(frames, keys, strict=True)]
    if all(type(matrix) is list and len(matrix) == 4 for matrix in matrices):
        try:
            return table(
                matrices, "transform_matrix", (len(frames), 4, 4)
            )  # takes a third of the time of separate calls
        except InvalidFile:
            pass  # the loop below finds the invalid frame
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    for i, (key, matrix) in enumerate(zip(keys, matrices, strict=True)):
        if matrix is None:
            raise InvalidFile(Problem(f"frames[{i}].{key}", "is missing", "4 x 4 numbers"))
        edge = 3 if type(matrix) is list and len(matrix) == 3 else 4
        poses[i, :edge] = table(matrix, f"frames[{i}].{key}", (edge, 4))
    return poses


def _key(frame: Frame) -> str:
    starts = "transform_matrix" not in frame and "transform_matrix_start" in frame
    return "transform_matrix_start" if starts else "transform_matrix"


def decode_positions(view: memoryview) -> npt.NDArray[np.float64]:
    """Return the positions of the cameras, (c, 3), in the world of the file."""
    try:
        return poses_of(parse(view)[1])[:, :3, 3]
    except InvalidFile as error:
        problem = error.problem
        raise InvalidFile(problem._replace(place=f"transforms.json: {problem.place}")) from None


# Keys that change rays and are not supported: files with a value other than 0 or false are rejected.
_UNKNOWN = (
    "latlong", "equirectangular", "orthographic", "ftheta_p0", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4",
    "ftheta_w", "ftheta_h", "s1", "s2", "s3", "s4", "sx1", "sy1", "tau_x", "tau_y", "omega", "skew", "sk_x",
    "normal_mts_args", "from_na",
)  # fmt: skip
_LEAST_ANGLE = 1e-6  # smallest field of view with a focal length that rays can be computed from
_FOCAL = ("{}_fov", "fl_{}", "camera_angle_{}")
_OWN = {*_UNKNOWN, *LENS_KEYS, *(name.format(axis) for name in _FOCAL for axis in "xy"), "cx", "cy", "w", "h"}
_NERFSTUDIO = ("camera_model", "applied_transform", "applied_scale", "train_filenames", "ply_file_path")
_NGP = ("aabb_scale", "x_fov", "is_fisheye", "transform_matrix_start", "fl_x", "k1")

Fields = Mapping[str, Any]
Intrinsics = dict[str, Any]  # arguments of Camera other than pose and name


def recognise(view: memoryview) -> bool:
    """Return True for the first bytes of a transforms.json."""
    head = bytes(view[:HEAD]).removeprefix(BOM_UTF8)
    start = head.lstrip()[:2]
    has_key = any(key in head for key in (b"camera_angle_x", b"fl_x", b"frames", b"camera_model", b"aabb_scale"))
    return (start[:1] == b"{" or start in (b"//", b"/*")) and has_key


def decode(view: memoryview, *, beside: CaptureFolder | None = None) -> Cameras:
    """Return the cameras in the order of the frames. beside: the folder that contains the file and its pictures."""
    fields, frames, held_out = parse(view)
    room_for(len(frames))
    sizes = PictureSizes(beside)
    paths = [path if isinstance(path := frame.get("file_path"), str) else None for frame in frames]
    unsized = not all(_sized(fields, frame) for frame in frames)
    first = next((size for path in paths if (size := sizes.of(path))), None) if unsized else None
    poses = poses_of(frames)
    shared: dict[Size | None, Intrinsics] = {}
    cameras, guessed = [], 0
    for i, (frame, path, name) in enumerate(zip(frames, paths, names_of(paths), strict=True)):
        _refuse_rolling(fields, frame, i)
        found = None if first is None else sizes.of(path)
        size = found or first
        if _OWN.isdisjoint(frame):
            if size not in shared:
                shared[size] = _intrinsics({}, fields, size, "")
            intrinsics = shared[size]
        else:
            intrinsics = _intrinsics(frame, fields, size, f"frames[{i}]")
        guessed += found is None and not _sized(fields, frame)
        cameras.append(Camera(pose=poses[i], name=name, picture=inside_of(path), **intrinsics))
    world = _world(fields)
    told = (f"its world: {world}",) if any(world) else ()
    notes = (*size_note(guessed, first, sizes.unreadable), *_mask_note(frames), *told)
    samples = whole(fields, "samples", default=1, low=1, high=MAX_SAMPLES)
    last = tuple(range(len(frames) - held_out, len(frames)))
    dialect = _dialect(fields, frames)
    return Cameras(tuple(cameras), dialect, notes=notes, samples=samples, held_out=last, world=world)


def _world(fields: Fields) -> World:
    """Return what a file says of its world; other programs may use this key for something else."""
    found = fields.get("world")
    if not isinstance(found, dict):
        return World()
    place = found.get("place")
    if place is not None:
        latitude, longitude, altitude = table(place, "world.place", (3,)).tolist()
        place = EarthPlace(latitude, longitude, altitude)
    return World(found.get("metres") is True, found.get("upright") is True, place)


def _world_fields(world: World) -> dict[str, Any]:
    known = {"metres": world.metres, "upright": world.upright, "place": world.place}
    return {"world": {key: value for key, value in known.items() if value}} if any(world) else {}


def _mask_note(frames: list[Frame]) -> tuple[str, ...]:
    """Return the note for frames with masks, which nerfstudio would apply."""
    masked = sum("mask_path" in frame for frame in frames)
    if not masked:
        return ()
    return (f"the masks of {plural(masked, 'frame')} (mask_path) are not read; fit takes masks with `masks=DIR`",)


def encode(cameras: Cameras) -> Iterator[bytes]:
    """Encode cameras for nerfbake, instant-ngp and nerfstudio. Those that are held out are in test_frames.

    Intrinsics are written once if all cameras share them, otherwise for each frame. nerfstudio 1.1.5 reads camera_model
    beside the frames only, and without it takes all of them for perspective: a common one is also written there.
    """
    fields = [_fields(camera) for camera in cameras.cameras]
    alike = all(each == fields[0] for each in fields)
    frames = [
        {
            "file_path": camera.picture or camera.name,
            **({} if alike else each),
            "transform_matrix": camera.pose.tolist(),
        }
        for camera, each in zip(cameras.cameras, fields, strict=True)
    ]
    models = {each.get("camera_model") for each in fields}
    common = {"camera_model": models.pop()} if len(models) == 1 and None not in models else {}
    samples = {} if cameras.samples == 1 else {"samples": cameras.samples}
    split: dict[str, Any] = {**_world_fields(cameras.world), "frames": frames}
    if 0 < len(cameras.held_out) < len(frames):
        held_out = set(cameras.held_out)
        split["frames"] = [frame for i, frame in enumerate(frames) if i not in held_out]
        split["test_frames"] = [frames[i] for i in cameras.held_out]
    yield json.dumps({**samples, **(fields[0] if alike else common), **split}, indent=1).encode() + b"\n"


def _fields(camera: Camera) -> dict[str, Any]:
    """Return the intrinsics of a camera. camera_angle_x, for older readers, is only written if it is sufficient."""
    fields: dict[str, Any] = {}
    middle = camera.width / 2, camera.height / 2
    if camera.lens is None and (camera.cx, camera.cy) == middle and camera.fx == camera.fy:
        fields["camera_angle_x"] = float(2 * arctan(0.5 * camera.width / camera.fx))
    unit = np.pi if camera.lens is not None and camera.lens.all_round else 1.0
    fields |= {"w": camera.width, "h": camera.height, "fl_x": unit * camera.fx, "fl_y": unit * camera.fy}
    return fields | {"cx": camera.cx, "cy": camera.cy} | lens_fields(camera.lens)


def misread_lenses(cameras: Cameras) -> Iterator[str]:
    """Yield a line for lenses that nerfbake reads, and nerfstudio 1.1.5 does not or takes for others.

    nerfstudio has no rational lens. It reads one camera_model for all frames, and without it they are perspective.
    """
    models = Counter("polynomial" if camera.lens is None else camera.lens.model for camera in cameras.cameras)
    if rational := models.pop("rational", 0):
        yield f"warning: nerfstudio does not read FULL_OPENCV, the lens of {plural(rational, 'camera')}; nerfbake does"
    wide = models.total() - models["polynomial"]
    if wide and (rational or sum(map(bool, models.values())) > 1):
        yield (
            "warning: nerfstudio reads one camera_model for all frames, and takes the "
            f"{plural(wide, 'camera')} with a fisheye or equirectangular picture for perspective; nerfbake does not"
        )


def _sized(fields: Fields, frame: Fields) -> bool:
    return bool({"w", "h"} & (fields.keys() | frame.keys()))


def _dialect(fields: Fields, frames: list[dict[str, Any]]) -> str:
    for name, keys in (("nerfstudio", _NERFSTUDIO), ("instant-ngp", _NGP)):
        if any(key in fields or key in frames[0] for key in keys):
            return name
    return "NeRF-Synthetic"


def _intrinsics(own: Fields, shared: Fields, size: Size | None, where: str) -> Intrinsics:
    """Return the size, focal lengths, centre and lens of a Camera."""
    both = {**shared, **{key: own[key] for key in _OWN & own.keys()}}
    for key in _UNKNOWN:
        if both.get(key) not in (None, 0, False):
            raise InvalidFile(
                Problem(key_place(where, key), f"is {shorten(both[key])}", "perspective, or a fisheye's k1 to k4")
            )
    guessed = size is None and not {"w", "h"} & both.keys()
    defaults = size or (DEFAULT_EDGE, DEFAULT_EDGE)
    width, height = (
        _pixels(both, key, default if size or guessed else None, where)
        for key, default in zip("wh", defaults, strict=True)
    )
    lens = lens_of(both, where)
    found = _focal(own, width, height, where) or _focal(shared, width, height, "")
    if lens is not None and lens.all_round:
        # nerfstudio's focal length is that of half a turn: the height of the picture, or half of its width.
        found = all_round(width, height)[0] if found is None else (found[0] / np.pi, found[1] / np.pi)
    if found is None:
        raise InvalidFile(Problem(key_place(where, "camera_angle_x"), "is missing", "camera_angle_x, fl_x or x_fov"))
    centre = None
    if {"cx", "cy"} & both.keys():
        centre = number(both, "cx", where, default=width / 2), number(both, "cy", where, default=height / 2)
    return {"width": width, "height": height, "focal": found, "centre": centre, "lens": lens}


def _pixels(fields: Fields, key: str, default: int | None, where: str) -> int:
    value = number(fields, key, where, default=default, low=1, high=MAX_EDGE)  # instant-ngp writes floats
    if value != int(value):
        raise InvalidFile(Problem(key_place(where, key), f"is {value:g}", "a whole number of pixels"))
    return int(value)


def _focal(fields: Fields, width: int, height: int, where: str) -> tuple[float, float] | None:
    """Return (fx, fy) of these fields. If only one of the two is given, it is used for both."""
    fx, fy = _focal_along("x", width, fields, where), _focal_along("y", height, fields, where)
    if fx is None and fy is None:
        return None
    return (fx or fy or 0.0), (fy or fx or 0.0)


def _focal_along(axis: str, edge: int, fields: Fields, where: str) -> float | None:
    degrees, pixels, radians = (name.format(axis) for name in _FOCAL)
    if degrees not in fields and pixels in fields:
        return number(fields, pixels, where, low=FOCAL_LENGTHS[0], high=FOCAL_LENGTHS[1])
    key, unit, most = (degrees, "degrees", 180.0) if degrees in fields else (radians, "radians", np.pi)
    if key not in fields:
        return None
    angle = number(fields, key, where)
    if not _LEAST_ANGLE <= angle < most:
        most_text = "180" if unit == "degrees" else "pi"
        raise InvalidFile(Problem(key_place(where, key), f"is {angle:.7g}", f"{unit} between 0 and {most_text}"))
    return float(0.5 * edge / tangent((np.radians(angle) if unit == "degrees" else angle) / 2))


def _refuse_rolling(fields: Fields, frame: Fields, index: int) -> None:
    """Raise InvalidFile for a moving camera with a rolling shutter, where each row has a different pose."""
    start, end = (frame.get(f"transform_matrix_{which}") for which in ("start", "end"))
    shutter = frame.get("rolling_shutter", fields.get("rolling_shutter"))
    if end is not None and start != end and shutter and shutter != [0] * 4:
        raise InvalidFile(
            Problem(
                key_place(f"frames[{index}]", "transform_matrix_end"),
                "is combined with a rolling_shutter",
                "cameras that do not move",
            )
        )
