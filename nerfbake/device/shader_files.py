"""The WGSL files of the package."""

from __future__ import annotations

import pkgutil
from functools import cache


@cache
def read_wgsl(*names: str) -> str:
    """Return the text of some files of nerfbake/shaders, one below the other; WGSL has no #include.

    >>> read_wgsl("wgsl/common", "wgsl/harmonics").count("fn ")
    6
    """
    texts = []
    for name in names:
        data = pkgutil.get_data("nerfbake", f"shaders/{name}.wgsl")
        assert data is not None
        texts.append(data.decode())
    return "\n".join(texts)
