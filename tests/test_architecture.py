"""The rules of the house: who may import whom, and what the catalog lists."""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import nerfbake
from nerfbake import catalog, jobs
from tests.conftest import REPOSITORY

PACKAGE = REPOSITORY / "nerfbake"

# layer: what it may import from nerfbake, what it may import from outside beyond the standard library
RULES: dict[str, tuple[set[str], set[str]]] = {
    "errors": (set(), set()),
    "kernels": ({"errors", "memory", "kernels"}, {"numpy", "numba"}),
    "scene": ({"errors", "memory", "kernels", "scene"}, {"numpy"}),
    "stages": ({"errors", "memory", "kernels", "scene", "stages"}, {"numpy"}),
    "formats": ({"errors", "memory", "kernels", "scene", "formats"}, {"numpy"}),
    "memory": ({"errors"}, set()),
    "catalog": ({"errors"}, set()),
    "io": ({"errors", "memory", "catalog", "io"}, set()),
    "jobs": ({"errors", "memory", "catalog", "io", "scene", "stages", "jobs", "nerfbake"}, set()),
    "bench": ({"errors", "memory", "kernels", "scene", "stages", "catalog", "io", "bench", "nerfbake"}, {"numpy"}),
    "cli": ({"errors", "memory", "catalog", "io", "jobs", "bench", "cli", "nerfbake"}, {"click", "rich"}),
}
# A part of a layer with rules of its own: what `formats/wire` holds knows no scene.
PARTS = {"formats/wire": ({"errors", "memory", "kernels", "formats.wire"}, {"numpy"})}
# The one library that a file is about.
OWN_LIBRARY = {
    "bench/access/warp_reader": {"warp"},  # beside ours in bench access
    "bench/atlas/clustering": {"sklearn"},  # beside ours in bench atlas
    "bench/formats/libraries": {"bson", "capnp", "flatbuffers", "google"},
    "bench/plot": {"matplotlib"},
    "formats/atlas/folder": {"PIL"},  # its version, for atlas.json
    "formats/octree/json": {"orjson"},
    "formats/picture/depth_png": {"PIL"},
    "formats/picture/gif": {"PIL"},
    "formats/picture/png": {"PIL"},
    "formats/wire/blosc": {"blosc"},
    "formats/wire/bson": {"bson"},
    "formats/wire/deflate": {"deflate", "zlib_ng"},
    "formats/wire/json": {"orjson"},
    "formats/wire/npz_reader": {"deflate"},
    "formats/wire/npz_writer": {"zlib_ng"},
    "formats/wire/picture": {"PIL"},
    "formats/wire/texture": {"PIL"},
    "formats/wire/zstd": {"zstandard"},
}
HEAVY = {
    "blosc",
    "deflate",
    "numba",
    "PIL",
    "bson",
    "orjson",
    "zstandard",
    "matplotlib",
    "numpy",
    "rich",
    "google",
    "zipfile",
    "hashlib",
    "concurrent",
    "asyncio",
}


def modules() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py") if path.name not in ("__init__.py", "__main__.py"))


def imports(path: Path) -> set[str]:
    """Dotted names of all modules that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {
                f"{node.module}.{alias.name}" if node.module == "nerfbake" else str(node.module) for alias in node.names
            }
    return found


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


def formats() -> list[str]:
    """The modules of `formats` that say encode() or decode(): what they import from their family says neither."""
    found = []
    for path in modules():
        place = path.relative_to(PACKAGE.parent).with_suffix("")
        functions = {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}
        if "formats" in place.parts and "wire" not in place.parts and functions & {"encode", "decode"}:
            found.append(".".join(place.parts))
    return found


def test_every_format_and_stage_has_its_line() -> None:
    def files(folder: str) -> set[str]:
        return {f"nerfbake.{folder}.{path.stem}" for path in (PACKAGE / folder).glob("[!_]*.py")}

    assert {f"nerfbake.formats.{form.module}" for form in catalog.FORMATS + catalog.FOLDERS} == set(formats())
    assert set(catalog.STAGES.values()) == files("stages")
    assert set(catalog.SCENES.values()) <= files("scene")


def test_every_line_of_the_catalog_is_true() -> None:
    for form in catalog.FORMATS:
        module = form.load_module()
        assert callable(module.encode)
        assert {hasattr(module, name) for name in ("decode", "recognise")} == {form.readable}
        assert form.scene in catalog.SCENES
        assert form.name == form.suffix.removeprefix(".")
    for name, home in (catalog.STAGES | catalog.SCENES).items():
        assert callable(getattr(import_module(home), name))


def test_every_folder_of_the_catalog_is_true() -> None:
    for form in catalog.FOLDERS:
        module = form.load_module()
        assert all(callable(getattr(module, name)) for name in ("decode", "recognise"))
        assert form.scene in catalog.SCENES
    written = {catalog.folders_of(form.scene)[0] for form in catalog.FOLDERS}
    assert all(callable(form.load_module().encode) for form in written)


def test_longer_endings_come_first() -> None:
    endings = [form.suffix for form in catalog.FORMATS]
    for i, ending in enumerate(endings):
        assert not any(ending.endswith(earlier) for earlier in endings[:i])


def test_public_names_are_there() -> None:
    for name in nerfbake.__all__:
        assert callable(getattr(nerfbake, name))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = nerfbake.nonsense


def test_public_jobs_are_there() -> None:
    written = {
        node.name
        for path in (PACKAGE / "jobs").glob("[!_]*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and any(argument.arg == "steps" for argument in node.args.kwonlyargs)
    }
    assert set(jobs.JOBS) == written
    for name in jobs.__all__:
        assert callable(getattr(jobs, name))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = jobs.nonsense


@pytest.mark.parametrize("arguments", [["--help"], ["svo", "--help"], ["--version"]])
def test_the_help_loads_nothing_heavy(arguments: list[str]) -> None:
    code = f"""if True:
        import sys
        from nerfbake.cli.main import run
        run({arguments!r})
        print(*sorted({{name.partition('.')[0] for name in sys.modules}} & {HEAVY!r}), file=sys.stderr)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.split() == []


# What NumPy, a BLAS or the C library compute by the CPU that they run on: not to its last bit the same on two of them.
BY_CPU = {"arccos", "arcsin", "arctan", "arctan2", "cbrt", "cos", "cosh", "dot", "einsum", "exp", "exp2", "expm1"}
BY_CPU |= {"hypot", "inner", "log", "log10", "log1p", "log2", "matmul", "sin", "sinh", "tan", "tanh", "tensordot"}


@pytest.mark.parametrize("layer", ["kernels", "scene", "stages", "formats"])
def test_what_is_written_does_not_hang_on_the_cpu(layer: str) -> None:
    found = []
    for path in sorted((PACKAGE / layer).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            place = f"{path.name}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
                found.append(f"{place} @")
            if isinstance(node, ast.Attribute):
                name = ast.unparse(node)
                if name.removeprefix("np.") in BY_CPU and name.startswith("np."):
                    found.append(f"{place} {name}")
                if name.startswith("np.linalg.") and name != "np.linalg.norm":
                    found.append(f"{place} {name}")
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "np.linalg.norm":
                # With an axis it is a sum of squares in order; without one it asks the BLAS.
                found += [] if any(word.arg == "axis" for word in node.keywords) else [f"{place} np.linalg.norm"]
            if isinstance(node, ast.keyword) and node.arg == "fastmath":
                found.append(f"{place} fastmath")
    assert found == []
