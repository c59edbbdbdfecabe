"""What .ply files of splats say beyond 3DGS: numbers in halves, movement, and the axis that points up.

    property ushort x ...           the bits of a half float: as integers, x and logarithms have no unit
    trbf_*, motion_*, omega_*       movement of each splat (Spacetime Gaussians); f_dc_3..8 are then features for an MLP
    t, scale_t, rot_r_*             a Gaussian in space and time (4DGS)
    vx vy vz, velocity_*, time ...  a straight path
    element delta_vertex_N          movement of all splats, a frame each (Brush)
    comment Vertical Axis: z        nerfstudio, in every file
    comment Vertical axis: 0 0 1    Brush since its pull request 507; before, it wrote y into every file

Source: BabylonJS/Babylon.js#18816; oppo-us-research/SpacetimeGaussians; fudan-zvg/4d-gaussian-splatting;
ArthurBrussee/brush; nerfstudio-project/nerfstudio (exporter).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.scene.splats import UPS, Up

_NUMBERS = re.compile(r"[xyz]|opacity|filter_3D|(?:f_dc|f_rest|scale|rot)_\d+")  # what is no integer by its nature
_TYPES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
_FEATURE = "f_dc_3"  # 3DGS has f_dc_0 to f_dc_2
# Each kind of movement: the properties, and how messages spell them.
_MOVING = (
    (re.compile(r"trbf_(?:center|scale)|motion_\d+|omega_\d+"), "trbf_*, motion_*, omega_*"),
    (re.compile(r"scale_t(?:_0)?|rot_r(?:_\d+)?"), "t, scale_t, rot_r_*"),
    (re.compile(r"v[xyz]|velocity_[0-9a-z]+|duration"), "velocities, time, duration"),
)
_FRAME = re.compile(r"(?:delta_vertex|meta_delta_(?:min|max))_\d+")  # elements
_VERTICAL = re.compile(r"vertical axis\s*[:=]\s*(.+)", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE)
_ALONG = 0.9999  # smallest share of an axis in a direction that counts as this axis


def with_halves(rows: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    """Return the rows of a 3DGS file with the numbers of type ushort as half floats, and a note if there are any.

    Raises InvalidFile for a number of another integer type, which has no scale.
    """
    kinds = [(name, rows.dtype[name]) for name in rows.dtype.names or ()]
    wrong = [(name, kind) for name, kind in kinds if _NUMBERS.fullmatch(name) and kind.kind in "iu"]
    halves = [name for name, kind in wrong if kind.str[1:] == "u2"]
    for name, kind in wrong:
        if name not in halves:
            found = f"has the property {name} as {_TYPES.get(kind.str[1:], kind.name)}"
            raise InvalidFile(Problem("element vertex", found, "float or double, or ushort for half floats"))
    if not halves:
        return rows, ()
    changed = [(name, kind.str.replace("u2", "f2") if name in halves else kind) for name, kind in kinds]
    names = ", ".join(halves[:3]) + (f" and {len(halves) - 3} more" if len(halves) > 3 else "")
    return rows.view(np.dtype(changed)), (f"the properties of type ushort are read as half floats: {names}",)


class Movement(NamedTuple):
    """left_out: the movement in a few words, for each kind that the file has. notes: what that means."""

    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def movement_of(properties: Mapping[str, Sequence[str]]) -> Movement:
    """Return what a file tells about movement, which nerfbake does not read. properties: the names of each element.

    Raises InvalidFile if its f_dc are features from which an MLP makes colours.
    """
    names = properties.get("vertex", ())
    if _FEATURE in names:
        found = "are features for an MLP, as in the full model of Spacetime Gaussians"
        raise InvalidFile(
            Problem("f_dc_0 to f_dc_8", found, "colours, in f_dc_0 to f_dc_2 alone, as in its lite model")
        )
    kinds = [kind for pattern, kind in _MOVING if any(pattern.fullmatch(name) for name in names)]
    times = any(re.fullmatch(r"trbf_center|t(?:_0)?|time", name) for name in names)
    if frames := sum(name.startswith("delta_vertex_") for name in properties if _FRAME.fullmatch(name)):
        kinds.append(f"{frames} frame{'s' if frames > 1 else ''} of elements delta_vertex_*")
    if not kinds:
        return Movement()
    what = "the splats of all times are shown together" if times else "the splats stand still, where x, y, z say"
    left_out = tuple(f"movement ({kind})" for kind in kinds)
    return Movement(left_out, tuple(f"{each} is left out: {what}" for each in left_out))


def stated_up(comments: Iterable[str]) -> tuple[Up | None, tuple[str, ...]]:
    """Return the axis that a file says points up, and a note if it names a direction that is no axis.

    The letter y alone tells nothing: older versions of Brush wrote it into every file.
    """
    for comment in comments:
        if (match := _VERTICAL.fullmatch(comment.strip())) is None:
            continue
        stated = match[1].strip().strip("[]()\"'").lower()
        letters: dict[str, Up] = {up: up for up in UPS} | {f"+{up}": up for up in UPS if up[0] != "-"}
        if stated in letters:
            return (None if stated == "y" else letters[stated]), ()
        numbers = [float(word) for word in _NUMBER.findall(stated)]
        if len(numbers) != 3 or not np.isfinite(numbers).all() or not any(numbers):
            continue
        most = max(numbers, key=abs)
        if sum((number / most) ** 2 for number in numbers) > _ALONG**-2:
            return None, (f"its header names {stated[:40]} as the vertical axis, which is none of x, y, z: not used",)
        return letters[f"{'-' if most < 0 else ''}{'xyz'[numbers.index(most)]}"], ()
    return None, ()


def vertical_axis(up: Up) -> str:
    """The comment that stated_up() reads, as Brush writes it."""
    length = -1 if up[0] == "-" else 1
    return "Vertical axis: " + " ".join(str(length if axis == up[-1] else 0) for axis in "xyz")
