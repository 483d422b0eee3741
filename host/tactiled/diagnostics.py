"""State of a board and of the daemon as ROS diagnostics and as the status service's reply."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tactile_bus.instant import Instant, seconds_between
from tactile_bus.messages import DROPS_PREFIX, MSG, diagnostic_status, header
from tactile_bus.recorder import Recorder
from tactiled.blocks import TaxelHealth
from tactiled.links.link import BoardLink
from tactiled.port import Port
from tactiled.station import Station

OK, WARNING, ERROR, STALE = range(4)

LEVELS = {
    "streaming": OK,
    "waiting": WARNING,
    "identified": WARNING,
    "silent": STALE,
    "unplugged": STALE,
    "refused": ERROR,
}
"""Severity of a station's state."""


def summary(port: Port, node: int, station: Station, now: Instant) -> dict[str, Any]:
    """Everything worth knowing of one board, for the status service. s, Hz, N, µT."""
    link = port.line.links.get(node)
    values: dict[str, Any] = {
        "state": station.state,
        "port": port.reader.transport.name,
        "bus_state": str(port.reader.transport.state),
        "node": node,
        "rate_hz": round(station.rate, 2),
        "latency_p50_s": _finite(station.latency.p50),
        "latency_p99_s": _finite(station.latency.p99),
        "cycles": station.sent,
        "reopened": port.reader.reopened,
        "calibration": station.calibration_summary(),
        "taring": station.pipeline is not None and station.pipeline.taring,
        "drops": drops(port, node, station),
        "board": dict(station.board_status),
    }
    if station.pipeline is not None:
        doubt = station.pipeline.rest_reason
        state = station.pipeline.rest_state.value
        values["rest"] = {"state": state, "reason": "" if doubt is None else doubt.text}
    if station.clock_problem:
        values["clock_problem"] = station.clock_problem
    identity = station.identity
    if identity is not None:
        values["serial_number"] = identity.serial_number
        values["model"] = identity.model
        values["firmware"] = identity.firmware
    if station.refusal is not None:
        values["refused"] = f"{station.refusal.problem}; {station.refusal.remedy}"
    if isinstance(link, BoardLink) and link.clock is not None:
        values["clock_synchronised"] = link.clock.synchronised
        values["clock_rate_error"] = _finite(link.clock.rate_error)
        values["clock_polls"] = dict(link.clock.counters)
        values["clock_trouble"] = link.clock_trouble
    cycle = station.last
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
    if station.chips is not None and station.chips.masked:
        values["masked_chips"] = {
            f"{one.array}:{one.chip}": str(one) for one in station.chips.masked
        }
    return values


def health(flags: np.ndarray[Any, np.dtype[np.uint8]]) -> dict[str, int]:
    """Taxels that are not to be trusted, by reason."""
    reasons = {flag.name or "": int(np.count_nonzero(flags & flag)) for flag in TaxelHealth}
    return {name.lower(): n for name, n in reasons.items() if n}


def drops(port: Port, node: int, station: Station) -> dict[str, int]:
    """Everything lost on the way from the wire to the features of one board, by reason."""
    counts = port.drops() | {k: n for k, n in station.drops().items() if n}
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
    """``DiagnosticArray`` with the board and, where there is one, the log."""
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
