from __future__ import annotations

from nerfbake.bench.formats.comparison import serializations
from nerfbake.bench.formats.libraries import LIBRARIES
from tests.support.octrees import SPELLINGS


def test_every_format_and_library_is_a_row() -> None:
    rows = [(row.name, row.profile) for row in serializations() if not row.packed]
    assert rows == [("raw", None), *SPELLINGS, *((library.name, None) for library in LIBRARIES)]
