"""``tactile crash --processes``: kill simulator, tactiled and reachd at random while they reach.

After each kill the arm must come to rest, must stay at rest while the killed process comes back,
and must move again only when an operator arms it. The log that was cut off must read and recover.
"""

from __future__ import annotations

import json
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tactile_core.bus.topics import ARM_STATE
from tactile_core.log.info import info
from tactile_core.log.records import LogError
from tactile_core.log.recovery import recover
from tactile_tools.reach.process_rig import LiveReach, WatchError, is_moving

PROCESSES = ("tactiled", "reachd", "cupboard")

MOVING_FOR_S = 4.0
"""Seconds of motion within which the kill comes."""

REST_S = 0.5
"""Seconds after the kill within which the arm must rest: 200 ms to the zero twist, 100 for the
arm's own expiry and braking (rows 13 and 15 of the fault table), and delays of an observer on a
busy machine."""

WATCH_S = 0.5
"""Seconds after the killed process is back in which nothing may move."""

TRIES = 3
"""Reaches that may end before the kill comes."""

AT_REST = 1e-3
"""Speed below which the arm is at rest, m/s and rad/s."""

SCENE = ("--scene", "authors_sim")


@dataclass(slots=True)
class OneKill:
    """``rest_s``: from the kill to rest; None if it did not move or the arm itself was killed."""

    number: int
    process: str
    rest_s: float | None = None
    back_s: float = 0.0
    problems: list[str] = field(default_factory=list)


@dataclass(slots=True)
class KillTotals:
    """Sums over all kills; ``problems`` is empty when all is well."""

    seed: int
    first: int
    asked: int
    kills: int = 0
    by_process: dict[str, int] = field(default_factory=dict)
    moving_when_killed: int = 0
    rest_s_p50: float = 0.0
    rest_s_max: float = 0.0
    back_s_p50: float = 0.0
    back_s_max: float = 0.0
    logs_read: int = 0
    rigs_started: int = 0
    seconds: float = 0.0
    load_average: float = 0.0
    next: int = 0
    problems: list[str] = field(default_factory=list)


def run_kills(
    count: int,
    seed: int,
    *,
    first: int = 0,
    seconds: float = float("inf"),
    progress: Callable[[int], None] = lambda _: None,
    save: Callable[[dict[str, Any]], None] = lambda _: None,
) -> KillTotals:
    """Kill ``count`` times, from number ``first`` on; begin none after ``seconds``.

    What kill n does is drawn from ``seed`` and n alone, so that a run can be continued. ``save``
    gets the totals so far after each kill.
    """
    started = time.monotonic()
    totals = KillTotals(seed, first, count, next=first)
    rests: list[float] = []
    backs: list[float] = []
    numbers = iter(range(first, first + count))
    while totals.next < first + count and time.monotonic() - started < seconds:
        totals.rigs_started += 1
        try:
            with tempfile.TemporaryDirectory(prefix="tactile-kills-") as name:
                for kill in _one_rig(Path(name), seed, numbers, started + seconds, totals):
                    totals.kills += 1
                    totals.next = kill.number + 1
                    totals.by_process[kill.process] = totals.by_process.get(kill.process, 0) + 1
                    totals.problems += [f"kill {kill.number}: {p}" for p in kill.problems]
                    if kill.rest_s is not None:
                        rests.append(kill.rest_s)
                    backs.append(kill.back_s)
                    _sum_up(totals, rests, backs, started)
                    save(asdict(totals))
                    progress(1)
        except WatchError as error:
            # The rig cannot go on: count and report it, and make another for the next number.
            totals.problems.append(f"kill {totals.next}: {error}")
            totals.next += 1
            totals.kills += 1
            numbers = iter(range(totals.next, first + count))
            progress(1)
    _sum_up(totals, rests, backs, started)
    return totals


def _sum_up(totals: KillTotals, rests: list[float], backs: list[float], started: float) -> None:
    if rests:
        totals.rest_s_p50 = round(float(np.median(rests)), 3)
        totals.rest_s_max = round(max(rests), 3)
    if backs:
        totals.back_s_p50 = round(float(np.median(backs)), 2)
        totals.back_s_max = round(max(backs), 2)
    totals.moving_when_killed = len(rests)
    totals.seconds = round(time.monotonic() - started, 1)
    totals.load_average = round(os.getloadavg()[1], 1)


def _one_rig(
    folder: Path, seed: int, numbers: Iterator[int], end: float, totals: KillTotals
) -> Iterator[OneKill]:
    """Kills on one rig, until ``end`` or all are done; its folder is emptied as it goes."""
    with LiveReach(folder, (*SCENE, "--seed", "0"), strategy="hybrid_event") as live:
        for number in numbers:
            yield _kill(live, folder, number, seed, totals)
            if time.monotonic() >= end:
                return


def _kill(live: LiveReach, folder: Path, number: int, seed: int, totals: KillTotals) -> OneKill:
    rng = np.random.default_rng([seed, number])
    kill = OneKill(number, str(rng.choice(PROCESSES)))
    wait = float(rng.uniform(0.0, MOVING_FOR_S))
    for attempt in range(TRIES):
        live.clear()
        live.begin(int(rng.integers(1000)))
        with suppress(WatchError):
            live.until(live.moving, "motion", 10.0)
        moved_until = time.monotonic() + wait
        while time.monotonic() < moved_until and not live.ended():
            time.sleep(0.002)
        if not live.ended() or attempt == TRIES - 1:
            break
    moving = live.moving()
    live.clear()
    at = live.signal(kill.process, signal.SIGKILL)
    if kill.process != "cupboard":
        time.sleep(REST_S + 0.15)
        kill.rest_s = _rest(live, at, kill) if moving else None
    _read_log(folder, kill, totals)
    before = time.monotonic()
    live.start(kill.process)
    live.clear()
    live.until(lambda: _is_sending(live, kill.process), f"{kill.process} again")
    kill.back_s = time.monotonic() - before
    live.clear()
    time.sleep(WATCH_S)
    speeds = [m for _, m in live.decoded(ARM_STATE) if is_moving(m.twist, AT_REST)]
    if speeds:
        kill.problems.append(f"{len(speeds)} states in motion after {kill.process} came back")
    if live.ask("status")["armed"] and kill.process == "reachd":
        kill.problems.append("reachd came back armed")
    return kill


def _rest(live: LiveReach, killed_ns: int, kill: OneKill) -> float:
    """Seconds from the kill to the first state at rest after the last in motion."""
    states = live.decoded(ARM_STATE)
    moving = [at for at, m in states if is_moving(m.twist, AT_REST)]
    rest = max(0.0, (max(moving, default=killed_ns) - killed_ns) / 1e9)
    if not states:
        kill.problems.append("no state of the arm was heard")
    elif rest > REST_S:
        kill.problems.append(f"the arm moved for {rest:.3f} s after {kill.process} was killed")
    return rest


def _is_sending(live: LiveReach, process: str) -> bool:
    from tactile_core.bus.topics import FEATURES, REACH_STATE

    topic = {"tactiled": FEATURES, "reachd": REACH_STATE, "cupboard": ARM_STATE}[process]
    return bool(live.heard[topic])


def _read_log(folder: Path, kill: OneKill, totals: KillTotals) -> None:
    """Read and recover what the killed process wrote; delete it if that went well."""
    if kill.process == "cupboard":
        return
    written = sorted(folder.glob(f"{kill.process}-*.mcap"), key=lambda p: p.stat().st_mtime)
    for path in written[-1:]:
        target = path.with_name(f"recovered-{path.name}")
        try:
            found = info(path)
            recover(path, target)
            again = info(target)
        except LogError as error:
            kill.problems.append(f"{path.name}: {error}")
            continue
        if not again.whole or again.messages != found.messages:
            kill.problems.append(f"{path.name}: {found.messages} read, {again.messages} recovered")
        totals.logs_read += 1
        path.unlink()
        target.unlink()


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write in one step, so that an interrupted run leaves what it has."""
    new = path.with_name(f".{path.name}.new")
    new.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    new.replace(path)
