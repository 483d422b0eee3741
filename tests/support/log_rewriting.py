"""Rewrite a log with messages changed, added or left out."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import Writer

from tactile_core.bus.messages import codec

Edit = Callable[[str, int, Any], Iterable[tuple[str, int, Any]]]
"""Takes topic, log time in ns and message; yields the replacements."""


def rewrite(source: Path, out: Path, edit: Edit) -> Path:
    """Write to ``out`` what ``edit`` yields for each message of ``source``; return ``out``."""
    with source.open("rb") as reading, out.open("wb") as writing:
        writer = Writer(writing)
        writer.start("ros2", "test")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        rows = []
        for schema, channel, message in make_reader(reading).iter_messages():
            assert schema is not None
            decoded = codec().decode(schema.name, message.data)
            for topic, log_ns, changed in edit(channel.topic, message.log_time, decoded):
                data = codec().encode(schema.name, changed)
                rows.append((log_ns, len(rows), topic, schema, data))
        for number, (log_ns, _, topic, schema, data) in enumerate(sorted(rows, key=_when)):
            if schema.name not in schemas:
                schemas[schema.name] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schemas[schema.name])
            writer.add_message(channels[topic], log_ns, data, log_ns, number)
        writer.finish()
    return out


def _when(row: tuple[Any, ...]) -> tuple[int, int]:
    return row[0], row[1]
