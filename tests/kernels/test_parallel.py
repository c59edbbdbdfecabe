from __future__ import annotations

import numpy as np
import pytest

from nerfbake.kernels import parallel


@pytest.mark.parametrize("count", [0, 1, 7, 100])
@pytest.mark.parametrize("cores", [1, 3, None])
def test_every_chunk_is_worked_once(count: int, cores: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    done = np.zeros(count, int)

    def work(begin: int, end: int) -> None:
        assert 0 < end - begin <= 7
        done[begin:end] += 1

    parallel.over_chunks(work, count, 7)
    assert (done == 1).all()


def test_an_error_in_any_thread_is_raised() -> None:
    def work(begin: int, end: int) -> None:
        if begin == 30:
            raise ValueError(f"{begin} to {end}")

    with pytest.raises(ValueError, match="30 to 40"):
        parallel.over_chunks(work, 100, 10)
