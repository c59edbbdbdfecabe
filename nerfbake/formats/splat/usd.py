"""Gaussian splats as prims of USD: the reader of all containers, and what the writers of each container share.

    Xform "scene"
        ParticleField3DGaussianSplat "splats"
            point3f[] positions        float3[] scales       quatf[] orientations    float[] opacities
            uniform int radiance:sphericalHarmonicsDegree
            float3[] radiance:sphericalHarmonicsCoefficients     all of a splat, then the next one
            float3[] extent            uniform token projectionModeHint, sortingModeHint
            custom bool nerfbake:antialiased

Scales are standard deviations and opacities 0 to 1, both as they are. In half floats the names end with h; positions
stay in float. The SH are svox's own in order and signs. Splats whose z is up are stored as they are, with upAxis Z. All
others are turned by half a turn about x, from -y up, with upAxis Y; reading undoes it. An origin is the translation.

A reader must judge lengths itself: the positions tell the number of splats, longer arrays are cut, and shorter ones
count as missing, with the defaults of the schema: scale 1, no rotation, opacity 1, degree 3, a grey of 0.5.
Source: OpenUSD 26.11, usdVol/schema.usda.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.splat.glb import placed_splats
from nerfbake.formats.wire.usd.content import VARIANTS, has_type, selected_variant
from nerfbake.formats.wire.usd.reading import StagePrim, read_stage
from nerfbake.formats.wire.usd.stage import Attribute, Prim, UsdStage
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.splats import BASES, MOVING, SplatRows, Splats, splats_in_blocks

KIND = "ParticleField3DGaussianSplat"
MOST_DEGREE = 3  # that is written: NVIDIA's rule for splats knows no higher one
KEEPS_ORIGIN = True
KEEPS_UP = True
LARGEST_HALF = 65504.0
DEGREE, SH = "radiance:sphericalHarmonicsDegree", "radiance:sphericalHarmonicsCoefficients"
_ANTIALIASED = "nerfbake:antialiased"
_DEFAULT_DEGREE = 3
_SIGMAS = 3.0  # to which the kernel is drawn
_ROWS = 1 << 14


# -- writing ---------------------------------------------------------------------------------------------------
def splat_stage(scene: Splats, *, half: bool = False) -> UsdStage:
    """Return the stage of splats. half: all but positions in half floats. Raises InvalidScene."""
    turned, up = as_stored(scene, half=half)
    end, kind = ("h", "half") if half else ("", "float")
    properties = {
        "positions": Attribute("point3f[]", turned.means),
        f"scales{end}": Attribute(f"{kind}3[]", turned.scales),
        f"orientations{end}": Attribute(f"quat{kind[0]}[]", turned.quats),
        f"opacities{end}": Attribute(f"{kind}[]", turned.opacity),
        DEGREE: Attribute("int", turned.degree, uniform=True),
        f"{SH}{end}": Attribute(f"{kind}3[]", turned.sh, {"elementSize": turned.B, "interpolation": "vertex"}),
        "extent": Attribute("float3[]", _extent(turned)),
        "projectionModeHint": Attribute("token", "perspective", uniform=True),
        "sortingModeHint": Attribute("token", "zDepth", uniform=True),
    }
    if turned.antialiased:
        properties[_ANTIALIASED] = Attribute("bool", True, uniform=True, custom=True)
    if turned.origin.any():
        properties["xformOp:translate"] = Attribute("double3", turned.origin)
        properties["xformOpOrder"] = Attribute("token[]", ["xformOp:translate"], uniform=True)
    return UsdStage(Prim("scene", "Xform", children=(Prim("splats", KIND, properties),)), "Z" if up == "z" else "Y")


def as_stored(scene: Splats, *, half: bool) -> tuple[Splats, str]:
    """Return splats in the coordinates and the precision of a file, and the axis that is up in them."""
    scene.require_usable()
    if scene.degree > MOST_DEGREE:
        raise InvalidScene(Problem("sh", f"has degree {scene.degree}", f"0 to {MOST_DEGREE}"))
    turned, up = (scene, "z") if scene.up == "z" else (scene.flipped(), "y")
    if not half:
        return turned, up
    largest = max(float(np.abs(array).max()) for array in (turned.scales, turned.sh))
    if largest > LARGEST_HALF:
        raise InvalidScene(Problem("the splats", f"hold {largest:g}", f"up to {LARGEST_HALF:g} in half floats"))
    arrays = {name: getattr(turned, name) for name in ("scales", "quats", "opacity", "sh")}
    rounded = {name: array.astype(np.float16).astype(np.float32) for name, array in arrays.items()}
    return replace(turned, **rounded), up


def stored(scene: Splats, *, half: bool = False) -> Splats:
    """Return the splats that a reader finds in the file, without the library that decode() needs."""
    found, up = as_stored(scene, half=half)
    lengths = np.sqrt((found.quats.astype(np.float64) ** 2).sum(axis=1, keepdims=True))
    found = replace(found, quats=(found.quats / lengths).astype(np.float32))
    return replace(found if up == "z" else found.flipped(), up="z" if up == "z" else "-y")


def _extent(scene: Splats) -> npt.NDArray[np.float32]:
    """(2, 3) the box of the centres with 3 standard deviations along each axis."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for start in range(0, scene.n, _ROWS):
        part = slice(start, start + _ROWS)
        reach = _SIGMAS * scene.reach(part)
        low = np.minimum(low, (scene.means[part] - reach).min(axis=0))
        high = np.maximum(high, (scene.means[part] + reach).max(axis=0))
    return np.stack([low, high]).astype(np.float32)


# -- reading ---------------------------------------------------------------------------------------------------
def recognise(view: memoryview) -> bool:
    """Return True for a file of USD that names the type of these prims, and selects no variant without them."""
    return has_type(view, KIND) and selected_variant(view, VARIANTS) in (None, "splats")


def decode(view: memoryview) -> Splats:
    """Read the splats of a stage in all containers. Raises UsageError without OpenUSD, InvalidFile, MemoryLimit."""
    stage = read_stage(view)
    parts: list[tuple[Splats, Floats]] = []
    for prim in stage.of(KIND):
        part = _splats(prim)
        if part is not None:
            if not np.array_equal(prim.place, np.eye(4)):
                memory.hold("the splats", memory.size_of(part) + MOVING * part.n)
            parts.append((part, prim.place))
    if not parts:
        raise InvalidFile(Problem("the stage", "has no splats", f"a {KIND} with positions"))
    memory.hold("the splats", 2 * sum(memory.size_of(part) for part, _ in parts))
    whole = placed_splats(parts)
    others = ("meshes",) * bool(stage.of("Mesh"))
    notes = (*whole.notes, *stage.notes, *("meshes in the file are left out" for _ in others))
    turned = replace(whole, up="z") if stage.up == "Z" else replace(whole.flipped(), up="-y")
    return replace(turned, notes=notes, left_out=others)


def _splats(prim: StagePrim) -> Splats | None:
    """Return the splats of a prim in its own coordinates; None if it has none."""
    values = prim.values
    means = _array(prim, "positions", 3)
    if means is None or not len(means):
        return None
    n, notes = len(means), []

    def column(name: str, columns: int, default: list[float], times: int = 1) -> npt.NDArray[Any]:
        found = _array(prim, name, columns)
        if found is not None and len(found) >= n * times:
            return found[: n * times]
        if found is not None:
            notes.append(f"{name} of {prim.path} are {len(found):,}, not {n * times:,}; their default is used")
        return np.broadcast_to(np.array(default, np.float32), (n * times, columns))

    degree = values.get(DEGREE, _DEFAULT_DEGREE)
    if not isinstance(degree, int) or not 0 <= degree < len(BASES):
        raise InvalidFile(Problem(f"{prim.path}.{DEGREE}", f"is {degree!r:.40}", f"0 to {len(BASES) - 1}"))
    scales, turns = column("scales", 3, [1, 1, 1]), column("orientations", 4, [0, 0, 0, 1])
    opacities = column("opacities", 1, [1])
    B = BASES[degree]
    sh = column(SH, 3, [0, 0, 0], B)
    if not sh.strides[0]:  # the default is grey, whatever the degree is
        B, sh = 1, sh[:n]

    def rows(block: slice) -> SplatRows:
        def wide(values: npt.NDArray[Any]) -> Floats:
            return np.asarray(values[block], np.float64)

        colours = np.asarray(sh[block.start * B : block.stop * B], np.float64).reshape(-1, B, 3)
        turn = wide(turns)[:, [3, 0, 1, 2]]
        return SplatRows(wide(means), wide(scales), turn, wide(opacities).reshape(-1), colours)

    antialiased = bool(values.get(_ANTIALIASED, False))
    return splats_in_blocks(n, B, rows, antialiased=antialiased, notes=tuple(notes))


def _array(prim: StagePrim, name: str, columns: int) -> npt.NDArray[Any] | None:
    """Return an attribute (n, columns), the one of floats if there are two; None if it is missing."""
    for key in (name, f"{name}h"):
        value = prim.values.get(key)
        if isinstance(value, np.ndarray) and (columns == 1 or value.ndim == 2) and value.size:
            if value.reshape(len(value), -1).shape[1] != columns or value.dtype.kind != "f":
                raise InvalidFile(
                    Problem(f"{prim.path}.{key}", f"is {value.dtype} of {value.shape}", "the schema's type")
                )
            return value.reshape(-1, columns)
    return None
