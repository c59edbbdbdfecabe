"""Optional libraries, and the command that adds one to the installation that runs.

nerfbake may be installed from a checkout, a wheel or an index, by pip, pipx or uv. Source: PEP 610 (direct_url.json),
PEP 376 (INSTALLER); pipx_metadata.json is pipx's own.
"""

from __future__ import annotations

import json
import shlex
import shutil
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from nerfbake.errors import Problem, UsageError

if TYPE_CHECKING:
    from importlib.metadata import Distribution

# Module: the extra of pyproject.toml that installs it, in the order of the extra `test`.
EXTRAS = {
    "matplotlib": "plot",
    "warp": "warp",
    "pycolmap": "poses",
    "pillow_heif": "heic",
    "av": "video",
    "pxr": "usd",
    "wgpu": "gpu",
    "sklearn": "bench",
    "bson": "bench",
}


def is_installed(module: str) -> bool:
    """Return whether a module can be imported, without importing it."""
    return find_spec(module) is not None


def require_installed(module: str, what: str) -> None:
    """Raise UsageError if a module that `what` needs is not installed."""
    if not is_installed(module):
        raise UsageError(Problem(what, f"needs {module}, which is not installed", command_for(module)))


def command_for(module: str) -> str:
    """Return the command that adds a module's library to this installation; '' if no extra contains it.

    pip        pip install 'nerfbake[poses]'; with the path of the checkout or of the wheel if it came from there, and
               with the path of the interpreter if `pip` is another one's
    pipx       pipx inject nerfbake 'pycolmap>=4.2'
    uv         uv pip install --python FOLDER 'nerfbake[poses]'
    """
    from importlib.metadata import PackageNotFoundError, distribution  # slow to import; the help does not need it

    if module not in EXTRAS:
        return ""
    try:
        found = distribution("nerfbake")
    except PackageNotFoundError:  # a checkout on the path, which nobody has installed
        return f"{_pip()} {shlex.join(_folder(Path(__file__).parents[1], EXTRAS[module], editable=True))}"
    return _command(found, EXTRAS[module])


def _command(found: Distribution, extra: str) -> str:
    if (Path(sys.prefix) / "pipx_metadata.json").is_file():
        return f"pipx inject nerfbake {shlex.join(_requirements(found, extra))}"
    by_uv = (found.read_text("INSTALLER") or "").strip() == "uv"
    pip = f"uv pip install --python {shlex.quote(sys.prefix)}" if by_uv else _pip()
    return f"{pip} {shlex.join(_source(found, extra))}"


def _source(found: Distribution, extra: str) -> list[str]:
    """The arguments of pip for nerfbake with an extra, from where it was installed."""
    origin = json.loads(found.read_text("direct_url.json") or "{}")
    url = origin.get("url", "")
    if "vcs_info" in origin:
        vcs = origin["vcs_info"]
        return [f"nerfbake[{extra}] @ {vcs['vcs']}+{url}@{vcs['commit_id']}"]
    if not url.startswith("file:"):
        return [f"nerfbake[{extra}] @ {url}" if url else f"nerfbake[{extra}]"]
    path = _path_of(url)
    if not path.exists():  # the checkout or the wheel is gone: what the extra needs does not depend on it
        return _requirements(found, extra)
    return _folder(path, extra, editable=bool(origin.get("dir_info", {}).get("editable")))


def _folder(path: Path, extra: str, *, editable: bool) -> list[str]:
    shown = _shown(path)
    if not {"/", "\\"} & {*shown} and shown != ".":
        shown = f"./{shown}"  # without a slash, it would be the name of a package
    return [*(["--editable"] if editable else []), f"{shown}[{extra}]"]


def _path_of(url: str) -> Path:
    from urllib.parse import urlsplit
    from urllib.request import url2pathname

    return Path(url2pathname(urlsplit(url).path))


def _requirements(found: Distribution, extra: str) -> list[str]:
    """The requirements of an extra in the metadata, without their markers."""
    marked = [requirement.split(";", 1) for requirement in found.requires or ()]
    return [name.strip() for name, *marker in marked if marker and f"'{extra}'" in marker[0].replace('"', "'")]


def _pip() -> str:
    """The command `pip install`, with the path of the interpreter unless the shell's `pip` belongs to it."""
    first = shutil.which("pip")
    own = first is not None and Path(first).parent == Path(sys.executable).parent
    return "pip install" if own else f"{shlex.quote(_shown(Path(sys.executable)))} -m pip install"


def _shown(path: Path) -> str:
    """A path relative to the working folder if it is below it."""
    with suppress(OSError):  # the working folder is gone
        here = Path.cwd()
        if path.is_relative_to(here) and len(here.parts) > 1:
            return str(path.relative_to(here))
    return str(path)
