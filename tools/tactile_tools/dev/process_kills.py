"""``tactile crash --processes``: kill simulator, tactiled and reachd at random while they reach.

After each kill the arm must come to rest, must stay at rest while the killed process comes back,
and must move again only when an operator arms it. The log that was cut off must read and recover.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from queue import Empty
from typing import Any

import numpy as np

from tactile_core.bus.topics import ARM_STATE
from tactile_core.cli import CommandError
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
    """``rest_s``: from the kill to rest; None if it did not move or the arm itself was killed.

    ``back_s``: until the killed process sent again. ``log_read``: whether there was a log, and it
    was read and recovered. ``load``: average of the machine in the last minute.
    """

    number: int
    process: str
    rest_s: float | None = None
    back_s: float = 0.0
    log_read: bool = False
    load: float = 0.0
    problems: list[str] = field(default_factory=list)


Row = dict[str, Any]


def run_kills(
    count: int,
    seed: int,
    done: Sequence[Row],
    *,
    rigs: int = 1,
    seconds: float = float("inf"),
    save: Callable[[list[Row]], None] = lambda _: None,
) -> list[Row]:
    """Kills 0 to ``count`` - 1 but those ``done``, on ``rigs`` at a time; all rows, in order.

    None begins after ``seconds``. What kill n does is drawn from ``seed`` and n alone. ``save``
    gets all rows so far after each kill. KeyboardInterrupt ends the rigs, too.
    """
    rows = {row["number"]: row for row in done if row["number"] < count}
    left = [number for number in range(count) if number not in rows]
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    end = time.monotonic() + seconds
    workers = [
        context.Process(target=_work, args=(left[k::rigs], seed, seconds, queue))
        for k in range(min(rigs, len(left)))
    ]
    for worker in workers:
        worker.start()
    try:
        while any(worker.is_alive() for worker in workers) or not queue.empty():
            try:
                row = queue.get(timeout=0.5)
            except Empty:
                continue
            rows[row["number"]] = row
            save([rows[number] for number in sorted(rows)])
    finally:
        for worker in workers:
            # Its rig ends in order on the signal of Ctrl-C.
            if worker.pid is not None and worker.is_alive() and time.monotonic() < end:
                os.kill(worker.pid, signal.SIGINT)
            worker.join()
    failed = [worker.exitcode for worker in workers if worker.exitcode]
    if failed:
        raise RuntimeError(f"a rig ended with {failed[0]}; what it did is kept")
    return [rows[number] for number in sorted(rows)]


def _work(numbers: Sequence[int], seed: int, seconds: float, queue: Any) -> None:
    """Kill ``numbers`` on one rig after another; a row of each into ``queue``."""
    with suppress(KeyboardInterrupt):
        end = time.monotonic() + seconds
        left = deque(numbers)
        parent = os.getppid()
        while left and time.monotonic() < end and os.getppid() == parent:
            try:
                with tempfile.TemporaryDirectory(prefix="tactile-kills-") as name:
                    _one_rig(Path(name), seed, left, end, queue)
            except WatchError as error:
                # The rig cannot go on: report it, and make another for the next number.
                number = left.popleft()
                queue.put(asdict(OneKill(number, "", problems=[str(error)])))


def _one_rig(folder: Path, seed: int, left: deque[int], end: float, queue: Any) -> None:
    """Kills on one rig, until ``end`` or all are done; its folder is emptied as it goes."""
    parent = os.getppid()
    with LiveReach(folder, (*SCENE, "--seed", "0"), strategy="hybrid_event") as live:
        # A parent that was killed itself leaves no rig behind.
        while left and time.monotonic() < end and os.getppid() == parent:
            kill = _kill(live, folder, left[0], seed)
            kill.load = round(os.getloadavg()[0], 1)
            left.popleft()
            queue.put(asdict(kill))


def summary(rows: Sequence[Row]) -> Row:
    """Sums over ``rows``; ``problems`` is empty when all is well."""
    rests = [row["rest_s"] for row in rows if row["rest_s"] is not None]
    backs = [row["back_s"] for row in rows if row["back_s"]]
    return {
        "kills": len(rows),
        "by_process": dict(sorted(Counter(row["process"] for row in rows).items())),
        "moving_when_killed": len(rests),
        "rest_s_p50": round(float(np.median(rests)), 3) if rests else None,
        "rest_s_max": round(max(rests), 3) if rests else None,
        "back_s_p50": round(float(np.median(backs)), 2) if backs else None,
        "back_s_max": round(max(backs), 2) if backs else None,
        "logs_read": sum(row["log_read"] for row in rows),
        "load_p50": round(float(np.median([row["load"] for row in rows])), 1) if rows else None,
        "problems": [f"kill {row['number']}: {p}" for row in rows for p in row["problems"]],
    }


def _kill(live: LiveReach, folder: Path, number: int, seed: int) -> OneKill:
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
        kill.rest_s = round(_rest(live, at, kill), 4) if moving else None
    _read_log(folder, kill)
    before = time.monotonic()
    live.start(kill.process)
    live.clear()
    live.until(lambda: _is_sending(live, kill.process), f"{kill.process} again")
    kill.back_s = round(time.monotonic() - before, 3)
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


def _read_log(folder: Path, kill: OneKill) -> None:
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
        kill.log_read = True
        path.unlink()
        target.unlink()


def read_rows(path: Path | None, seed: int, *, restart: bool) -> list[Row]:
    """Rows of an earlier run into ``path`` with the same ``seed``; `CommandError` for others."""
    if path is None or restart or not path.exists():
        return []
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        rows: list[Row] = found["rows"]
        theirs = found["seed"]
    except (ValueError, KeyError, TypeError) as error:
        raise CommandError(
            f"--out {path} is not a result of this command: name another, or overwrite it with "
            "--force"
        ) from error
    if theirs != seed:
        raise CommandError(
            f"--out {path} was made with --seed {theirs}: name another, or overwrite it with "
            "--force"
        )
    return rows


def write_json(path: Path, values: Row, rows: Sequence[Row]) -> None:
    """Write in one step, so that an interrupted run leaves what it has; a line for each row."""
    new = path.with_name(f".{path.name}.new")
    head = json.dumps(values, indent=1)[:-2]
    lines = ",\n  ".join(json.dumps(row) for row in rows)
    new.write_text(f'{head},\n "rows": [\n  {lines}\n ]\n}}\n', encoding="utf-8")
    new.replace(path)
