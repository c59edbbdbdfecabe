"""Meshes in USD, judged by OpenUSD, and files of others."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import PIL.Image
import pytest
from numpy.testing import assert_array_equal
from pxr import UsdGeom, UsdShade

from nerfbake import load, save
from nerfbake.errors import InvalidFile, InvalidScene, UsageError
from nerfbake.formats.mesh import usd, usda, usdc, usdz
from nerfbake.formats.wire.picture import encode_texture
from nerfbake.kernels.picture.metrics import to_linear
from nerfbake.scene.mesh import Meshes
from tests.support.meshes import TEXELS, assert_same_mesh, cube, painted, sphere, square
from tests.support.usd import errors_of, facts_of, layer, opened, package
from tests.support.usd import in_this_process as in_this_process

pytestmark = pytest.mark.usefixtures("in_this_process")
MAP = np.array([453000.125, 5012345.4, 120.3])
ROUNDING = 1e-6  # v is 1 - v in a file, and colours are linear
FLAT = 'point3f[] points = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0)]\nuniform token subdivisionScheme = "none"\n'
SQUARE = FLAT + "int[] faceVertexCounts = [4]\nint[] faceVertexIndices = [0, 1, 2, 3]\n"


def written(module: ModuleType, scene: Meshes, **options: Any) -> bytes:
    return b"".join(module.encode(scene, **options))


def read(data: bytes, **beside: Any) -> Meshes:
    return usd.decode(memoryview(data), **beside)


def one(body: str, **more: Any) -> Any:
    (mesh,) = read(layer(f'def Mesh "m"\n{{\n{body}\n}}', **more)).meshes
    return mesh


# -- what is written -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("image", ["png", "jpeg"])
def test_a_package_holds_a_crate_and_the_textures(image: str, tmp_path: Path) -> None:
    data = written(usdz, painted(), image=image)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        layer_name, texture = archive.namelist()
        assert (layer_name, Path(texture).suffix) == ("scene.usdc", {"png": ".png", "jpeg": ".jpg"}[image])
        with PIL.Image.open(io.BytesIO(archive.read(texture))) as picture:
            assert (picture.format, picture.size) == (image.upper(), (4, 4))
    stage = opened(tmp_path / "a.usdz", data)
    assert errors_of(stage) == []
    assert facts_of(stage) == ("Y", 1.0, "/scene")


def test_openusd_finds_the_triangles_and_the_texture(tmp_path: Path) -> None:
    flat = replace(square(half=1.0), texture=TEXELS)
    stage = opened(tmp_path / "a.usdz", written(usdz, Meshes((flat,))))
    prim = stage.GetPrimAtPath("/scene/mesh_0")
    mesh = UsdGeom.Mesh(prim)
    assert_array_equal(np.asarray(mesh.GetPointsAttr().Get()), flat.positions)
    assert_array_equal(np.asarray(mesh.GetFaceVertexIndicesAttr().Get()), flat.faces.reshape(-1))
    assert {*mesh.GetFaceVertexCountsAttr().Get()} == {3}
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert mesh.GetNormalsInterpolation() == "vertex"
    assert len(mesh.GetNormalsAttr().Get()) == len(flat.positions)
    assert np.allclose(mesh.GetExtentAttr().Get(), [flat.positions.min(axis=0), flat.positions.max(axis=0)])
    st = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
    assert (st.GetInterpolation(), str(st.GetTypeName())) == ("faceVarying", "texCoord2f[]")
    assert flat.uvs is not None
    places = flat.uvs[flat.faces.reshape(-1)]
    assert np.allclose(st.Get(), np.stack([places[:, 0], 1 - places[:, 1]], axis=1))  # from the bottom
    assert "MaterialBindingAPI" in prim.GetAppliedSchemas()
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    surface, *_ = material.ComputeSurfaceSource()
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    assert (surface.GetInput("roughness").Get(), surface.GetInput("metallic").Get()) == (1, 0)
    texture = UsdShade.Shader(surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source)
    assert texture.GetIdAttr().Get() == "UsdUVTexture"
    assert texture.GetInput("sourceColorSpace").Get() == "sRGB"
    assert texture.GetInput("file").Get().path == "./texture.png"
    assert texture.GetInput("file").Get().resolvedPath.endswith("a.usdz[texture.png]")
    reader = UsdShade.Shader(texture.GetInput("st").GetConnectedSources()[0][0].source)
    assert (reader.GetIdAttr().Get(), reader.GetInput("varname").Get()) == ("UsdPrimvarReader_float2", "st")


def test_colours_of_vertices_are_linear_display_colours(tmp_path: Path) -> None:
    coloured = cube(colours=np.linspace(0, 1, 24, dtype=np.float32).reshape(8, 3))
    stage = opened(tmp_path / "a.usdc", written(usdc, Meshes((coloured,))))
    primvar = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/mesh_0")).GetDisplayColorPrimvar()
    assert primvar.GetInterpolation() == "vertex"
    assert coloured.colours is not None
    assert np.allclose(primvar.Get(), to_linear(coloured.colours))
    assert errors_of(stage) == []


def test_z_up_is_turned_to_y_as_apple_demands_and_back(tmp_path: Path) -> None:
    scene = Meshes((cube(0.3, colours=np.zeros((8, 3), np.float32)),), origin=np.array([0, 0, 7e7]))
    for up, expected in (("y", [0, 0, 7e7]), ("z", [0, 7e7, 0])):
        data = written(usdc, scene, up=up)
        stage = opened(tmp_path / f"{up}.usdc", data)
        assert facts_of(stage)[0] == "Y"
        place = UsdGeom.Xformable(stage.GetPrimAtPath("/scene")).GetLocalTransformation()
        assert [*place.ExtractTranslation()] == expected
        x, y, z = scene.meshes[0].positions.T
        points = np.asarray(UsdGeom.Mesh(stage.GetPrimAtPath("/scene/mesh_0")).GetPointsAttr().Get())
        assert_array_equal(points, np.stack([x, z, -y] if up == "z" else [x, y, z], axis=1))
        found = read(data)
        assert np.allclose(found.origin + found.meshes[0].positions, scene.origin + scene.meshes[0].positions, atol=4)


def test_textures_lie_beside_a_layer(tmp_path: Path) -> None:
    flat = replace(square(half=1.0), texture=TEXELS)
    for name in ("a.usda", "a@@@b c.usda", "ö.usdc"):
        stem = name.rpartition(".")[0]
        save(tmp_path / name, Meshes((flat,)))
        assert (tmp_path / f"{stem}.png").exists()
        stage = opened(tmp_path / name, (tmp_path / name).read_bytes())
        assert errors_of(stage) == []
        assert_same_mesh(load(tmp_path / name, Meshes).meshes[0], flat, atol=ROUNDING)
    save(tmp_path / "several.usdc", Meshes((flat, cube(), flat)), image="jpeg")
    assert {path.name for path in tmp_path.glob("several*")} == {"several.usdc", "several_0.jpg", "several_2.jpg"}
    with pytest.raises(InvalidScene, match=r"the mesh has a texture; allowed: \.usdz"):
        written(usda, Meshes((flat,)))
    with pytest.raises(InvalidScene, match="the name is 'a"):
        list(usda.encode_files(Meshes((flat,)), "a\nb"))


def test_levels_of_detail_and_webp_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidScene, match="2 levels of detail"):
        written(usdz, Meshes((sphere(6, 6),), (cube(),)))
    with pytest.raises(UsageError, match="option 'image' of usdz is 'webp'; allowed: png, jpeg"):
        save(tmp_path / "a.usdz", painted(), image="webp")


# -- read back -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("up", ["y", "z"])
def test_meshes_are_read_back_as_they_were(up: str) -> None:
    scene = painted()
    found = read(written(usdz, scene, up=up))
    for mesh, expected, stored in zip(found.meshes, scene.meshes, usdz.stored(scene).meshes, strict=True):
        assert_same_mesh(mesh, expected, atol=ROUNDING)
        assert_same_mesh(mesh, stored, atol=ROUNDING)
        assert_array_equal(mesh.positions, expected.positions)
        assert_array_equal(mesh.faces, expected.faces)
    plain = Meshes(scene.meshes[:2])
    for module in (usda, usdc):
        for mesh, expected in zip(read(written(module, plain)).meshes, plain.meshes, strict=True):
            assert_same_mesh(mesh, expected, atol=ROUNDING)
    assert found.notes == ()


def test_a_far_mesh_keeps_its_digits() -> None:
    scene = Meshes((cube(0.3),), origin=MAP)
    found = read(written(usdz, scene))
    assert np.abs(found.origin + found.meshes[0].positions - (MAP + scene.meshes[0].positions)).max() < 1e-6


# -- files of others -------------------------------------------------------------------------------------------
def test_polygons_holes_and_left_handed_faces() -> None:
    mesh = one(FLAT + "int[] faceVertexCounts = [4, 3, 2]\nint[] faceVertexIndices = [0, 1, 2, 3, 0, 1, 2, 0, 1]\n")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    holes = "int[] holeIndices = [1, 9, -1]\n"
    body = FLAT + "int[] faceVertexCounts = [4, 3]\nint[] faceVertexIndices = [0, 1, 2, 3, 0, 1, 2]\n" + holes
    assert len(one(body).faces) == 2
    assert one(SQUARE + 'uniform token orientation = "leftHanded"').faces.tolist() == [[2, 1, 0], [3, 2, 0]]
    mirror = 'float3 xformOp:scale = (-1, 1, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    mirrored = one(SQUARE + mirror)
    assert mirrored.faces.tolist() == [[2, 1, 0], [3, 2, 0]]
    assert mirrored.positions[1].tolist() == [-2, 0, 0]
    assert one(SQUARE, metres=0.01).positions.max() == np.float32(0.02)


def test_subdivision_surfaces_get_a_note() -> None:
    body = SQUARE.replace('"none"', '"catmullClark"')
    assert read(layer(f'def Mesh "m"\n{{\n{body}\n}}')).notes == (
        "subdivision surfaces are read as the meshes that control them",
    )


def material(name: str, body: str) -> str:
    surface = f'uniform token info:id = "UsdPreviewSurface"\n{body}\ntoken outputs:surface\n'
    output = f"token outputs:surface.connect = </scene/{name}/surface.outputs:surface>"
    return f'def Material "{name}"\n{{\n{output}\ndef Shader "surface"\n{{\n{surface}}}\n'


def textured(file: str, more: str = "") -> str:
    texture = f'uniform token info:id = "UsdUVTexture"\nasset inputs:file = @{file}@\n{more}\n'
    texture += "float2 inputs:st.connect = </scene/look/place.outputs:result>\nfloat3 outputs:rgb\n"
    place = 'uniform token info:id = "UsdTransform2d"\nfloat2 inputs:in.connect = </scene/look/st.outputs:result>\n'
    place += "float2 inputs:scale = (0.5, 2)\nfloat inputs:rotation = 90\nfloat2 inputs:translation = (0.25, 0)\n"
    reader = 'uniform token info:id = "UsdPrimvarReader_float2"\nstring inputs:varname = "map1"\n'
    shaders = (
        ("tex", texture),
        ("place", place + "float2 outputs:result\n"),
        ("st", reader + "float2 outputs:result\n"),
    )
    surface = material("look", "color3f inputs:diffuseColor.connect = </scene/look/tex.outputs:rgb>")
    return surface + "".join(f'def Shader "{name}"\n{{\n{body}}}\n' for name, body in shaders) + "}\n"


BOUND = "rel material:binding = </scene/look>\n"
PLACES = 'texCoord2f[] primvars:map1 = [(0, 0), (1, 0), (1, 1), (0, 1)] (\n interpolation = "{}"\n)\n'


def test_a_texture_of_a_package_with_moved_coordinates_and_a_factor() -> None:
    picture = encode_texture(TEXELS)
    mesh = f'def Mesh "m"\n{{\n{SQUARE}{BOUND}{PLACES.format("faceVarying")}}}\n'
    data = package(
        {
            "a.usda": layer(mesh + textured("./maps/a.png", "float4 inputs:scale = (1, 0.5, 1, 1)")),
            "maps/a.png": picture,
        }
    )
    (found,) = read(data).meshes
    assert found.texture is not None
    assert found.uvs is not None
    assert found.colours is not None
    assert_array_equal(found.texture, TEXELS)
    # Scaled, turned by 90 degrees counter-clockwise, moved: (s, t) is (-2 t + 0.25, 0.5 s), and v is 1 - t.
    assert np.allclose(found.uvs, [[0.25, 1], [0.25, 0.5], [-1.75, 0.5], [-1.75, 1]])
    assert np.allclose(to_linear(found.colours.astype(np.float64)), [1, 0.5, 1])


def test_textures_outside_are_never_opened(tmp_path: Path) -> None:
    picture = encode_texture(TEXELS)
    (tmp_path / "secret.png").write_bytes(picture)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link").symlink_to(tmp_path)
    mesh = f'def Mesh "m"\n{{\n{SQUARE}{BOUND}{PLACES.format("vertex")}}}\n'
    for name in (str(tmp_path / "secret.png"), "../secret.png", "./x/../../secret.png"):
        path = tmp_path / "in" / "a.usda"
        path.write_bytes(layer(mesh + textured(name)))
        with pytest.raises(InvalidFile, match="allowed: a file below the stage's folder"):
            load(path, Meshes)
    for name in ("link/secret.png", "missing.png", "secret.tiff"):
        path.write_bytes(layer(mesh + textured(f"./{name}")))
        found = load(path, Meshes)
        assert found.meshes[0].texture is None
        assert found.notes == (f"the texture '{name}' is left out: it is no PNG, JPEG or WebP beside the layer",)


def test_colours_of_materials_and_of_vertices() -> None:
    look = material("look", "color3f inputs:diffuseColor = (1, 0, 0.25)") + "}\n"
    display = 'color3f[] primvars:displayColor = [(0, 1, 0)] (\n interpolation = "constant"\n)\n'
    (found,) = read(layer(f'def Mesh "m"\n{{\n{SQUARE}{BOUND}{display}}}\n{look}')).meshes
    assert np.allclose(to_linear(found.colours.astype(np.float64)), [1, 0, 0.25])  # type: ignore[union-attr]
    assert np.allclose(one(SQUARE + display).colours, [0, 1, 0])
    uniform = 'color3f[] primvars:displayColor = [(0, 1, 0), (1, 0, 0)] (\n interpolation = "uniform"\n)\n'
    two = "int[] faceVertexCounts = [3, 3]\nint[] faceVertexIndices = [0, 1, 2, 0, 2, 3]\n"
    split = one(FLAT + two + uniform)
    assert len(split.positions) == 6  # a colour for each face
    assert np.allclose(split.colours[split.faces].reshape(2, 3, 3)[0], [0, 1, 0])
    indexed = uniform.replace('"uniform"', '"vertex"') + "int[] primvars:displayColor:indices = [0, 1, 1, 0]\n"
    assert one(FLAT + two + indexed).colours[:, 0].tolist() == [0, 1, 1, 0]


def test_subsets_of_faces_become_meshes() -> None:
    looks = "".join(
        material(name, f"color3f inputs:diffuseColor = {c}") + "}\n"
        for name, c in (("look", "(1, 0, 0)"), ("b", "(0, 0, 1)"))
    )
    two = "int[] faceVertexCounts = [3, 3]\nint[] faceVertexIndices = [0, 1, 2, 0, 2, 3]\n"
    subset = 'def GeomSubset "s"\n{\nuniform token elementType = "face"\nuniform token familyName = "materialBind"\n'
    subset += "int[] indices = [1]\nrel material:binding = </scene/b>\n}\n"
    first, second = read(layer(f'def Mesh "m"\n{{\n{FLAT}{two}{BOUND}{subset}}}\n{looks}')).meshes
    assert (first.colours[0].tolist(), second.colours[0].tolist()) == ([0, 0, 1], [1, 0, 0])  # type: ignore[index]
    assert (len(first.positions), len(second.positions)) == (3, 3)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("int[] faceVertexCounts = [4]\nint[] faceVertexIndices = [0, 1, 2]", "add up to 4, with 3 indices"),
        ("int[] faceVertexCounts = [-3, 6]\nint[] faceVertexIndices = [0, 1, 2]", "add up to 3"),
        ("int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 4]", "are 4; allowed: 0 to 3"),
        ("int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, -1]", "are -1; allowed: 0 to 3"),
        ("", "the stage has no faces"),
    ],
)
def test_faces_that_do_not_fit_are_refused(body: str, said: str) -> None:
    with pytest.raises(InvalidFile, match=said):
        one(FLAT + body)


def test_numbers_that_are_not_finite_are_refused_or_left_out() -> None:
    with pytest.raises(InvalidScene, match="mesh positions"):
        one(SQUARE.replace("(2, 1, 0)", "(nan, 1, 0)"))
    bad = 'color3f[] primvars:displayColor = [(0, nan, 0)] (\n interpolation = "constant"\n)\n'
    found = read(layer(f'def Mesh "m"\n{{\n{SQUARE}{bad}}}'))
    assert found.meshes[0].colours is None
    assert "displayColor of /scene/m is left out" in found.notes[0]
    short = bad.replace("nan", "0").replace("constant", "faceVarying")
    assert "its counts do not fit" in read(layer(f'def Mesh "m"\n{{\n{SQUARE}{short}}}')).notes[0]
