"""Run the fuzzer for a long time, or repeat one case."""

from __future__ import annotations

import argparse
import sys
import time

from tests.conftest import REPOSITORY
from tests.fuzz import corpus
from tests.fuzz.breakage import case_of
from tests.fuzz.campaign import Result, campaign
from tests.fuzz.trial import Finding, put
from tests.fuzz.worker import tried, warm_up

KEPT = REPOSITORY / "build" / "fuzz"


def main() -> int:
    """Run the fuzzer. Returns exit code 1 if there are findings."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Breaks files and tries them.")
    parser.add_argument("--minutes", type=float, help="how long to look")
    parser.add_argument("--cases", type=int, help="how many cases to try, instead")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--format", choices=corpus.names(), help="this one alone")
    parser.add_argument("--case", type=int, help="one case again, as a finding names it")
    options = parser.parse_args()
    if options.case is not None:
        return one(options.seed, options.case)
    seconds = None if options.minutes is None and options.cases else 60 * (options.minutes or 1)
    start, shown, result = time.monotonic(), 0, Result()
    for result in campaign(options.seed, jobs=options.jobs, cases=options.cases, seconds=seconds, form=options.format):
        groups = result.by_key()
        for first, *_ in list(groups.values())[shown:]:
            keep(options.seed, first)
        shown = len(groups)
    tell(result, options.seed, time.monotonic() - start)
    return 1 if result.findings else 0


def one(seed: int, number: int) -> int:
    case = case_of(seed, number)
    KEPT.mkdir(parents=True, exist_ok=True)
    warm_up()
    found = tried(case)
    for finding in found:
        print(f"{finding.form}, {finding.step}: {finding.what} {finding.where}")
    print(f"case {number} of seed {seed}: {len(found)} findings")
    return 1 if found else 0


def keep(seed: int, finding: Finding) -> None:
    """Print a finding, and keep its file in build/fuzz."""
    case = case_of(seed, finding.case)
    place = KEPT / f"{seed}_{finding.case}"
    place.mkdir(parents=True, exist_ok=True)
    path = place / case.name
    if not path.exists():
        put(case, place)
    print(f"{finding.form}, {finding.step}: {finding.what} {finding.where}")
    print(f"    python -m tests.fuzz --seed {seed} --case {finding.case}    {path.relative_to(REPOSITORY)}", flush=True)


def tell(result: Result, seed: int, seconds: float) -> None:
    for first, *more in sorted(result.by_key().values(), key=len, reverse=True):
        print(f"{1 + len(more):7,} x {first.form}, {first.step}: {first.what[:120]} {first.where} (case {first.case})")
    total = sum(result.tried.values())
    by_format = ", ".join(f"{name} {count:,}" for name, count in sorted(result.tried.items()))
    print(
        f"{total:,} cases of seed {seed} in {seconds / 60:.1f} minutes, {len(result.findings):,} findings ({by_format})"
    )


if __name__ == "__main__":
    sys.exit(main())
