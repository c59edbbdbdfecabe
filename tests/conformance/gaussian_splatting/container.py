"""A .glb of a few accessors, written from plain numbers."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

NAME = "KHR_gaussian_splatting"
FLOAT, BYTE, UBYTE, SHORT, USHORT, UINT = 5126, 5120, 5121, 5122, 5123, 5125
DTYPES = {FLOAT: "<f4", BYTE: "i1", UBYTE: "u1", SHORT: "<i2", USHORT: "<u2", UINT: "<u4"}
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
LOOK = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
Json = dict[str, Any]


class Glb:
    """A document that grows. The camera is its first node."""

    def __init__(self, camera: Json | None = None, pose: Any = None) -> None:
        self.body = b""
        self.root: Json = {
            "asset": {"version": "2.0", "generator": "KHR_gaussian_splatting conformance set"},
            "extensionsUsed": [NAME],
            "scene": 0,
            "scenes": [{"nodes": []}],
            "nodes": [],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
            "buffers": [{"byteLength": 0}],
        }
        if camera is not None:
            self.root["cameras"] = [camera]
            self.node({"name": "camera", "camera": 0, "matrix": np.asarray(pose).T.reshape(-1).tolist()})

    def node(self, entry: Json, *, inside: int | None = None) -> int:
        """Add a node to the scene, or to another node."""
        self.root["nodes"].append(entry)
        number = len(self.root["nodes"]) - 1
        above = (
            self.root["scenes"][0]["nodes"] if inside is None else self.root["nodes"][inside].setdefault("children", [])
        )
        above.append(number)
        return number

    def accessor(
        self, values: Any, component: int = FLOAT, *, normalised: bool = False, bounds: bool = False, stride: int = 0
    ) -> int:
        """Add an accessor of stored numbers (n,) or (n, columns)."""
        array = np.asarray(values, DTYPES[component])
        array = array.reshape(len(array), -1)
        n, columns = array.shape
        size = columns * array.itemsize
        step = stride or -(-size // 4) * 4  # attributes start at multiples of 4 bytes
        rows = np.zeros((n, step), np.uint8)
        rows[:, :size] = np.ascontiguousarray(array).view(np.uint8).reshape(n, size)
        view: Json = {"buffer": 0, "byteOffset": len(self.body), "byteLength": n * step, "target": 34962}
        if step != size:
            view["byteStride"] = step
        self.body += rows.tobytes()
        self.root["bufferViews"].append(view)
        entry: Json = {"bufferView": len(self.root["bufferViews"]) - 1, "componentType": component, "count": n}
        entry["type"] = KINDS[columns]
        if normalised:
            entry["normalized"] = True
        if bounds:
            entry |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        self.root["accessors"].append(entry)
        return len(self.root["accessors"]) - 1

    def finish(self) -> bytes:
        self.root["buffers"] = [{"byteLength": len(self.body)}]
        text = json.dumps(self.root, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(self.body), len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(self.body), b"BIN\0") + self.body


def attributes_of(glb: Glb, part: Json, **stored: tuple[Any, int, bool]) -> Json:
    """Add the accessors of splats, and return them by their names. stored: numbers, component, normalised."""
    found: Json = {"POSITION": glb.accessor(*stored.get("POSITION", (part["positions"],))[:2], bounds=True)}
    for name, key in (("ROTATION", "rotations"), ("SCALE", "scales"), ("OPACITY", "opacities")):
        values, component, normalised = stored.get(name, (part[key], FLOAT, False))
        found[f"{NAME}:{name}"] = glb.accessor(values, component, normalised=normalised)
    sh = np.asarray(part["sh"], np.float64)
    k = 0
    degree = 0
    while k < sh.shape[1]:
        for m in range(2 * degree + 1):
            found[f"{NAME}:SH_DEGREE_{degree}_COEF_{m}"] = glb.accessor(sh[:, k])
            k += 1
        degree += 1
    return found


def primitive_of(attributes: Json, **look: Any) -> Json:
    """A primitive of splats. look: properties of the extension that are not as usual; None leaves one out."""
    properties = {key: value for key, value in {**LOOK, **look}.items() if value is not None}
    return {"attributes": attributes, "mode": 0, "extensions": {NAME: properties}}
