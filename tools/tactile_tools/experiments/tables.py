"""A run's rows, whether it is finished or not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactile_tools.experiments.journal import read_definition, read_lines
from tactile_tools.experiments.rows import Row, sort_rows
from tactile_tools.experiments.spec import spec_of
from tactile_tools.experiments.studies import Options, Study, rebuild

GROUP = ("set", "engine", "depth")
"""Columns that part a run into studies of their own."""


@dataclass(frozen=True, slots=True)
class Run:
    """A run: its folder, what it is of, its rows in the table's order, and how many it is to have.

    ``error`` rows are among ``rows``.
    """

    directory: Path
    study: Study
    options: Options
    rows: list[Row]

    @property
    def kind(self) -> str:
        """Which study."""
        return str(self.study.definition["study"])

    @property
    def missing(self) -> int:
        """Trials that are not finished."""
        return len(self.study.specs) - len(self.rows)

    def groups(self) -> dict[tuple[str, ...], list[Row]]:
        """Rows by parameter set, engine and depth."""
        found: dict[tuple[str, ...], list[Row]] = {}
        for row in self.rows:
            found.setdefault(tuple(row[name] for name in GROUP), []).append(row)
        return found


def load_run(directory: Path) -> Run:
    """The run in ``directory``; FolderError or TableError."""
    definition: dict[str, Any] = read_definition(directory)
    study, options = rebuild(directory, definition)
    finished = read_lines(directory)
    wanted = set(study.specs)
    rows = sort_rows([row for row in finished.values() if spec_of(row) in wanted])
    return Run(directory, study, options, rows)
