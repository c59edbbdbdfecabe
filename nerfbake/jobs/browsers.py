"""Pages for the reader's own browser, where nobody names a file for them."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerfbake.errors import UsageError
from nerfbake.jobs.files import AnyTarget, Target, as_target

_ALLOWED = "an OUT, to be opened where there is one"


@contextmanager
def written_or_opened(target: AnyTarget | None) -> Iterator[Target]:
    """Where a page goes: the target. Without one, a folder of the reader's own, from where the browser opens the page
    behind the block; it stays for the browser, unless the block fails.

    Raises UsageError, before any work is done, where no browser could show it.
    """
    if target is not None:
        yield as_target(target)
        return
    _require_browser()
    folder = tempfile.mkdtemp(prefix="nerfbake-")
    page = Path(folder) / "page.html"
    try:
        yield Target(str(page))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    if not webbrowser.open_new_tab(page.as_uri()):
        raise UsageError(f"no browser took {page}; allowed: {_ALLOWED}")


def _require_browser() -> None:
    screen = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not screen and not os.environ.get("BROWSER"):
        raise UsageError(f"there is no display for a browser; allowed: {_ALLOWED}")
    try:
        webbrowser.get()
    except webbrowser.Error:
        raise UsageError(f"there is no browser; allowed: {_ALLOWED}") from None
