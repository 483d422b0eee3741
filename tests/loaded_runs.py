"""Run the whole suite again and again on a loaded machine, and keep one row for each run.

``make test-loaded RUNS=20``: two busy loops run beside the suite. Each finished run appends its row
to ``docs/results/suite.json``, so that the runs may be spread over days: only those are done that
are still missing for the commits in question. These are the checked-out commit alone or, with
``--since COMMIT`` (``make test-loaded SINCE=COMMIT``), every commit after that one up to it.
Exit status: 0 if as many runs are green as were asked for, else 1; 2 for bad arguments.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "docs" / "results" / "suite.json"
BUSY_LOOPS = 2

Row = dict[str, Any]


def git(*words: str) -> str:
    """Return what git answers in this repository; RuntimeError with git's words if it fails."""
    done = subprocess.run(
        ["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip().splitlines()[0])
    return done.stdout.strip()


def commits_since(since: str | None) -> list[str]:
    """Return the commits whose runs count, newest first: HEAD, or all after ``since``."""
    head = git("rev-parse", "HEAD")
    if since is None:
        return [head]
    return git("rev-list", f"{since}..HEAD").split() or [head]


def read_rows(path: Path) -> list[Row]:
    """Return the rows of earlier runs; none if there is no file yet."""
    if not path.exists():
        return []
    rows: list[Row] = json.loads(path.read_text(encoding="utf-8"))["runs"]
    return rows


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Replace the file at once, so that an interrupted run never spoils earlier rows."""
    beside = path.with_suffix(".part")
    beside.write_text(json.dumps({"runs": list(rows)}, indent=1) + "\n", encoding="utf-8")
    beside.replace(path)


def read_report(path: Path) -> Row:
    """Return counts and failed tests of a JUnit report as pytest writes it."""
    counts = {"passed": 0, "failed": 0, "skipped": 0}
    failures: list[str] = []
    for case in ElementTree.parse(path).getroot().iter("testcase"):
        outcome = {child.tag for child in case}
        if outcome & {"failure", "error"}:
            counts["failed"] += 1
            failures.append(f"{case.get('classname')}::{case.get('name')}")
        elif "skipped" in outcome:
            counts["skipped"] += 1
        else:
            counts["passed"] += 1
    return {**counts, "failures": failures}


@contextlib.contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Keep ``count`` processes busy while the block runs."""
    running = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def run_suite(words: Sequence[str], loops: int = BUSY_LOOPS, beside: str = "") -> Row:
    """Run pytest with ``words`` beside ``loops`` busy loops and return the row of that run.

    ``beside``: what else is running, in words.

    A run that gives no report, as one that could not collect its tests, counts as failed.
    """
    started, before = time.monotonic(), datetime.now(UTC).isoformat(timespec="seconds")
    with tempfile.TemporaryDirectory() as folder, busy_loops(loops):
        report = Path(folder) / "report.xml"
        cpu = cpu_seconds()
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", f"--junitxml={report}", *words],
            cwd=ROOT,
            check=False,
        )
        row: Row = {
            "commit": git("rev-parse", "HEAD"),
            "changed": bool(git("status", "--porcelain", "--untracked-files=no", "--", "*.py")),
            "started": before,
            "seconds": round(time.monotonic() - started, 1),
            "cpu_s": round(cpu_seconds() - cpu, 1),
            "loops": loops,
            "beside": beside,
            "load": [round(load, 1) for load in os.getloadavg()],
            "exit": done.returncode,
        }
        empty: Row = {"passed": 0, "failed": 0, "skipped": 0, "failures": ["no report"]}
        return {**row, **(read_report(report) if report.exists() else empty)}


def cpu_seconds() -> float:
    """CPU time of all processes that were waited for: pytest, its workers and what they started."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def green(row: Row) -> bool:
    """Whether a run passed as a whole, on the files of its commit."""
    return row["exit"] == 0 and row["failed"] == 0 and not row["changed"]


def main(words: Sequence[str] | None = None) -> int:
    """Do the runs that are missing, then say how many of those asked for are green."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--runs", type=int, default=1, help="runs asked for in all")
    parser.add_argument("--since", metavar="COMMIT", help="count runs of later commits, too")
    parser.add_argument("--json", type=Path, default=RESULT, help="where rows are kept")
    parser.add_argument(
        "--loops", type=int, default=BUSY_LOOPS, help="busy loops; 0 where other work loads enough"
    )
    parser.add_argument(
        "--beside", metavar="TEXT", default="", help="what else loads the machine, for the rows"
    )
    parser.add_argument("pytest", nargs="*", help="words for pytest, after --")
    given = parser.parse_args(words)
    if given.runs < 1:
        parser.error(f"argument --runs: {given.runs}; allowed: a whole number above 0")
    if not given.json.parent.is_dir():
        parser.error(f"argument --json: there is no folder {given.json.parent}")
    try:
        counted = set(commits_since(given.since))
    except RuntimeError as error:
        parser.error(f"argument --since: {error}")
    rows = read_rows(given.json)

    def mine() -> list[Row]:
        return [row for row in rows if row["commit"] in counted and not row["changed"]]

    for number in range(len(mine()) + 1, given.runs + 1):
        print(f"run {number} of {given.runs}", flush=True)
        words_of_pytest = given.pytest or ["-n", "2", "--dist", "worksteal"]
        rows.append(run_suite(words_of_pytest, given.loops, given.beside))
        write_rows(given.json, rows)
    passed = sum(map(green, mine()))
    print(f"{passed} of {given.runs} runs asked for are green ({len(mine())} done) in {given.json}")
    for row in mine():
        if not green(row):
            print(f"{row['started']} {row['commit'][:10]}: {', '.join(row['failures'])}")
    return 0 if passed >= given.runs else 1


if __name__ == "__main__":
    sys.exit(main())
