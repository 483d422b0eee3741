"""State of a board and of the daemon, as ROS diagnostics and as reply of the status service."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from tactile_core.bus.messages import DROPS_PREFIX, MSG, diagnostic_status, header
from tactile_core.log.recorder import Recorder
from tactile_core.log.retention import DiskWatch
from tactile_core.types import Instant, seconds_between
from tactiled.blocks import TaxelHealth
from tactiled.board_session import BoardSession
from tactiled.boards.board import BoardLink
from tactiled.port import Port

# Alarms warn before something becomes a fault: a disk that fills, a skin that drifts.


DRIFT_N = 0.1
"""N; less never counts as touch anywhere in this project."""

ALARM_WINDOW_S = 60.0
"""s of one window; the lowest force in it is kept."""

WINDOWS = 10
"""Windows that must all stay above `DRIFT_N`: a skin in use is released within ten minutes."""


class DriftWatch:
    """Tells zero drift from touch: touch ends now and then, drift does not. Pure.

    Given the peak force once a second, it keeps the minimum of each minute. When the minimum over
    ten minutes is still above `DRIFT_N`, the skin has drifted or something lies on it.
    """

    def __init__(self) -> None:
        self._least: deque[float] = deque(maxlen=WINDOWS)
        self._now = math.inf
        self._since: Instant | None = None

    def add(self, force_n: float, now: Instant) -> None:
        """Take the peak force (N) of valid features at ``now``."""
        if self._since is None:
            self._since = now
        if seconds_between(self._since, now) >= ALARM_WINDOW_S:
            if math.isfinite(self._now):
                self._least.append(self._now)
            self._now, self._since = math.inf, now
        if math.isfinite(force_n):
            self._now = min(self._now, force_n)

    def forget(self) -> None:
        """Start over: the board was tared or replaced."""
        self._least.clear()
        self._now, self._since = math.inf, None

    def alarm(self) -> str | None:
        """What is wrong and what to do, or None."""
        if len(self._least) < WINDOWS or min(self._least) <= DRIFT_N:
            return None
        if self._now <= DRIFT_N:
            return None
        minutes = WINDOWS * ALARM_WINDOW_S / 60
        return (
            f"never below {min(self._least):.2f} N for {minutes:.0f} min: its zero has drifted, or "
            "something lies on it; let go of it and tare"
        )


class Alarms:
    """Alarms of all boards of a daemon; used from the pipeline's thread."""

    def __init__(self) -> None:
        self._disk: DiskWatch | None = None
        self._drift: dict[str, DriftWatch] = {}
        self._seen: dict[str, str] = {}

    def watch(self, recorder: Recorder) -> None:
        """Watch the free space of a log's disk."""
        self._disk = DiskWatch(lambda: Path(recorder.stats.path).parent)
        self._disk.start()

    def stop(self) -> None:
        """Stop watching the disk."""
        if self._disk is not None:
            self._disk.stop()

    def each_second(self, board: BoardSession, now: Instant) -> list[str]:
        """Alarms of a board; each says what to do."""
        watch = self._drift.setdefault(board.name, DriftWatch())
        serial_number = "" if board.identity is None else str(board.identity.serial_number)
        taring = board.pipeline is not None and board.pipeline.taring
        if taring or self._seen.get(board.name) != serial_number:
            watch.forget()
            self._seen[board.name] = serial_number
        elif board.last is not None and board.last.features.valid:
            watch.add(board.last.features.peak_force, now)
        disk = None if self._disk is None else self._disk.alarm(now)
        return [alarm for alarm in (disk, watch.alarm()) if alarm is not None]


OK, WARNING, ERROR, STALE = range(4)
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""

LEVELS = {
    "streaming": OK,
    "waiting": WARNING,
    "identified": WARNING,
    "silent": STALE,
    "unplugged": STALE,
    "refused": ERROR,
}
"""Severity of a board's state."""


def summary(port: Port, node: int, board: BoardSession, now: Instant) -> dict[str, Any]:
    """State of one board for the status service, in s, Hz, N and µT."""
    link = port.line.links.get(node)
    values: dict[str, Any] = {
        "state": board.state,
        "port": port.reader.transport.name,
        "bus_state": str(port.reader.transport.state),
        "node": node,
        "rate_hz": round(board.rate, 2),
        "latency_p50_s": _finite(board.latency.p50),
        "latency_p99_s": _finite(board.latency.p99),
        "cycles": board.sent,
        "reopened": port.reader.reopened,
        "calibration": board.calibration_summary(),
        "taring": board.pipeline is not None and board.pipeline.taring,
        "drops": drops(port, node, board),
        "board": dict(board.board_status),
    }
    if board.pipeline is not None:
        doubt = board.pipeline.rest_reason
        state = board.pipeline.rest_state.value
        values["rest"] = {"state": state, "reason": "" if doubt is None else doubt.text}
    if board.clock_problem:
        values["clock_problem"] = board.clock_problem
    identity = board.identity
    if identity is not None:
        values["serial_number"] = identity.serial_number
        values["model"] = identity.model
        values["firmware"] = identity.firmware
    if board.refusal is not None:
        values["refused"] = f"{board.refusal.problem}; {board.refusal.remedy}"
    if isinstance(link, BoardLink) and link.clock is not None:
        values["clock_synchronised"] = link.clock.synchronised
        values["clock_rate_error"] = _finite(link.clock.rate_error)
        values["clock_polls"] = dict(link.clock.counters)
        values["clock_trouble"] = link.clock_trouble
    cycle = board.last
    if cycle is not None:
        ambient, features = cycle.ambient, cycle.features
        values |= {
            "age_s": round(seconds_between(cycle.captured, now), 4),
            "clock_uncertainty_s": _finite(cycle.uncertainty),
            "compensation": ambient.method,
            "field_support": [_finite(v) for v in ambient.support.tolist()],
            "field_residual_ut": [_finite(v) for v in ambient.residual_ut.tolist()],
            "field_valid": [bool(v) for v in ambient.valid],
            "features_valid": features.valid,
            "reasons": [reason.text for reason in features.reasons],
            "reason_codes": [reason.code for reason in features.reasons],
            "peak_force_n": _finite(features.peak_force),
            "normal_force_n": _finite(features.normal_force),
            "normal_force_bound_n": _finite(features.normal_force_bound),
            "unhealthy_taxels": health(cycle.health),
        }
    if board.chips is not None and board.chips.masked:
        values["masked_chips"] = {f"{one.array}:{one.chip}": str(one) for one in board.chips.masked}
    return values


def health(flags: np.ndarray[Any, np.dtype[np.uint8]]) -> dict[str, int]:
    """Count the unhealthy taxels by reason; ``flags``: (N,) uint8 of `TaxelHealth`."""
    reasons = {flag.name or "": int(np.count_nonzero(flags & flag)) for flag in TaxelHealth}
    return {name.lower(): n for name, n in reasons.items() if n}


def drops(port: Port, node: int, board: BoardSession) -> dict[str, int]:
    """Count by reason what was lost between the wire and the features of one board."""
    counts = port.drops() | {k: n for k, n in board.drops().items() if n}
    link = port.line.links.get(node)
    if isinstance(link, BoardLink):
        trackers = [array.tracker for array in link.arrays.values()]
        counts["samples_missing"] = sum(t.missing for t in trackers)
        counts["samples_duplicate"] = sum(t.duplicate for t in trackers)
        counts["samples_late"] = sum(t.late for t in trackers)
    elif link is not None:
        counts |= {f"arrivals_{reason}": n for reason, n in link.clock.counters.items()}
    return {reason: n for reason, n in counts.items() if n}


def message(name: str, values: dict[str, Any], recorder: Recorder | None, wall_ns: int) -> Any:
    """``DiagnosticArray`` of the board and, if there is one, the log."""
    state = values["state"]
    level = LEVELS.get(state, WARNING)
    alarms = values.get("alarms", ())
    if level == OK and (alarms or not values.get("features_valid", True)):
        level = WARNING
    masked = values.get("masked_chips", {})
    if level == OK and masked:
        level = WARNING
    text = state if level == OK else "; ".join([state, *values.get("reasons", ()), *alarms])
    if masked:
        text += "; masked: " + ", ".join(masked)
    statuses = [
        diagnostic_status(
            f"tactiled/{name}", level, text, values.get("serial_number", ""), _flatten(values)
        )
    ]
    if recorder is not None:
        log = log_summary(recorder)
        log_level = OK if log["state"] == "recording" else ERROR
        statuses.append(
            diagnostic_status(f"tactiled/{name}/log", log_level, log["state"], "", _flatten(log))
        )
    return MSG.DiagnosticArray(header(wall_ns, ""), statuses)


def log_summary(recorder: Recorder) -> dict[str, Any]:
    """State of the log and what it dropped."""
    stats = recorder.stats
    return {
        "state": stats.state,
        "path": stats.path,
        "files": stats.files,
        "written": stats.written,
        "bytes": stats.bytes_written,
        "queued": stats.queued,
        "errors": stats.errors,
        "last_error": stats.last_error,
        "marked": stats.marked,
        "drops": dict(stats.dropped),
    }


def _flatten(values: dict[str, Any]) -> dict[str, object]:
    flat: dict[str, object] = {}
    for key, value in values.items():
        prefix = DROPS_PREFIX if key == "drops" else f"{key}."
        if isinstance(value, dict):
            flat |= {f"{prefix}{inner}": v for inner, v in value.items()}
        elif isinstance(value, list):
            flat[key] = ", ".join(str(v) for v in value)
        else:
            flat[key] = value
    return flat


def _finite(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None
