"""A scene to look around in as one page that needs nothing else: opened from a file, it asks nobody for anything.

The page's own parts stand in nerfbake/shaders/page, as they are: document, style, scripts and shader. What it carries
are a picture that is there at once, facts (JSON: what its script reads) and the data in base64, at its end:

    octree  the bytes of a .svoq, as schemas/svoq.md has them
    arrays  a zlib stream of a PageField's top and blocks, little-endian, then for each of the 4 T channels of the
            texels the lower bytes of all rows, then their upper bytes
    surface none of these

and behind them triangles, where there are some, as triangles.py in this folder packs them.

Its policy lets its own script and style run, told by their digests, and nothing else; whatever a file is called, its
name is text. The same page is the same bytes.
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
from nerfbake.formats.page.parts import ball_of, part_of
from nerfbake.formats.page.triangles import pack_triangles, surface_facts, triangle_facts
from nerfbake.formats.picture import png
from nerfbake.formats.wire.deflate import deflate_whole, inflate
from nerfbake.formats.wire.photograph import encode_thumbnail
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.camera import Camera
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.page import Page
from nerfbake.scene.page_field import PageField, density_unit, grid_of, texels_of
from nerfbake.scene.page_surface import PageSurface
from nerfbake.scene.radiance_field import RadianceField

_SCRIPTS = (
    "svoq.js",
    "svoq_values.js",
    "field.js",
    "bytes.js",
    "levels.js",
    "carried.js",
    "triangles.js",
    "picture.js",
    "camera.js",
    "choices.js",
    "controls.js",
    "panel.js",
    "viewer.js",
    "main.js",
)
_SHADERS = ("field.glsl", "march.glsl", "smooth.glsl", "shown.glsl")
_THUMBNAIL = 200, 64  # of og:image: pixels along an edge, the least that sites ask for, and colours
_NEAREST = 0.1  # of the scene's radius: no pivot is nearer to a camera


def encode(page: Page) -> Iterator[bytes]:
    """The page, in pieces."""
    content = _data(page.content)
    data = base64.b64encode(content + pack_triangles(page))
    head, tail = _document(page, {"length": len(data), **_facts(page), **triangle_facts(page, at=len(content))})
    yield head.encode()
    yield data
    yield tail.encode()


def coded_size(page: Page) -> int:
    """Bytes of the page that encode() gives."""
    return sum(map(len, encode(page)))


def carried(view: memoryview) -> bytes:
    """The bytes of a .svoq as they are, or with the same numbers in the coding that the page's script reads."""
    if svoq.describe_packing(view)["coding"] == svoq.CODINGS[0]:
        return bytes(view)
    return b"".join(svoq.encode(svoq.decode_quantised(view)))


def content_of(view: memoryview) -> PageField | SparseVoxelOctree:
    """The field that a page carries, of the bytes that encode() gave. Raises InvalidFile, MemoryLimit."""
    found = re.search(rb'id="facts">([^<]*)</script>.*?id="data">([^<]*)</script>', view, re.DOTALL)
    if found is None:
        raise InvalidFile("is no whole page to look around in; allowed: what `nerfbake view` writes")
    facts = json.loads(found[1])
    data = base64.b64decode(found[2])[: facts.get("triangles", {}).get("at")]
    if facts["kind"] == "svoq":
        return svoq.decode(memoryview(data))
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
    """The page up to its data, and behind them."""
    script = '(() => {\n"use strict";\n' + "\n".join(map(part_of, _SCRIPTS)) + "})();\n"
    style = part_of("page.css")
    digests = {name: _digest(text) for name, text in (("script", script), ("style", style))}
    policy = "; ".join(
        [
            "default-src 'none'",
            f"script-src 'sha256-{digests['script']}'",
            f"style-src 'sha256-{digests['style']}'",
            "img-src data:",
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
        "shader": "\n".join(map(part_of, _SHADERS)) if page.field else part_of("surface.glsl"),
        "cover": base64.b64encode(cover).decode(),
        "thumbnail": base64.b64encode(encode_thumbnail(memoryview(cover), *_THUMBNAIL)).decode(),
        "about": escape(f"All of the scene is in this file: {all_of_it}."),
        "facts": json.dumps(facts).replace("<", "\\u003c"),
    }
    # One pass: what stands in a part, whatever it is, is not looked at again.
    head, tail = (
        re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], text) for text in part_of("page.html").split("{{data}}")
    )
    return head, tail


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _facts(page: Page) -> dict[str, Any]:
    """What the page's script reads; all places and directions in the world, but for those named otherwise."""
    facts = _field_facts(page.content, page.field) if page.field else surface_facts(page.content)
    facts |= {"background": page.background, "turns": page.turns, "lookup": page.lookup}
    centre, radius = np.array(facts["centre"]), facts["radius"]
    return {**facts, "views": [_view(camera, centre, radius) for camera in page.cameras.cameras]}


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
        facts |= {"rows": len(content.texels), "leaves": len(content.blocks) // 8}
        facts["size"] = content.top.nbytes + content.blocks.nbytes + content.texels.nbytes
    return facts


def _view(camera: Camera, centre: npt.NDArray[np.float64], radius: float) -> dict[str, Any]:
    """A camera, with the pivot where its line of sight passes the scene's middle."""
    distance = float((camera.pose[:3, 2] * (camera.pose[:3, 3] - centre)).sum())
    focal = 2 * camera.fx / min(camera.width, camera.height)
    return {"pose": camera.pose.tolist(), "focal": focal, "distance": max(distance, _NEAREST * radius)}


def _data(content: Any) -> bytes:
    if isinstance(content, bytes):
        return content
    if isinstance(content, PageSurface):
        return b""
    if not isinstance(content, PageField):
        return b"".join(svoq.encode(content))
    rows = len(content.texels)
    halves = np.ascontiguousarray(content.texels.reshape(rows, -1).T).astype("<f2")
    planes = halves.view(np.uint8).reshape(-1, rows, 2).transpose(0, 2, 1)
    whole = (content.top.astype("<i4", copy=False), content.blocks.astype("<u4", copy=False))  # the grid may be large
    return deflate_whole(
        [
            *(np.ascontiguousarray(each).reshape(-1).view(np.uint8).data for each in whole),
            *(plane.tobytes() for plane in planes),
        ]
    )
