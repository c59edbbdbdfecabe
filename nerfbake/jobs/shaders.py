"""The shader twins as files, for an engine or a page of one's own."""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Sequence
from pathlib import Path

from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.files import FolderTarget
from nerfbake.jobs.steps import SILENT, Steps

LANGUAGES = ("glsl", "hlsl", "wgsl", "c")
NEEDS = {  # each file, and the files that it includes; WGSL has no #include, so they are pasted above it
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
_INCLUDE = re.compile(r'^#include "(.*)"\n', re.MULTILINE)


def write_shaders(
    target: FolderTarget | str | Path,
    *,
    languages: Sequence[str] = (),
    what: Sequence[str] = (),
    steps: Steps = SILENT,
) -> dict[str, int]:
    """Writes lookups, marcher, harmonics and transforms as shaders, gives the files' sizes; `nerfbake shaders`.

    Reads nothing, writes the folder `target`: a page that says how to feed them, and a folder for each language.
    languages, what: of LANGUAGES and NEEDS; none are all. What another file needs is written with it; of C there is
    nanovdb alone, which is HLSL, too.
    Raises NerfbakeError.

    >>> sorted(write_shaders("shaders", languages=["hlsl"], what=["octree"]))
    ['README.md', 'hlsl/common.hlsl', 'hlsl/octree.hlsl']
    """
    _require_known("language", languages, LANGUAGES)
    _require_known("what", what, tuple(NEEDS))
    wanted = {name: None for chosen in what or NEEDS for name in (*NEEDS[chosen], chosen)}
    paths = {path: None for language in languages or LANGUAGES for name in wanted if (path := _path(language, name))}
    if not paths:
        allowed = "nanovdb in hlsl and c, all else in glsl, hlsl and wgsl"
        raise UsageError(f"{', '.join(what)} is not there in {', '.join(languages)}; allowed: {allowed}")
    target = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    target.require()
    files = [(path, [shader_text(path).encode()]) for path in (PAGE, *paths)]
    with steps.phase(f"writing {target.path}"):
        sizes = io.save_files(target.path, files, force=target.force)
    steps.say(f"{target.path}: {len(sizes)} files, {sum(sizes.values()):,} bytes; {PAGE} says how to feed them")
    return sizes


def _require_known(option: str, given: Sequence[str], known: Sequence[str]) -> None:
    for value in given:
        if value not in known:
            raise UsageError(f"{option} is {value!r:.40}; allowed: {', '.join(known)}")


def _path(language: str, name: str) -> str:
    """Where a file stands, both here and there; '' where the language has none. What is C and HLSL at once is one."""
    if name == "nanovdb":
        return "pnanovdb/nanovdb.h" if language in ("hlsl", "c") else ""
    return "" if language == "c" else f"{language}/{name}.{language}"


def shader_text(name: str) -> str:
    """A shader of the package, ready to be compiled: "glsl/octree.glsl".

    WebGL has no #include, so a GLSL file carries the text of what it includes, behind the same guards: of several files
    that are pasted one below the other only the first copy counts.
    """
    data = pkgutil.get_data("nerfbake", f"shaders/{name}")
    assert data is not None
    text = data.decode()
    if name.endswith(".glsl"):
        return _INCLUDE.sub(lambda found: shader_text(f"glsl/{found[1]}"), text)
    return text
