"""``tactile status``: state of the boards of a running tactiled."""

from __future__ import annotations

import argparse
import json
import shutil
import textwrap
from collections.abc import Mapping
from typing import Any

from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.topics import service_key
from tactile_tools.operate import boards

INDENT = 13
"""Width of the labels' column."""


def status(options: argparse.Namespace) -> None:
    """Print what tactiled reports of one board, or of all."""
    with boards.bus(options) as session:
        names = boards.find(session, options)
        if options.board is not None:
            names = [boards.choose(options.board, names)]
        statuses: dict[str, Any] = {}
        for name in names:
            try:
                statuses[name] = call(session, service_key(name, "status"), timeout=boards.STATUS_S)
            except ServiceError as error:
                statuses[name] = {"state": "unknown", "reasons": [str(error)]}
    if options.json:
        print(json.dumps(statuses, indent=2, ensure_ascii=False))
        return
    width = shutil.get_terminal_size().columns
    for name, values in statuses.items():
        print("\n".join(describe(name, values, width)))


run = boards.as_command(status)


def describe(name: str, values: Mapping[str, Any], width: int) -> list[str]:
    """Status of one board, in lines of at most ``width`` columns."""
    board = " ".join(str(values[k]) for k in ("model", "serial_number") if values.get(k))
    port = f" on {values['port']}" if values.get("port") else ""
    out = _wrap(f"{name}: {values.get('state', 'unknown')}", f"{board}{port}".strip(), width)
    for label, text in matters(values):
        if text:
            out += _wrap(f"  {label}", text, width)
    return out


def matters(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Label and text of each line; the text is empty if there is nothing to say."""
    reasons = "; ".join(str(reason) for reason in values.get("reasons", ()))
    felt = _force(values)
    valid = values.get("features_valid")
    drops: Mapping[str, int] = values.get("drops", {})
    listed = ", ".join(f"{n} {reason}" for reason, n in sorted(drops.items(), key=lambda i: -i[1]))
    sick: Mapping[str, int] = values.get("unhealthy_taxels", {})
    taxels = ", ".join(f"{n} {reason.replace('_', ' ')}" for reason, n in sick.items())
    return [
        ("refused", str(values.get("refused", ""))),
        ("force", felt if valid else ""),
        ("not valid" if valid is False or valid is None else "but", reasons),
        ("rest", _rest(values)),
        ("rate", _rate(values)),
        ("clock", _clock(values)),
        ("dropped", f"{sum(drops.values())}: {listed}" if drops else "0"),
        ("taxels", f"masked: {taxels}" if taxels else ""),
        ("calibration", _calibration(values.get("calibration") or {})),
        ("log", _log(values.get("log"))),
    ]


def _force(values: Mapping[str, Any]) -> str:
    whole, peak = values.get("normal_force_n"), values.get("peak_force_n")
    if whole is None or peak is None:
        return ""
    bound = values.get("normal_force_bound_n")
    within = "" if bound is None else f" ± {bound:.2f}"
    return f"{whole:.2f}{within} N, of it {peak:.2f} N on the taxel pressed most"


def _rest(values: Mapping[str, Any]) -> str:
    rest = values.get("rest")
    if isinstance(rest, Mapping):
        rest = "; ".join(str(v) for v in rest.values() if v not in (None, ""))
    if rest:
        return str(rest)
    return "taring" if values.get("taring") else ""


def _rate(values: Mapping[str, Any]) -> str:
    if not values.get("rate_hz"):
        return ""
    text = f"{values['rate_hz']:.3g} Hz"
    half, most = values.get("latency_p50_s"), values.get("latency_p99_s")
    if half is not None and most is not None:
        text += f", features {half * 1e3:.1f} ms after the last byte (99 %: {most * 1e3:.1f} ms)"
    return text


def _clock(values: Mapping[str, Any]) -> str:
    if values.get("clock_trouble"):
        return f"cannot be used: {values['clock_trouble']}"
    error = values.get("clock_uncertainty_s")
    if error is None:
        return ""
    text = f"instants known to ± {error * 1e3:.2g} ms"
    off = values.get("clock_rate_error")
    if off is not None:
        text += f", the board's own {abs(off):.2%} {'fast' if off > 0 else 'slow'}"
    return text


def _calibration(used: Mapping[str, Any]) -> str:
    if not used:
        return ""
    if used.get("nominal"):
        return "none: forces are nominal, accurate to about a factor of two"
    return str(used.get("file") or used.get("hash", ""))


def _log(log: Mapping[str, Any] | None) -> str:
    if log is None:
        return ""
    text = f"{log['path']}, {log['bytes'] / 1e6:.1f} MB"
    if log["state"] != "recording":
        text += f", {log['state']} {log['last_error']}".rstrip()
    dropped = sum(log["drops"].values())
    return text + (f", {dropped} messages dropped" if dropped else "")


def _wrap(label: str, text: str, width: int) -> list[str]:
    """``text`` beside its label, broken only between words."""
    head = f"{label:{INDENT}} "
    if len(label) > INDENT:
        head = f"{label}  "
    return textwrap.wrap(
        text,
        max(width, 2 * INDENT),
        initial_indent=head,
        subsequent_indent=" " * (INDENT + 1),
        break_long_words=False,
        break_on_hyphens=False,
    ) or [label]
