#!/usr/bin/env bash
# usd-core 26.11: the bounds of a stage leave splats out, and nothing says so.
#
# A ParticleField3DGaussianSplat with two positions and without `extent` has an empty bounding box, and
# ComputeExtentFromPlugins() returns None: no plug-in of the wheel computes the extent of splats, although Mesh and
# Points have theirs. A camera that is placed by the bounds of the whole stage, beside a cube, looks at the cube alone.
# None of the 30 validators of the wheel mentions the missing extent.
#
# Seen on 2026-11-27:
#   30 validators, findings about the extent: []
#   box of the splats is empty: True
#   box of the stage: [(-1, -1, -1)...(1, 1, 1)]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check usd-core==26.11
"$folder/venv/bin/python" - <<'PYTHON'
from pxr import Usd, UsdGeom, UsdValidation, UsdVol

stage = Usd.Stage.CreateInMemory()
world = UsdGeom.Xform.Define(stage, "/world")
stage.SetDefaultPrim(world.GetPrim())
UsdGeom.SetStageUpAxis(stage, "Y")
UsdGeom.SetStageMetersPerUnit(stage, 1)
UsdGeom.Cube.Define(stage, "/world/cube")
splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/world/splats")
splats.CreatePositionsAttr([(0, 0, 0), (10, 0, 0)])
validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
errors = UsdValidation.ValidationContext(validators).Validate(stage)
told = [error.GetName() for error in errors if "xtent" in error.GetName() + error.GetMessage()]
print(f"{len(validators)} validators, findings about the extent: {told}")
bounds = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"])
own = bounds.ComputeWorldBound(splats.GetPrim()).GetRange()
whole = bounds.ComputeWorldBound(world.GetPrim()).ComputeAlignedRange()
print(f"box of the splats is empty: {own.IsEmpty()}")
print(f"box of the stage: {whole}")
assert not told and own.IsEmpty() and whole.GetMax()[0] == 1
boundable = UsdGeom.Boundable(splats.GetPrim())
assert UsdGeom.Boundable.ComputeExtentFromPlugins(boundable, Usd.TimeCode.Default()) is None
PYTHON
