"""Read and write baked atlases as folders for engines, web pages and shaders.

| file | content |
|---|---|
| atlas.json | all conventions that a shader needs, in words and numbers; counts, errors, bake settings |
| atlas_{c}.png | the maps with their gutters; linear filter, linear values, no mips |
| labels_{c}.png | red + 256 green = the texel's cluster; blue = `slopes` of that cluster; nearest, no mips |
| features_{c}.png | for affine and grid: the texel's offset or feature; nearest, no mips |
| mesh_{c}.obj, .mtl, feat0_{c} | mesh and diffuse texture, copied from the input |
| scene.glb | glTF 2.0: unlit diffuse in any viewer, the atlas as further textures and extras |

Labels use two 8-bit channels because browsers truncate 16-bit PNGs to 8 bits.
"""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import PIL

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.mesh.glb_writer import MeshPart, encode_glb
from nerfbake.formats.mesh.surface import decode_surface, encode_surface
from nerfbake.formats.wire.json import number, parse_object
from nerfbake.formats.wire.json import whole as whole_number
from nerfbake.formats.wire.picture import decode_texture, encode_texture
from nerfbake.kernels.surface import octahedron
from nerfbake.kernels.surface.octahedron import tiles_per_row
from nerfbake.scene.atlas import MAX_MAP_SIZE, MAX_TILES, METHODS, BakedAtlas, Method, OctahedralAtlas
from nerfbake.scene.stage1 import diffuse_name

VERSION = 1
_NAME = "atlas.json"
FILES = re.compile(r"atlas\.json|scene\.glb|(atlas|labels|features)_\d+\.png|feat0_\d+\.(png|jpg)|mesh_\d+\.(obj|mtl)")

CONVENTION = {
    "up_axis": "y, in the mesh's own coordinates",
    "direction": "unit, from the camera to the surface point",
    "octahedron": "p = d / (|d.x| + |d.y| + |d.z|); d.y >= 0: q = p.xz; else q = (1 - |p.zx|) * (p.xz < 0 ? -1 : 1); "
    "uv = q / 2 + 1/2",
    "map_texel": "texel (i, j) of a map holds the colour at its centre, uv = ((i + 1/2), (j + 1/2)) / map_size",
    "origin": "texel (0, 0) of every texture is the first of its PNG, the upper left one; v points down, as in glTF",
    "tile": "tile t starts at texel ((t % tiles_per_row), (t / tiles_per_row)) * (map_size + 2 border) + border",
    "gutter": "border texels around each tile, by octahedral wrap: (-1, j) = (0, map_size - 1 - j), "
    "(map_size, j) = (map_size - 1, map_size - 1 - j), rows likewise, corners both",
    "labels": "label = red + 256 green, 0..255 each",
    "filter": {"atlas": "linear, no mips", "labels": "nearest, no mips", "features": "nearest, no mips"},
    "colour_space": "all textures hold linear numbers: no sRGB decoding; colour = clamp(diffuse + specular, 0, 1), "
    "diffuse as the file's bytes / 255, the result being what a screen shows",
    "kmeans": "specular = tile[label]",
    "affine": "o = (255 features - 127) / 255; s = slope * labels.blue; specular = tile[4 label] + "
    "sum over i = 0..2 of s * o[i] * (255 tile[4 label + 1 + i] - 128) / 127",
    "grid": "p = features * (n - 1); low = min(floor(p), n - 2); f = p - low; from node low = (r n + g) n + b to its "
    "opposite corner, axes by decreasing f: weights 1 - f0, f0 - f1, f1 - f2, f2 of the four tiles met",
}


class CascadeEntry(NamedTuple):
    """The entry of one cascade in atlas.json, returned by parse()."""

    method: Method
    maps: int
    map_size: int
    border: int
    slope: float
    slopes: npt.NDArray[np.uint8] | None


def cascade_entry(atlas: OctahedralAtlas) -> dict[str, Any]:
    """Return the JSON fields that describe the atlas of one cascade."""
    H, W = atlas.labels.shape
    numbers: dict[str, Any] = {
        "method": atlas.method,
        "maps": len(atlas.tiles),
        "clusters": atlas.K,
        "map_size": atlas.R,
        "border": atlas.border,
        "tiles_per_row": tiles_per_row(len(atlas.tiles)),
        "texture_size": [W, H],
    }
    if atlas.method == "grid":
        numbers["n"] = atlas.n
    if atlas.slopes is not None:
        numbers |= {"slope": atlas.slope, "slopes": atlas.slopes.tolist()}
    return numbers


def parse(view: memoryview) -> dict[str, Any]:
    """Parse atlas.json to {'cascades': [CascadeEntry, ...], 'facts': all other keys}. Raises InvalidFile."""
    document = parse_object(view, _NAME)
    if document.get("nerfbake_atlas") != VERSION:
        raise InvalidFile(Problem(_NAME, "is not an atlas description", f'an object with "nerfbake_atlas": {VERSION}'))
    cascades = document.pop("cascades", None)
    if not isinstance(cascades, list) or not cascades or not all(isinstance(one, dict) for one in cascades):
        raise InvalidFile(Problem(f"{_NAME}: cascades", "is not a list of objects", "one object for each cascade"))
    return {
        "cascades": [_read_entry(one, f"{_NAME}: cascades[{i}]") for i, one in enumerate(cascades)],
        "facts": document,
    }


def _read_entry(numbers: dict[str, Any], place: str) -> CascadeEntry:
    def whole(key: str, low: int, high: int) -> int:
        return whole_number(numbers, key, place, low=low, high=high)

    method = numbers.get("method")
    if method not in METHODS:
        raise InvalidFile(Problem(f"{place}.method", f"is {str(method)[:40]}", ", ".join(METHODS)))
    slope, slopes = number(numbers, "slope", place, default=1.0), numbers.get("slopes")
    if slopes is not None and not (
        isinstance(slopes, list) and all(type(share) is int and 0 <= share <= 255 for share in slopes)
    ):
        raise InvalidFile(Problem(f"{place}.slopes", "is not a list of bytes", "0 to 255 for each cluster"))
    return CascadeEntry(
        method,
        whole("maps", 1, MAX_TILES),
        whole("map_size", 2, MAX_MAP_SIZE),
        whole("border", 0, MAX_MAP_SIZE // 2),
        slope,
        None if slopes is None else np.array(slopes, np.uint8),
    )


_LABEL = 10  # bytes of a label while it is put together
_GENERATOR = f"nerfbake {version('nerfbake')}"


def recognise(files: Mapping[str, memoryview]) -> bool:
    return "atlas.json" in files


def encode(baked: BakedAtlas, *, up: Literal["y", "z"] = "y") -> Iterator[tuple[str, list[bytes | memoryview]]]:
    """Yield the files by name. up: the axis of the mesh that is up in scene.glb; vertices are not changed."""
    parts, cascades = [], []
    files = dict(baked.files)
    for cascade, mesh in enumerate(baked.meshes):
        files |= {name: b"".join(pieces) for name, pieces in encode_surface(mesh, baked.files, cascade)}
    for cascade, atlas in enumerate(baked.atlases):
        textures: dict[str, bytes | memoryview] = {
            "atlas": encode_texture(atlas.image),
            "labels": encode_texture(label_texels(atlas)),
        }
        if atlas.features is not None:
            textures["features"] = encode_texture(atlas.features)
        for role, content in textures.items():
            yield f"{role}_{cascade}.png", [content]
        entry = cascade_entry(atlas)
        diffuse, mesh = diffuse_name(files, cascade), baked.meshes[cascade]
        if diffuse:
            textures["diffuse"] = files[diffuse]
        if mesh is not None:
            parts.append(MeshPart(f"cascade {cascade}", mesh, textures, {**entry, "convention": CONVENTION}))
        names = {role: f"{role}_{cascade}.png" for role in textures if role != "diffuse"}
        cascades.append({**entry, "files": names | ({"diffuse": diffuse} if diffuse else {})})
    for name, content in files.items():
        yield name, [content]
    if parts:
        yield "scene.glb", encode_glb(parts, _GENERATOR, up=up)
    document = {
        "nerfbake_atlas": VERSION,
        "generator": _GENERATOR,
        "convention": CONVENTION,
        "cascades": cascades,
        **baked.facts,
        "versions": {"python": platform.python_version(), "numpy": np.__version__, "pillow": PIL.__version__},
    }
    yield "atlas.json", [(json.dumps(document, indent=1) + "\n").encode()]


def decode(files: Mapping[str, memoryview]) -> BakedAtlas:
    """Read the atlases and meshes of a folder that encode() wrote. Raises InvalidFile with the file name."""
    document = parse(_require(files, "atlas.json"))
    atlases = []
    for cascade, entry in enumerate(document["cascades"]):

        def texture(role: str, cascade: int = cascade) -> npt.NDArray[np.uint8]:
            name = f"{role}_{cascade}.png"
            return decode_texture(_require(files, name), name)

        image, texels = texture("atlas"), texture("labels")
        memory.hold("the atlas", image.nbytes + _LABEL * len(texels) * texels.shape[1])
        labels = texels.astype(np.uint16)
        count, size, border = entry.maps, entry.map_size, entry.border
        edge = size + 2 * border
        per_row = octahedron.tiles_per_row(count)
        expected = (-(-count // per_row) * edge, per_row * edge, 3)
        if image.shape != expected:
            found = f"has {image.shape[1]}x{image.shape[0]} texels"
            allowed = f"{expected[1]}x{expected[0]} for {count:,} maps of {size} texels with {border} of gutter"
            raise InvalidFile(Problem(f"atlas_{cascade}.png", found, allowed))
        atlases.append(
            OctahedralAtlas(
                entry.method,
                octahedron.unpack(image, count, size, border),
                (labels[..., 0] | labels[..., 1] << 8).astype(np.uint16),
                None if entry.method == "kmeans" else texture("features"),
                border,
                entry.slope,
                entry.slopes,
            )
        )
    meshes = [decode_surface(files, cascade) for cascade in range(len(atlases))]
    return BakedAtlas(tuple(atlases), tuple(meshes), {}, document["facts"])


def label_texels(atlas: OctahedralAtlas) -> npt.NDArray[np.uint8]:
    """Return the texels of labels_{c}.png, (H, W, 3)."""
    texels = np.zeros((*atlas.labels.shape, 3), np.uint8)
    texels[..., 0], texels[..., 1] = atlas.labels & 255, atlas.labels >> 8
    if atlas.slopes is not None:
        texels[..., 2] = atlas.slopes[atlas.labels]
    return texels


def _require(files: Mapping[str, memoryview], name: str) -> memoryview:
    if name not in files:
        raise InvalidFile(Problem(name, "is missing", "a folder that `nerfbake atlas` wrote"))
    return files[name]
