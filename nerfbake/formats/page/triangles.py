"""Pack the triangles of a page losslessly into one zlib stream of arrays.

Each part (a cascade or a mesh) has: positions (v, 3) float32, faces (t, 3) uint32, optionally uvs (v, 2) and colours
(v, 3) float32, then its textures (H, W, 3) uint8 in the order of their names in the facts. If the page has an MLP, it
follows all parts: a line for each hidden unit, (h, 6) and (h, 3) float32. An MLP with more layers, biases or features,
as MobileNeRF's, has a line for each output of a layer, (out, in + 1) float32 with the bias last, layer after layer. Its
features are in textures of three channels each, features0, features1, ...; the last one is filled up with 0.

Four-byte numbers are stored column by column, each as the difference of its bits from those of the number before it,
modulo 2^32: the lowest bytes of all numbers first, then the next ones. Texels are stored channel by channel, each as
the difference from the texel before it. nerfbake/shaders/page/triangles.js reads the stream. Textures are not embedded
as PNG, since a browser may change colours when it decodes a PNG.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.formats.atlas import folder as atlas_json
from nerfbake.formats.atlas.folder import label_texels
from nerfbake.formats.wire.deflate import deflate_whole
from nerfbake.kernels.arrays import Singles
from nerfbake.scene.atlas import OctahedralAtlas
from nerfbake.scene.camera import WORLD
from nerfbake.scene.mesh import Mesh, vertex_box
from nerfbake.scene.page import Page, PageSurface

Parts = PageSurface | Sequence[Mesh]


def pack_triangles(page: Page) -> bytes:
    """Return the zlib stream; empty for a page without triangles."""
    parts = _parts(page)
    if not parts:
        return b""
    return deflate_whole(_texels(array) if array.dtype == np.uint8 else _words(array) for array in _arrays(parts))


def triangle_facts(page: Page, *, at: int) -> dict[str, Any]:
    """Return the facts about the triangles for the page's script, and their shaders; {} for a page without triangles.

    at: the offset of the stream in the page's data.
    """
    parts = _parts(page)
    if not parts:
        return {}
    surface = parts if isinstance(parts, PageSurface) else None
    centre, reach = ball_of(vertex_box(_meshes(parts)))
    facts = {
        "at": at,
        "size": sum(array.nbytes for array in _arrays(parts)),
        "parts": [_part_facts(parts, i) for i in range(len(_meshes(parts)))],
        "hidden": surface.fields[0].w0.shape[1] if surface and surface.fields and not surface.is_deep else 0,
        "layers": [[w.shape[1] - 1, len(w)] for w in _layers(surface)] if surface and surface.is_deep else [],
        "highlights": [*(surface.highlights if surface else ()), "none"],
        "composites": [] if surface else sorted(("stop", "ztest", "cutout"), key=lambda how: how != page.composite),
        "centre": centre.tolist(),
        "reach": reach,
        "shaders": {
            "vertex": package_text("mesh_vertex.glsl"),
            "mesh": package_text("mesh.glsl"),
            "atlas": package_text("atlas.glsl", "shaders/glsl"),
        },
    }
    return {"triangles": facts}


def surface_facts(surface: Any) -> dict[str, Any]:
    """Return the facts about a PageSurface, in place of those of a field: world coordinates, the third axis is up."""
    centre, radius = ball_of(vertex_box(surface.meshes))
    return {
        "kind": "surface",
        "modes": ["colour", "depth"],
        "place": np.eye(3, 4).tolist(),
        "axes": WORLD.tolist(),
        "box": [[0, 0, 0], [1, 1, 1]],
        "up": WORLD[2].tolist(),
        "centre": centre.tolist(),
        "radius": radius,
    }


def _parts(page: Page) -> Parts:
    return page.content if isinstance(page.content, PageSurface) else page.meshes


def _meshes(parts: Parts) -> Sequence[Mesh]:
    return parts.meshes if isinstance(parts, PageSurface) else parts


def _part_facts(parts: Parts, i: int) -> dict[str, Any]:
    mesh, textures = _meshes(parts)[i], _textures(parts, i)
    facts: dict[str, Any] = {
        "vertices": len(mesh.positions),
        "faces": len(mesh.faces),
        "uvs": mesh.uvs is not None,
        "colours": mesh.colours is not None,
        "textures": {name: [texels.shape[1], texels.shape[0]] for name, texels in textures.items()},
    }
    if isinstance(parts, PageSurface) and parts.atlases:
        facts["atlas"] = _numbers(parts.atlases[i])
    return facts


def _arrays(parts: Parts) -> Iterator[npt.NDArray[Any]]:
    for i, mesh in enumerate(_meshes(parts)):
        yield from (array for array in (mesh.positions, mesh.faces, mesh.uvs, mesh.colours) if array is not None)
        yield from _textures(parts, i).values()
    if isinstance(parts, PageSurface) and parts.fields:
        yield from _layers(parts) if parts.is_deep else (parts.fields[0].w0.T, parts.fields[0].w1)


def _layers(surface: PageSurface) -> list[Singles]:
    """(out, in + 1) the weights of each layer of an MLP, and its biases in the last column."""
    field = surface.fields[0]
    layers = (field.w0, *field.middle, field.w1)
    biases = field.biases or [np.zeros(weights.shape[1], np.float32) for weights in layers]
    return [np.concatenate([w.T, b[:, None]], axis=1) for w, b in zip(layers, biases, strict=True)]


def _textures(parts: Parts, i: int) -> dict[str, npt.NDArray[np.uint8]]:
    """The textures of a part, by their names in the shader."""
    texture, opaque = _meshes(parts)[i].texture, _meshes(parts)[i].opaque
    textures = {} if texture is None else {"diffuse": texture}
    if opaque is not None:
        textures |= {"opaque": np.where(opaque[..., None], np.full(3, 255, np.uint8), np.uint8(0))}
    if isinstance(parts, PageSurface) and parts.atlases:
        atlas = parts.atlases[i]
        textures |= {"atlas": atlas.image}
        if atlas.method != "grid":
            textures |= {"labels": label_texels(atlas)}
        if atlas.features is not None:
            textures |= {"atlasFeatures": atlas.features}
    if isinstance(parts, PageSurface) and parts.fields:
        features = parts.fields[i].features
        if not parts.is_deep:
            return textures | {"mlpFeatures": features}
        padded = np.pad(features, ((0, 0), (0, 0), (0, -features.shape[2] % 3)))
        for k in range(0, padded.shape[2], 3):
            textures[f"features{k // 3}"] = np.ascontiguousarray(padded[..., k : k + 3])
    return textures


def _numbers(atlas: OctahedralAtlas) -> dict[str, float]:
    """The members of the struct Atlas in atlas.glsl."""
    entry = atlas_json.cascade_entry(atlas)
    names = {"mapSize": "map_size", "border": "border", "tilesPerRow": "tiles_per_row", "slope": "slope", "n": "n"}
    return {name: float(entry[key]) for name, key in names.items() if key in entry}


def _words(array: npt.NDArray[Any]) -> bytes:
    words = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).view("<u4")
    steps = np.diff(words, axis=0, prepend=np.zeros((1, words.shape[1]), "<u4")).T.astype("<u4", order="C")
    return np.ascontiguousarray(steps.view(np.uint8).reshape(*steps.shape, 4).transpose(0, 2, 1)).tobytes()


def _texels(texels: npt.NDArray[np.uint8]) -> bytes:
    flat = texels.reshape(-1, 3)
    return np.ascontiguousarray(np.diff(flat, axis=0, prepend=np.zeros((1, 3), np.uint8)).T).tobytes()


def package_text(name: str, folder: str = "shaders/page") -> str:
    """Read a text file of the package, wherever it was imported from."""
    data = pkgutil.get_data("nerfbake", f"{folder}/{name}")
    assert data is not None
    return data.decode()


def ball_of(corners: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], float]:
    """Return the centre of a box with the opposite corners (2, 3), and their distance from it."""
    return corners.mean(axis=0), float(np.sqrt(((corners[1] - corners[0]) ** 2).sum())) / 2
