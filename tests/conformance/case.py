"""A frozen scene: its files, what a reader must find in them, and what our reader finds."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from nerfbake import catalog
from nerfbake.catalog import AnyFormat
from tests.conftest import REPOSITORY

HOME = REPOSITORY / "schemas" / "conformance"
SUFFIX = ".expected.json"
COMPUTED = ("lookups", "rays")  # keys whose numbers a reader computes; all others stand in the files

Facts = dict[str, Any]


@dataclass(frozen=True)
class Frozen:
    """A file, or a folder, and how it is written: a format of the catalog, and what its encode() takes.

    data: the file itself, or a folder's files by their names, of a format that is read alone.
    beside: by their names, the files in the same folder that its reader needs.
    """

    form: AnyFormat
    scene: Any
    options: Facts = field(default_factory=dict)
    compressed: bool = False
    data: bytes | Mapping[str, bytes] | None = None
    beside: Mapping[str, bytes] = field(default_factory=dict)

    def pieces(self) -> Any:
        """What is written: pieces of bytes, or of a folder names with such pieces."""
        if self.data is not None:
            return [self.data] if isinstance(self.data, bytes) else [(name, [data]) for name, data in self.data.items()]
        pieces: Any = self.form.load_module().encode(self.scene, **self.options)
        return catalog.load_compression().compress(pieces) if self.compressed else pieces

    def written(self, name: str) -> dict[str, bytes]:
        """All files by their paths below HOME; `name` is the file's or the folder's."""
        if isinstance(self.form, catalog.FolderKind):
            return {f"{name}/{file}": b"".join(pieces) for file, pieces in self.pieces()}
        return {name: b"".join(self.pieces())} | dict(zip(self.beside_paths(name), self.beside.values(), strict=True))

    def beside_paths(self, name: str) -> list[str]:
        """The paths below HOME of the files beside the one of this name."""
        return [f"{PurePosixPath(name).parent}/{each}" for each in self.beside]


@dataclass(frozen=True)
class Case:
    """name: the path of the expected values below HOME, without SUFFIX; files: by their paths below HOME.

    facts   what a reader must find, as JSON has it, worked out from the hand-written scene alone
    answer  what our reader finds in one of the files, in the same words; it may look up there where it is to look
    stored, computed  how far numbers of the file, and numbers that a reader computes, may be off: times max(1, number)
    """

    name: str
    about: str
    files: Mapping[str, Frozen]
    facts: Facts
    answer: Callable[[Path, Facts], Facts]
    stored: float = 0
    computed: float = 1e-6

    @property
    def path(self) -> Path:
        return HOME / f"{self.name}{SUFFIX}"

    def document(self, packed_by: Callable[[str], dict[str, str]]) -> Facts:
        """What the JSON says. packed_by: of a file's path the libraries that decide its bytes."""
        files = {}
        for name, frozen in self.files.items():
            ending = catalog.COMPRESSED if frozen.compressed else ""
            files[name] = {"format": frozen.form.name + ending, "options": frozen.options}
            packers = {path: packed_by(path) for path in frozen.written(name)}
            files[name]["packed_by"] = packers if isinstance(frozen.form, catalog.FolderKind) else packers[name]
            if frozen.beside:
                files[name]["beside"] = frozen.beside_paths(name)
        tolerance = {"stored": self.stored, "computed": self.computed}
        return {"about": self.about, "files": files, "tolerance": tolerance, **self.facts}

    def recorded(self) -> dict[str, dict[str, str]]:
        """By the path of each file what its JSON says that packed it; {} where there is no JSON yet."""
        found: dict[str, dict[str, str]] = {}
        files = json.loads(self.path.read_text())["files"] if self.path.exists() else {}
        for name, told in files.items():
            kind = form_named(told["format"].removesuffix(catalog.COMPRESSED))
            found |= told["packed_by"] if isinstance(kind, catalog.FolderKind) else {name: told["packed_by"]}
            found |= {path: {} for path in told.get("beside", ())}
        return found


def text_of(value: Any, indent: str = "") -> str:
    """JSON that a person can read and `git diff` can show: rows of numbers on a line each."""
    line = json.dumps(value)
    inner = indent + " "
    if isinstance(value, dict) and value and (not indent or len(line) > 110):
        lines = [f"{inner}{json.dumps(key)}: {text_of(each, inner)}" for key, each in value.items()]
        return "{\n" + ",\n".join(lines) + "\n" + indent + "}"
    if isinstance(value, list) and len(line) > 110 and isinstance(value[0], list | dict):
        return "[\n" + ",\n".join(inner + text_of(each, inner) for each in value) + "\n" + indent + "]"
    return line


def require_like(
    found: Any, expected: Any, tolerance: Mapping[str, float], place: str = "", kind: str = "stored"
) -> None:
    """Raises AssertionError with the first place where two values of JSON differ by more than is allowed."""
    if isinstance(expected, dict):
        assert isinstance(found, dict), place
        assert found.keys() == expected.keys(), place
        for key, value in expected.items():
            require_like(found[key], value, tolerance, f"{place}.{key}", "computed" if key in COMPUTED else kind)
    elif isinstance(expected, list):
        assert isinstance(found, list), place
        assert len(found) == len(expected), place
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            require_like(one, other, tolerance, f"{place}[{i}]", kind)
    elif type(expected) is float:
        assert type(found) in (float, int), place
        assert abs(found - expected) <= tolerance[kind] * max(1, abs(expected)), (place, found, expected)
    else:
        assert found == expected, place
        assert type(found) is type(expected) or type(found) is float, place


def form_named(name: str, scene: str | None = None) -> AnyFormat:
    """The format of this name; scene: of this scene type, where two have the name."""
    forms = (*catalog.FORMATS, *catalog.FOLDERS)
    return next(form for form in forms if form.name == name and scene in (None, form.scene))


def floats(array: Any) -> Any:
    """An array as lists of numbers: float32 and float16 are floats exactly."""
    return None if array is None else array.tolist()
