"""Rules for imports between layers, for opening files, and for the modules that --help loads."""

from __future__ import annotations

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests.support.source import PACKAGE, import_graph, imports, imports_by_name, modules, parsed

ANY = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or path.is_dir()}
# layer: allowed imports from nerfbake, and from packages other than the standard library
RULES: dict[str, tuple[set[str], set[str]]] = {
    "errors": (set(), set()),
    "installation": ({"errors"}, set()),
    "kernels": ({"errors", "memory", "progress", "kernels"}, {"numpy", "numba"}),
    "scene": ({"errors", "memory", "progress", "kernels", "scene"}, {"numpy"}),
    "device": ({"errors", "installation", "memory", "kernels", "device"}, {"numpy"}),
    "stages": ({"errors", "memory", "progress", "kernels", "device", "scene", "stages"}, {"numpy"}),
    "contract": ({"errors"}, set()),
    "formats": (
        {"errors", "installation", "memory", "progress", "contract", "kernels", "scene", "formats"},
        {"numpy"},
    ),
    "memory": ({"errors"}, set()),
    "progress": (set(), set()),
    "catalog": ({"errors", "contract"}, set()),
    "io": ({"errors", "memory", "progress", "contract", "catalog", "io"}, set()),
    "batch": ({"errors", "memory", "progress", "catalog", "io", "formats.wire", "batch", "__version__"}, set()),
    "jobs": (
        {
            *("errors", "installation", "memory", "progress", "kernels", "device", "catalog", "io"),
            *("scene", "stages", "batch", "jobs", "__version__"),
        },
        set(),
    ),
    "console": ({"errors", "progress", "kernels", "io"}, {"rich"}),
    "api": ({"errors", "scene", "stages", "jobs", "console"}, set()),
    "display": ({"errors", "catalog", "scene", "stages"}, set()),
    "bench": (ANY - {"cli"}, {"numpy"}),
    "cli": (ANY | {"__version__"}, {"click"}),
}
# Parts of a layer with other rules: `formats/wire` may not import scenes.
_WIRE = ({"errors", "installation", "memory", "progress", "kernels", "formats.wire"}, {"numpy"})
PARTS = {"formats/wire": _WIRE, "formats/wire/usd": _WIRE}
# What a single module may import from a layer above its own: a scene is displayed with stages and formats.
UPWARD = {"scene/compact_repr": {"display"}}
# What a single module may import by import_module(): * is any module.
BY_NAME = {
    "catalog": {"nerfbake.formats"},  # formats are imported when a file needs them
    "cli/params": {"*"},  # classes of jobs are imported when a command runs
    "bench/measure": {"*"},  # a function for a child process
}
# Libraries that a single module may import.
OWN_LIBRARY = {
    "bench/access/warp_reader": {"warp"},  # compared in bench access
    "bench/atlas": {"sklearn"},  # compared in bench atlas
    "bench/compress": {"sklearn", "zstandard"},
    "bench/formats/libraries": {"bson", "capnp", "flatbuffers", "google"},
    "bench/plot": {"matplotlib"},
    "device/library": {"wgpu"},
    "formats/atlas/folder": {"PIL"},  # for its version in atlas.json
    "formats/octree/flatbuffers": {"flatbuffers"},
    "formats/octree/json": {"orjson"},
    "formats/picture/depth_png": {"PIL"},
    "formats/picture/gif": {"PIL"},
    "formats/picture/png": {"PIL"},
    "formats/wire/blosc": {"blosc"},
    "formats/wire/deflate": {"deflate", "zlib_ng"},
    "formats/wire/json": {"orjson"},
    "formats/wire/npz": {"zlib_ng"},
    "formats/wire/heif": {"pillow_heif", "pi_heif"},
    "formats/wire/colour_profile": {"PIL"},
    "formats/wire/picture": {"PIL"},
    "formats/wire/png": {"deflate"},
    "formats/wire/usd/_child": {"pxr"},  # in a process of its own
    "formats/wire/usd/package": {"deflate"},
    "formats/wire/usd/text": {"orjson"},
    "formats/wire/video": {"av"},
    "formats/wire/yaml": {"yaml"},
    "formats/wire/zip_reader": {"deflate"},
    "formats/wire/zstd": {"zstandard"},
    "jobs/_matching": {"numpy"},  # in the process of pycolmap, which must not load kernels
    "jobs/_pycolmap": {"pycolmap"},
    "scene/packed_pictures": {"zstandard"},  # in memory alone
    "stages/mesh_to_mesh": {"fast_simplification"},
}
HEAVY = {
    "av",
    "fast_simplification",
    "blosc",
    "deflate",
    "numba",
    "PIL",
    "pillow_heif",
    "pi_heif",
    "bson",
    "capnp",
    "flatbuffers",
    "orjson",
    "zstandard",
    "matplotlib",
    "pxr",
    "pycolmap",
    "sklearn",
    "trimesh",
    "warp",
    "wgpu",
    "yaml",
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
    ours = ours | UPWARD.get(str(place), set())
    for name in imports(path):
        top, _, rest = name.partition(".")
        if top == "nerfbake":
            parts = (rest or "nerfbake").split(".")
            assert {parts[0], ".".join(parts[:2])} & ours, f"{place} may not import {name}"
        elif top not in sys.stdlib_module_names:
            assert top in outside | OWN_LIBRARY.get(str(place), set()), f"{place} may not import {name}"


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_import_module_follows_the_rules(path: Path) -> None:
    place = path.relative_to(PACKAGE).with_suffix("")
    allowed = BY_NAME.get(str(place), set())
    for name in imports_by_name(path):
        assert name in allowed or ".".join(name.split(".")[:2]) in allowed, f"{place} may not import {name} by name"


def test_a_private_module_is_imported_by_its_own_package_alone() -> None:
    foreign = [
        (path.name, found.name)
        for path, imported in import_graph().items()
        for found in imported
        if found.name.startswith("_") and found.parent != path.parent
    ]
    assert foreign == []


def test_imports_form_no_circle() -> None:
    """An import inside a function counts, except those of UPWARD."""
    upward = {PACKAGE / f"{place}.py": {PACKAGE / f"{name}.py" for name in names} for place, names in UPWARD.items()}
    TopologicalSorter({path: found - upward.get(path, set()) for path, found in import_graph().items()}).prepare()


def test_only_io_opens_files() -> None:
    openers = {"open", "read_bytes", "read_text", "write_bytes", "write_text", "memmap", "fromfile", "tofile"}
    # These open a device, bytes in memory, metadata of a package, files in their own process, or the cache of kernels.
    no_files = {"main", "picture", "video", "installation", "_pycolmap", "_child", "kernel_cache"}
    for path in modules():
        if "io" in path.parts or "bench" in path.parts:  # benchmarks of files open them
            continue
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Call):
                if isinstance(node.func, ast.Attribute) and getattr(node.func.value, "id", "") == "Pillow":
                    continue  # Pillow.open() of bytes in memory
                name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
                assert name not in openers or path.stem in no_files, f"{path.name}: {name}() at line {node.lineno}"


def _loaded(arguments: list[str], names: set[str]) -> set[str]:
    """Run a command in a process of its own and return which of these top-level modules it loaded."""
    code = f"""if True:
        import sys
        from nerfbake.cli.main import run
        code = run({arguments!r})
        print(*{{name.partition('.')[0] for name in sys.modules}} & {names!r}, file=sys.stderr)
        sys.exit(code)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stderr.split()) & names


@pytest.mark.parametrize("arguments", [["--help"], ["svo", "--help"], ["--version"]])
def test_the_help_loads_nothing_heavy(arguments: list[str]) -> None:
    assert _loaded(arguments, HEAVY) == set()


def test_the_api_does_not_load_click() -> None:
    code = """if True:
        import sys
        import nerfbake
        nerfbake.jobs.Steps, nerfbake.fit
        print(*{"click", "rich"} & {*sys.modules})"""
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "\n"


def test_commands_that_need_no_kernels_do_not_load_numba(tmp_path: Path) -> None:
    tree, octree, other = (str(tmp_path / name) for name in ("a.npz", "a.svo.pb", "a.svo.npz"))
    _loaded(["sample", "octree", tree, "--resolution", "8", "--quiet"], set())
    for arguments in (["check", tree], ["info", tree], ["svo", tree, octree], ["convert", octree, other]):
        assert _loaded([*arguments, "--quiet"], {"numba", "llvmlite"}) == set(), arguments[0]
    assert Path(other).exists()
