from __future__ import annotations

import csv
import io
import json

from nerfbake.bench.measure import Statistics
from nerfbake.bench.plot import Mark, lines, scatter
from nerfbake.bench.report import Report, Table, as_csv, as_json, document, markdown
from tests.support.outputs import read_output

TABLE = Table(
    "Formats",
    ["format", "MB", "ms", "exact"],
    [
        ["raw", 96.04, Statistics.of([3.0, 1.0, 2.0]), True],
        ["a|b", 1234.5, Statistics.of([0.5]), False],
        ["c: gone", None, None, None],
    ],
)
REPORT = Report("Title", {"scene": "chair", "Python": "3.11"}, [TABLE], ["One note.", "Two."])


def test_markdown_shows_median_and_spread() -> None:
    assert markdown(REPORT) == (
        "# Title\n\n"
        "scene chair; Python 3.11\n\n"
        "**Formats**\n\n"
        "| format | MB | ms | exact |\n"
        "| --- | ---: | ---: | --- |\n"
        "| raw | 96.0 | 2.00 [1.00..3.00] | yes |\n"
        "| a\\|b | 1,234 | 0.50 | no |\n"
        "| c: gone | - | - | - |\n\n"
        "- One note.\n- Two.\n"
    )


def test_csv_has_a_column_for_each_end_of_a_spread() -> None:
    rows = list(csv.DictReader(io.StringIO(as_csv(REPORT))))
    assert (rows[0]["ms"], rows[0]["ms min"], rows[0]["ms max"], rows[0]["rounds"]) == ("2.0", "1.0", "3.0", "3")
    assert [row["format"] for row in rows] == ["raw", "a|b", "c: gone"]
    assert rows[2]["MB"] == ""


def test_json_has_everything() -> None:
    whole = read_output("bench", as_json(REPORT))
    assert whole["head"] == REPORT.head
    assert whole["notes"] == REPORT.notes
    assert whole["tables"][0]["rows"][0]["ms max"] == 3.0
    assert whole["tables"][0]["rows"][2]["ms"] is None


def test_several_reports_in_json_are_one_object() -> None:
    several = read_output("bench", document([REPORT, REPORT], "json"))
    assert [{"version": 1, **report} for report in several["reports"]] == [json.loads(as_json(REPORT))] * 2


def test_a_chart_names_every_mark_and_is_the_same_each_time() -> None:
    # Marks so close together that their labels have to make way.
    marks = [Mark(f"row {k}", 10 + k / 10, 5, "ours" if k % 2 else "theirs") for k in range(8)]
    images = [scatter(marks, title="t", x="ms", y="MB", suffix=".svg") for _ in range(2)]
    assert images[0] == images[1]
    assert all(f"row {k}" in images[0].decode() for k in range(8))
    assert scatter(marks, title="t", x="ms", y="MB", suffix=".png")[:4] == b"\x89PNG"


def test_a_chart_of_many_marks_names_them_all() -> None:
    marks = [Mark(f"mark {i}", 10 ** (i / 5), 10 ** (i % 4), f"group {i % 3}") for i in range(24)]
    image = scatter(marks, title="t", x="ms", y="MB", suffix=".svg").decode()
    assert all(f">{mark.label}<" in image for mark in marks)


def test_curves_carry_their_names_and_are_the_same_every_time() -> None:
    curves = {"fitted": [(1.0, 20.0), (3.5, 25.0)], "written": [(4.0, 25.5)]}
    made = [lines(curves, title="Chair", x="CPU seconds", y="PSNR dB", suffix=".svg") for _ in range(2)]
    assert made[0] == made[1]
    assert all(name in made[0].decode() for name in ("fitted", "written", "Chair", "CPU seconds", "PSNR dB"))
    assert lines(curves, title="", x="", y="", suffix=".png")[:4] == b"\x89PNG"
