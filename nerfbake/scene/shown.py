"""How scenes show themselves where somebody asks them to, as notebooks do with what a cell gives."""

from __future__ import annotations

from html import escape
from importlib import import_module


def encoded(scene: object) -> bytes:
    """What a file of the scene holds, in the first of its formats.

    Scenes know no formats: the table of formats does, and is asked for by its name when somebody wants to look.
    """
    (form, *_) = import_module("nerfbake.catalog").formats_of(type(scene).__name__)
    return b"".join(form.load_module().encode(scene))


def framed(document: bytes, *, scripts: bool, height: int) -> str:
    """A whole page as an element of another one, in a frame: styles, names and policies of the two stay apart.

    scripts: the page may run its own; it never gets at the page around it. height: in that page's pixels.
    """
    rights = 'sandbox="allow-scripts" allow="fullscreen; clipboard-write"' if scripts else 'sandbox=""'
    style = f"width: 100%; height: {height}px; border: 0"
    return f'<iframe {rights} style="{style}" srcdoc="{escape(document.decode())}"></iframe>'
