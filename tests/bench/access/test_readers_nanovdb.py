from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake.bench.access import readers
from nerfbake.bench.access.comparison import figures
from nerfbake.bench.access.readers import Reader, compile_nanovdb, reading
from nerfbake.bench.measure import Result
from nerfbake.errors import NerfbakeError

NANOVDB = "NanoVDB C++"


def test_without_a_compiler_nanovdb_keeps_its_rows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(readers, "which", lambda name: None)
    compile_nanovdb(tmp_path)
    with pytest.raises(NerfbakeError, match=r"no g\+\+ here \(Debian: g\+\+\)") as said:
        reading(NANOVDB, str(tmp_path), 1, [], 0)
    row = Reader(NANOVDB, all=False)
    rows = figures(64, {(row, 1): [Result(error=str(said.value))]})
    assert rows == [[f"{NANOVDB}: {said.value}", 64, 1, *[None] * 7]]


@pytest.mark.tools
def test_without_headers_or_with_wrong_ones_nanovdb_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for code, said in (
        ("#include <nanovdb/util/IO.h: No such file>\n", "no headers of NanoVDB here (Debian: libnanovdb-dev)"),
        ("int main() { return nanovdb; }\n", "g++ "),
    ):
        source = tmp_path / "a.cpp"
        source.write_text(code)
        monkeypatch.setattr(readers, "SOURCE", source)
        compile_nanovdb(tmp_path)
        text = (tmp_path / "nanovdb.missing").read_text()
        assert text.startswith(said)
    assert "error" in text
