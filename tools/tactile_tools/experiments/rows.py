"""Columns of the table of trials, and the table as Parquet and CSV."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactile_tools.experiments.spec import IDENTITY, spec_of

Row = dict[str, Any]
"""One trial by column name; None where there is no value."""

DIRECTIONS = ("ccw", "cw")
TRIGGERS = ("clock", "stall", "push", "other")


@dataclass(frozen=True, slots=True)
class Column:
    """Column: its type, unit and meaning. ``provenance``: how a row was made, not its result."""

    name: str
    kind: type
    unit: str
    meaning: str
    provenance: bool = False


COLUMNS: tuple[Column, ...] = (
    Column("source", str, "", "scene generator"),
    Column("scene_seed", int, "", "seed of the scene"),
    Column("set", str, "", "named parameter set"),
    Column("engine", str, "", "physics engine"),
    Column("depth", str, "", "contacts of the engine, or the whole chain of taxels"),
    Column("strategy", str, "", "reaching strategy"),
    Column("trial_seed", int, "", "seed of strategy, board and arm"),
    Column("parameters", str, "JSON", "parameters that differ from the set's"),
    Column("conditions", str, "JSON", "world and touch where they differ from the set's"),
    Column("error", str, "", "why the trial could not be run, if it could not"),
    Column("objects", int, "", "objects in the scene"),
    Column("fill", float, "", "area of footprints over area of the cupboard"),
    Column("success", bool, "", "reached, by the set's own rule"),
    Column("reason", str, "", "why the reach ended"),
    Column("entered", bool, "", "tip was ever within 7.5 mm of the goal, the paper's region"),
    Column("distance_m", float, "m", "tip to goal at the end"),
    Column("closest_m", float, "m", "least distance of tip and goal"),
    Column("normalized_distance", float, "", "d_goal / d_scene at the end"),
    Column("normalized_closest", float, "", "the same at the closest"),
    Column("time_s", float, "s", "t_comp, the time limit where not reached"),
    Column("time_limit_s", float, "s", "t_tot"),
    Column("normalized_time", float, "", "t_comp / t_tot"),
    Column("excavations", int, "", "excavations begun"),
    *(
        Column(f"excavations_{d}_{t}", int, "", f"those {d.upper()} on the trigger {t}")
        for d in DIRECTIONS
        for t in TRIGGERS
    ),
    Column("peak_contact_n", float, "N", "greatest peak contact force that was felt"),
    Column("peak_load_n", float, "N", "greatest sum of normal forces on the finger"),
    Column("mean_load_n", float, "N", "mean sum of normal forces on the finger"),
    Column("peak_arm_n", float, "N", "greatest in-plane force that the arm reported"),
    Column("ejected", int, "", "objects pushed past the front edge"),
    Column("interventions", int, "", "times the safety gate set in"),
    Column("interventions_by_code", str, "JSON", "the same by reason"),
    Column("simulated_s", float, "s", "simulated time"),
    Column("version", str, "", "version of the software", provenance=True),
    Column("wall_s", float, "s", "time it took", provenance=True),
    Column("cpu_s", float, "s", "CPU time of the trial", provenance=True),
    Column("scene_cpu_s", float, "s", "CPU time of its scene, 0 if at hand", provenance=True),
    Column("memory_mb", float, "MB", "resident memory of the worker afterwards", provenance=True),
    Column("worker", str, "", "machine and process that ran it", provenance=True),
    Column("worker_trials", int, "", "trials that worker had run by then", provenance=True),
)

NAMES = tuple(c.name for c in COLUMNS)
PROVENANCE = frozenset(c.name for c in COLUMNS if c.provenance)


class TableError(Exception):
    """A table cannot be read; the message says which file, what is wrong and what to do."""


def outcome_of(row: Mapping[str, Any]) -> Row:
    """``row`` without provenance: equal whoever ran it, wherever."""
    return {name: row[name] for name in NAMES if name not in PROVENANCE}


def sort_rows(rows: Sequence[Row]) -> list[Row]:
    """``rows`` in the table's order, which does not depend on the order of finishing."""
    return sorted(rows, key=lambda row: tuple(row[name] for name in IDENTITY))


def whole(row: Mapping[str, Any]) -> bool:
    """Whether ``row`` has every column with a value of its kind, or None."""
    for column in COLUMNS:
        if column.name not in row:
            return False
        value = row[column.name]
        fits: type | tuple[type, ...] = (int, float) if column.kind is float else column.kind
        if value is not None and not isinstance(value, fits):
            return False
    return all(row[name] is not None for name in IDENTITY)


def write_tables(rows: Sequence[Row], directory: Path) -> None:
    """Write ``rows`` as trials.parquet and trials.csv, each whole or not at all; OSError."""
    replace_file(directory / "trials.parquet", parquet_bytes(rows))
    replace_file(directory / "trials.csv", csv_text(rows).encode())


def parquet_bytes(rows: Sequence[Row]) -> bytes:
    """``rows`` as a Parquet file whose columns carry their unit and meaning."""
    import pyarrow
    import pyarrow.parquet

    types = {
        str: pyarrow.string(),
        int: pyarrow.int64(),
        float: pyarrow.float64(),
        bool: pyarrow.bool_(),
    }
    schema = pyarrow.schema(
        [
            pyarrow.field(c.name, types[c.kind], metadata={"unit": c.unit, "meaning": c.meaning})
            for c in COLUMNS
        ]
    )
    table = pyarrow.Table.from_pylist([{n: r[n] for n in NAMES} for r in rows], schema=schema)
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(table, buffer, compression="zstd", compression_level=19)
    return buffer.getvalue()


def csv_text(rows: Sequence[Row], names: Sequence[str] = NAMES) -> str:
    """``rows`` as CSV; numbers read back exactly, None is empty."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        writer.writerow(["" if row[n] is None else row[n] for n in names])
    return out.getvalue()


def replace_file(path: Path, data: bytes) -> None:
    """Put ``data`` at ``path`` in one move: a reader never sees half of it; OSError."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def read_table(path: Path) -> list[Row]:
    """Rows of a Parquet file made by `parquet_bytes`; TableError."""
    import pyarrow
    import pyarrow.parquet

    try:
        rows: list[Row] = pyarrow.parquet.read_table(path).to_pylist()
    except (OSError, pyarrow.ArrowException) as error:
        raise TableError(f"cannot read {path}: {error}") from None
    for row in rows:
        if not whole(row):
            lacks = sorted(set(NAMES) - set(row))
            raise TableError(
                f"{path} is not a table of this version's trials"
                + (f": it lacks {', '.join(lacks)}" if lacks else "")
                + "; run the experiment again"
            )
    return rows


def describe(row: Mapping[str, Any]) -> str:
    """One trial in a few words, for messages."""
    spec = spec_of(row)
    text = f"{spec.strategy} in scene {spec.scene_seed} of {spec.source}"
    extra = [t for t in (spec.parameters, spec.conditions) if t != "{}"]
    return " ".join([text, *extra])
