"""The rows of `bench formats`: every way to write an octree."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from nerfbake import catalog
from nerfbake.bench.formats.libraries import LIBRARIES
from nerfbake.errors import UsageError

RAW = "raw"


class Serialization(NamedTuple):
    """One row. kind: raw, format or library; name and profile say which; packed with zstd or not."""

    kind: str
    name: str
    profile: str | None = None
    packed: bool = False
    slow: bool = False

    @property
    def label(self) -> str:
        return f"{self.name}{catalog.COMPRESSED if self.packed else ''}{f' {self.profile}' if self.profile else ''}"


def serializations() -> Iterator[Serialization]:
    """Every row that there is: the floor, our formats in each profile, those with .zst, then the libraries' own use."""
    forms = catalog.formats_of("SparseVoxelOctree")
    ours = [(form.name, profile) for form in forms for profile in _profiles(form)]
    yield Serialization(RAW, RAW)
    yield from (Serialization("format", name, profile) for name, profile in ours)
    yield from (Serialization("format", form.name, _profiles(form)[0], packed=True) for form in forms)
    yield from (Serialization("library", library.name, slow=library.slow) for library in LIBRARIES)


def _profiles(form: catalog.Format) -> tuple[str | None, ...]:
    return form.choices("profile") or (None,)


def chosen(names: Iterable[str]) -> list[Serialization]:
    """The rows whose label starts with one of these names, all if there is none, and always the floor."""
    known, names = list(serializations()), list(names)
    for name in names:
        if not any(row.label.startswith(name) for row in known):
            raise UsageError(f"no format is called {name!r}; allowed: {', '.join(row.label for row in known)}")
    return [row for row in known if row.kind == RAW or not names or row.label.startswith(tuple(names))]
