"""Read the cameras of a glTF 2.0 scene, a .glb or a .gltf: nodes with a camera.

The matrix of a node is camera to world in OpenGL's axes, x right, y up, looking along -z; +y is up in the scene. For
perspective.yfov in radians and a picture of the height h, fy = h / (2 tan(yfov / 2)). aspectRatio is width / height of
the picture, and pixels are square. The file has no sizes: a picture beside it that is named as the node or the camera
gives one, else 800 pixels along the height are assumed. If that picture has another shape than aspectRatio, pixels are
not square, and a note says so. Cameras that an animation moves are read where their nodes are, with a note.
Source: glTF 2.0, section 3.10.
"""

from __future__ import annotations

import math
from typing import Any

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, require_count
from nerfbake.formats.camera.capture import DEFAULT_EDGE, CaptureFolder, Size
from nerfbake.formats.mesh.glb import placed_nodes
from nerfbake.formats.mesh.glb_document import Document
from nerfbake.formats.wire.json import number
from nerfbake.kernels.maths.elementary import tangent
from nerfbake.kernels.soundness import MAX_EDGE, plural
from nerfbake.scene.camera import Cameras

_LEAST, _MOST = 1e-6, math.pi - 1e-6  # radians
_SPACE = 64  # bytes before the text of a .gltf: head may have megabytes, which need no copy
_SQUARE = 0.005  # by which the sides of a pixel differ at most; below it, the picture's size was rounded


def recognise(name: str, head: bytes) -> bool:
    binary = head.startswith(b"glTF")
    return (binary or head[:_SPACE].lstrip().startswith(b"{")) and b'"cameras"' in head and b'"asset"' in head


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    view = files[name]
    document = Document(view if bytes(view[:4]) == b"glTF" else _packed(view))
    album, posed, nodes, others, unsized, oblong = Album(files), [], list[int](), 0, 0, 0
    for index, key, matrix in placed_nodes(document, "camera"):
        place, camera = f"cameras[{key}]", document.item("cameras", key)
        if camera.get("type") != "perspective":
            others += 1
            continue
        optics = camera.get("perspective")
        if not isinstance(optics, dict):
            raise InvalidFile(Problem(f"{place}.perspective", "is missing", "an object with yfov"))
        yfov = number(optics, "yfov", f"{place}.perspective")
        if not _LEAST <= yfov <= _MOST:
            raise InvalidFile(Problem(f"{place}.perspective.yfov", f"is {yfov:g}", "radians between 0 and pi"))
        label = _label(document.item("nodes", index), camera, index)
        picture = album.find(label)
        found = album.size(picture)
        unsized += found is None
        width, height = found or _assumed(optics, place)
        focal = float(0.5 * height / tangent(yfov / 2))
        ratio = number(optics, "aspectRatio", f"{place}.perspective", default=width / height)
        if not 1e-3 <= ratio <= 1e3:
            raise InvalidFile(Problem(f"{place}.perspective.aspectRatio", f"is {ratio:g}", "0.001 to 1,000"))
        oblong += found is not None and abs(width / (height * ratio) - 1) > _SQUARE
        posed.append(Posed(label, picture, matrix, (width, height), (focal * width / (height * ratio), focal)))
        nodes.append(index)
        require_count(len(posed), name)
    if not posed:
        raise InvalidFile(Problem(name, "has no node with a perspective camera", "one or more"))
    notes = []
    if others:
        notes.append(f"{plural(others, 'orthographic camera')} left out")
    if unsized:
        told = f"tell no size of a picture; {DEFAULT_EDGE} pixels along the height are assumed"
        notes.append(f"{unsized:,} of {plural(len(posed), 'camera')} {told}")
    if oblong:
        told = "have another aspectRatio than their pictures, so that pixels are not square"
        notes.append(f"{oblong:,} of {plural(len(posed), 'camera')} {told}")
    if animated := len(_animated(document).intersection(nodes)):
        notes.append(f"animations are not read, which move {animated:,} of {plural(len(posed), 'camera')}")
    return cameras_of(posed, dialect="glTF", source=name, notes=notes)


def _animated(document: Document) -> set[int]:
    """Return the nodes that an animation moves, and all nodes below them. Those that do not exist are skipped."""
    count = len(document.root["nodes"])
    animations = _objects(document.root.get("animations"))
    channels = [channel for each in animations for channel in _objects(each.get("channels"))]
    targets = _objects([channel.get("target") for channel in channels])
    waiting = [target.get("node") for target in targets if target.get("path") != "weights"]
    found: set[int] = set()
    while waiting:
        index = waiting.pop()
        if type(index) is int and 0 <= index < count and index not in found:
            found.add(index)
            waiting += document.item("nodes", index).get("children", [])
    return found


def _objects(entries: Any) -> list[dict[str, Any]]:
    return [each for each in entries if isinstance(each, dict)] if isinstance(entries, list) else []


def _packed(view: memoryview) -> memoryview:
    """The JSON of a .gltf as a .glb without data."""
    text = bytes(view).removeprefix(b"\xef\xbb\xbf")
    header = b"glTF" + (2).to_bytes(4, "little") + (20 + len(text)).to_bytes(4, "little")
    return memoryview(header + len(text).to_bytes(4, "little") + b"JSON" + text)


def _label(node: dict[str, Any], camera: dict[str, Any], index: int) -> str:
    return next((each for each in (node.get("name"), camera.get("name")) if isinstance(each, str) and each), f"{index}")


def _assumed(optics: dict[str, Any], place: str) -> Size:
    ratio = number(optics, "aspectRatio", f"{place}.perspective", default=1.0)
    return max(1, min(round(DEFAULT_EDGE * max(ratio, 0.0)), MAX_EDGE)), DEFAULT_EDGE
