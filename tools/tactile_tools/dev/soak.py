"""``tactile soak``: unplug and replug boards for an hour; nothing may grow."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil
from rich.console import Console
from rich.progress import Progress

from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.topics import service_key
from tactile_tools.processes import command, running, socket_at, wait_for

if TYPE_CHECKING:
    import subprocess

    import zenoh

BOARDS = 4
REPLUG_PERIOD_S = 1.0
AWAY_S = 0.4
WARM_UP_S = 30.0
"""Seconds for imports, the first log chunks, and the bounded windows of clock and tare to fill."""

SAMPLE_S = 1.0
KINDS = ("finger", "anyskin")
"""Boards that identify themselves, and boards that only stream."""

LOG_BYTES = 256 << 20
"""Bytes of logs kept, so that retention works for an hour as well."""

GROWTH_MB = 20.0
"""Resident memory gained from the first to the last twentieth, MB, that counts as growth: the
allocator itself moves it by a few MB."""

GROWTH_DESCRIPTORS = 4.0
QUIET_S = 10.0
"""Seconds at the end without a replug and without a reading, for every board to come back in."""

LATE_S = 30.0
"""Extra seconds that a board may take to be back at the end, on a busy machine."""


@dataclass(slots=True)
class Soak:
    """``growth``: median of the last twentieth of the readings less that of the first."""

    minutes: float
    boards: int
    replug_period_s: float
    rate_hz: float
    readings: int = 0
    rss_mb_first: float = 0.0
    rss_mb_last: float = 0.0
    rss_mb_max: float = 0.0
    rss_growth_mb: float = 0.0
    descriptors_first: float = 0.0
    descriptors_last: float = 0.0
    descriptors_growth: float = 0.0
    threads_max: int = 0
    cpu_pct: float = 0.0
    replugs: int = 0
    cycles: int = 0
    log_files_kept: int = 0
    log_mb_kept: float = 0.0
    log_drops: dict[str, int] = field(default_factory=dict)
    load_average: float = 0.0
    seconds: float = 0.0
    problems: list[str] = field(default_factory=list)


def run(options: argparse.Namespace) -> int:
    """Run the soak. Returns 0 if nothing grew and every board came back."""
    if options.out is not None and not options.out.parent.is_dir():
        print(f"tactile soak: --out {options.out}: there is no folder for it", file=sys.stderr)
        return 2
    if options.replug * options.boards <= 2 * AWAY_S:
        print(
            f"tactile soak: --replug {options.replug:g}: each of {options.boards} boards would be "
            f"away more often than not; allowed: above {2 * AWAY_S / options.boards:g} s",
            file=sys.stderr,
        )
        return 2
    soak = Soak(options.minutes, options.boards, options.replug, options.rate)
    try:
        _soak(soak)
    except (RuntimeError, OSError) as error:
        print(f"tactile soak: {error}", file=sys.stderr)
        return 3
    text = json.dumps(asdict(soak), indent=2)
    if options.out is not None:
        options.out.write_text(text + "\n", encoding="utf-8")
    print(text)
    return 1 if soak.problems else 0


def _soak(soak: Soak) -> None:
    from tactile_core.bus.session import BusConfig, close_session, open_session

    started = time.monotonic()
    seconds = soak.minutes * 60 + WARM_UP_S
    with (
        tempfile.TemporaryDirectory(prefix="tactile-soak-") as name,
        contextlib.ExitStack() as stack,
    ):
        folder = Path(name)
        names = [f"b{index}" for index in range(soak.boards)]
        for index, board in enumerate(names):
            simulator = _simulator(soak, folder / board, index, seconds)
            output = folder / f"{board}.txt"
            wait_for(folder / board, stack.enter_context(running(simulator, output)), output)
        (folder / "soak.toml").write_text(
            f'[log]\ndestination = "{folder / "logs"}"\n[log.recorder]\nmax_bytes = {LOG_BYTES}\n',
            encoding="utf-8",
        )
        endpoint = socket_at(folder, "tactiled")
        daemon = [command("tactiled"), "--config", str(folder / "soak.toml"), "--wait"]
        daemon += ["--listen", endpoint]
        for index, board in enumerate(names):
            daemon += ["--port", str(folder / board), "--name", board]
            daemon += ["--kind", "anyskin" if KINDS[index % 2] == "anyskin" else "auto"]
        process = stack.enter_context(running(daemon, folder / "tactiled.txt"))
        session = open_session(BusConfig(listen=(), connect=(endpoint,)))
        stack.callback(close_session, session)
        time.sleep(WARM_UP_S)
        _watch(soak, process, started + seconds - QUIET_S)
        time.sleep(QUIET_S)
        if process.poll() is not None:
            last = (folder / "tactiled.txt").read_text(errors="replace")[-2000:]
            soak.problems.append(f"tactiled ended with {process.returncode}: {last}")
            return
        _ask(soak, session, names)
        logs = list((folder / "logs").glob("*.mcap"))
        soak.log_files_kept = len(logs)
        soak.log_mb_kept = round(sum(p.stat().st_size for p in logs) / 1e6, 1)
    soak.seconds = round(time.monotonic() - started, 1)
    soak.load_average = round(os.getloadavg()[2], 1)


def _simulator(soak: Soak, pty: Path, index: int, seconds: float) -> list[str]:
    """Command line of a board that is away for `AWAY_S` in its turn, until `QUIET_S` before the
    end."""
    kind = KINDS[index % 2]
    words = [command("simdevice"), "boards", "--pty", str(pty), "--seed", str(index + 1)]
    words += ["--kind", kind]
    if kind != "anyskin":
        words += ["--rate", f"{soak.rate_hz:g}"]
    period = soak.replug_period_s * soak.boards
    at = WARM_UP_S / 2 + index * soak.replug_period_s
    while at < seconds - QUIET_S:
        words += ["--unplug", f"{at:g}s+{AWAY_S:g}s"]
        at += period
    return words


def _watch(soak: Soak, process: subprocess.Popen[bytes], end: float) -> None:
    """Read memory, descriptors and threads once a second until ``end``."""
    watched = psutil.Process(process.pid)
    memory: list[float] = []
    descriptors: list[float] = []
    cpu, began = watched.cpu_times(), time.monotonic()
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("soaking", total=end - began)
        while time.monotonic() < end and process.poll() is None:
            with contextlib.suppress(psutil.Error):
                memory.append(watched.memory_info().rss / 1e6)
                descriptors.append(watched.num_fds())
                soak.threads_max = max(soak.threads_max, watched.num_threads())
                later = watched.cpu_times()
            bar.update(task, completed=time.monotonic() - began)
            time.sleep(SAMPLE_S)
    if not memory:
        soak.problems.append("no reading was taken")
        return
    part = max(1, len(memory) // 20)
    soak.readings = len(memory)
    spent = later.user + later.system - cpu.user - cpu.system
    soak.cpu_pct = round(100 * spent / (time.monotonic() - began), 1)
    soak.rss_mb_max = round(max(memory), 1)
    soak.rss_mb_first, soak.rss_mb_last = _ends(memory, part)
    soak.descriptors_first, soak.descriptors_last = _ends(descriptors, part)
    soak.rss_growth_mb = round(soak.rss_mb_last - soak.rss_mb_first, 2)
    soak.descriptors_growth = soak.descriptors_last - soak.descriptors_first
    if soak.rss_growth_mb > GROWTH_MB:
        soak.problems.append(f"memory grew by {soak.rss_growth_mb:.1f} MB")
    if soak.descriptors_growth > GROWTH_DESCRIPTORS:
        soak.problems.append(f"descriptors grew by {soak.descriptors_growth:g}")


def _ends(values: list[float], part: int) -> tuple[float, float]:
    return round(float(np.median(values[:part])), 2), round(float(np.median(values[-part:])), 2)


def _ask(soak: Soak, session: zenoh.Session, names: list[str]) -> None:
    """Check what tactiled reports of its boards: all must be streaming and have been replugged."""
    for name, status in _statuses(session, names):
        if status is None or status.get("state") != "streaming":
            state = "no answer" if status is None else status.get("state")
            soak.problems.append(f"{name} was not back at the end: {state}")
            continue
        soak.replugs += int(status["reopened"])
        soak.cycles += int(status["cycles"])
        if not status["reopened"]:
            soak.problems.append(f"{name} was never replugged")
        log = status.get("log") or {}
        soak.log_drops = dict(log.get("drops", {}))
        if log.get("state") != "recording":
            soak.problems.append(f"the log is {log.get('state')}: {log.get('last_error')}")


def _statuses(
    session: zenoh.Session, names: list[str]
) -> Iterator[tuple[str, dict[str, Any] | None]]:
    for name in names:
        end = time.monotonic() + LATE_S
        status: dict[str, Any] | None = None
        while time.monotonic() < end:
            with contextlib.suppress(ServiceError):
                status = call(session, service_key(name, "status"), timeout=5.0)
            if status is not None and status.get("state") == "streaming":
                break
            time.sleep(0.2)
        yield name, status
