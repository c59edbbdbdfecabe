"""Lens distortion as instant-ngp and nerfstudio write it in a transforms.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import number, shown, within
from nerfbake.scene.lens import Lens, LensModel

# Names of COLMAP's models, as nerfstudio has them, with what k1, k2, ... mean there.
_MODELS: dict[str, LensModel] = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), "polynomial"),
    "FULL_OPENCV": "rational",
    **dict.fromkeys(("FISHEYE", "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "fisheye"),
}
_WRITTEN = {"polynomial": "OPENCV", "rational": "FULL_OPENCV", "fisheye": "OPENCV_FISHEYE"}
_K = ("k1", "k2", "k3", "k4", "k5", "k6")
_P = ("p1", "p2")
_LIST = ("k1", "k2", "k3", "k4", "p1", "p2")  # nerfstudio's order
LENS_KEYS = (*_K, *_P, "camera_model", "is_fisheye", "distortion_params")


def lens_of(fields: Mapping[str, Any], where: str) -> Lens | None:
    """None for a pinhole. Raises InvalidFile for a model, or a field, that is not understood."""
    values = {key: number(fields, key, where) for key in (*_K, *_P) if key in fields}
    if "distortion_params" in fields:
        listed = fields["distortion_params"]
        if not isinstance(listed, list) or len(listed) != len(_LIST):
            raise InvalidFile(Problem(within(where, "distortion_params"), "is no list of 6", ", ".join(_LIST)))
        named = dict(zip(_LIST, listed, strict=True))
        values |= {key: number(named, key, within(where, "distortion_params")) for key in named}
    model = _model(fields, where)
    if model is None and values.get("k4", 0) != 0:
        # To nerfstudio it is the factor of r^8, to OpenCV it stands below the line, instant-ngp leaves it out.
        raise InvalidFile(
            Problem(within(where, "k4"), f"is {values['k4']:g}", "0, or a camera_model that says what it means")
        )
    model = model or "polynomial"
    for key in ("k5", "k6") if model != "rational" else ():
        if values.get(key, 0) != 0:
            raise InvalidFile(Problem(within(where, key), f"is {values[key]:g}", "0, or camera_model FULL_OPENCV"))
    k = [values.get(key, 0.0) for key in (_K if model == "rational" else _K[:4])]
    lens = Lens(model, tuple(k), (values.get("p1", 0.0), values.get("p2", 0.0)))
    return lens if lens.bends else None


def lens_fields(lens: Lens | None) -> dict[str, Any]:
    """What lens_of() reads; instant-ngp takes is_fisheye, k1 and what follows, nerfstudio camera_model, too."""
    if lens is None:
        return {}
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
        raise InvalidFile(Problem(within(where, "camera_model"), f"is {shown(named)}", ", ".join(_MODELS)))
    model = None if named is None else _MODELS[named]
    fisheye = fields.get("is_fisheye")
    if fisheye not in (None, True, False, 0, 1):
        raise InvalidFile(Problem(within(where, "is_fisheye"), f"is {shown(fisheye)}", "true or false"))
    if fisheye and model not in (None, "fisheye"):
        raise InvalidFile(Problem(within(where, "is_fisheye"), "is true", f"false with camera_model {named}"))
    return "fisheye" if fisheye else model
