#!/usr/bin/env bash
# PyAV 18.1.0: asking for the tag of a transfer function changes the pixels, which PyAV 17.0.0 left alone.
#
# reformat(dst_color_trc=...) and dst_color_primaries=... say, in both versions, that they set metadata only. The swscale 9.5
# of 18.1.0 reads these tags of the target frame and converts to them: HDR of a phone (HLG, BT.2020) is toned down, and a
# colour of BT.709 gets sRGB's curve. Code that converted the pixels itself and then asked for the tag, which was right
# before, now converts twice, without a word.
#
# Seen on 2026-11-28 (a pixel of 10 bits as RGB of 8; without tags, with sRGB's curve, with it and BT.709's primaries):
#   17.0.0 HLG: [184, 110, 130] [184, 110, 130] [184, 110, 130]
#   17.0.0 SDR: [188, 113, 130] [188, 113, 130] [188, 113, 130]
#   18.1.0 HLG: [184, 110, 130] [224, 127, 142] [255, 111, 141]
#   18.1.0 SDR: [188, 113, 130] [191, 114, 123] [191, 114, 123]
#
# nerfbake asks for no tag and converts HLG and PQ by their formulas.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
for version in 17.0.0 18.1.0; do
  venv/bin/pip install -q --disable-pip-version-check av==$version numpy==2.4.6
  venv/bin/python - $version <<'PYTHON'
import sys

import av
import numpy as np

SRGB, BT709 = 13, 1


def frame(curve, space):
    made = av.VideoFrame(64, 64, "yuv444p10le")
    for plane, value in zip(made.planes, (512, 512, 640), strict=True):
        plane.update(np.full(plane.buffer_size // 2, value, np.uint16).tobytes())
    made.color_trc, made.color_primaries, made.colorspace, made.color_range = curve, space, space, 1
    return made


assert "metadata only" in av.video.reformatter.VideoReformatter.reformat.__doc__
for name, source in (("HLG", frame(18, 9)), ("SDR", frame(1, 1))):
    asked = ({}, {"dst_color_trc": SRGB}, {"dst_color_trc": SRGB, "dst_color_primaries": BT709})
    found = [source.reformat(format="rgb24", **tags).to_ndarray()[0, 0].tolist() for tags in asked]
    print(sys.argv[1], f"{name}:", *found)
    same = found[0] == found[1] == found[2]
    assert same if sys.argv[1] == "17.0.0" else not same
PYTHON
done
