"""How scenes are displayed: as text in an interpreter, and in the cells of notebooks."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

from nerfbake.errors import one_line

LONGEST = 240  # characters of a repr: three lines of 80


class CompactRepr:
    """A repr of at most three lines for any arrays: the scene's str(), or the shapes of its fields."""

    def __repr__(self) -> str:
        if type(self).__str__ is object.__str__:
            return one_line(f"{type(self).__name__}({', '.join(_fields(self))})", LONGEST)
        return f"<{one_line(f'{type(self).__name__}: {self}', LONGEST - 2)}>"


def _fields(scene: Any) -> list[str]:
    """The scene's fields as text: dtype and shape of an array, length of a long list."""
    found = []
    for field in fields(scene):
        value = getattr(scene, field.name)
        if hasattr(value, "shape"):
            text = f"{value.dtype} {value.shape}"
        elif isinstance(value, tuple | list | dict) and len(value) > 4:
            text = f"{len(value)} of {type(value).__name__}"
        elif is_dataclass(value) and not isinstance(value, CompactRepr):
            text = type(value).__name__
        else:
            text = repr(value)
        found.append(f"{field.name}={text}")
    return found


def notebook_html(scene: object) -> str | None:
    """What a notebook cell shows of a scene: a page, or facts and a thumbnail. None for a scene that is a picture."""
    from nerfbake import display  # the one import from above scenes, when a notebook displays one

    return display.html(scene)


def notebook_png(picture: object) -> bytes:
    """The picture that a notebook cell shows, as a PNG file."""
    from nerfbake import display

    return display.first_format(picture)
