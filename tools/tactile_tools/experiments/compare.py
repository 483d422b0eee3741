"""``tactile experiment compare``: two runs side by side."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tactile_tools.experiments.document import TableData, percent, points, shown_p, whole
from tactile_tools.experiments.journal import DiskError
from tactile_tools.experiments.rows import Row, TableError
from tactile_tools.experiments.spec import STRATEGIES
from tactile_tools.experiments.statistics import (
    Rate,
    contrast,
    paired_rates,
    signed_rank,
)
from tactile_tools.experiments.tables import load_run

COMPARED = ("source", "set", "engine", "depth", "parameters", "conditions")
"""Columns in which two runs may differ as a whole: those with one value throughout each run."""


def compare_runs(first: Path, second: Path, csv: Path | None = None) -> int:
    """Print the comparison, and write it to ``csv``; FolderError, TableError, DiskError."""
    runs = [load_run(path) for path in (first, second)]
    rows = [[row for row in run.rows if row["error"] is None] for run in runs]
    for run, good in zip(runs, rows, strict=True):
        if not good:
            raise TableError(f"{run.directory} has no finished trials: nothing to compare")
    tables = comparison(rows[0], rows[1])
    console = Console()
    for name, run in zip("AB", runs, strict=True):
        heading = f"{name}: {run.directory}, {len(run.rows)} trials"
        if run.missing:
            heading += f", {run.missing} of its trials are missing"
        console.print(heading, highlight=False, markup=False)
    for line in differences(rows[0], rows[1]):
        console.print("   " + line, highlight=False, markup=False)
    for table in tables:
        shown = Table(title=table.caption, title_justify="left", pad_edge=False)
        for index, name in enumerate(table.head):
            shown.add_column(escape(name), justify="right" if index else "left")
        for cells in table.rows:
            shown.add_row(*(escape(cell) for cell in cells))
        console.print(shown)
        console.print(table.note, highlight=False, markup=False)
    if csv is not None:
        try:
            csv.write_text("\n".join(t.to_csv() for t in tables), encoding="utf-8")
        except OSError as error:
            raise DiskError(f"cannot write {csv}: {error.strerror}") from error
        console.print(f"wrote {csv}")
    return 0


def differences(a: Sequence[Row], b: Sequence[Row]) -> list[str]:
    """Differences between the runs, one line each."""
    return [
        f"{name}: {a[0][name]} against {b[0][name]}"
        for name in _constant(a, b)
        if a[0][name] != b[0][name]
    ]


def comparison(a: Sequence[Row], b: Sequence[Row]) -> tuple[TableData, TableData]:
    """Success of both by strategy with their difference, and the paired tests of the rest.

    Trials are paired by scene, seed, strategy and whatever varies within the runs.
    """
    if not a or not b:
        return _tables([], [])
    dropped = set(_constant(a, b)) - {"source"}
    keys = ["scene_seed", "trial_seed", *(n for n in COMPARED if n not in dropped)]
    success, values = [], []
    for strategy in _order({row["strategy"] for row in [*a, *b]}):
        left = {tuple(r[k] for k in keys): r for r in a if r["strategy"] == strategy}
        right = {tuple(r[k] for k in keys): r for r in b if r["strategy"] == strategy}
        if not left or not right:
            continue
        common = sorted(left.keys() & right.keys())
        of_a, of_b = [left[k] for k in common], [right[k] for k in common]
        success.append([strategy, *_success(left.values(), right.values(), of_a, of_b)])
        if common:
            values.append([strategy, *_values(of_a, of_b)])
    return _tables(success, values)


def _tables(success: list[list[str]], values: list[list[str]]) -> tuple[TableData, TableData]:
    return (
        TableData(
            caption="Success, B beside A",
            head=["strategy", "A [95 %]", "B [95 %]", "B − A [95 %]", "p", "paired", "same"],
            rows=success,
            note="Wilson intervals. Paired trials: McNemar's exact test, interval after Agresti "
            "and Min; where none pair: Fisher's exact test and Newcombe's interval. Same: paired "
            "trials with the same outcome.",
            name="success",
        ),
        TableData(
            caption="Means of paired trials, B beside A",
            head=["strategy", "distance A", "B", "p", "time A", "B", "p"],
            rows=values,
            note="d_goal/d_scene and t_comp/t_tot; p by Wilcoxon's signed ranks.",
            name="values",
        ),
    )


def _success(
    left: Collection[Row], right: Collection[Row], of_a: list[Row], of_b: list[Row]
) -> list[str]:
    """Rates of all trials, and the difference of the paired ones if there are any."""
    rate_a, rate_b = _rate(left), _rate(right)
    cells = [percent(rate_a), percent(rate_b)]
    if not of_a:
        found = contrast(rate_b, rate_a)
        return [*cells, points(found.difference, found.interval), shown_p(found.p), "0", "–"]
    paired = paired_rates([r["success"] for r in of_b], [r["success"] for r in of_a])
    same = paired.scenes - paired.only_a - paired.only_b
    return [
        *cells,
        points(paired.difference, paired.interval),
        shown_p(paired.p),
        str(paired.scenes),
        f"{whole(same / paired.scenes)} %",
    ]


def _values(of_a: list[Row], of_b: list[Row]) -> list[str]:
    """Means of distance and time of both, with their tests."""
    cells = []
    for column in ("normalized_distance", "normalized_time"):
        x, y = [r[column] for r in of_a], [r[column] for r in of_b]
        cells += [f"{sum(v) / len(v):.3f}" for v in (x, y)]
        cells.append(shown_p(signed_rank(x, y)[0]))
    return cells


def _constant(a: Sequence[Row], b: Sequence[Row]) -> list[str]:
    """Columns of `COMPARED` that have one value throughout a and one throughout b."""
    return [n for n in COMPARED if all(len({row[n] for row in rows}) == 1 for rows in (a, b))]


def _rate(rows: Collection[Row]) -> Rate:
    outcomes = [row["success"] for row in rows]
    return Rate(sum(outcomes), len(outcomes))


def _order(names: set[str]) -> list[str]:
    """Names of strategies: the paper's first, in its order."""
    return [*(n for n in STRATEGIES if n in names), *sorted(names - set(STRATEGIES))]
