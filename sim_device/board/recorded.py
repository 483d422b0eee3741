"""Send the recorded fields of a real board again, as AnySkin frames."""

from __future__ import annotations

import csv
import gzip
import io
import math
import zlib
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensor_proto.anyskin import MAX_FIELD_UT, MAX_MAGNETOMETERS, encode_anyskin
from sensor_proto.packets import FloatSamples, TaxelStatus
from sim_device.board.wire import SerialWire
from sim_device.faults import FaultPlan
from sim_device.skin.chips import COUNT_MAX, Reading, temperature_of_raw
from sim_device.skin.damage import BrokenTaxels
from tactile_core.types import Instant, after, seconds_between

TEMPERATURE_C = 25.0
"""°C put into every frame: recordings hold no temperature."""

PROBE_FRAME = b"\r\n"
"""Probe bytes sent before the start: once they are gone, a host reads. A real host, too, opens a
port in the middle of a frame, so the first bytes it gets are the end of one."""

BURST = 12
"""Most frames sent at once at high speed: the longest just fit into a terminal."""

MAX_ROWS = 10_000_000
"""A day at 100 Hz. A longer file is surely not a recording, and would not fit in memory."""

FIXED_FORM = "time in s, then x, y, z in µT for each of 1 to 20 magnetometers"


class RecordingError(ValueError):
    """Not a recording; the message gives file, line, what was found and what is allowed."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """``seconds``: (n,) s from the first row. ``field_ut``: (n, m, 3) float32 µT in chip axes."""

    seconds: NDArray[np.float64]
    field_ut: NDArray[np.float32]

    @property
    def magnetometers(self) -> int:
        """Number of magnetometers of the recorded board."""
        return int(self.field_ut.shape[1])

    @property
    def period(self) -> float:
        """Median time between rows, s, without rows of equal time; 0.1 for one row."""
        steps = np.diff(self.seconds)
        steps = steps[steps > 0]
        return float(np.median(steps)) if len(steps) else 0.1


def load(path: str | Path) -> Recording:
    """Read a CSV file, plain or ``.gz``, in the form `FIXED_FORM`; a heading is skipped.

    RecordingError for anything else; OSError if the file cannot be read.
    """
    path = Path(path)
    rows: list[list[float]] = []
    columns = 0
    last = -math.inf
    try:
        with _open_text(path) as file:
            for number, cells in enumerate(csv.reader(file), start=1):
                if not cells or (number == 1 and _is_heading(cells)):
                    continue
                where = f"{path}:{number}"
                if not columns:
                    columns = _count_columns(len(cells), where)
                if len(cells) != columns:
                    raise RecordingError(
                        f"{where}: {len(cells)} columns given; allowed: {columns}, as in the "
                        "rows above"
                    )
                row = [_number(cell, k, where) for k, cell in enumerate(cells)]
                if row[0] < last:
                    raise RecordingError(
                        f"{where}: time {cells[0]} s given, earlier than the row above; allowed: "
                        "times that do not decrease"
                    )
                last = row[0]
                if len(rows) >= MAX_ROWS:
                    raise RecordingError(f"{where}: too long; allowed: {MAX_ROWS} rows")
                rows.append(row)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise RecordingError(f"{path}: broken gzip file ({error}); allowed: a whole one") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not text ({error.reason}); allowed: {FIXED_FORM}") from error
    except csv.Error as error:
        raise RecordingError(f"{path}: not CSV ({error}); allowed: {FIXED_FORM}") from error
    if not rows:
        raise RecordingError(f"{path}: no rows; allowed: {FIXED_FORM}")
    table = np.array(rows)
    return Recording(table[:, 0] - table[0, 0], table[:, 1:].reshape(len(rows), -1, 3).astype("f4"))


def _open_text(path: Path) -> io.TextIOWrapper:
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"  # gzip, whatever the file's name
    if packed:
        return io.TextIOWrapper(gzip.open(path, "rb"), encoding="utf-8", newline="")
    return path.open("r", encoding="utf-8", newline="")


def _is_heading(cells: list[str]) -> bool:
    """Whether none of the cells is a number: then they are names of columns."""
    for cell in cells:
        try:
            float(cell)
        except ValueError:
            continue
        return False
    return True


def _count_columns(columns: int, where: str) -> int:
    magnetometers, rest = divmod(columns - 1, 3)
    if rest or not 1 <= magnetometers <= MAX_MAGNETOMETERS:
        raise RecordingError(f"{where}: {columns} columns given; allowed: {FIXED_FORM}")
    return columns


def _number(cell: str, column: int, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RecordingError(
            f"{where}: column {column + 1}: {cell!r} given; allowed: a finite number"
        )
    if column and abs(value) > MAX_FIELD_UT:
        raise RecordingError(
            f"{where}: column {column + 1}: {cell} µT given; allowed: up to {MAX_FIELD_UT:g} µT"
        )
    return value


class ReplayBoard:
    """Board that sends a recording. It sends `PROBE_FRAME` until `start`, and takes no commands.

    ``speed``: times real time. ``loop``: begin again one period after the last row. ``plan``:
    faults of the chips, which form one array ``skin``, and of the wire, in the recording's time.
    ValueError for faults of other boards.
    """

    def __init__(
        self,
        recording: Recording,
        speed: float = 1.0,
        loop: bool = False,
        plan: FaultPlan | None = None,
    ) -> None:
        plan = plan or FaultPlan()
        if plan.reset or plan.busoff:
            raise ValueError("reset and busoff: such a board has neither clock nor bus")
        self._broken = BrokenTaxels(plan, {"skin": recording.magnetometers})
        self._wire = SerialWire(plan, delimited=False) if plan.touches_wire else None
        self._has_faults = bool(plan.taxels or plan.copy)
        self._lsb = _scale(recording.field_ut)
        if not (speed > 0 and math.isfinite(speed)):
            raise ValueError(f"speed {speed} given; allowed: a positive number")
        self._recording = recording
        self._speed = speed
        self._loop = loop
        self._temperature = np.full(recording.magnetometers, TEMPERATURE_C, np.float32)
        self._status = np.zeros(recording.magnetometers, np.uint8)
        self._start: Instant | None = None
        self._probed = False
        self._row = 0
        self.sent = 0
        """Frames sent so far."""

    def __len__(self) -> int:
        """Rows of the recording."""
        return len(self._recording.seconds)

    @property
    def started(self) -> bool:
        """Whether `start` has been called."""
        return self._start is not None

    @property
    def finished(self) -> bool:
        """Whether the last frame has been sent and no more will follow."""
        return self._row >= len(self) and not self._loop

    def start(self, now: Instant) -> None:
        """Send the first row at ``now`` and the others at their distances from it."""
        self._start = now

    def postpone(self, seconds: float) -> None:
        """Move all rows not yet sent by ``seconds``."""
        if self._start is not None:
            self._start = after(self._start, seconds)

    def receive(self, data: bytes, now: Instant) -> None:
        """Ignore the data: such boards take no commands."""

    def tick(self, now: Instant) -> bytes:
        """Frames due by ``now``, at most `BURST`; the others come with the next call."""
        if self._start is None:
            probe, self._probed = (b"" if self._probed else PROBE_FRAME), True
            return probe
        out: list[bytes] = []
        while len(out) < BURST and not self.finished and self._due(self._row) <= now:
            if self._row >= len(self):
                self._start, self._row = self._due(self._row), 0
            out.append(self._frame(self._row))
            self._row += 1
            self.sent += 1
        if self._wire is not None:
            seconds = seconds_between(self._start, now) * self._speed
            return b"".join(self._wire.pass_on(deque(out), seconds))
        return b"".join(out)

    def _due(self, row: int) -> Instant:
        seconds = self._recording.seconds
        at = seconds[row] if row < len(self) else seconds[-1] + self._recording.period
        return after(self._start or Instant(0), float(at) / self._speed)

    def _frame(self, row: int) -> bytes:
        field, temperature = self._recording.field_ut[row], self._temperature
        if self._has_faults:
            field, temperature = self._with_faults(field, float(self._recording.seconds[row]))
        return encode_anyskin(FloatSamples(field, temperature, self._status))

    def _with_faults(
        self, field: NDArray[np.float32], seconds: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Field, µT, and temperatures, °C, as broken chips give them.

        Both are made from counts, so that repeated values are the same bit for bit.
        """
        counts = np.clip(np.rint(field / self._lsb), -COUNT_MAX - 1, COUNT_MAX).astype(np.int16)
        reading = Reading(counts, self._status, self._temperature.astype(np.float64))
        broken = self._broken.apply(reading, seconds)
        out = broken.counts * self._lsb
        failed = np.flatnonzero(broken.status & TaxelStatus.READ_FAILED)
        temperature = broken.temperature_c.copy()
        temperature[failed] = temperature_of_raw(np.full(len(failed), 65535.0))
        if broken.infinite is not None:
            out[broken.infinite] = np.inf, -np.inf, np.nan
        return out.astype(np.float32), temperature.astype(np.float32)


_SCALES_UT = tuple(
    (xy * factor, z * factor)
    for factor in (8, 4, 2, 1)
    for xy, z in (
        (0.751, 1.210), (0.601, 0.968), (0.451, 0.727), (0.375, 0.605),
        (0.300, 0.484), (0.250, 0.403), (0.200, 0.323), (0.150, 0.242),
    )
)  # fmt: skip
"""µT per count of x and y, and of z, of an MLX90393 at each resolution and gain (datasheet)."""
_LOOKED_AT = 64
"""Rows from which the scale of a recording is found."""


def _scale(field_ut: NDArray[np.float32]) -> NDArray[np.float64]:
    """(3,) µT per count of which all of (n, m, 3) are multiples; the finest if none fits."""
    rows = field_ut[:_LOOKED_AT].astype(np.float64)
    for xy, z in _SCALES_UT:
        scale = np.array([xy, xy, z])
        counts = rows / scale
        if (np.abs(counts - np.rint(counts)) < 0.1).all():
            return scale
    return np.array([*_SCALES_UT[-1][:1], *_SCALES_UT[-1]])
