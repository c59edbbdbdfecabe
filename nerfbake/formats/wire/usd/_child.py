"""The process that reads a stage with OpenUSD. It runs alone, because OpenUSD may crash on a damaged file.

It is run as a script in an empty folder, and imports nothing of nerfbake, so that it starts fast.

    stdin   a line of JSON: {"files": [[name, bytes], ...], "root": name, "bytes": limit, "seconds": limit} | the files
    stdout  u64 size | JSON | the arrays to which the JSON refers by [offset, bytes, NumPy's type, columns]

The JSON is {"up", "turned", "metres", "prims", "left_out"}, or {"error": [place, found, allowed]}.
A layer may refer to the other files alone. That is checked in every layer before a stage is composed of them.
"""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

MOST_PRIMS = 1_000_000  # that are looked at
MOST_READ = 10_000  # splats, meshes and cameras
SPLATS, MESH, CAMERA = "ParticleField3DGaussianSplat", "Mesh", "Camera"
_SPLAT = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")
_VALUES = {
    SPLATS: (*_SPLAT, *(f"{name}h" for name in _SPLAT), "radiance:sphericalHarmonicsDegree", "nerfbake:antialiased"),
    MESH: ("points", "faceVertexCounts", "faceVertexIndices", "holeIndices", "orientation", "subdivisionScheme"),
    CAMERA: (
        *("projection", "focalLength", "horizontalAperture", "verticalAperture"),
        *("horizontalApertureOffset", "verticalApertureOffset", "nerfbake:size", "nerfbake:picture"),
    ),
}
_CONTAINERS = ("", "Xform", "Scope", "Material", "Shader", "NodeGraph", "GeomSubset", "OpenVDBAsset", "Volume")
_LOOKS = ("Light", "Render")  # starts or ends of the types that change no shape
_DTYPES = {"f": "<f4", "d": "<f8", "e": "<f2", "i": "<i4", "I": "<u4", "B": "|u1", "?": "|u1"}


class Refused(Exception):
    """A file that is not read. Its arguments are place, found and allowed, as in nerfbake's errors."""


def main() -> None:
    """Answer the request on stdin."""
    request = json.loads(sys.stdin.buffer.readline())
    for name, size in request["files"]:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        with open(name, "wb") as file:
            while size:
                piece = sys.stdin.buffer.read(min(size, 1 << 20))
                size -= len(piece)
                file.write(piece)
    with suppress(ImportError):
        import resource  # not on Windows

        seconds = request["seconds"]
        for name, soft, hard in (
            ("AS", request["bytes"], request["bytes"]),
            ("CPU", seconds, seconds + 5),  # SIGXCPU, then SIGKILL
            ("FSIZE", 0, 0),  # no report of a crash
            ("CORE", 0, 0),
        ):
            what = getattr(resource, f"RLIMIT_{name}")
            most = resource.getrlimit(what)[1]
            limits = [value if most == resource.RLIM_INFINITY else min(value, most) for value in (soft, hard)]
            resource.setrlimit(what, (limits[0], limits[1]))
    arrays = Arrays()
    try:
        found = read_stage(request["root"], [name for name, _ in request["files"]], arrays)
    except Refused as refused:
        found = {"error": refused.args}
    text = json.dumps(found).encode()
    out = sys.stdout.buffer
    out.write(len(text).to_bytes(8, "little") + text)
    for view in arrays.views if "error" not in found else ():
        out.write(view)
    out.flush()
    os._exit(0)  # without the destructors of OpenUSD


class Arrays:
    """The arrays of the answer."""

    def __init__(self) -> None:
        self.views: list[memoryview] = []
        self._size = 0

    def add(self, value: Any) -> Any:
        """Return a value for the JSON: numbers and text as they are, an array as where it is in the answer."""
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if type(value).__module__ == "pxr.Gf":
            return [float(number) for number in value]
        try:
            view = memoryview(value)
        except TypeError:  # an array of texts, or none at all
            return None
        if view.format not in _DTYPES or view.shape is None:
            return None
        columns = view.shape[1] if view.ndim > 1 else 1
        place = [self._size, view.nbytes, _DTYPES[view.format], columns]
        if view.nbytes:
            self.views.append(view.cast("B"))
            self._size += view.nbytes
        return {"array": place}


def read_stage(root: str, names: list[str], arrays: Arrays) -> dict[str, Any]:
    """Return the JSON for a stage. names: of all its layers, in the working folder. Raises Refused."""
    from pxr import Sdf, Tf, Usd, UsdGeom

    try:
        for name in names:
            layer = Sdf.Layer.FindOrOpen(str(Path(name).absolute()))
            if layer is None:
                raise Refused(name, "is no layer of USD", "a file that OpenUSD reads")
            _require_own(layer, name, names)
        stage = Usd.Stage.Open(str(Path(root).absolute()))
        up, metres = UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)
        reader = _Reader(stage, arrays)
        prims = reader.prims()
        first = stage.GetDefaultPrim()
        turned = first.GetAttribute("nerfbake:up").Get() if first and first.HasAttribute("nerfbake:up") else ""
        told = {"up": str(up), "turned": str(turned or ""), "metres": metres}
        return {**told, "prims": prims, "left_out": reader.left_out}
    except Tf.ErrorException as error:
        said = next((line.strip() for line in str(error).splitlines()[::-1] if line.strip(" '\t")), "an error")
        for name in names:
            said = said.replace(str(Path(name).absolute()), name)
        raise Refused("the stage", f"cannot be read: {said.strip(chr(39))}", "a stage that OpenUSD reads") from None


def _require_own(layer: Any, name: str, names: list[str]) -> None:
    """Refuse a layer that refers to files other than these, which OpenUSD would open."""
    for path in (*layer.GetCompositionAssetDependencies(), *layer.GetExternalAssetDependencies()):
        if _below(name, str(path)) not in names:
            allowed = "layers in the same .usdz; `usdcat --flatten` of OpenUSD makes one layer of several"
            raise Refused(name, f"refers to {str(path)[:80]}", allowed)

    def look(path: Any) -> None:
        prim = layer.GetPrimAtPath(path) if path.IsPrimPath() or path.IsPrimVariantSelectionPath() else None
        if prim and (prim.HasInfo("clips") or prim.HasInfo("clipSets")):
            raise Refused(name, f"has value clips at {path}", "values in the layer itself")

    layer.Traverse("/", look)


def _below(layer: str, path: str) -> str | None:
    """The name of a file that a layer refers to; None if it is outside the folder."""
    found = os.path.normpath(Path(layer).parent / path)
    return None if found.startswith(("/", "..")) or ":" in path else found


class _Reader:
    """The prims of a stage, at its first time."""

    def __init__(self, stage: Any, arrays: Arrays) -> None:
        from pxr import Usd, UsdGeom

        self._stage, self._arrays = stage, arrays
        self._time = Usd.TimeCode.EarliestTime()
        self._places = UsdGeom.XformCache(self._time)
        self.left_out: dict[str, int] = {}

    def prims(self) -> list[dict[str, Any]]:
        from pxr import Usd, UsdGeom

        found: list[dict[str, Any]] = []
        range_ = Usd.PrimRange(self._stage.GetPseudoRoot(), Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
        steps = iter(range_)
        for count, prim in enumerate(steps):
            if count > MOST_PRIMS or len(found) > MOST_READ:
                raise Refused("the stage", f"has more than {MOST_READ:,} prims", f"{MOST_READ:,} to read")
            kind = str(prim.GetTypeName())
            if kind == "PointInstancer":
                self._leave(kind)
                steps.PruneChildren()
            elif kind not in _VALUES:
                if kind not in _CONTAINERS and not kind.startswith(_LOOKS) and not kind.endswith(_LOOKS):
                    self._leave(kind)
            elif kind != CAMERA and not self._shown(UsdGeom.Imageable(prim)):
                self._leave("hidden")
            else:
                found.append(self._prim(prim, kind))
        return found

    def _leave(self, kind: str) -> None:
        self.left_out[kind] = self.left_out.get(kind, 0) + 1

    def _shown(self, prim: Any) -> bool:
        return prim.ComputeVisibility(self._time) != "invisible" and prim.ComputePurpose() in ("default", "render")

    def _prim(self, prim: Any, kind: str) -> dict[str, Any]:
        values = {name: self._value(prim.GetAttribute(name)) for name in _VALUES[kind]}
        place = self._places.GetLocalToWorldTransform(prim)
        if self._changes(prim, kind):
            self._leave("later times")
        told = {
            "path": str(prim.GetPath()),
            "kind": kind,
            "place": [float(place[row][column]) for row in range(4) for column in range(4)],
            "values": {name: value for name, value in values.items() if value is not None},
        }
        return {**told, **self._looks(prim)} if kind == MESH else told

    def _changes(self, prim: Any, kind: str) -> bool:
        """True if a prim moves, also with a prim above it, or if what is read of it has values of several times."""
        from pxr import UsdGeom

        values = (prim.GetAttribute(name) for name in _VALUES[kind])
        if any(value and value.ValueMightBeTimeVarying() for value in values):
            return True
        stands = (UsdGeom.Xformable(self._stage.GetPrimAtPath(path)) for path in prim.GetPath().GetPrefixes())
        return any(each and each.TransformMightBeTimeVarying() for each in stands)

    def _value(self, attribute: Any) -> Any:
        return self._arrays.add(attribute.Get(self._time)) if attribute else None

    def _looks(self, prim: Any) -> dict[str, Any]:
        """The materials of a mesh: of all of it, and of subsets of its faces; and the primvars that they need."""
        from pxr import UsdGeom, UsdShade

        binding = UsdShade.MaterialBindingAPI(prim)
        parts = []
        for subset in binding.GetMaterialBindSubsets():
            faces = self._value(subset.GetIndicesAttr())
            material, _ = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()
            if faces is not None:
                parts.append({"faces": faces, **self._material(material)})
        material, _ = binding.ComputeBoundMaterial()
        whole = self._material(material)
        primvars = {}
        for name in {"displayColor", whole.get("st"), *(part.get("st") for part in parts)} - {None}:
            primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
            value = self._arrays.add(primvar.Get(self._time)) if primvar else None
            if isinstance(value, dict):
                indices = self._arrays.add(primvar.GetIndices(self._time)) if primvar.IsIndexed() else None
                primvars[name] = {"values": value, "indices": indices, "on": str(primvar.GetInterpolation())}
        return {"material": whole, "parts": parts, "primvars": primvars}

    def _material(self, material: Any) -> dict[str, Any]:
        """The base colour of a UsdPreviewSurface: a constant, or a texture with the name of its coordinates."""
        shader = material.ComputeSurfaceSource()[0] if material else None
        if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
            return {}
        wanted = shader.GetInput("diffuseColor")
        if not wanted:
            return {}
        sources = wanted.GetValueProducingAttributes()
        source = sources[0] if sources else None
        if source is None or source.GetPrim() == shader.GetPrim() or not source.GetPrim().HasAttribute("info:id"):
            return {"colour": self._arrays.add(source.Get(self._time))} if source else {}
        texture = source.GetPrim()
        if texture.GetAttribute("info:id").Get() != "UsdUVTexture":
            return {}
        found: dict[str, Any] = {"file": self._file(_input(texture, "file"))}
        for name in ("scale", "bias"):
            found[name] = self._value(_input(texture, name))
        found |= self._coordinates(_input(texture, "st"))
        return found

    def _coordinates(self, attribute: Any) -> dict[str, Any]:
        """The name of the texture coordinates, and how they are moved."""
        if attribute is None:
            return {}
        reader = attribute.GetPrim()
        kind = reader.GetAttribute("info:id").Get() if reader.HasAttribute("info:id") else None
        if kind == "UsdTransform2d":
            move = {name: self._value(_input(reader, name)) for name in ("scale", "rotation", "translation")}
            return {**self._coordinates(_input(reader, "in")), "move": move}
        if kind != "UsdPrimvarReader_float2":
            return {}
        name = _input(reader, "varname")
        return {"st": str(name.Get(self._time)) if name and name.Get(self._time) else None}

    def _file(self, attribute: Any) -> str | None:
        """The name of a texture among the files, as the layer that names it sees it."""
        value = attribute.Get(self._time) if attribute else None
        if value is None or not str(getattr(value, "path", "")):
            return None
        specs = attribute.GetPropertyStack(self._time)
        layer = os.path.relpath(specs[0].layer.realPath) if specs else ""
        found = _below(layer, value.path)
        if found is None:
            raise Refused(str(attribute.GetPath()), f"names {value.path[:80]}", "a file below the stage's folder")
        return found


def _input(prim: Any, name: str) -> Any:
    """The attribute that has the value of a shader's input; None if there is none."""
    from pxr import UsdShade

    found = UsdShade.Shader(prim).GetInput(name)
    sources = found.GetValueProducingAttributes() if found else []
    return sources[0] if sources else None


if __name__ == "__main__":
    main()
