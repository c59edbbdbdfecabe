"""Write a scene as one self-contained, interactive HTML page that opens from a file without network requests.

nerfbake/shaders/page contains the parts of the page: document, style, scripts and shaders. encode() adds a picture that
is visible before the scene is decoded, the facts (JSON, read by the script), and at the end the data in base64:

    octree  the bytes of a .svoq, see schemas/svoq.md
    arrays  a zlib stream of a PageField's top and blocks, little-endian, then for each of the 4 T channels of the
            texels the lower bytes of all rows, then their upper bytes
    surface none of these
    splats  a zlib stream of planes of bytes, see splats.py in this folder

followed by the arrays of each shell around the inner cube, if any, and by the triangles, if any, as packed by
triangles.py in this folder.

The scripts are concatenated in the order of _SCRIPTS into one scope. They are not modules: a page that is opened from a
file cannot import modules, and a bundler would need Node wherever nerfbake runs. TypeScript checks them as one program.

The page's policy allows only its own script and style, which it identifies by their digests. File names are escaped.
The same page gives the same bytes.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterator
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, one_line
from nerfbake.formats.octree import svoq
from nerfbake.formats.page.splats import pack_splats, splat_facts, unpack_splats
from nerfbake.formats.page.triangles import ball_of, pack_triangles, package_text, surface_facts, triangle_facts
from nerfbake.formats.picture import png
from nerfbake.formats.wire.deflate import deflate_whole, inflate
from nerfbake.formats.wire.picture import encode_thumbnail
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.camera import Camera
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.page import Page, PageField, PageSurface, density_unit, grid_of, texels_of
from nerfbake.scene.page_splats import PageSplats
from nerfbake.scene.radiance_field import RadianceField

_SCRIPTS = (
    "svoq.js",
    "svoq_values.js",
    "field.js",
    "bytes.js",
    "levels.js",
    "shells.js",
    "splats.js",
    "sorting.js",
    "carried.js",
    "triangles.js",
    "drawing.js",
    "picture.js",
    "splat_picture.js",
    "camera.js",
    "choices.js",
    "controls.js",
    "panel.js",
    "photograph.js",
    "viewer.js",
    "main.js",
)
_OF_SPLATS = {"splats.js", "sorting.js", "splat_picture.js"}
_OF_OTHERS = {"svoq.js", "svoq_values.js", "bytes.js", "levels.js", "shells.js", "triangles.js", "picture.js"}
_SHADERS = ("field.glsl", "march.glsl", "smooth.glsl", "shells.glsl", "shown.glsl")
_THUMBNAIL = 200, 64  # og:image: pixels an edge (the minimum that sites require), and colours
_NEAREST = 0.1  # minimum distance of a pivot from its camera, in radii of the scene


def encode(page: Page) -> Iterator[bytes]:
    """Yield the page in pieces."""
    streams = [_data(content) for content in (page.content, *page.around)]
    ends = np.cumsum([len(stream) for stream in streams]).tolist()
    data = base64.b64encode(b"".join(streams) + pack_triangles(page))
    around = [
        {**_array_facts(shell), "at": start, "end": end}
        for shell, start, end in zip(page.around, ends, ends[1:], strict=False)
    ]
    beside = {"around": around} if around else {}
    head, tail = _document(page, {"length": len(data), **_facts(page), **beside, **triangle_facts(page, at=ends[-1])})
    yield head.encode()
    yield data
    yield tail.encode()


def coded_size(page: Page) -> int:
    """The size in bytes of the page that encode() returns."""
    return sum(map(len, encode(page)))


def script_readable(view: memoryview) -> bytes:
    """Return the bytes of a .svoq, recoded without loss if it is not in the coding that the page's script reads."""
    if svoq.describe_packing(view)["coding"] == svoq.CODINGS[0]:
        return bytes(view)
    return b"".join(svoq.encode(svoq.decode_quantised(view)))


def content_of(view: memoryview) -> PageField | SparseVoxelOctree | PageSplats:
    """Read the field or the splats of a page that encode() wrote. Raises InvalidFile, MemoryLimit."""
    found = re.search(rb'id="facts">([^<]*)</script>.*?id="data">([^<]*)</script>', view, re.DOTALL)
    if found is None:
        raise InvalidFile("is not a complete page of a scene; allowed: a page that `nerfbake view` writes")
    facts = json.loads(found[1])
    data = base64.b64decode(found[2])[: (facts.get("around") or [facts.get("triangles", {})])[0].get("at")]
    if facts["kind"] == "svoq":
        return svoq.decode(memoryview(data))
    if facts["kind"] == "splats":
        return unpack_splats(memoryview(data), facts)
    cells, leaves, rows, T = int(np.prod(facts["shape"])), facts["leaves"], facts["rows"], facts["texels"]
    raw = np.frombuffer(inflate(memoryview(data), facts["size"], "the page's data"), np.uint8)
    top, blocks, planes = np.split(raw, [4 * cells, 4 * cells + 128 * leaves])
    halves = np.ascontiguousarray(planes.reshape(4 * T, 2, rows).transpose(2, 0, 1)).view("<f2")
    return PageField(
        top.view("<i4").astype(np.int32).reshape(facts["shape"]),
        blocks.view("<u4").astype(np.uint32).reshape(-1, 4),
        halves.astype(np.float16).reshape(rows, T, 4),
        facts["densityUnit"],
        np.array(facts["place"]),
        np.array(facts["box"]),
        parse_basis(facts["basis"]),
    )


def _document(page: Page, facts: dict[str, Any]) -> tuple[str, str]:
    """Return the part of the page before its data, and the part after it."""
    splats = isinstance(page.content, PageSplats)
    names = [name for name in _SCRIPTS if name not in (_OF_OTHERS if splats else _OF_SPLATS)]
    script = '(() => {\n"use strict";\n' + "\n".join(map(package_text, names)) + "})();\n"
    style = package_text("page.css")
    digests = {name: _digest(text) for name, text in (("script", script), ("style", style))}
    policy = "; ".join(
        [
            "default-src 'none'",
            f"script-src 'sha256-{digests['script']}'",
            f"style-src 'sha256-{digests['style']}'",
            "img-src data:",
            *(["worker-src blob:"] if splats else []),
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )
    all_of_it: object = page.field or page.content
    cover = b"".join(png.encode(page.cover))
    parts = {
        "policy": policy,
        "title": escape(one_line(page.title)),
        "style": style,
        "script": script,
        "shader": _shader(page),
        "cover": base64.b64encode(cover).decode(),
        "thumbnail": base64.b64encode(encode_thumbnail(memoryview(cover), *_THUMBNAIL)).decode(),
        "about": escape(f"All of the scene is in this file: {all_of_it}."),
        "facts": json.dumps(facts).replace("<", "\\u003c"),
    }
    # One pass, so that placeholders inside a part are never replaced.
    head, tail = (
        re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], text)
        for text in package_text("page.html").split("{{data}}")
    )
    return head, tail


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _shader(page: Page) -> str:
    if page.field:
        return "\n".join(map(package_text, _SHADERS))
    return "" if isinstance(page.content, PageSplats) else package_text("surface.glsl")


def _facts(page: Page) -> dict[str, Any]:
    """Return the facts for the page's script. Positions and directions are in the world unless named otherwise."""
    if page.field:
        facts = _field_facts(page.content, page.field)
    elif isinstance(page.content, PageSplats):
        facts = splat_facts(page.content)
    else:
        facts = surface_facts(page.content)
    facts |= {"background": page.background, "turns": page.turns, "lookup": page.lookup}
    centre, radius = np.array(facts["centre"]), facts["radius"]
    views = [_view(camera, centre, radius) for camera in page.cameras.cameras]
    for view, camera, photograph in zip(views, page.cameras.cameras, page.photographs, strict=False):
        view["photograph"] = _photograph(camera, photograph)
    return {**facts, "views": views}


def _field_facts(content: Any, field: RadianceField) -> dict[str, Any]:
    start, shape = grid_of(field.box)
    place = field.place.copy()
    place[:, 3] -= start
    centre, radius = ball_of(field.world(field.box))
    facts: dict[str, Any] = {
        "kind": "arrays" if isinstance(content, PageField) else "svoq",
        "basis": str(field.basis),
        "texels": texels_of(field.basis),
        "shape": shape,
        "start": start.tolist(),
        "edge": field.cells.edge,
        "box": (field.box - start).tolist(),
        "place": place.tolist(),
        "axes": field.axes.tolist(),
        "up": field.axes[2].tolist(),
        "centre": centre.tolist(),
        "radius": radius,
        "densityUnit": density_unit(float(field.values[:, -1].max())),
    }
    if isinstance(content, PageField):
        facts |= _array_facts(content)
    return facts


def _array_facts(content: PageField) -> dict[str, Any]:
    return {
        "texels": texels_of(content.basis),
        "shape": content.top.shape,
        "place": content.place.tolist(),
        "densityUnit": content.density_unit,
        "rows": len(content.texels),
        "leaves": len(content.blocks) // 8,
        "size": content.top.nbytes + content.blocks.nbytes + content.texels.nbytes,
    }


def _view(camera: Camera, centre: npt.NDArray[np.float64], radius: float) -> dict[str, Any]:
    """Return a camera; its pivot is the point of its line of sight that is closest to the scene's centre."""
    distance = float((camera.pose[:3, 2] * (camera.pose[:3, 3] - centre)).sum())
    focal = 2 * camera.fx / min(camera.width, camera.height)
    return {"pose": camera.pose.tolist(), "focal": focal, "distance": max(distance, _NEAREST * radius)}


def _photograph(camera: Camera, photograph: bytes) -> dict[str, Any]:
    """Return a photograph with its width, its height and the offset of its middle, in focal lengths of its camera.

    The page's camera looks at the middle of the canvas, which is the principal point of the photograph.
    """
    focal = np.array([camera.fx, camera.fy])
    size = np.array([camera.width, camera.height])
    offset = (size / 2 - [camera.cx, camera.cy]) / focal
    text = f"data:image/jpeg;base64,{base64.b64encode(photograph).decode()}"
    return {"source": text, "size": (size / focal).tolist(), "offset": offset.tolist()}


def _data(content: Any) -> bytes:
    if isinstance(content, bytes):
        return content
    if isinstance(content, PageSurface):
        return b""
    if isinstance(content, PageSplats):
        return pack_splats(content)
    if not isinstance(content, PageField):
        return b"".join(svoq.encode(content))
    rows = len(content.texels)
    halves = np.ascontiguousarray(content.texels.reshape(rows, 4 * texels_of(content.basis)).T).astype("<f2")
    planes = halves.view(np.uint8).reshape(len(halves), rows, 2).transpose(0, 2, 1)
    whole = (content.top.astype("<i4", copy=False), content.blocks.astype("<u4", copy=False))  # the grid may be large
    return deflate_whole(
        [
            *(np.ascontiguousarray(each).reshape(-1).view(np.uint8).data for each in whole),
            *(plane.tobytes() for plane in planes),
        ]
    )
