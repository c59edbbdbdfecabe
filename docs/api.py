"""Writes docs/api.md: every public name with its signature, what its docstring says, and its example.

python docs/api.py                  rewrites docs/api.md
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import nerfbake
from nerfbake import jobs

PAGE = Path(__file__).with_name("api.md")
HEAD = """# API

Every public name of `nerfbake` and of `nerfbake.jobs`, made from its docstring (`make api`). [Python](python.md) shows
how they go together. Letters stand for sizes, everywhere the same: n nodes, m leaves, D values of a node, B functions
of a basis, K clusters. Each example runs in the tests.
"""
SECTIONS = {
    "Files": (nerfbake, "nerfbake.io nerfbake.memory nerfbake.errors"),
    "Scenes": (nerfbake, "nerfbake.scene"),
    "Stages": (nerfbake, "nerfbake.stages"),
    "Jobs": (jobs, "nerfbake.jobs"),
}


def main() -> None:
    PAGE.write_text(page())


def page() -> str:
    """The text of docs/api.md."""
    parts = [HEAD]
    for title, (package, layers) in SECTIONS.items():
        parts.append(f"## {title}\n")
        for name in package.__all__:
            thing = getattr(package, name)
            if thing.__module__.startswith(tuple(layers.split())):
                parts += [
                    f"### {name}\n",
                    f"```py\n{signature(name, thing)}\n```\n",
                    *blocks(inspect.getdoc(thing) or ""),
                ]
    return "\n".join(parts)


def signature(name: str, thing: Callable[..., Any]) -> str:
    """As a reader would type it, a parameter a line where it is long."""
    if inspect.isclass(thing) and issubclass(thing, Exception):
        return f"class {name}(Exception)"
    parameters, starred = [], False
    for each in inspect.signature(thing).parameters.values():
        if each.kind is each.KEYWORD_ONLY and not starred:
            parameters.append("*")
        starred = starred or each.kind in (each.KEYWORD_ONLY, each.VAR_POSITIONAL)
        stars = {each.VAR_POSITIONAL: "*", each.VAR_KEYWORD: "**"}.get(each.kind, "")
        default = "" if each.default is each.empty else f" = {_shown(each.default)}"
        annotation = getattr(each.annotation, "__forward_arg__", each.annotation)  # as named tuples hold them
        parameters.append(f"{stars}{each.name}: {annotation}{default}")
    line = f"{name}({', '.join(parameters)})"
    if len(line) > 100:
        line = f"{name}(\n    " + ",\n    ".join(parameters) + ",\n)"
    result = inspect.signature(thing).return_annotation
    return line if inspect.isclass(thing) else f"{line} -> {result}"


def _shown(default: Any) -> str:
    """A default as one would type it; what a dataclass makes anew for each object has no such spelling."""
    return repr(default) if isinstance(default, str | int | float | tuple | None) else "..."


def blocks(text: str) -> Iterator[str]:
    """A docstring's paragraphs: examples as code, columns as they stand, everything else as prose."""
    for paragraph in text.split("\n\n"):
        if paragraph.lstrip().startswith(">>>"):
            yield f"```pycon\n{inspect.cleandoc(paragraph)}\n```\n"
        elif re.search(r"^\s|\S {2,}\S", paragraph, re.MULTILINE):
            yield f"```text\n{paragraph.rstrip()}\n```\n"
        else:
            yield re.sub(r"([*_<|])", r"\\\1", paragraph) + "\n"


if __name__ == "__main__":
    main()
