"""Find the scene in gzip, or in a zip archive that holds nothing else that could be one."""

from __future__ import annotations

from collections.abc import Mapping

from nerfbake.catalog import ARCHIVES, FORMATS, load_wrapping
from nerfbake.errors import InvalidFile
from nerfbake.io.sources import require_some

_MOST = 3  # wrappings around each other
_PICTURES = ("Image", "Depth", "EnvironmentMap")  # scenes that also lie beside others, as textures
_NO_SCENES = ("Cameras",)  # readable files that say nothing without their folder


def unwrapped(view: memoryview, path: str) -> tuple[memoryview, str, Mapping[str, memoryview] | None]:
    """Return the bytes of a scene, its path, and for a scene in an archive the files beside it.

    A file that is no wrapping is returned as it is. Raises InvalidFile, MemoryLimit.
    """
    beside: Mapping[str, memoryview] | None = None
    wrapping = load_wrapping()
    for _ in range(_MOST):
        if wrapping.is_gzip(view) and not any(form.load_module().recognise(view) for form in FORMATS if form.in_gzip):
            view, path, _none = wrapping.unwrap_gzip(view, path)
        elif _may_be_archive(path) and (found := wrapping.unwrap_zip(view, _endings())):
            view, path, beside = found
        else:
            return view, path, beside
        require_some(view)
    raise InvalidFile(f"is a file in more than {_MOST} wrappings; allowed: a scene, also in gzip or zip")


def _may_be_archive(path: str) -> bool:
    """False for a path with the extension of a format that is an archive itself."""
    return not path.lower().endswith(ARCHIVES)


def _endings() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The extensions of scenes, and those of pictures."""
    forms = [form for form in FORMATS if form.readable and form.scene not in _NO_SCENES]
    scenes = tuple(form.suffix for form in forms if form.scene not in _PICTURES)
    return scenes, tuple(form.suffix for form in forms if form.scene in _PICTURES)
