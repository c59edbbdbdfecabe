"""Who may import whom and open files, and what the help loads."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.source import PACKAGE, imports, modules

# layer: what it may import from nerfbake, what it may import from outside beyond the standard library
RULES: dict[str, tuple[set[str], set[str]]] = {
    "errors": (set(), set()),
    "kernels": ({"errors", "memory", "progress", "kernels"}, {"numpy", "numba"}),
    "scene": ({"errors", "memory", "progress", "kernels", "scene"}, {"numpy"}),
    "stages": ({"errors", "memory", "progress", "kernels", "scene", "stages"}, {"numpy"}),
    "contract": ({"errors"}, set()),
    "formats": ({"errors", "memory", "progress", "contract", "kernels", "scene", "formats"}, {"numpy"}),
    "memory": ({"errors"}, set()),
    "progress": (set(), set()),
    "catalog": ({"errors", "contract"}, set()),
    "io": ({"errors", "memory", "progress", "contract", "catalog", "io"}, set()),
    "bench": (
        {
            "errors",
            "memory",
            "progress",
            "kernels",
            "scene",
            "stages",
            "formats",
            "contract",
            "catalog",
            "io",
            "batch",
            "jobs",
            "bench",
            "nerfbake",
        },
        {"numpy"},
    ),
    "batch": ({"errors", "memory", "progress", "catalog", "io", "formats.wire", "batch", "nerfbake"}, set()),
    "jobs": ({"errors", "memory", "progress", "catalog", "io", "scene", "stages", "batch", "jobs", "nerfbake"}, set()),
    "cli": (
        {"errors", "memory", "progress", "catalog", "io", "batch", "jobs", "bench", "cli", "nerfbake"},
        {"click", "rich"},
    ),
}
# A part of a layer with rules of its own: what `formats/wire` holds knows no scene.
PARTS = {"formats/wire": ({"errors", "memory", "progress", "kernels", "formats.wire"}, {"numpy"})}
# The one library that a file is about.
OWN_LIBRARY = {
    "bench/access/warp_reader": {"warp"},  # beside ours in bench access
    "bench/atlas/clustering": {"sklearn"},  # beside ours in bench atlas
    "bench/compress/contenders": {"sklearn", "zstandard"},
    "bench/formats/libraries": {"bson", "capnp", "flatbuffers", "google"},
    "bench/plot": {"matplotlib"},
    "bench/view/browser": {"playwright"},
    "formats/atlas/folder": {"PIL"},  # its version, for atlas.json
    "formats/octree/json": {"orjson"},
    "formats/picture/depth_png": {"PIL"},
    "formats/picture/gif": {"PIL"},
    "formats/picture/png": {"PIL"},
    "formats/wire/blosc": {"blosc"},
    "formats/wire/bson": {"bson"},
    "formats/wire/deflate": {"deflate", "zlib_ng"},
    "formats/wire/flatbuffers": {"flatbuffers"},
    "formats/wire/json": {"orjson"},
    "formats/wire/zip_reader": {"deflate"},
    "formats/wire/npz_writer": {"zlib_ng"},
    "formats/wire/photograph": {"PIL"},
    "formats/wire/picture": {"PIL"},
    "formats/wire/texture": {"PIL"},
    "formats/wire/zstd": {"zstandard"},
    "stages/_mesh_summary": {"trimesh"},
}
HEAVY = {
    "blosc",
    "deflate",
    "numba",
    "PIL",
    "bson",
    "capnp",
    "flatbuffers",
    "orjson",
    "zstandard",
    "matplotlib",
    "sklearn",
    "trimesh",
    "warp",
    "numpy",
    "rich",
    "google",
    "zipfile",
    "hashlib",
    "concurrent",
    "asyncio",
}


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_follow_the_rules(path: Path) -> None:
    place = path.relative_to(PACKAGE).with_suffix("")
    ours, outside = PARTS.get(str(place.parent)) or RULES[place.parts[0]]
    for name in imports(path):
        top, _, rest = name.partition(".")
        if top == "nerfbake":
            parts = (rest or "nerfbake").split(".")
            assert {parts[0], ".".join(parts[:2])} & ours, f"{place} may not import {name}"
        elif top not in sys.stdlib_module_names:
            assert top in outside | OWN_LIBRARY.get(str(place), set()), f"{place} may not import {name}"


def test_only_io_opens_files() -> None:
    openers = {"open", "read_bytes", "read_text", "write_bytes", "write_text", "memmap", "fromfile", "tofile"}
    no_files = {"main", "picture"}  # what these open is a device, and bytes in memory
    for path in modules():
        if "io" in path.parts or "bench" in path.parts:  # a benchmark of files opens them
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                if isinstance(node.func, ast.Attribute) and getattr(node.func.value, "id", "") == "Pillow":
                    continue  # Pillow.open() of bytes in memory
                name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
                assert name not in openers or path.stem in no_files, f"{path.name}: {name}() at line {node.lineno}"


@pytest.mark.parametrize("arguments", [["--help"], ["svo", "--help"], ["--version"]])
def test_the_help_loads_nothing_heavy(arguments: list[str]) -> None:
    code = f"""if True:
        import sys
        from nerfbake.cli.main import run
        run({arguments!r})
        print(*sorted({{name.partition('.')[0] for name in sys.modules}} & {HEAVY!r}), file=sys.stderr)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.split() == []
