"""Settings of a run, from the YAML files beside its checkpoint."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.yaml import MAX_BYTES, parse_map

_ENDINGS = (".yaml", ".yml")
_MOST = 8  # files that have one of the keys


class YamlBeside:
    """The values of these keys in all YAML files of a folder; the first file by name decides.

    places: the file that each key was found in. Files without any of the keys are not parsed. Raises InvalidFile.
    """

    def __init__(self, beside: Mapping[str, memoryview], keys: Collection[str]) -> None:
        self.values: dict[str, Any] = {}
        self.places: dict[str, str] = {}
        names = [name for name in sorted(beside) if name.lower().endswith(_ENDINGS) and name in beside]
        read = 0
        for name in names:
            start = bytes(beside[name][:MAX_BYTES])
            if read == _MOST or not any(key.encode() in start for key in keys):
                continue
            read += 1
            for key, value in parse_map(beside[name], name).items():
                if key in keys and key not in self.values:
                    self.values[key], self.places[key] = value, name

    def flag(self, key: str, default: bool) -> bool:
        """Return a value that is true or false."""
        value = self.values.get(key, default)
        if type(value) is not bool:
            raise self.refusal(key, "true or false")
        return value

    def number(self, key: str, default: float, most: float = 1e6) -> float:
        """Return a number from 0 to `most`."""
        value = self.values.get(key, default)
        if type(value) not in (int, float) or not 0 <= value <= most:
            raise self.refusal(key, f"a number from 0 to {most:g}")
        return float(value)

    def refusal(self, key: str, allowed: str) -> InvalidFile:
        return InvalidFile(Problem(f"{self.places[key]}: {key}", f"is {str(self.values[key])[:60]}", allowed))
