#!/usr/bin/env bash
# usd-validation-nvidia 1.22.0: the rule for splats refuses those in half floats, which the schema allows.
#
# ParticleField3DGaussianSplat has each attribute twice, in float and in half (scales, scalesh); readers take the float
# one if both are there. A splat with half attributes alone passes the validator's default rules, because its rule for
# splats, com.nvidia.usd.VG.035, is off unless it is named. Named, it fails: "Required attribute 'scales' is missing".
# The same splat in floats passes both. So a pipeline that names the rule cannot take the smaller files.
#
# Seen on 2026-11-27 (failures by default, with the rule):
#   float: 0 0
#   half: 0 4
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check usd-validation-nvidia==1.22.0 usd-core==26.11
cd "$folder"
venv/bin/python - <<'PYTHON'
from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol

for kind, end in (("float", ""), ("half", "h")):
    stage = Usd.Stage.CreateNew(f"{kind}.usda")
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/splats")
    stage.SetDefaultPrim(splats.GetPrim())
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    splats.CreatePositionsAttr([(0, 0, 0)])
    splats.CreateExtentAttr([(-3, -3, -3), (3, 3, 3)])
    turn = Gf.Quath(1, 0, 0, 0) if end else Gf.Quatf(1, 0, 0, 0)
    prim = splats.GetPrim()
    prim.GetAttribute(f"scales{end}").Set([(1, 1, 1)])
    prim.GetAttribute(f"orientations{end}").Set([turn])
    prim.GetAttribute(f"opacities{end}").Set([0.5])
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(0)
    colours = prim.GetAttribute(f"radiance:sphericalHarmonicsCoefficients{end}")
    colours.Set([(0, 0, 0)])
    UsdGeom.Primvar(colours).SetInterpolation("vertex")
    colours.SetMetadata("elementSize", 1)
    stage.Save()
PYTHON
failures() { (venv/bin/nvidia_usd_validate "$@" 2>&1 || true) | sed -n 's/.*Failures: \([0-9]*\).*/\1/p' | tail -1 | grep . || echo 0; }
rule="--requirement com.nvidia.usd.VG.035"
for kind in float half; do
    echo "$kind: $(failures $kind.usda) $(failures $rule $kind.usda)" | tee -a seen
done
grep -qx "float: 0 0" seen
grep -qx "half: 0 4" seen
