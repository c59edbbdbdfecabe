#!/usr/bin/env bash
# py360convert 1.0.4, panorama-projection-toolkit 0.4.0, EquiForge 0.2.0, PyAV 18.1.0: four views for one.
#
# A view of 90 degrees and 128 pixels has a focal length of 64 and its centre at 63.5, between pixels 63 and 64. Four
# programs cut it out of a panorama whose pixels hold their own directions, and each has another camera. For
# py360convert and the toolkit, 90 degrees reach from the middle of the first pixel to the middle of the last, so the
# six faces of a cube share the pixels of their edges. The toolkit and FFmpeg's v360, which PyAV has, take the first and
# the last column of the panorama for one direction. EquiForge's view is half a pixel off, across and down. Positive yaw
# is right for three and left for the toolkit; positive pitch is up for three and down for EquiForge. A trainer
# that computes the focal length from the 90 degrees is wrong by up to 0.8 %.
# Guess: all four have 64.00 and 63.5; signs may differ.
#
# Seen on 2026-11-28 (a panorama of 1,024 x 512; the last two are where a view at yaw 30, pitch 20 looks):
#   py360convert: focal length 63.50, centre 63.50 63.50, 30 to the right, 20 up
#   panorama-projection-toolkit: focal length 63.58, centre 63.50 63.50, -30 to the right, 20 up
#   EquiForge: focal length 63.95, centre 64.00 64.00, 30 to the right, -20 up
#   PyAV: focal length 64.08, centre 63.50 63.50, 30 to the right, 20 up
#
# For nerfbake, the middle of a pixel is half a pixel from its edge, in panoramas as in other pictures.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check py360convert==1.0.4 panorama-projection-toolkit==0.4.0 \
  equiforge==0.2.0 av==18.1.0 numpy==2.4.6 scipy 2>/dev/null
PPT_GPU=0 venv/bin/python - 2>log <<'PYTHON'
import contextlib
import io

import av
import equiforge
import numpy as np
import py360convert
from av.filter import Graph
from panorama_projection_toolkit import pano_to_view

WIDE, HIGH, SIZE = 1024, 512, 128
across = ((np.arange(WIDE) + 0.5) / WIDE - 0.5) * 2 * np.pi
up = (0.5 - (np.arange(HIGH) + 0.5) / HIGH) * np.pi
across, up = np.meshgrid(across, up)
PANORAMA = np.stack([np.cos(up) * np.sin(across), np.sin(up), np.cos(up) * np.cos(across)], -1)  # right, up, ahead


def by_equiforge(yaw, pitch):
    with contextlib.redirect_stdout(io.StringIO()):
        picture = ((PANORAMA + 1) * 127.5).round().astype(np.uint8)
        return equiforge.equi2pers(picture, SIZE, SIZE, fov_x=90.0, yaw=yaw, pitch=pitch, roll=0.0) / 127.5 - 1


def by_pyav(yaw, pitch):
    channels = []
    for i in range(3):
        graph = Graph()
        shape = f"video_size={WIDE}x{HIGH}:pix_fmt=gray16le:time_base=1/25:pixel_aspect=1/1"
        view = f"input=e:output=flat:h_fov=90:v_fov=90:yaw={yaw}:pitch={pitch}:w={SIZE}:h={SIZE}:interp=line"
        steps = [graph.add("buffer", shape), graph.add("v360", view), graph.add("format", "gray16le")]
        steps.append(graph.add("buffersink"))
        for one, other in zip(steps, steps[1:], strict=False):
            one.link_to(other)
        graph.configure()
        frame = av.VideoFrame.from_ndarray(((PANORAMA[..., i] + 1) * 32767.5).round().astype(np.uint16), "gray16le")
        frame.pts = 0
        graph.push(frame)
        channels.append(graph.pull().to_ndarray() / 32767.5 - 1)
    return np.stack(channels, -1)


PROGRAMS = {
    "py360convert": lambda yaw, pitch: py360convert.e2p(PANORAMA, 90, yaw, pitch, (SIZE, SIZE)),
    "panorama-projection-toolkit": lambda yaw, pitch: pano_to_view(
        PANORAMA, 90, np.array([pitch, 0, yaw], np.float32), (SIZE, SIZE)
    ),
    "EquiForge": by_equiforge,
    "PyAV": by_pyav,
}
SEEN = (
    ("63.50", "63.50 63.50", 30, 20),
    ("63.58", "63.50 63.50", -30, 20),
    ("63.95", "64.00 64.00", 30, -20),
    ("64.08", "63.50 63.50", 30, 20),
)
inner = np.arange(8, SIZE - 8)
for (name, cut), seen in zip(PROGRAMS.items(), SEEN, strict=True):
    view = cut(0, 0)[8:-8, 8:-8]
    slope, x = np.polyfit(inner, (view[..., 0] / view[..., 2]).mean(0), 1)
    down, y = np.polyfit(inner, (-view[..., 1] / view[..., 2]).mean(1), 1)
    right, high, ahead = cut(30, 20)[SIZE // 2 - 1 : SIZE // 2 + 1, SIZE // 2 - 1 : SIZE // 2 + 1].mean((0, 1))
    yaw = 5 * round(np.degrees(np.arctan2(right, ahead)) / 5)
    pitch = 5 * round(np.degrees(np.arctan2(high, np.hypot(right, ahead))) / 5)
    found = (f"{1 / slope:.2f}", f"{-x / slope:.2f} {-y / down:.2f}", yaw, pitch)
    print("{}: focal length {}, centre {}, {} to the right, {} up".format(name, *found))
    assert found == seen
PYTHON
