"""A baked atlas as a folder: what an engine, a web page or a shader loads.

| file | content |
|---|---|
| atlas.json | every convention that a shader needs, counts, errors, how it was baked |
| atlas_{c}.png | the maps with their gutters; linear filter, linear values, no mips |
| labels_{c}.png | red + 256 green = the texel's cluster; blue = `slopes` of that cluster; nearest, no mips |
| features_{c}.png | for affine and grid: the texel's offset or feature; nearest, no mips |
| mesh_{c}.obj, .mtl, feat0_{c} | mesh and diffuse texture, as they were given |
| scene.glb | glTF 2.0: unlit diffuse in any viewer, the atlas as further textures and extras |

Labels are two 8-bit channels because browsers cut 16-bit PNGs to 8.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Literal

import numpy as np
import numpy.typing as npt
import PIL

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.atlas import document as atlas_json
from nerfbake.formats.mesh.glb_writer import Part, encode_glb
from nerfbake.formats.mesh.surface import decode_surface, encode_surface
from nerfbake.formats.wire.texture import decode_texture, encode_texture
from nerfbake.kernels.surface import octahedron
from nerfbake.scene.atlas import BakedAtlas, OctahedralAtlas
from nerfbake.scene.stage1 import diffuse_name

_GENERATOR = f"nerfbake {version('nerfbake')}"


def recognise(files: Mapping[str, memoryview]) -> bool:
    return "atlas.json" in files


def encode(baked: BakedAtlas, *, up: Literal["y", "z"] = "y") -> Iterator[tuple[str, list[bytes | memoryview]]]:
    """The files by name. up: the mesh's axis that points up in scene.glb's world; its vertices stay as they are."""
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
        entry = atlas_json.entry(atlas)
        diffuse, mesh = diffuse_name(files, cascade), baked.meshes[cascade]
        if diffuse:
            textures["diffuse"] = files[diffuse]
        if mesh is not None:
            parts.append(Part(f"cascade {cascade}", mesh, textures, {**entry, "convention": atlas_json.CONVENTION}))
        names = {role: f"{role}_{cascade}.png" for role in textures if role != "diffuse"}
        cascades.append({**entry, "files": names | ({"diffuse": diffuse} if diffuse else {})})
    for name, content in files.items():
        yield name, [content]
    if parts:
        yield "scene.glb", encode_glb(parts, _GENERATOR, up=up)
    document = {
        "nerfbake_atlas": atlas_json.VERSION,
        "generator": _GENERATOR,
        "convention": atlas_json.CONVENTION,
        "cascades": cascades,
        **baked.facts,
        "versions": {"python": platform.python_version(), "numpy": np.__version__, "pillow": PIL.__version__},
    }
    yield "atlas.json", [(json.dumps(document, indent=1) + "\n").encode()]


def decode(files: Mapping[str, memoryview]) -> BakedAtlas:
    """The atlases of a folder that encode() wrote, and its meshes. Raises InvalidFile naming what is wrong."""
    document = atlas_json.parse(_require(files, "atlas.json"))
    atlases = []
    for cascade, entry in enumerate(document["cascades"]):

        def texture(role: str, cascade: int = cascade) -> npt.NDArray[np.uint8]:
            name = f"{role}_{cascade}.png"
            return decode_texture(_require(files, name), name)

        image, labels = texture("atlas"), texture("labels").astype(np.uint16)
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
    """(H, W, 3) what labels_{c}.png holds."""
    texels = np.zeros((*atlas.labels.shape, 3), np.uint8)
    texels[..., 0], texels[..., 1] = atlas.labels & 255, atlas.labels >> 8
    if atlas.slopes is not None:
        texels[..., 2] = atlas.slopes[atlas.labels]
    return texels


def _require(files: Mapping[str, memoryview], name: str) -> memoryview:
    if name not in files:
        raise InvalidFile(Problem(name, "is missing", "a folder that `nerfbake atlas` wrote"))
    return files[name]
