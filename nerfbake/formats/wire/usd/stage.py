"""A model of the stages that are written: prims with attributes and relationships, and the facts of the stage.

A stage has one root prim, which is its default prim. Values are numbers, text or arrays; KINDS lists their types.
Quaternions are in the order w x y z here and in text; the crate stores x y z w.
Source: OpenUSD 26.11, "Basic Data Types for Scene Description Provided by Sdf".
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple


class ValueKind(NamedTuple):
    """A type of values: its number in the crate, NumPy's type of its numbers ('' for text), and their count."""

    code: int
    dtype: str = ""
    columns: int = 1


KINDS = {
    "bool": ValueKind(1, "u1"),
    "int": ValueKind(3, "<i4"),
    "half": ValueKind(7, "<f2"),
    "float": ValueKind(8, "<f4"),
    "double": ValueKind(9, "<f8"),
    "string": ValueKind(10),
    "token": ValueKind(11),
    "asset": ValueKind(12),
    "quatf": ValueKind(17, "<f4", 4),
    "quath": ValueKind(18, "<f2", 4),
    "matrix4d": ValueKind(15, "<f8", 16),
    "float2": ValueKind(20, "<f4", 2),
    "texCoord2f": ValueKind(20, "<f4", 2),
    "double3": ValueKind(23, "<f8", 3),
    "float3": ValueKind(24, "<f4", 3),
    "point3f": ValueKind(24, "<f4", 3),
    "normal3f": ValueKind(24, "<f4", 3),
    "color3f": ValueKind(24, "<f4", 3),
    "half3": ValueKind(25, "<f2", 3),
    "float4": ValueKind(28, "<f4", 4),
}


class Attribute(NamedTuple):
    """An attribute.

    kind      its type: a name of KINDS, with [] for an array
    value     the value; None: it has none
    more      metadata by name: text is a token, a whole number an int
    uniform   its value cannot change over time
    custom    no schema knows it
    source    the path of the attribute that it is connected to; '' for none
    """

    kind: str
    value: Any = None
    more: Mapping[str, str | int] = {}
    uniform: bool = False
    custom: bool = False
    source: str = ""


class Relationship(NamedTuple):
    """A relationship to other prims, by their paths."""

    targets: tuple[str, ...]


@dataclass(frozen=True)
class Prim:
    """A prim with its properties and children, both in order. schemas: the names in its apiSchemas.

    variant_set, variants: the name of a set of variants, of which the first is selected. Only text has them.
    """

    name: str
    kind: str
    properties: Mapping[str, Attribute | Relationship] = field(default_factory=dict)
    children: tuple[Prim, ...] = ()
    schemas: tuple[str, ...] = ()
    variant_set: str = ""
    variants: Mapping[str, UsdVariant] = field(default_factory=dict)


class UsdVariant(NamedTuple):
    """What a prim has if this variant is selected.

    facts      customData below the key nerfbake, by name
    reference  path of a layer whose default prim is added; '' for none
    """

    properties: Mapping[str, Attribute | Relationship] = {}
    children: tuple[Prim, ...] = ()
    facts: Mapping[str, str | float] = {}
    reference: str = ""


class UsdStage(NamedTuple):
    """A stage. root: its only root prim; up: the axis that points up; its unit is a metre."""

    root: Prim
    up: Literal["Y", "Z"]


METRES_PER_UNIT = 1.0
_LONGEST = 100  # characters of a name


def prim_names(wanted: Iterable[str], *, default: str) -> Iterator[str]:
    """Yield an identifier for each of these names, which differ from each other.

    Letters of any script are allowed, digits not at the start. Other characters become an underscore.
    """
    taken: set[str] = set()
    for name in wanted:
        plain = re.sub(r"\W", "_", unicodedata.normalize("NFC", name))[:_LONGEST].strip("_") or default
        plain = plain if plain.isidentifier() else f"_{plain}"
        plain = plain if plain.isidentifier() else default
        found, number = plain, 0
        while found in taken:
            number += 1
            found = f"{plain}_{number}"
        taken.add(found)
        yield found
