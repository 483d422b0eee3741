"""Read a recording from a log (MCAP) with a board's field and a reference force.

Field: ``tactile/<name>/field``, µT over the rest field at the time, in taxel axes. Reference:
``reference/<name>/wrench``, see `tactile_core.bus.topics.REFERENCE`; a row with a value that is not
finite counts as no reading.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tactile_core.arrays import FloatArray
from tactile_core.bus.messages import DecodeError, codec, stamp_ns
from tactile_core.bus.topics import FIELD, REFERENCE, find_topic
from tactile_core.calibration import BoardCalibration, CalibrationError, loads
from tactile_core.calibration.file import SUFFIX
from tactile_core.log.reader import LogReader
from tactile_core.log.records import AttachmentRecord, Block, LogError
from tactile_core.types import NS_PER_S
from tactile_tools.calibrate.recording import (
    MIN_FRAMES,
    Recording,
    RecordingError,
    check,
    with_clock,
)

MAX_FRAMES = 2_000_000
"""Over five hours at 100 Hz; more in one log is a mistake and would fill the memory."""
SHEAR_SHARE = 0.02
"""Shear that never reaches this share of the largest force was not measured, or is noise."""
MAX_MASKED = 0.2
"""A recording with a larger share of frames with an unhealthy taxel is refused."""


@dataclass(slots=True)
class _Board:
    """What the log says of one board; stamps in ns."""

    field_ns: list[int] = field(default_factory=list)
    field_ut: list[FloatArray] = field(default_factory=list)
    masked: int = 0
    reference_ns: list[int] = field(default_factory=list)
    force: list[tuple[float, float, float]] = field(default_factory=list)


def read_log(path: Path, name: str | None = None) -> Recording:
    """Read the recording of board ``name`` in log ``path``.

    None: of the only one with a reference.
    """
    try:
        boards, attached = _collect(path)
    except (LogError, DecodeError) as error:
        raise RecordingError(f"{path}: {error}") from error
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}; name a log that can be read") from error
    name = _which(path, boards, name)
    board = boards[name]
    _drop_early(board)
    _drop_repeated(board)
    calibration = attached.get(name)
    if calibration is None:
        raise RecordingError(
            f"{path}: holds no calibration of {name!r}, so nothing says where its taxels are; "
            "logs of tactiled and of `tactile calibrate record` do"
        )
    total = len(board.field_ns) + board.masked
    if total and board.masked > MAX_MASKED * total:
        raise RecordingError(
            f"{path}: {board.masked} of {total} frames have a taxel that is not healthy; see what "
            "ails the board (tactiled says it), then record again"
        )
    for what, count in (("frames", len(board.field_ns)), ("reference", len(board.force))):
        if count < MIN_FRAMES:
            raise RecordingError(
                f"{path}: {count} {what} of {name!r}, at least {MIN_FRAMES} are needed; record for "
                "longer"
            )
    widths = {len(frame) for frame in board.field_ut}
    if widths != {3 * calibration.geometry.taxels}:
        raise RecordingError(f"{path}: fields of {name!r} are not of its {widths} channels")
    force = np.array(board.force)
    targets = _targets(force)
    begin = board.field_ns[0]
    whole = check(
        Recording(
            path=path,
            geometry=calibration.geometry,
            serial_number=calibration.serial_number,
            started=datetime.fromtimestamp(begin / NS_PER_S, UTC).isoformat(timespec="seconds"),
            time_s=(np.array(board.field_ns) - begin) / NS_PER_S,
            field_ut=np.array(board.field_ut, np.float64),
            rest_ut=None,
            label_time_s=(np.array(board.reference_ns) - begin) / NS_PER_S,
            labels=np.column_stack([_label(force, t) for t in targets]),
            targets=targets,
            calibration=calibration,
        )
    )
    return with_clock(whole)


def _collect(path: Path) -> tuple[dict[str, _Board], dict[str, BoardCalibration]]:
    boards: dict[str, _Board] = defaultdict(_Board)
    attached: dict[str, BoardCalibration] = {}
    decode = codec().decode
    with LogReader(path) as reader:
        for event in reader.events():
            if isinstance(event, AttachmentRecord) and event.name.endswith(SUFFIX):
                text = reader.read_at(event.position, event.size).decode("utf-8", "replace")
                try:
                    calibration = loads(text, f"{path}: {event.name}")
                except CalibrationError as error:
                    raise RecordingError(str(error)) from error
                attached[event.name.removesuffix(SUFFIX)] = calibration
            if not isinstance(event, Block):
                continue
            for message in reader.messages(event):
                channel = reader.channels.get(message.channel)
                found = None if channel is None else find_topic(channel.topic)
                if found is None or found[0] not in (FIELD, REFERENCE):
                    continue
                board, value = boards[found[1]], decode(found[0], message.data)
                if found[0] is REFERENCE:
                    _take_reference(board, value)
                else:
                    _take_field(board, value, path)
    return boards, attached


def _take_reference(board: _Board, message: Any) -> None:
    force = message.wrench.force
    vector = (float(force.x), float(force.y), float(force.z))
    stamp = stamp_ns(message.header.stamp)
    if np.isfinite(vector).all() and stamp not in board.reference_ns[-1:]:
        board.reference_ns.append(stamp)
        board.force.append(vector)


def _take_field(board: _Board, message: Any, path: Path) -> None:
    values = np.asarray(message.field_ut, np.float64)
    if not np.isfinite(values).all():
        board.masked += 1
        return
    stamp = stamp_ns(message.header.stamp)
    if stamp in board.field_ns[-1:]:
        return  # older logs stamp frames that were read together alike
    if len(board.field_ns) >= MAX_FRAMES:
        raise RecordingError(f"{path}: over {MAX_FRAMES} frames; `tactile log split` it")
    board.field_ns.append(stamp)
    board.field_ut.append(values)


def _drop_early(board: _Board) -> None:
    """Drop the frames before the first reading: the rest field may have been another then."""
    first = min(board.reference_ns)
    keep = next((i for i, at in enumerate(board.field_ns) if at >= first), len(board.field_ns))
    del board.field_ns[:keep], board.field_ut[:keep]


def _drop_repeated(board: _Board) -> None:
    """Drop a frame or a reading that has the stamp of the one before it.

    For boards without a clock the daemon estimates when a frame was captured, and never lets its
    stamps run back: they stand still until the estimate has caught up.
    """
    for stamps, values in ((board.field_ns, board.field_ut), (board.reference_ns, board.force)):
        same = [i for i in range(1, len(stamps)) if stamps[i] == stamps[i - 1]]
        for index in reversed(same):
            del stamps[index], values[index]


def _which(path: Path, boards: dict[str, _Board], name: str | None) -> str:
    usable = sorted(n for n, b in boards.items() if b.field_ns and b.force)
    if name is not None:
        if name not in usable:
            held = ", ".join(usable) or "none"
            raise RecordingError(f"{path}: no board {name!r} with a reference; it holds {held}")
        return name
    if not usable:
        raise RecordingError(
            f"{path}: no board has both a field and a reference force (reference/<name>/wrench); "
            "make such a log with `tactile calibrate record`"
        )
    if len(usable) > 1:
        raise RecordingError(f"{path}: holds boards {', '.join(usable)}; say which with --board")
    return usable[0]


def _targets(force: FloatArray) -> tuple[str, ...]:
    """Names of the measured targets: always normal force, and shear where it was measured."""
    least = SHEAR_SHARE * np.abs(force).max()
    shear = np.abs(force[:, :2]).max(axis=0) > least
    return ("normal", *(n for n, there in zip(("shear_x", "shear_y"), shear, strict=True) if there))


def _label(force: FloatArray, target: str) -> FloatArray:
    return -force[:, 2] if target == "normal" else force[:, ("shear_x", "shear_y").index(target)]
