"""Messages as columns: nested fields flattened, times in nanoseconds, notes from the definitions.

Each row of a column holds a number, a text, a list of numbers, a list of texts, or the rows of a
nested table.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Literal

import numpy as np

from tactile_core.bus.messages import NUMBER_TYPES
from tactile_tools.log.decode import ARRAY, BASE, NAME, SEQUENCE, TIMES, Reader, plain
from tactile_tools.log.stream import Stream

Kind = Literal["number", "text", "numbers", "texts", "rows"]

FIELD_LINE = re.compile(
    r"^\s*([A-Za-z][\w/]*(?:<=\d+)?(?:\[[^\]]*\])?)\s+([a-z]\w*)\b[^#=]*(?:#\s*(.*))?$"
)

TIME_NOTE = "ns since the Unix epoch"


@dataclass(slots=True)
class Column:
    """One column. ``get``: reads its value from a message. ``fields``: columns of a nested table.

    ``length``: elements of a list of fixed length, else None.
    """

    name: str
    kind: Kind
    get: Callable[[Any], Any]
    dtype: np.dtype[Any] | None = None
    note: str = ""
    length: int | None = None
    fields: list[Column] = field(default_factory=list)
    to_plain: Callable[[Any], Any] = lambda value: value


def plan(stream: Stream, reader: Reader) -> list[Column]:
    """Make the columns of a stream's messages, in the order of their definition."""
    if not reader.fields:
        import json

        return [Column("json", "text", lambda message: json.dumps(message, ensure_ascii=False))]
    notes = comments(stream)
    return _columns(reader.fields, reader.msgtype, "", "", notes)


def _columns(
    fields: dict[str, Any], msgtype: str, path: str, prefix: str, notes: dict[tuple[str, str], str]
) -> list[Column]:
    """Columns of a part of a message.

    ``path``: attributes that lead from the message to this part. ``prefix``: of the columns' names.
    """
    out: list[Column] = []
    for name, (kind, arguments) in fields[msgtype][1]:
        here = f"{path}.{name}" if path else name
        column = prefix + name
        note = notes.get((msgtype, name), "")
        get = attrgetter(here)
        if kind == NAME:
            if arguments in TIMES:
                out.append(
                    Column(f"{column}_ns", "number", _time(get), np.dtype(np.int64), TIME_NOTE)
                )
                continue
            inner = _columns(fields, arguments, here, f"{column}.", notes)
            for each in inner:
                each.note = each.note or note
            out += inner
        elif kind == BASE:
            out.append(_single(column, get, arguments[0], note))
        elif kind in (ARRAY, SEQUENCE):
            (inner_kind, inner_arguments), size = arguments
            length = size if kind == ARRAY else None
            if inner_kind == NAME:
                out.append(_table(fields, column, get, inner_arguments, note, notes))
            elif inner_arguments[0] in NUMBER_TYPES:
                dtype = np.dtype(NUMBER_TYPES[inner_arguments[0]])
                out.append(Column(column, "numbers", get, dtype, note, length))
            else:
                out.append(Column(column, "texts", get, None, note, length))
    return out


def _single(name: str, get: Callable[[Any], Any], base: str, note: str) -> Column:
    if base in NUMBER_TYPES:
        return Column(name, "number", get, np.dtype(NUMBER_TYPES[base]), note)
    return Column(name, "text", get, None, note)


def _time(get: Callable[[Any], Any]) -> Callable[[Any], int]:
    def nanoseconds(message: Any) -> int:
        time = get(message)
        return int(time.sec) * 1_000_000_000 + int(time.nanosec)

    return nanoseconds


def _table(
    fields: dict[str, Any],
    name: str,
    get: Callable[[Any], Any],
    msgtype: str,
    note: str,
    notes: dict[tuple[str, str], str],
) -> Column:
    if msgtype in TIMES:

        def times(message: Any) -> Any:
            return np.array(
                [int(t.sec) * 1_000_000_000 + int(t.nanosec) for t in get(message)], np.int64
            )

        return Column(f"{name}_ns", "numbers", times, np.dtype(np.int64), TIME_NOTE)
    inner = _columns(fields, msgtype, "", "", notes)
    return Column(
        name, "rows", get, None, note, None, inner, lambda each: plain(each, fields, msgtype)
    )


def comments(stream: Stream) -> dict[tuple[str, str], str]:
    """Comments of the definition by type and field; they hold the units."""
    found: dict[tuple[str, str], str] = {}
    msgtype = stream.msgtype
    for line in stream.definition.decode("utf-8", "replace").splitlines():
        if line.startswith("MSG: "):
            package, _, name = line[5:].strip().rpartition("/")
            msgtype = f"{package.removesuffix('/msg')}/msg/{name}"
        elif (match := FIELD_LINE.match(line)) is not None and match[3]:
            found[msgtype, match[2]] = match[3].strip()
    return found


MAX_STEM = 100
"""Letters of a topic in a file's name; a hash distinguishes longer ones."""

RESERVED = re.compile(r"con|prn|aux|nul|com\d|lpt\d", re.IGNORECASE)
"""Names that some systems reserve for devices."""


class FileNames:
    """File names of streams, distinct where topics are equal or differ only in capitals."""

    def __init__(self, suffix: str) -> None:
        self.names: dict[Stream, str] = {}
        self._suffix = suffix
        self._taken: set[str] = set()
        self._next: dict[str, int] = {}

    def add(self, stream: Stream) -> str:
        """Return a new name for ``stream``."""
        stem = re.sub(r"[^A-Za-z0-9-]+", "_", stream.topic).strip("_") or "topic"
        if len(stem) > MAX_STEM:
            digest = hashlib.blake2b(stream.topic.encode("utf-8", "replace"), digest_size=4)
            stem = f"{stem[:MAX_STEM]}_{digest.hexdigest()}"
        if RESERVED.fullmatch(stem):
            stem += "_"
        name, number = stem, self._next.get(stem.lower(), 1)
        while name.lower() in self._taken:
            number += 1
            name = f"{stem}_{number}"
        self._next[stem.lower()] = number
        self._taken.add(name.lower())
        self.names[stream] = f"{name}{self._suffix}"
        return self.names[stream]
