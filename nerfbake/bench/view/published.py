"""What is published of frames of such scenes, beside which our own figures stand. Titles: docs/sources.md."""

from __future__ import annotations

from nerfbake.bench.report import Table

REPORT = Table(
    "TR-24-01, table 3, as context: frames a second at 800x800, Unity's preview, Ryzen 5 5600 and RX 6700 XT",
    ["scene", "128^3", "256^3"],
    [["chair", 317.9, None], ["lego", 205.0, 153.5], ["hot dog", 204.5, 156.3], ["microphone", 280.0, 214.9]],
)
THESIS = Table(
    "The thesis, section 3.1, as context: frames a second before and after its atlas",
    ["program", "MLP, weights in textures", "atlas"],
    [["Unity", 47, 200], ["WebGL", 280, 800]],
)
