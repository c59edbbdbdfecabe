"""Reports: failures first, the command to paste, the same state the same bytes, whatever files are called."""

from __future__ import annotations

import csv
import html
import io
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Image, save
from nerfbake.batch import report
from nerfbake.batch.items import Item
from nerfbake.batch.report import Batch, Row, as_csv, as_markdown, as_page
from nerfbake.batch.state import Attempt, OutputRecord
from nerfbake.errors import OutputError, UsageError
from nerfbake.jobs import BatchOptions, run_batch

HOSTILE = "<img src=x onerror=alert(1)>|`*\n\udcff.npz"


def row(name: str, attempt: Attempt | None) -> Row:
    return Row(Item(("svo", name, "out"), (name,), ("out",)), attempt)


def done(seconds: float, size: int, psnr: float | None) -> Attempt:
    return Attempt("done", 0, "", seconds, 50_000_000, 1_000_000, (OutputRecord("out", size, "0"),), psnr)


BATCH = Batch(
    (
        row("slow.npz", done(9.0, 10, 40.0)),
        row("big.npz", done(1.0, 2_000_000, 30.0)),
        row("unread.npz", None),
        row(HOSTILE, Attempt("failed", 1, f"{HOSTILE}: is broken")),
        row("poor.npz", Attempt("rejected", 3, "poor.npz: 20 dB")),
    ),
    machines=("a machine, Python 3",),
)


def test_the_page_tells_what_is_wrong_first_and_the_command_to_paste() -> None:
    page = as_page(BATCH)
    assert re.findall(r'<p class="missed">(\w+)', page) == ["failed", "rejected", "waiting"]
    commands = [html.unescape(found) for found in re.findall(r"<pre[^>]*>(.*?)</pre>", page)]
    assert commands == [BATCH.rows[i].item.line for i in (3, 4, 2)]
    assert shlex.split(commands[1]) == ["nerfbake", "svo", "poor.npz", "out"]
    assert page.index("Not done") < page.index("Slowest") < page.index("<h2>Items")
    assert "Not all done" in page
    assert "a machine, Python 3" in page


def test_whatever_files_are_called_is_text() -> None:
    page, table = as_page(BATCH), as_markdown(BATCH)
    assert "<img" not in page
    assert "<script" not in page
    assert "default-src 'none'" in page
    (line,) = [line for line in table.splitlines() if "onerror" in line and line.startswith("|")]
    assert line.count("|") - line.count("\\|") == 9  # of eight columns
    assert as_csv(BATCH).encode("ascii")


def test_what_stands_out_is_listed() -> None:
    lists = dict(BATCH.outstanding())
    names = {title: [each.item.name for each in rows] for title, rows in lists.items()}
    assert names["Slowest"] == ["slow.npz", "big.npz"]
    assert names["Biggest"] == ["big.npz", "slow.npz"]
    assert names["Worst PSNR"] == ["big.npz", "slow.npz"]


def test_the_table_has_all_that_is_known() -> None:
    rows = list(csv.DictReader(io.StringIO(as_csv(BATCH))))
    assert [each["status"] for each in rows] == ["done", "done", "waiting", "failed", "rejected"]
    assert rows[1] == {
        "command": "nerfbake svo big.npz out", "status": "done", "exit": "0", "error": "", "seconds": "1.0",
        "peak_bytes": "50000000", "bytes_in": "1000000", "bytes_out": "2000000", "psnr": "30.0",
    }  # fmt: skip
    assert rows[2]["exit"] == ""


@pytest.mark.parametrize(
    ("statuses", "code"),
    [([], 0), (["done"], 0), (["rejected", "done"], 3), (["rejected", "failed"], 1), (["waiting"], 1), (["killed"], 1)],
)
def test_the_exit_code_says_what_is_missing(statuses: list[str], code: int) -> None:
    attempts = [None if status == "waiting" else Attempt(status, 0) for status in statuses]
    batch = Batch(tuple(row("a", attempt) for attempt in attempts))
    assert batch.exit_code == code
    assert batch._replace(stopped=15).exit_code == 143


def test_the_same_state_gives_the_same_report_with_pictures_of_what_was_written(folder: Path) -> None:
    ones = np.ones((300, 400, 3), np.float32)
    items = []
    for name in ("a.png", "b.depth.png", "c.txt"):
        save("in/x.png", Image(ones, ones[..., 0], ones[..., 0]), force=True)
        Path(f"in/{name}").write_bytes(Path("in/x.png").read_bytes())
        items.append(Item(("svo", f"in/{name}", f"out/{name}"), (f"in/{name}",), (f"out/{name}",)))
    batch = run_batch(items, state="run", run=BatchOptions(jobs=2), report_to="run/report.html")
    assert batch.exit_code == 0
    first = Path("run/report.html").read_bytes()
    assert re.findall(rb"<figcaption>(.*?)</figcaption>", first) == [b"out/a.png"]
    assert len(first) < 60_000
    run_batch(items, state="run", run=None, report_to="run/report.html")  # its own it replaces
    assert Path("run/report.html").read_bytes() == first
    run_batch(items, state="run", run=None, report_to="sub/report.csv")
    assert len(Path("sub/report.csv").read_text().splitlines()) == 4


def test_pictures_are_bounded_in_number_and_bytes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(0).random((40, 40, 3), np.float32)
    save("a.png", Image(noise, noise[..., 0], noise[..., 0]))
    rows = tuple(Row(Item(("x",)), Attempt("done", 0, outputs=(OutputRecord("a.png", 1, "0"),))) for _ in range(5))
    (one, *_) = report.thumbnails(Batch(rows))
    assert len(one.png) > 3000
    monkeypatch.setattr(report, "BYTES", 2 * len(one.png) + 10)
    assert len(report.thumbnails(Batch(rows))) == 2
    monkeypatch.setattr(report, "THUMBNAILS", 1)
    assert len(report.thumbnails(Batch(rows))) == 1
    Path("a.png").write_bytes(b"\x89PNG no picture")
    assert report.thumbnails(Batch(rows)) == []


def test_a_report_that_is_not_ours_is_left_alone_and_told_before_anything_runs(folder: Path) -> None:
    Path("in/a").write_text("fine\n")
    item = Item(("svo", "in/a", "out/a"), ("in/a",), ("out/a",))
    Path("report.html").write_text("somebody's")
    with pytest.raises(OutputError, match=r"report.html: exists already"):
        run_batch([item], state="run", report_to="report.html")
    with pytest.raises(UsageError, match=r"allowed: .html, .md, .csv"):
        run_batch([item], state="run", report_to="report.pdf")
    assert not Path("out").exists()
    assert Path("report.html").read_text() == "somebody's"


def test_a_state_that_is_a_file_is_named(tmp_path: Path) -> None:
    state = tmp_path / "run"
    state.write_text("kept")
    with pytest.raises(OutputError, match=r"run: is a file; allowed: a new folder, or the state of a batch$"):
        report.save_plan(state, [])
    assert state.read_text() == "kept"
