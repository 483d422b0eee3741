"""Messages of an export, held encoded and decoded in batches. Bounded memory.

Decoded, a message takes about ten times its bytes, so only the messages of one batch of one table
are decoded at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tactile_tools.log.stream import Record

if TYPE_CHECKING:
    from tactile_tools.log.columns import Column

BATCH = 1024
"""Most rows per batch."""

BATCH_BYTES = 256 << 10
"""Encoded bytes after which a batch is written in any case: as objects they take ten times that."""

HELD_BYTES = 24 << 20
"""Encoded bytes of the messages held by all tables together."""

MESSAGE_BYTES = 250
"""Bytes counted for a message besides its own."""

OWN = ("time_s", "log_time_ns", "publish_time_ns", "log_sequence")
"""Columns in front: seconds since the start of the log, then what the log says of the message."""

NOTES = {
    "time_s": "s since the first message of the log",
    "log_time_ns": "ns since the Unix epoch, when it was logged",
    "publish_time_ns": "ns since the Unix epoch, when it was sent",
    "log_sequence": "number of the message within its stream",
}


def own_names(columns: list[Column]) -> tuple[str, ...]:
    """Names of the columns in front, other than those of the messages' fields."""
    taken = {column.name for column in columns}
    return tuple(name + "_" * (name in taken) for name in OWN)


REFUSED = object()
"""Instead of a message that could not be decoded; the decoder has counted it."""


class Budget:
    """Memory of all tables of an export; when it is spent, all tables write."""

    def __init__(self, limit: int = HELD_BYTES) -> None:
        self.held = 0
        self._limit = limit

    @property
    def spent(self) -> bool:
        """Whether the tables hold more than the limit."""
        return self.held > self._limit


class Table:
    """A table being written, batch by batch. ``rows``: number of rows written so far.

    ``decode``: decodes the bytes of a message or returns `REFUSED`.
    """

    def __init__(self, decode: Callable[[bytes], Any], budget: Budget) -> None:
        self.rows = 0
        self._decode = decode
        self._budget = budget
        self._held: list[Record] = []
        self._bytes = 0

    def add(self, record: Record) -> None:
        """Add a row."""
        self._held.append(record)
        size = len(record.data) + MESSAGE_BYTES
        self._bytes += size
        self._budget.held += size
        if len(self._held) >= BATCH or self._bytes >= BATCH_BYTES:
            self.flush()

    def flush(self) -> None:
        """Decode and write all held rows."""
        held, self._held = self._held, []
        self._budget.held -= self._bytes
        self._bytes = 0
        decode = self._decode
        messages = [decode(record.data) for record in held]
        if any(message is REFUSED for message in messages):
            both = [each for each in zip(held, messages, strict=True) if each[1] is not REFUSED]
            held, messages = [each[0] for each in both], [each[1] for each in both]
        if messages:
            self.rows += len(messages)
            self.write(held, messages)

    def write(self, records: list[Record], messages: list[Any]) -> None:
        """Write rows; ``messages`` are decoded."""
        raise NotImplementedError

    def close(self) -> list[dict[str, str]]:
        """Write the held rows and finish. Returns a description of the columns."""
        raise NotImplementedError
