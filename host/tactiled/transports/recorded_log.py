"""A recorded log as a port: plays its raw chunks at the pace at which they were recorded."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sensor_proto.can_transfers import BusState, CanFrame
from tactile_core.bus.messages import MSG, DecodeError, codec, header
from tactile_core.bus.topics import RAW
from tactile_core.log.reader import LogReader
from tactile_core.log.records import Block, ChannelRecord, LogError, MetadataRecord
from tactile_core.types import Instant, WallClock, after, monotonic_now, seconds_between
from tactiled.blocks import Chunk
from tactiled.transports.base import (
    EndOfLog,
    Losses,
    Medium,
    PortClosed,
    PortDenied,
    PortGone,
    PortMissing,
    PortUnsuitable,
)

# Chunks as ``tactile_msgs/RawChunk`` messages, and back.


SERIAL, CAN = 0, 1
FD_BIT = 1 << 31
ERROR_BIT = 1 << 29
ID_MASK = ERROR_BIT - 1
"""Bits of ``RawChunk.can_id``: FD frame, error frame, identifier."""


def to_raw(chunk: Chunk, port: str, wall: WallClock) -> Any:
    """Convert a chunk read from ``port`` to a RawChunk message."""
    payload = chunk.payload
    if isinstance(payload, bytes):
        ids, lengths, data, medium = [], [], payload, SERIAL
    else:
        ids = [f.identifier | FD_BIT * f.fd | ERROR_BIT * f.error for f in payload]
        lengths = [len(f.data) for f in payload]
        data, medium = b"".join(f.data for f in payload), CAN
    return MSG.RawChunk(
        header(wall.wall_ns(chunk.received), port),
        received_ns=chunk.received,
        medium=medium,
        can_id=np.array(ids, np.uint32),
        can_length=np.array(lengths, np.uint8),
        data=np.frombuffer(data, np.uint8),
    )


def from_raw(message: Any) -> Chunk:
    """Convert a RawChunk message to a chunk; `DecodeError` when it is inconsistent."""
    data = np.asarray(message.data, np.uint8).tobytes()
    received = Instant(int(message.received_ns))
    if message.medium == SERIAL:
        return Chunk(received, data)
    if message.medium != CAN:
        raise DecodeError(f"RawChunk of medium {message.medium}: 0 serial, 1 CAN")
    ids, lengths = message.can_id.tolist(), message.can_length.tolist()
    if len(ids) != len(lengths) or sum(lengths) != len(data):
        raise DecodeError(
            f"RawChunk with {len(ids)} identifiers, {len(lengths)} lengths and {len(data)} bytes"
        )
    frames, at = [], 0
    for can_id, length in zip(ids, lengths, strict=True):
        part = data[at : at + length]
        at += length
        frames.append(
            CanFrame(can_id & ID_MASK, part, bool(can_id & FD_BIT), bool(can_id & ERROR_BIT))
        )
    return Chunk(received, tuple(frames))


log = logging.getLogger(__name__)


class McapTransport:
    """Plays the raw chunks of one board of a log (`RawChunk` on ``tactile/<board>/raw``), in order.

    ``board`` None: the first board in the log. ``speed``: times real time; `math.inf`: as fast as
    possible. Stamps begin at the moment of opening and keep the recorded spacing, divided by a
    finite ``speed``. Of damaged or truncated files, everything readable is played. After the last
    chunk `read` raises `EndOfLog`.
    """

    def __init__(self, path: str | Path, board: str | None = None, speed: float = 1.0) -> None:
        if not speed > 0:
            raise ValueError(f"speed {speed} given; allowed: a positive number, or inf")
        self._path = Path(path)
        self._board = board
        self._speed = speed
        self._losses = Losses()
        self._closed = threading.Event()
        self._closed.set()
        self._reading = threading.Lock()
        self._chunks: Iterator[Chunk] = iter(())
        self._channels: dict[int, bool] = {}
        self._next: Chunk | None = None
        self._first = self._start = Instant(0)
        self._medium = Medium.SERIAL
        self.metadata: dict[str, dict[str, str]] = {}
        """Metadata records read so far, by name; once open, those before the first chunk."""

    @property
    def name(self) -> str:
        """Path of the log."""
        return str(self._path)

    @property
    def board(self) -> str | None:
        """Name of the board played; if none was given, known once open."""
        return self._board

    @property
    def medium(self) -> Medium:
        """Medium of the recorded board; known once open."""
        return self._medium

    @property
    def state(self) -> BusState:
        """Always active."""
        return BusState.ACTIVE

    @property
    def losses(self) -> dict[str, int]:
        """Counts of damaged records, and of writes, which are dropped."""
        return self._losses.snapshot()

    def open(self) -> None:
        """Find the first chunk; `TransportError` when there is no file, log or raw chunk."""
        try:
            self._path.open("rb").close()
        except FileNotFoundError as error:
            raise PortMissing(f"there is no log {self._path}", "give the path of a log") from error
        except PermissionError as error:
            raise PortDenied(f"no permission to read {self._path}", "see its mode") from error
        except OSError as error:
            raise PortUnsuitable(f"cannot read {self._path}: {error}", "give a log") from error
        self._channels.clear()
        self._chunks = self._read_chunks()
        try:
            self._next = next(self._chunks, None)
        except LogError as error:
            raise PortUnsuitable(str(error), "give a log that tactiled wrote") from error
        if self._next is None:
            of = "" if self._board is None else f" of board {self._board!r}"
            raise PortUnsuitable(
                f"{self._path} holds no raw chunks{of}",
                "give a log that was written with raw chunks (see `tactile log info`)",
            )
        self._medium = Medium.SERIAL if isinstance(self._next.payload, bytes) else Medium.CAN
        self._closed.clear()
        self._first = self._next.received
        self._start = monotonic_now()

    def read(self, timeout: float) -> Chunk | None:
        """Return the next chunk when it is due; see `Transport.read`."""
        with self._reading:
            if self._closed.is_set():
                raise PortClosed(f"{self._path} is closed")
            chunk = self._next
            if chunk is None:
                raise EndOfLog(f"{self._path} is at its end")
            spacing = seconds_between(self._first, chunk.received)
            due = self._start
            if math.isinf(self._speed):
                stamp = after(self._start, spacing)
            else:
                stamp = due = after(self._start, spacing / self._speed)
            wait = seconds_between(monotonic_now(), due)
            if self._closed.wait(max(0.0, min(wait, timeout))):
                raise PortClosed(f"{self._path} was closed")
            if wait > timeout:
                return None
            try:
                self._next = next(self._chunks, None)
            except LogError as error:
                raise PortGone(str(error), "see whether the disk is sound") from error
            return Chunk(stamp, chunk.payload)

    def write(self, data: bytes | tuple[CanFrame, ...]) -> None:
        """Drop and count: a recording takes no data."""
        self._losses.add("write_to_recording", len(data))

    def close(self) -> None:
        """Close; a waiting reader wakes at once."""
        self._closed.set()
        with self._reading:
            self._chunks, self._next = iter(()), None

    def _read_chunks(self) -> Iterator[Chunk]:
        with LogReader(self._path) as reader:
            for event in reader.events():
                if isinstance(event, MetadataRecord):
                    self.metadata[event.name] = event.values
                if not isinstance(event, Block):
                    continue
                for message in reader.messages(event):
                    if not self._wants(message.channel, reader):
                        continue
                    try:
                        yield from_raw(codec().decode(RAW, message.data))
                    except DecodeError:
                        self._losses.add("broken_message")
            if reader.damage_count:
                self._losses.add("damaged_places", reader.damage_count)
            if reader.damage_count or not reader.closed:
                log.warning("%s was cut off or damaged; replayed what could be read", self._path)

    def _wants(self, number: int, reader: LogReader) -> bool:
        wanted = self._channels.get(number)
        if wanted is None:
            channel = reader.channels.get(number)
            wanted = channel is not None and self._is_raw(channel, reader)
            self._channels[number] = wanted
        return wanted

    def _is_raw(self, channel: ChannelRecord, reader: LogReader) -> bool:
        schema = reader.schemas.get(channel.schema)
        if schema is None or schema.name != RAW.msgtype:
            return False
        board = channel.topic.removesuffix("/raw").rpartition("/")[2]
        if self._board is None:
            self._board = board
        elif board != self._board:
            log.info("%s also holds raw chunks of board %r", self._path, board)
        return board == self._board
