"""Items that would get in each other's way are refused before one of them runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake.batch.items import Item, require_apart
from nerfbake.errors import UsageError


def item(reads: str, writes: str, **more: tuple[str, ...]) -> Item:
    return Item(("svo", reads, writes), (reads,), (writes,), **more)


@pytest.mark.parametrize(
    ("items", "found"),
    [
        ([item("a", "x"), item("b", "./x")], "item 2 (nerfbake svo b ./x) writes './x', as item 1 "),
        ([item("a", "x"), item("b", "link/x")], "item 2 (nerfbake svo b link/x) writes 'link/x', as item 1 "),
        ([item("a", "x.rejected"), item("b", "x", spare=("x.rejected",))], "item 2 "),
        ([item("a", "x"), item("x", "y")], "item 1 (nerfbake svo a x) writes 'x', which item 2 "),
        ([item("a", "a")], "item 1 (nerfbake svo a a) writes 'a', which item 1 "),
        ([item("a", "x"), item("x/b", "y")], "item 1 (nerfbake svo a x) writes 'x/b', which item 2 "),
        ([item("a", "x"), item("b", "x/y")], "which another item writes"),
        ([item("a", "x"), item("x", "x/y")], "item 1 (nerfbake svo a x) writes 'x', which item 2 "),
        (
            [Item(("fit",), albums=("c",), writes=("c/1",)), Item(("fit",), albums=("c",), writes=("2",))],
            "which another item reads",
        ),
        ([item("a", "run")], "writes 'run/state', which belongs to the batch"),
        ([item("-", "x")], "nerfbake svo - x: reads or writes a stream; allowed in a batch: files and folders"),
        ([item("a", "-")], "nerfbake svo a -: reads or writes a stream; allowed in a batch: files and folders"),
    ],
)
def test_a_clash_is_refused(items: list[Item], found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(UsageError) as caught:
        require_apart(items, ["run/state"])
    assert found in str(caught.value)
    assert "; allowed: " in str(caught.value) or "; allowed in a batch: " in str(caught.value)


def test_what_does_not_clash_is_let_through() -> None:
    album = Item(("fit", "c", "c/a.npz"), albums=("c",), writes=("c/a.npz",))
    require_apart([album, item("a", "out/a"), item("a", "out/b"), item("b", "run/state/c")], ["run/state", "r.html"])
