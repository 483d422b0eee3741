"""Rows of a run, finished or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactile_tools.experiments.journal import read_definition, read_lines
from tactile_tools.experiments.rows import Row, parquet_bytes, read_table, replace_file, sort_rows
from tactile_tools.experiments.spec import spec_of
from tactile_tools.experiments.studies import Options, Study, rebuild

GROUP = ("set", "engine", "depth")
"""Columns that divide a run into separate studies."""


_WORDS = {
    "mujoco": "MuJoCo",
    "planar": "the planar engine",
    "pymunk": "Chipmunk",
    "pybullet": "Bullet",
    "contacts": "exact contacts",
    "taxels": "touch through taxels",
}


def title_of(group: Sequence[str]) -> str:
    """Group in words."""
    return " · ".join(_WORDS.get(value, value) for value in group)


@dataclass(frozen=True, slots=True)
class Run:
    """Run: its folder, its study and options, and its rows in the table's order.

    ``rows`` include trials that ended in an error.
    """

    directory: Path
    study: Study
    options: Options
    rows: list[Row]

    @property
    def kind(self) -> str:
        """Name of the study."""
        return str(self.study.definition["study"])

    @property
    def missing(self) -> int:
        """Number of trials that are not finished."""
        return len(self.study.specs) - len(self.rows)

    def groups(self) -> dict[tuple[str, ...], list[Row]]:
        """Rows by parameter set, engine and depth."""
        found: dict[tuple[str, ...], list[Row]] = {}
        for row in self.rows:
            found.setdefault(tuple(row[name] for name in GROUP), []).append(row)
        return found


def load_run(directory: Path) -> Run:
    """Load the run in ``directory``, or one kept by `archive`; FolderError or TableError."""
    definition: dict[str, Any] = read_definition(directory)
    study, options = rebuild(directory, definition)
    table = directory / "trials.parquet"
    if table.exists() and not (directory / "trials.jsonl").exists():
        # A run kept by `archive`, which writes only the table.
        found = read_table(table)
    else:
        found = list(read_lines(directory).values())
    wanted = set(study.specs)
    rows = sort_rows([row for row in found if spec_of(row) in wanted])
    return Run(directory, study, options, rows)


def archive(run: Run, directory: Path) -> None:
    """Write to ``directory`` what `load_run` needs of ``run``, as small as possible; OSError."""
    directory.mkdir(parents=True, exist_ok=True)
    replace_file(directory / "experiment.json", (run.directory / "experiment.json").read_bytes())
    replace_file(directory / "trials.parquet", parquet_bytes(run.rows))
