"""`nerfbake check` as a shell sees it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from nerfbake import save
from tests.conftest import Shell
from tests.support.scenes import n3tree


def test_check_lists_everything_and_exits_1(shell: Shell, tmp_path: Path) -> None:
    tree = n3tree()
    tree.data[0, 0, 0, 0, 1] = np.nan
    tree.data[0, 1, 0, 0, 3] = -1
    save(tmp_path / "bad.npz", tree)
    done = shell("check", "bad.npz")
    assert done.returncode == 1
    assert done.stdout.decode().splitlines() == [
        "bad.npz: data[0, 0, 0, 0, 1] is nan; allowed: a finite number",
        "bad.npz: data[0, 1, 0, 0, 3] is -1; allowed: a density of 0 or more (`svo --sigma-min 0` reads less as empty)",
    ]
    told = json.loads(shell("check", "bad.npz", "--json").stdout)
    assert not told["ok"]
    assert told["problems"][0]["place"] == "data[0, 0, 0, 0, 1]"
    (tmp_path / "cut.npz").write_bytes((tmp_path / "bad.npz").read_bytes()[:-100])
    cut = "cut.npz: file is not a complete zip archive (File is not a zip file); allowed: an .npz as NumPy writes it"
    assert shell("check", "cut.npz").stdout.decode().splitlines() == [cut]
    nope = "nope.npz: file cannot be read: No such file or directory; allowed: a file that nerfbake reads\n"
    assert shell("check", "nope.npz").stdout.decode() == nope
    save(tmp_path / "good.npz", n3tree())
    done = shell("check", "good.npz", "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout) == {"version": 1, "file": "good.npz", "ok": True, "problems": []}
    # What check finds fault with, a cut reads as empty.
    tree.data[0, 0, 0, 0, 1] = 0
    save(tmp_path / "negative.npz", tree)
    assert shell("svo", "negative.npz", "a.svo.pb").returncode == 1
    assert shell("svo", "negative.npz", "a.svo.pb", "--sigma-min", "0").returncode == 0
