#!/usr/bin/env bash
# usd-core 26.11: an identity rotation that is set as a NumPy array becomes half a turn about x.
#
# Quaternions of OpenUSD are w x y z in text and in constructors, but x y z w in memory. An array is copied as memory:
# Set(numpy [[1, 0, 0, 0]]) stores (0, 1, 0, 0), and numpy.asarray() of Quatf(1, 0, 0, 0) is [0, 0, 0, 1]. Neither
# warns, a round trip through NumPy alone is right, and the splats of a scene all lie wrong.
#
# Seen on 2026-11-27:
#   set [[1. 0. 0. 0.]], stored [(0, 1, 0, 0)]
#   stored [(1, 0, 0, 0)], read [[0. 0. 0. 1.]]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check usd-core==26.11 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
from pxr import Gf, Usd, UsdVol, Vt

stage = Usd.Stage.CreateInMemory()
turns = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/splats").CreateOrientationsAttr()
identity = np.array([[1, 0, 0, 0]], np.float32)
turns.Set(identity)
print(f"set {identity}, stored {turns.Get()}")
assert turns.Get()[0] == Gf.Quatf(0, 1, 0, 0)
turns.Set(Vt.QuatfArray([Gf.Quatf(1, 0, 0, 0)]))
print(f"stored {turns.Get()}, read {np.asarray(turns.Get())}")
assert np.asarray(turns.Get()).tolist() == [[0, 0, 0, 1]]
PYTHON
