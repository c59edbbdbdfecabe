"""Meshes as a stage of USD, which the writers of all containers share.

    Xform "scene"                                   xformOp:translate: the origin; nerfbake:up: z, if it was z
        Mesh "mesh_0", ...                          MaterialBindingAPI
            point3f[] points, int[] faceVertexCounts, int[] faceVertexIndices, normal3f[] normals, float3[] extent
            texCoord2f[] primvars:st                a row for each corner, v from the bottom
            color3f[] primvars:displayColor         linear
        Scope "materials"
            Material "material_0", ...
                Shader "surface"                    UsdPreviewSurface, rough
                Shader "texture", "coordinates"     UsdUVTexture (sRGB), UsdPrimvarReader_float2
                Shader "colour"                     without a texture: UsdPrimvarReader_float3

y is up in the stage, as the programs of Apple demand: meshes whose z is up are turned, and turned back when they are
read. USD has no unlit material: programs light what is written. A texture is shown without the colours of the vertices.
Source: OpenUSD, "UsdPreviewSurface Specification" 2.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.wire.picture import decode_texture, encode_picture
from nerfbake.formats.wire.usd.stage import Attribute, Prim, Relationship, UsdStage
from nerfbake.kernels.picture.metrics import to_linear
from nerfbake.kernels.surface.normals import welded_normals
from nerfbake.scene.mesh import Mesh, Meshes

Image = Literal["png", "jpeg"]
_ENDINGS = {"png": ".png", "jpeg": ".jpg"}
UP = "nerfbake:up"
_MATERIALS = "/scene/materials"


def mesh_stage(scene: Meshes, stem: str, *, up: Literal["y", "z"], image: Image) -> UsdStage:
    """Return the stage of meshes. stem: of the textures' names. Raises InvalidScene for levels of detail."""
    if scene.coarser:
        raise InvalidScene(Problem("the mesh", f"has {1 + len(scene.coarser)} levels of detail", "one, or .glb"))
    if not stem.isprintable():
        raise InvalidScene(Problem("the name", f"is {stem!r:.80}", "printable characters, which USD can refer to"))
    names = texture_names(scene, stem, image)
    turned = scene.with_up("-z") if up == "z" else scene
    meshes = tuple(_mesh(number, mesh) for number, mesh in enumerate(turned.meshes))
    looks = tuple(
        _material(number, names.get(number))
        for number, mesh in enumerate(scene.meshes)
        if number in names or mesh.colours is not None
    )
    children = (*meshes, Prim("materials", "Scope", children=looks)) if looks else meshes
    place: dict[str, Attribute | Relationship] = {}
    if up == "z":
        place[UP] = Attribute("token", up, uniform=True, custom=True)
    if turned.origin.any():
        place["xformOp:translate"] = Attribute("double3", turned.origin)
        place["xformOpOrder"] = Attribute("token[]", ["xformOp:translate"], uniform=True)
    return UsdStage(Prim("scene", "Xform", place, children), "Y")


def texture_names(scene: Meshes, stem: str, image: Image) -> dict[int, str]:
    """Return the name of the texture of each mesh that has one."""
    ending, several = _ENDINGS[image], len(scene.meshes) > 1
    textured = [number for number, mesh in enumerate(scene.meshes) if mesh.texture is not None]
    return {number: f"{stem}_{number}{ending}" if several else f"{stem}{ending}" for number in textured}


def textures_of(scene: Meshes, stem: str, image: Image) -> Sequence[tuple[str, bytes]]:
    """Return the names of the textures, and the pictures."""
    names = texture_names(scene, stem, image)
    return [
        (names[number], encode_picture(mesh.texture, image))
        for number, mesh in enumerate(scene.meshes)
        if mesh.texture is not None
    ]


def stored(scene: Meshes, *, up: Literal["y", "z"] = "y", image: Image = "png") -> Meshes:
    """Return the meshes that a reader finds in the file, without the library that decode() needs."""
    meshes = []
    for mesh in scene.meshes:
        picture = None if mesh.texture is None else encode_picture(mesh.texture, image)
        texture = None if picture is None else decode_texture(memoryview(picture), "the texture")
        meshes.append(replace(mesh, texture=texture, colours=mesh.colours if texture is None else None))
    return replace(scene, meshes=tuple(meshes))


def require_no_texture(scene: Meshes) -> None:
    """Raise InvalidScene for textures, which need files beside a layer."""
    if any(mesh.texture is not None for mesh in scene.meshes):
        raise InvalidScene(Problem("the mesh", "has a texture", ".usdz, or a file on the disk"))


def _mesh(number: int, mesh: Mesh) -> Prim:
    corners = mesh.faces.reshape(-1)
    held = mesh.positions[corners]
    properties: dict[str, Attribute | Relationship] = {
        "points": Attribute("point3f[]", mesh.positions),
        "faceVertexCounts": Attribute("int[]", np.full(len(mesh.faces), 3, np.int32)),
        "faceVertexIndices": Attribute("int[]", corners),
        "normals": Attribute("normal3f[]", welded_normals(mesh.positions, mesh.faces), {"interpolation": "vertex"}),
        "extent": Attribute("float3[]", np.stack([held.min(axis=0), held.max(axis=0)])),
        "subdivisionScheme": Attribute("token", "none", uniform=True),
        "doubleSided": Attribute("bool", True, uniform=True),
    }
    if mesh.uvs is not None:
        places = mesh.uvs[corners]
        places[:, 1] = 1 - places[:, 1]
        properties["primvars:st"] = Attribute("texCoord2f[]", places, {"interpolation": "faceVarying"})
    if mesh.colours is not None:
        light = to_linear(mesh.colours.astype(np.float64))
        properties["primvars:displayColor"] = Attribute("color3f[]", light, {"interpolation": "vertex"})
    if mesh.texture is None and mesh.colours is None:
        return Prim(f"mesh_{number}", "Mesh", properties)
    properties["material:binding"] = Relationship((f"{_MATERIALS}/material_{number}",))
    return Prim(f"mesh_{number}", "Mesh", properties, schemas=("MaterialBindingAPI",))


def _material(number: int, texture: str | None) -> Prim:
    """The material of a mesh: its texture, or the colours of its vertices."""
    path = f"{_MATERIALS}/material_{number}"
    colour = f"{path}/texture.outputs:rgb" if texture else f"{path}/colour.outputs:result"
    surface = _shader(
        "surface",
        "UsdPreviewSurface",
        {
            "inputs:diffuseColor": Attribute("color3f", source=colour),
            "inputs:roughness": Attribute("float", 1.0),
            "inputs:metallic": Attribute("float", 0.0),
            "outputs:surface": Attribute("token"),
        },
    )
    if texture is None:
        reader = {"inputs:varname": Attribute("string", "displayColor"), "outputs:result": Attribute("float3")}
        shaders = [_shader("colour", "UsdPrimvarReader_float3", reader)]
    else:
        read = {
            "inputs:file": Attribute("asset", f"./{texture}"),
            "inputs:sourceColorSpace": Attribute("token", "sRGB"),
            "inputs:wrapS": Attribute("token", "repeat"),
            "inputs:wrapT": Attribute("token", "repeat"),
            "inputs:st": Attribute("float2", source=f"{path}/coordinates.outputs:result"),
            "outputs:rgb": Attribute("float3"),
        }
        named = {"inputs:varname": Attribute("string", "st"), "outputs:result": Attribute("float2")}
        shaders = [_shader("texture", "UsdUVTexture", read), _shader("coordinates", "UsdPrimvarReader_float2", named)]
    output = {"outputs:surface": Attribute("token", source=f"{path}/surface.outputs:surface")}
    return Prim(f"material_{number}", "Material", output, (surface, *shaders))


def _shader(name: str, kind: str, properties: dict[str, Attribute]) -> Prim:
    return Prim(name, "Shader", {"info:id": Attribute("token", kind, uniform=True), **properties})
