from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerfbake import save
from nerfbake.bench.formats.comparison import Serialization, decoding, encoding, serializations
from tests.support.octrees import small_octree


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
@pytest.mark.parametrize("row", list(serializations()), ids=lambda row: row.label)
def test_every_row_comes_back_exactly(row: Serialization, dtype: type, tmp_path: Path) -> None:
    scene, target = tmp_path / "a.svo.npz", tmp_path / "target"
    save(scene, small_octree(dtype))
    written = encoding(list(row), str(scene), str(target))
    assert written.check(written.run())["size"] == target.stat().st_size > 0
    read = decoding(list(row), str(scene), str(target))
    assert read.check(read.run()) == {"exact": True}


def test_a_wrong_value_would_be_seen(tmp_path: Path) -> None:
    scene, target = tmp_path / "a.svo.npz", tmp_path / "target"
    save(scene, small_octree())
    written = encoding(["raw", "raw"], str(scene), str(target))
    written.run()
    content = bytearray(target.read_bytes())
    content[-1] ^= 1
    target.write_bytes(content)
    read = decoding(["raw", "raw"], str(scene), str(target))
    assert read.check(read.run()) == {"exact": False}
