"""NumPy's archives, stored and deflated, read by NumPy and by the standard library."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_array_equal

from nerfbake.formats.wire.npz import StreamedArray, write_npz

ARRAYS: dict[str, npt.ArrayLike | StreamedArray] = {
    "empty": np.zeros((0, 3), np.float32),
    "one": np.int64(7),
    "rows": np.arange(60_000, dtype=np.float16).reshape(-1, 3) % 1000,
    "text": np.array("SH9"),
}


@pytest.mark.parametrize("deflated", [False, True])
def test_numpy_reads_what_was_written(deflated: bool) -> None:
    data = b"".join(write_npz(ARRAYS, deflated=deflated))
    with np.load(io.BytesIO(data)) as found:
        assert list(found) == list(ARRAYS)
        for name, array in ARRAYS.items():
            assert_array_equal(found[name], np.asarray(array))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
        kinds = {member.compress_type for member in archive.infolist()}
    assert kinds == {zipfile.ZIP_DEFLATED if deflated else zipfile.ZIP_STORED}


def test_deflated_members_are_smaller_and_the_same_every_time() -> None:
    small, again = (b"".join(write_npz(ARRAYS, deflated=True)) for _ in range(2))
    assert small == again
    assert len(small) < len(b"".join(write_npz(ARRAYS))) / 2
