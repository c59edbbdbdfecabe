"""How scenes are displayed: as text in an interpreter, and as HTML in notebook cells."""

from __future__ import annotations

import base64
from dataclasses import fields, is_dataclass
from html import escape
from importlib import import_module
from typing import Any

from nerfbake.errors import NerfbakeError, format_size, one_line

LONGEST = 240  # characters of a repr: three lines of 80
_FACTS, _FACT = 10, 80  # rows of a notebook's table, and characters of each
_EDGE = 160  # pixels of its thumbnail
_LARGEST = 512 << 20  # bytes of a scene; the thumbnail of a larger one takes too long


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


def described(scene: Any) -> str:
    """A table of facts with a thumbnail, for a notebook cell. All text is escaped."""
    package = import_module("nerfbake")
    try:
        facts = package.summarise_scene(scene)
    except (NerfbakeError, AttributeError):  # it has no summary, or is invalid
        facts = {}
    rows = {"scene": str(scene)} | {name: _told(name, value) for name, value in facts.items()}
    cells = "".join(
        f"<tr><th>{escape(name.replace('_', ' '))}</th><td>{escape(one_line(text, _FACT))}</td></tr>"
        for name, text in list(rows.items())[: _FACTS + 1]
    )
    return f"<div>{_thumbnail(scene, facts)}<table>{cells}</table></div>"


def _told(name: str, value: Any) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        return format_size(value) if name.startswith("bytes") else f"{value:,}"
    return "-" if value is None else str(value)


def _thumbnail(scene: Any, facts: dict[str, Any]) -> str:
    """A picture of the scene as HTML; '' if it is too large to wait for, or cannot be rendered."""
    if facts.get("bytes_in_memory", _LARGEST) >= _LARGEST:
        return ""
    parts, cameras = import_module("nerfbake.stages._picture"), import_module("nerfbake.stages.scene_to_cameras")
    try:
        seen = parts.renderable(scene)
        (camera,) = cameras.orbit_cameras(seen, width=_EDGE, height=_EDGE).cameras
        png = encode_first(parts.render_picture(seen, camera))
    except NerfbakeError:  # it cannot be rendered
        return ""
    source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
    return f'<img src="{source}" width="{_EDGE}" height="{_EDGE}" alt="thumbnail" style="float: left">'


def encode_first(scene: object) -> bytes:
    """The bytes of the scene in the first of its formats.

    Scenes do not depend on formats: the catalog is imported by name when a scene is displayed.
    """
    (form, *_) = import_module("nerfbake.catalog").formats_of(type(scene).__name__)
    return b"".join(form.load_module().encode(scene))


def framed(document: bytes, *, scripts: bool, height: int) -> str:
    """An HTML page as an iframe, which isolates its styles, names and policies from the surrounding page.

    scripts: the page may run its own scripts; it never has access to the surrounding page. height: in pixels of the
    surrounding page.
    """
    rights = 'sandbox="allow-scripts" allow="fullscreen; clipboard-write"' if scripts else 'sandbox=""'
    style = f"width: 100%; height: {height}px; border: 0"
    return f'<iframe {rights} style="{style}" srcdoc="{escape(document.decode())}"></iframe>'
