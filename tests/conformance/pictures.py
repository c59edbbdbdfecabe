"""Pictures, moving ones, depth, and the page of a comparison: pixels, written out."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import PIL.ImageSequence

from nerfbake import load
from nerfbake.scene.comparison import AMPLIFIED, Comparison
from nerfbake.scene.environment import EnvironmentMap
from nerfbake.scene.image import Animation, Depth, Image
from nerfbake.scene.shipment import Judgement, ReadingProgram, SharedStep, Shipment, ShippedFile
from tests.conformance.case import Case, Facts, Frozen, floats, form_named

Pixels = list[list[list[int]]]

OPAQUE: Pixels = [
    [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]],
    [[1, 2, 3], [254, 253, 252], [128, 127, 126], [0, 0, 0]],
    [[10, 20, 30], [40, 50, 60], [70, 80, 90], [100, 110, 120]],
]
# Straight alpha; where nothing is to be seen there is no colour either.
TRANSPARENT: Pixels = [
    [[255, 0, 0, 255], [0, 255, 0, 128], [0, 0, 0, 0]],
    [[10, 200, 30, 64], [0, 0, 0, 0], [255, 255, 255, 1]],
]
DISTANCES = [[0.0, 0.0001, 0.0015, 1.0], [2.25, 3.1415927, 12.5, 65.535]]
STEPS = [[0, 1, 2, 1000], [2250, 3142, 12500, 65535]]  # thousandths; what is met is never 0


def cases() -> Iterator[Case]:
    for name, pixels in (("opaque", OPAQUE), ("transparent", TRANSPARENT)):
        facts: Facts = {"width": len(pixels[0]), "height": len(pixels), "pixels": pixels}
        files = {f"picture/{name}.png": Frozen(form_named("png"), image(pixels))}
        yield Case(f"picture/{name}", "A picture of 8-bit sRGB, with straight alpha if any.", files, facts, _picture)
    distances = np.array(DISTANCES, np.float32)
    files = {"picture/steps.depth.png": Frozen(form_named("depth.png"), Depth(distances))}
    facts = {"unit": "1/1000 world unit along the ray, 0: nothing met", "pixels": STEPS}
    yield Case("picture/steps", "Depth as a grey picture of 16 bits.", files, facts, _steps)
    files = {"picture/distances.depth.npy": Frozen(form_named("depth.npy"), Depth(distances))}
    facts = {"unit": "world unit along the ray, 0: nothing met", "distances": distances.tolist()}
    yield Case("picture/distances", "Depth as float32, NumPy's .npy.", files, facts, _distances)
    yield from _moving()
    yield from _lights()
    yield _page()
    yield _receipt()


def image(pixels: Any) -> Image:
    """The picture of these bytes; one with alpha is premultiplied by it."""
    values = np.array(pixels, np.float32) / np.float32(255)
    alpha = values[..., 3] if values.shape[2] == 4 else np.ones(values.shape[:2], np.float32)
    colour = values[..., :3] * alpha[..., None] if values.shape[2] == 4 else values
    background = None if values.shape[2] == 4 else (1.0, 1.0, 1.0)
    return Image(colour, alpha, np.zeros_like(alpha), background)


def _picture(path: Path, _: Facts) -> Facts:
    picture = load(path, Image)
    return {"width": picture.size[0], "height": picture.size[1], "pixels": floats(picture.pixels)}


def _steps(path: Path, expected: Facts) -> Facts:
    steps = np.rint(load(path, Depth).distance * 1000).astype(int)
    return {"unit": expected["unit"], "pixels": steps.tolist()}


def _distances(path: Path, expected: Facts) -> Facts:
    return {"unit": expected["unit"], "distances": floats(load(path, Depth).distance)}


# -- moving pictures -------------------------------------------------------------------------------------------
def _moving() -> Iterator[Case]:
    opaque = [OPAQUE, [row[::-1] for row in OPAQUE], OPAQUE[::-1]]
    # A pixel that is less than half covered is not shown.
    red, green, none = [255, 0, 0, 255], [0, 128, 0, 200], [9, 9, 9, 100]
    clear = [[[red, none], [none, green]], [[none, red], [green, red]]]
    shown = [[[[*pixel[:3], 255 if pixel[3] >= 128 else 0] for pixel in row] for row in frame] for frame in clear]
    for name, frames, seen in (
        ("turning", opaque, [[[[*pixel, 255] for pixel in row] for row in frame] for frame in opaque]),
        ("turning_clear", clear, [[[p if p[3] else [0] * 4 for p in row] for row in frame] for frame in shown]),
    ):
        animation = Animation(tuple(map(image, frames)))
        files = {f"picture/{name}.gif": Frozen(form_named("gif"), animation)}
        facts: Facts = {"milliseconds": 80, "loop": 0, "frames": seen}
        yield Case(f"picture/{name}", "A moving picture, frames of RGBA as they are shown.", files, facts, _frames)


def _frames(path: Path, _: Facts) -> Facts:
    """Our program reads no GIF: Pillow does."""
    with PIL.Image.open(path) as file:
        frames = [np.asarray(frame.convert("RGBA")).copy() for frame in PIL.ImageSequence.Iterator(file)]
        facts = {"milliseconds": int(file.info["duration"]), "loop": file.info["loop"]}
    for frame in frames:
        frame[frame[..., 3] == 0] = 0
    return {**facts, "frames": [frame.tolist() for frame in frames]}


# -- light -----------------------------------------------------------------------------------------------------
def _lights() -> Iterator[Case]:
    """Maps of light, written by hand as the module's docstring says: nerfbake only reads them."""
    coded = [[[128, 64, 0, 129], [1, 2, 255, 136]], [[9, 9, 9, 0], [255, 128, 2, 128]]]
    rows = [[row[0], row[0], row[1], row[1]] for row in coded]
    yield _light("flat", 4, rows, bytes(value for row in rows for pixel in row for value in pixel))
    rows = [[pixel] * 8 for row in coded for pixel in row]
    runs = b"".join(bytes([2, 2, 0, 8, *(part for value in row[0] for part in (136, value))]) for row in rows)
    yield _light("runs", 8, rows, runs)


def _light(name: str, width: int, rows: Any, body: bytes) -> Case:
    """A pixel is its first three numbers times 2 to the power of the last one minus 136; black if the last is 0."""
    data = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (len(rows), width) + body
    linear = [
        [[value * 2.0 ** (pixel[3] - 136) * bool(pixel[3]) for value in pixel[:3]] for pixel in row] for row in rows
    ]
    facts: Facts = {"width": width, "height": len(rows), "radiance": linear}
    files = {f"picture/{name}.hdr": Frozen(form_named("hdr"), None, data=data)}
    return Case(f"picture/{name}", "A map of light, linear, row 0 at the top.", files, facts, _radiance)


def _radiance(path: Path, _: Facts) -> Facts:
    radiance = load(path, EnvironmentMap).radiance
    return {"width": radiance.shape[1], "height": radiance.shape[0], "radiance": floats(radiance)}


# -- the page --------------------------------------------------------------------------------------------------
_PSNR, _SSIM, _MOST = [30.5, 36.0], [0.9, 0.95], [0.25, 0.125]
_VALUES = {"sigma": {"mean": 0.5, "max": 2.0}, "dc": {"mean": 0.125, "max": 0.75}}
_BUDGETS = {"min_psnr": 33.0, "max_error": 0.125}


def _page() -> Case:
    truth, a, b = OPAQUE, [row[::-1] for row in OPAQUE], OPAQUE[::-1]
    errors = [{"psnr": p, "ssim": s, "max_error": e} for p, s, e in zip(_PSNR, _SSIM, _MOST, strict=True)]
    views = tuple(
        {"name": f"view <{i}>", **dict.fromkeys(("a_b", "a_truth", "b_truth"), each)} for i, each in enumerate(errors)
    )
    comparison = Comparison(views, _VALUES, ((image(truth), image(a), image(b)),) * 2)
    sides = {"a": {"name": "a & b.npz", "bytes": 4000}, "b": {"name": "folder/c.svo.pb", "bytes": 1000}}
    files = {"picture/page.html": Frozen(form_named("html"), comparison, {**sides, **_BUDGETS})}
    means = [sum(_PSNR) / 2, sum(_SSIM) / 2, max(_MOST)]
    table = [*(number for row in zip(_PSNR, _SSIM, _MOST, strict=True) for number in row), *means]
    facts: Facts = {
        "title": "c.svo.pb against a & b.npz",
        "verdict": "Within budget" if means[0] >= 33 and means[2] <= 0.125 else "Budget missed",
        # In the page's order: each budget's figure with what is allowed, the four tiles, sizes, three tables, values.
        "figures": [means[0], 33.0, means[2], 0.125, *means, 0.25, 4000, 1000, *table * 3, 0.5, 2.0, 0.125, 0.75],
        "views": ["view <0>", "view <1>"],
        "pictures": [truth, a, b, *(_difference(*pair) for pair in ((a, b), (a, truth), (b, truth)))] * 2,
    }
    about = "A comparison: every figure in a `data` element, a row of pictures for each view."
    return Case("picture/page", about, files, facts, _told)


def _receipt() -> Case:
    a, b = OPAQUE, OPAQUE[::-1]
    shown = image(a), image(b), image(_difference(a, b))
    readers = ReadingProgram("Blender", "5.0", "shows <it>", "ran"), ReadingProgram("Kit", "", "", "not run")
    judged = Judgement(31.5, 0.25, "front & left", 30.5, "read by nerfbake", shown)
    made = ShippedFile("scene.vdb", ("blender",), "a volume", readers, 1_230_000, 1.5, 2.5, judged, "")
    failed = ShippedFile("mesh.usdz", ("ios",), "a mesh", (), 0, 0.0, 0.0, None, "no <memory>")
    shipment = Shipment(
        "a & b.npz", "a PlenOctree", ("blender", "ios"), (made, failed), (SharedStep("splats", 3.5, 4.5),), "8 views"
    )
    facts: Facts = {
        "title": "a & b.npz: receipt",
        "verdict": "Failed: mesh.usdz",
        # In the page's order: MB, PSNR, the worst view, the largest error, seconds; the shared step; the worst view.
        "figures": [1.23, 31.5, 30.5, 0.25, 1.5, 3.5, 4.5, 30.5],
        "views": [],
        "pictures": [a, b, _difference(a, b)],
    }
    files = {"picture/receipt.html": Frozen(form_named("html", "Shipment"), shipment)}
    return Case("picture/receipt", "A receipt of a shipment, of which a file failed.", files, facts, _told)


def _difference(a: Pixels, b: Pixels) -> Pixels:
    return [
        [[min(255, AMPLIFIED * abs(x - y)) for x, y in zip(p, q, strict=True)] for p, q in zip(r, s, strict=True)]
        for r, s in zip(a, b, strict=True)
    ]


def _told(path: Path, _: Facts) -> Facts:
    """Our program reads no page: its text is searched."""
    text = path.read_text()

    def words(pattern: str) -> list[str]:
        return [html.unescape(each) for each in re.findall(pattern, text)]

    pictures = []
    for data in words('src="data:image/png;base64,([^"]*)"'):
        with PIL.Image.open(io.BytesIO(base64.b64decode(data))) as picture:
            pictures.append(np.asarray(picture.convert("RGB")).tolist())
    return {
        "title": words("<title>(.*)</title>")[0],
        "verdict": words('<p class="verdict[^>]*>([^<]*)<')[0],
        "figures": [float(each) for each in words('<data value="([^"]*)"')],
        "views": [each.partition(", ")[0] for each in words("<h3>(.*)</h3>")],
        "pictures": pictures,
    }
