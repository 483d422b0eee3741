"""Exports of logs longer than a batch: memory, lists that grow late, messages left out."""

from __future__ import annotations

import csv
import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import zstandard

from tactile_core.log.mcap_file import ChunkBuffer, DiskStorage, McapFile
from tactile_tools.log.batches import BATCH, HELD_BYTES, REFUSED, Budget, Table
from tactile_tools.log.stream import Record, Stream

BASE_NS = 1_700_000_000_000_000_000
KINDS = ("csv", "parquet", "npz")


@pytest.fixture(scope="module")
def short_and_long(recorded: Any, tmp_path_factory: Any) -> tuple[Path, Path]:
    """Logs of one and a half and of three batches a topic."""
    folder = tmp_path_factory.mktemp("lengths")
    # Small chunks, for a writer that is starved makes larger ones, which take memory.
    small = {"queue_bytes": 1 << 30, "chunk_bytes": 1 << 16}
    short, long = (
        recorded(folder / f"{batches}.mcap", batches * BATCH / 100, **small) for batches in (1.5, 3)
    )
    return short, long


@pytest.mark.parametrize("kind", KINDS)
def test_memory_of_an_export_does_not_grow_with_the_log(
    log_tool: Any, short_and_long: tuple[Path, Path], tmp_path: Path, kind: str
) -> None:
    short, long = short_and_long
    out = tmp_path / "out"
    assert log_tool("export", short, "--format", kind, "--out", out).code == 0  # loads all it needs
    most = []
    for path in (short, long):
        tracemalloc.start()
        try:
            outcome = log_tool(
                "export", path, "--format", kind, "--out", tmp_path / f"{path.stem}.d"
            )
            most.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
        assert outcome.code == 0, outcome.err
    assert f"{3 * BATCH} messages" in outcome.out
    assert most[1] < most[0] + (1 << 20)
    assert most[1] < HELD_BYTES


def arrays_log(
    path: Path, payloads: list[bytes], fields: bytes = b"float32[] values\nstring[] names\n"
) -> None:
    file = McapFile(path, DiskStorage(), "t")
    file.add_schema(1, "a/msg/List", "ros2msg", fields)
    file.add_channel(1, 1, "/list", "cdr", {})
    chunk = ChunkBuffer()
    for number, data in enumerate(payloads):
        at = BASE_NS + number * 1_000_000
        chunk.add(1, number, at, at, data)
    file.add_chunk(chunk.seal(zstandard.ZstdCompressor()))
    file.finish()


def list_message(values: list[float], names: list[str]) -> bytes:
    """CDR, little endian, by hand."""
    body = len(values).to_bytes(4, "little") + np.array(values, "<f4").tobytes()
    body += len(names).to_bytes(4, "little")
    for name in names:
        text = name.encode() + b"\0"
        body += bytes(-len(body) % 4) + len(text).to_bytes(4, "little") + text
    return b"\0\1\0\0" + body


@pytest.mark.parametrize("kind", KINDS)
def test_lists_may_be_longest_in_the_last_batch(log_tool: Any, tmp_path: Path, kind: str) -> None:
    count = 2 * BATCH + 5
    payloads = [list_message([k / 2], ["a"]) for k in range(count)]
    payloads[-1] = list_message([1.0, float("nan"), 3.0], ["x", "y"])
    payloads[BATCH] = list_message([], [])
    arrays_log(tmp_path / "a.mcap", payloads)
    assert log_tool("export", tmp_path / "a.mcap", "--format", kind).code == 0
    out = tmp_path / f"a_{kind}"
    assert sorted(path.name for path in out.iterdir()) == ["columns.json", f"list.{kind}"]
    if kind == "csv":
        with (out / "list.csv").open(newline="") as file:
            table = list(csv.DictReader(file))
        lists = ["values.0", "values.1", "values.2", "names.0", "names.1"]
        assert list(table[0])[4:] == lists
        assert [table[-1][name] for name in lists] == ["1", "nan", "3", "x", "y"]
        assert [table[3][name] for name in lists] == ["1.5", "", "", "a", ""]
        assert [table[BATCH][name] for name in lists] == [""] * 5
        assert len(table) == count
    elif kind == "parquet":
        read = pyarrow.parquet.read_table(out / "list.parquet")
        assert read.num_rows == count
        assert read["names"][-1].as_py() == ["x", "y"]
        assert read["values"][BATCH].as_py() == []
        assert read["values"][BATCH + 1].as_py() == [(BATCH + 1) / 2]
    else:
        with np.load(out / "list.npz") as arrays:
            lengths = np.diff(arrays["values.offsets"])
            assert lengths.tolist() == [1] * BATCH + [0] + [1] * (count - BATCH - 2) + [3]
            assert arrays["values"][-1] == 3.0
            assert arrays["names"][-1] == '["x", "y"]'


@pytest.mark.parametrize("kind", KINDS)
def test_messages_that_cannot_be_decoded_are_counted_within_a_batch(
    log_tool: Any, tmp_path: Path, kind: str
) -> None:
    payloads = [list_message([k], ["a"]) for k in range(100)]
    payloads[0] = payloads[50] = payloads[99] = b"\0\1\0\0\xff"
    arrays_log(tmp_path / "a.mcap", payloads)
    outcome = log_tool("export", tmp_path / "a.mcap", "--format", kind)
    assert outcome.code == 1
    assert "3 messages of /list left out" in outcome.err
    assert "97 messages" in outcome.out
    contents = json.loads((tmp_path / f"a_{kind}" / "columns.json").read_text())
    assert contents[0]["rows"] == 97
    if kind == "npz":
        with np.load(tmp_path / "a_npz" / "list.npz") as arrays:
            assert arrays["log_sequence"].tolist() == [*range(1, 50), *range(51, 99)]
            assert arrays["values"][:, 0].tolist() == [*range(1, 50), *range(51, 99)]


@pytest.mark.parametrize("kind", KINDS)
def test_fields_called_like_the_columns_in_front_keep_their_values(
    log_tool: Any, tmp_path: Path, kind: str
) -> None:
    payloads = [b"\0\1\0\0" + k.to_bytes(4, "little") for k in (7, 8, 9)]
    arrays_log(tmp_path / "a.mcap", payloads, b"uint32 log_sequence\n")
    assert log_tool("export", tmp_path / "a.mcap", "--format", kind).code == 0
    path = tmp_path / f"a_{kind}" / f"list.{kind}"
    if kind == "csv":
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        found = {name: [int(row[name]) for row in rows] for name in rows[0] if "seq" in name}
    elif kind == "parquet":
        table = pyarrow.parquet.read_table(path)
        found = {name: table[name].to_pylist() for name in table.column_names if "seq" in name}
    else:
        with np.load(path) as arrays:
            found = {name: arrays[name].tolist() for name in arrays.files if "seq" in name}
    assert found == {"log_sequence_": [0, 1, 2], "log_sequence": [7, 8, 9]}


class Kept(Table):
    """Notes how many messages were decoded at a time."""

    def __init__(self, budget: Budget) -> None:
        super().__init__(lambda data: REFUSED if data == b"bad" else data, budget)
        self.sizes: list[int] = []

    def write(self, records: list[Record], messages: list[Any]) -> None:
        assert [each.data for each in records] == messages
        self.sizes.append(len(messages))


def test_one_batch_is_decoded_at_a_time() -> None:
    budget, stream = Budget(1 << 20), Stream("/t", "", "", b"", "json")
    table, large = Kept(budget), Kept(budget)
    for k in range(BATCH + 10):
        table.add(Record(stream, k, 0, 0, b"bad" if k % 2 else b"good"))
    assert table.sizes == [BATCH // 2]
    for _ in range(3):
        large.add(Record(stream, 0, 0, 0, bytes(150_000)))
    assert large.sizes == [2]
    assert not budget.spent
    large.add(Record(stream, 0, 0, 0, bytes(50_000)))
    table.flush()
    large.flush()
    assert (table.rows, large.rows, budget.held) == (BATCH // 2 + 5, 4, 0)
