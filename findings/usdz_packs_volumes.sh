#!/usr/bin/env bash
# usd-core 26.11: packing a stage with an OpenVDB volume makes a .usdz that usd-core's own validator refuses.
#
# The specification of .usdz lists the file types of a package, and .vdb is none of them. UsdUtils.CreateNewUsdzPackage
# and CreateNewARKitUsdzPackage copy the .vdb all the same and return True, also the one that is named after ARKit.
# UsdValidation, of the same wheel, then reports UnsupportedFileExtensionInPackage.
# nerfbake writes no volume into a .usdz.
#
# Seen on 2026-11-28:
#   CreateNewUsdzPackage: True ['stage.usda', 'smoke.vdb'] ['UnsupportedFileExtensionInPackage']
#   CreateNewARKitUsdzPackage: True ['stage.usdc', 'smoke.vdb'] ['UnsupportedFileExtensionInPackage']
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check usd-core==26.11
venv/bin/python - <<'PYTHON'
import zipfile

from pxr import Usd, UsdGeom, UsdUtils, UsdValidation, UsdVol

# Packing copies the file without reading it: its name alone decides.
with open("smoke.vdb", "wb") as file:
    file.write(b"stands for a volume")
stage = Usd.Stage.CreateNew("stage.usda")
UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
UsdGeom.SetStageMetersPerUnit(stage, 1.0)
volume = UsdVol.Volume.Define(stage, "/Smoke")
field = UsdVol.OpenVDBAsset.Define(stage, "/Smoke/density")
field.CreateFilePathAttr("./smoke.vdb")
field.CreateFieldNameAttr("density")
volume.CreateFieldRelationship("density", field.GetPath())
stage.SetDefaultPrim(volume.GetPrim())
stage.Save()
context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
for pack in (UsdUtils.CreateNewUsdzPackage, UsdUtils.CreateNewARKitUsdzPackage):
    target = f"{pack.__name__}.usdz"
    made = pack("stage.usda", target)
    held = zipfile.ZipFile(target).namelist()
    errors = [error.GetName() for error in context.Validate(Usd.Stage.Open(target))]
    print(f"{pack.__name__}: {made} {held} {errors}")
    assert made and held[1] == "smoke.vdb" and errors == ["UnsupportedFileExtensionInPackage"]
PYTHON
