"""Scenes in the cells of notebooks: a page in a frame, or a table of facts with a thumbnail.

Scenes are displayed with stages and formats, which are above them. scene/compact_repr.py imports this module when a
notebook asks a scene how it looks.
"""

from __future__ import annotations

import base64
from html import escape
from typing import Any

from nerfbake import catalog
from nerfbake.errors import NerfbakeError, format_size, one_line
from nerfbake.scene.comparison import Comparison
from nerfbake.scene.image import Image
from nerfbake.scene.page import Page
from nerfbake.scene.shipment import Shipment
from nerfbake.stages.picture import render_picture, renderable
from nerfbake.stages.scene_to_cameras import orbit_cameras
from nerfbake.stages.scene_to_summary import summarise_scene

_FACTS, _FACT = 10, 80  # rows of a notebook's table, and characters of each
_EDGE = 160  # pixels of its thumbnail
_LARGEST = 512 << 20  # bytes of a scene; the thumbnail of a larger one takes too long


def html(scene: Any) -> str | None:
    """A page as a frame, another scene as a table of facts with a thumbnail. None for a picture, which is a PNG."""
    if isinstance(scene, Page):
        return _framed(first_format(scene), scripts=True, height=500)
    if isinstance(scene, Comparison | Shipment):
        return _framed(first_format(scene), scripts=False, height=700)
    return None if isinstance(scene, Image) else _table(scene)


def first_format(scene: object) -> bytes:
    """The bytes of the scene in the first of its formats, for example of an Image as PNG."""
    (form, *_) = catalog.formats_of(type(scene).__name__)
    return b"".join(form.load_module().encode(scene))


def _table(scene: Any) -> str:
    """A table of facts with a thumbnail. All text is escaped."""
    try:
        facts = summarise_scene(scene)
    except (NerfbakeError, AttributeError):  # it has no summary, or is invalid
        facts = {}
    rows = {"scene": str(scene)} | {name: _value_text(name, value) for name, value in facts.items()}
    cells = "".join(
        f"<tr><th>{escape(name.replace('_', ' '))}</th><td>{escape(one_line(text, _FACT))}</td></tr>"
        for name, text in list(rows.items())[: _FACTS + 1]
    )
    return f"<div>{_thumbnail(scene, facts)}<table>{cells}</table></div>"


def _value_text(name: str, value: Any) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        return format_size(value) if name.startswith("bytes") else f"{value:,}"
    return "-" if value is None else str(value)


def _thumbnail(scene: Any, facts: dict[str, Any]) -> str:
    """A picture of the scene as HTML; '' if it is too large to wait for, or cannot be rendered."""
    if facts.get("bytes_in_memory", _LARGEST) >= _LARGEST:
        return ""
    try:
        seen = renderable(scene)
        (camera,) = orbit_cameras(seen, width=_EDGE, height=_EDGE).cameras
        png = first_format(render_picture(seen, camera))
    except NerfbakeError:  # it cannot be rendered
        return ""
    source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
    return f'<img src="{source}" width="{_EDGE}" height="{_EDGE}" alt="thumbnail" style="float: left">'


def _framed(document: bytes, *, scripts: bool, height: int) -> str:
    """An HTML page as an iframe, which isolates its styles, names and policies from the surrounding page.

    scripts: the page may run its own scripts; it never has access to the surrounding page. height: in pixels of the
    surrounding page.
    """
    rights = 'sandbox="allow-scripts" allow="fullscreen; clipboard-write"' if scripts else 'sandbox=""'
    style = f"width: 100%; height: {height}px; border: 0"
    return f'<iframe {rights} style="{style}" srcdoc="{escape(document.decode())}"></iframe>'
