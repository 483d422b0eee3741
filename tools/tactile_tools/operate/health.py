"""``tactile health``: whether a rig is well, in one line and an exit status, for monitoring."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from tactile_core.options import BusTable, bus_config

if TYPE_CHECKING:
    import zenoh

HEALTHY, DEGRADED, USAGE, NO_ANSWER, FAILED = range(5)
"""Exit statuses: all well; needs attention; bad argument; no answer; something has failed."""

WORDS = {HEALTHY: "OK", DEGRADED: "WARNING", FAILED: "CRITICAL", NO_ANSWER: "NOBODY"}

LATE_S = 0.010
"""Lateness of the control loop (99.9 %) that is too much, s: a whole cycle."""

KINDS = ("tactile", "reach", "arm")
LABELS = {"tactile": "board", "reach": "reach", "arm": "arm"}


@dataclass
class Part:
    """One board, reach or arm: ``level`` is an exit status, ``problems`` say why."""

    kind: str
    name: str
    level: int = HEALTHY
    state: str = ""
    problems: list[str] = field(default_factory=list)

    def add(self, level: int, problem: str) -> None:
        """Note a problem and raise the level."""
        self.level = max(self.level, level)
        self.problems.append(problem)


def run(options: argparse.Namespace) -> int:
    """Ask, print and return the exit status."""
    from tactile_core.bus.session import BusError, close_session, open_session

    try:
        session = open_session(bus_config(options, BusTable(), "tool"))
    except BusError as error:
        print(f"tactile health: {error}", file=sys.stderr)
        return NO_ANSWER
    try:
        wanted = {kind: list(getattr(options, LABELS[kind])) for kind in KINDS}
        parts = check(session, wanted, options.wait)
    finally:
        close_session(session)
    level = max((part.level for part in parts), default=NO_ANSWER)
    if options.json:
        print(json.dumps({"level": WORDS[level], "parts": [_shown(p) for p in parts]}))
    else:
        print(line(level, parts))
    return level


def line(level: int, parts: list[Part]) -> str:
    """Result in one line, problems first."""
    if not parts:
        return f"{WORDS[level]}: no board, reach or arm answers on this bus"
    wrong = [f"{p.kind} {p.name}: {'; '.join(p.problems)}" for p in parts if p.problems]
    well = [f"{p.kind} {p.name} {p.state}".strip() for p in parts if not p.problems]
    return f"{WORDS[level]}: " + " | ".join([*wrong, *well])


def check(session: zenoh.Session, wanted: dict[str, list[str]], timeout: float) -> list[Part]:
    """Ask those that are there, or those ``wanted``; in a fixed order. ``timeout``: s."""
    from tactile_core.bus.services import ServiceError, call
    from tactile_core.bus.topics import service_key

    parts = []
    for kind in KINDS:
        names = dict.fromkeys(wanted[kind])
        if not any(wanted.values()):
            names = dict.fromkeys(_alive(session, kind, timeout))
        for name in names:
            part = Part(LABELS[kind], name)
            parts.append(part)
            try:
                status = call(session, service_key(name, "status", kind), timeout=timeout)
            except (ServiceError, ValueError) as error:
                part.add(FAILED, str(error))
                continue
            JUDGES[kind](part, status if isinstance(status, dict) else {})
    return parts


def _alive(session: zenoh.Session, kind: str, timeout: float) -> list[str]:
    """Names that have a token; links take a moment to form, so it asks repeatedly."""
    import time

    key, found = f"{kind}/*/alive", set()
    deadline = time.monotonic() + min(timeout, 1.0)
    while (left := deadline - time.monotonic()) > 0:
        for reply in session.liveliness().get(key, timeout=left):
            if reply.ok is not None:
                found.add(str(reply.ok.key_expr).split("/")[1])
        if found:
            break
        time.sleep(0.05)
    return sorted(found)


def _judge_board(part: Part, status: dict[str, Any]) -> None:
    state = str(status.get("state", "unknown"))
    part.state = f"{state} {status.get('rate_hz', 0):g} Hz"
    if state in ("silent", "unplugged", "refused"):
        part.add(FAILED, str(status.get("refused") or state))
    elif state != "streaming":
        part.add(DEGRADED, state)
    elif not status.get("features_valid", False):
        reasons = ", ".join(map(str, status.get("reasons", ()))) or "no reason given"
        part.add(DEGRADED, f"features not valid ({reasons})")
    for reason, count in (status.get("unhealthy_taxels") or {}).items():
        part.add(DEGRADED, f"{count} taxels {reason}")
    _judge_common(part, status)


def _judge_reach(part: Part, status: dict[str, Any]) -> None:
    part.state = str(status.get("state", "unknown"))
    if status.get("armed") is False:
        part.state += " disarmed"
    late = (status.get("lateness_s") or {}).get("p99.9", 0.0)
    if late > LATE_S:
        part.add(DEGRADED, f"control loop {late * 1e3:.0f} ms late (99.9 %)")
    _judge_common(part, status)


def _judge_arm(part: Part, status: dict[str, Any]) -> None:
    part.state = str(status.get("mode", "unknown"))
    if part.state == "fault":
        part.add(FAILED, "fault")
    elif part.state == "estop":
        part.add(DEGRADED, "emergency stop")


def _judge_common(part: Part, status: dict[str, Any]) -> None:
    for alarm in status.get("alarms") or ():
        part.add(DEGRADED, str(alarm))
    log = status.get("log")
    if isinstance(log, dict) and log.get("state") not in ("recording", None):
        part.add(FAILED, f"log {log['state']} {log.get('last_error', '')}".strip())


JUDGES = {"tactile": _judge_board, "reach": _judge_reach, "arm": _judge_arm}


def _shown(part: Part) -> dict[str, Any]:
    return asdict(part) | {"level": WORDS[part.level]}
