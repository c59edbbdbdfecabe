"""What is published of octrees in these formats, beside which our own figures stand: TR-24-01's appendix B.

The report's title: docs/sources.md.
"""

from __future__ import annotations

from nerfbake.bench.report import Table

# Tables 4 and 5: LEGO at 128^3, 420k nodes x 49 float32, on a free Colab CPU.
PAPER = Table(
    "TR-24-01, table 5, as context: another machine and another scene (LEGO at 128^3)",
    ["format", "encode s", "MB"],
    [
        ["JSON", 35.5, 244.8],
        ["BSON", 18.0, 421.0],
        ["Protocol Buffers", 4.4, 120.0],
        ["FlatBuffers", 60.0, 96.0],
        ["Cap'n Proto", 6.8, 96.0],
    ],
)
PAPER_BYTES = 96e6
FEATURES = Table(
    "Features (after TR-24-01, table 4)",
    ["format", "binary", "Python", "C#", "packed arrays", "generic types"],
    [
        ["JSON", False, True, True, False, False],
        ["BSON", True, True, True, "as binary only", False],
        ["Protocol Buffers", True, True, True, True, "by type_url"],
        ["FlatBuffers", True, True, True, True, False],
        ["Cap'n Proto", True, True, True, True, True],
        ["NumPy .npz", True, True, "third party", True, "by dtype"],
        ["BinaryFormatter", True, False, "withdrawn", True, True],
    ],
)
WITHDRAWN = "not measured: .NET only; Microsoft withdrew it as unsafe and took it out of .NET 9"
