"""Write the package's shaders to a folder, for an engine or a web page."""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.files import FolderTarget
from nerfbake.jobs.steps import SILENT, Steps

LANGUAGES = ("glsl", "hlsl", "wgsl", "c")
NEEDS = {  # each shader and the files that it includes; WGSL has no #include, so paste them above it
    "octree": ("common",),
    "vdb_index": ("common",),
    "march": ("common", "harmonics"),
    "harmonics": (),
    "atlas": (),
    "mlp": ("common",),
    "world": (),
    "nanovdb": (),
}
PAGE = "README.md"
_TITLE = b"# Shaders that read nerfbake's files\n"  # the first line of PAGE, in every version
# HLSL has the harmonics of GLSL, with these changes.
_TO_HLSL = (
    (r"(?m)^// GLSL ES .*$", "// HLSL, shader model 5."),
    (r"(?m)^(precision .*\n)+\n", ""),
    (r"(?m)^const ", "static const "),
    (r"\bvec3\b", "float3"),
    (r"_GLSL\b", "_HLSL"),
)
_INCLUDE = re.compile(r'^#include "(.*)"\n', re.MULTILINE)


def _path(language: str, name: str) -> str:
    """Return the path of a shader in the package and in the output; '' if the language has none.

    C and HLSL share one nanovdb file.
    """
    if name == "nanovdb":
        return "pnanovdb/nanovdb.h" if language in ("hlsl", "c") else ""
    return "" if language == "c" else f"{language}/{name}.{language}"


def _recognise(files: Mapping[str, memoryview]) -> bool:
    return PAGE in files and bytes(files[PAGE][: len(_TITLE)]) == _TITLE


_NAMES = {*NEEDS, *(name for names in NEEDS.values() for name in names)}
_PATHS = (PAGE, *(_path(language, name) for language in LANGUAGES for name in _NAMES if _path(language, name)))
CONTENTS = io.FolderContents("nerfbake's shaders", re.compile("|".join(map(re.escape, _PATHS))), _recognise)


def write_shaders(
    target: FolderTarget | str | Path,
    *,
    languages: Sequence[str] = (),
    what: Sequence[str] = (),
    steps: Steps = SILENT,
) -> dict[str, int]:
    """Write lookups, ray marcher, harmonics and transforms as shaders. This is `nerfbake shaders`.

    Reads nothing. Writes the folder `target`: a page that explains the inputs, and a folder for each language. Returns
    the size in bytes of each file. Raises NerfbakeError.

    languages  some of LANGUAGES; none: all. In C there is only nanovdb, a file that is also valid HLSL
    what       some of NEEDS; none: all. Files that they include are written, too

    >>> sorted(write_shaders("shaders", languages=["hlsl"], what=["octree"]))
    ['README.md', 'hlsl/common.hlsl', 'hlsl/octree.hlsl']
    """
    _require_known("language", languages, LANGUAGES)
    _require_known("what", what, tuple(NEEDS))
    wanted = {name: None for chosen in what or NEEDS for name in (*NEEDS[chosen], chosen)}
    paths = {path: None for language in languages or LANGUAGES for name in wanted if (path := _path(language, name))}
    if not paths:
        allowed = "nanovdb in hlsl and c, all else in glsl, hlsl and wgsl"
        raise UsageError(f"{', '.join(what)} does not exist in {', '.join(languages)}; allowed: {allowed}")
    target = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    target.require(CONTENTS)
    files = [(path, [shader_text(path).encode()]) for path in (PAGE, *paths)]
    with steps.phase(f"writing {target.path}"):
        sizes = io.save_files(target.path, files, CONTENTS, force=target.force)
    steps.say(f"{target.path}: {len(sizes)} files, {sum(sizes.values()):,} bytes; {PAGE} explains their inputs")
    return sizes


def _require_known(option: str, given: Sequence[str], known: Sequence[str]) -> None:
    for value in given:
        if value not in known:
            raise UsageError(f"{option} is {value!r:.40}; allowed: {', '.join(known)}")


def shader_text(name: str) -> str:
    """Return the text of a shader of the package, such as "glsl/octree.glsl", ready to be compiled.

    WebGL has no #include, so a GLSL file contains the text of its includes, with their include guards. If you paste
    several files into one, only the first copy of an include is compiled.
    """
    if name == "hlsl/harmonics.hlsl":
        text = shader_text("glsl/harmonics.glsl")
        for pattern, other in _TO_HLSL:
            text = re.sub(pattern, other, text)
        return text
    data = pkgutil.get_data("nerfbake", f"shaders/{name}")
    assert data is not None
    text = data.decode()
    if name.endswith(".glsl"):
        return _INCLUDE.sub(lambda found: shader_text(f"glsl/{found[1]}"), text)
    return text
