"""`python -m tests.conformance` (make golden) writes the frozen files that are missing; nothing else does.

What is there stays, whatever libraries would pack it now. Who means to change it deletes it first, and says why.
"""

from __future__ import annotations

from tests.conformance.case import HOME, Case, text_of
from tests.conformance.cases import CASES
from tests.conformance.packing import packed_by


def add(case: Case) -> None:
    known = {path: packers for path, packers in case.recorded().items() if (HOME / path).exists()}
    written = {path: data for name, frozen in case.files.items() for path, data in frozen.written(name).items()}
    missing = written.keys() - known.keys()
    for path in missing:
        (HOME / path).parent.mkdir(parents=True, exist_ok=True)
        (HOME / path).write_bytes(written[path])
    if missing:
        case.path.write_text(text_of(case.document(lambda path: known.get(path) or packed_by(path))) + "\n")


for case in CASES:
    add(case)
