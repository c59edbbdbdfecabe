from __future__ import annotations

from collections.abc import Iterator

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


def test_items_made_ahead_come_in_order_with_the_error_behind_them() -> None:
    def items() -> Iterator[int]:
        yield from range(5)
        raise ValueError("behind 4")

    seen: list[int] = []
    with pytest.raises(ValueError, match="behind 4"):
        seen.extend(parallel.prefetched(items()))
    assert seen == [0, 1, 2, 3, 4]
    assert list(parallel.prefetched([])) == []


def test_no_more_than_one_item_is_made_ahead() -> None:
    made = []

    def items() -> Iterator[int]:
        for item in range(100):
            made.append(item)
            yield item

    ahead = parallel.prefetched(items())
    assert [next(ahead), next(ahead)] == [0, 1]
    ahead.close()
    assert made == [0, 1, 2]
