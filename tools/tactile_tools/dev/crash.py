"""``tactile crash``: kill processes that log, at random moments, and read what they left behind.

``--processes``: kill simulator, tactiled and reachd instead, while they reach (`process_kills`).
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from tactile_core.log.info import LogInfo, info
from tactile_core.log.records import LogError
from tactile_core.log.recovery import recover
from tactile_core.types import NS_PER_S
from tactile_tools.dev.crash_writer import TRUTH

ALLOWED_LOSS_S = 1.0
"""Seconds of log that a kill may cost (faults.md row 29)."""

START_SHARE = 0.2
"""Share of the kills that come anywhere from the start of the process on, also before and while
its first file is opened. The others come after its first message."""

START_S = 1.0
RUN_S = 2.5
"""Seconds after the start, or after the first message, within which the kill comes."""

PATIENCE_S = 30.0
"""Seconds to wait for a writer's first message before giving up on it."""


@dataclass(slots=True)
class Kill:
    """What one killed writer left. ``lost_s``: from the last message read to the last written."""

    written: int = 0
    read: int = 0
    lost_s: float = 0.0
    files: int = 0
    empty: int = 0
    problems: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Result:
    """Sums over all kills; ``problems`` empty and ``lost_s_max`` ≤ 1 when all is well."""

    kills: int = 0
    kills_before_the_first_message: int = 0
    files: int = 0
    files_empty: int = 0
    messages_written: int = 0
    messages_lost: int = 0
    lost_s_p50: float = 0.0
    lost_s_p99: float = 0.0
    lost_s_max: float = 0.0
    seconds: float = 0.0
    writers: int = 0
    seed: int = 0
    cores: int = 0
    load_average: float = 0.0  # of the machine, over the last minutes of the run
    problems: list[str] = field(default_factory=list)


def _run_processes(options: argparse.Namespace) -> int:
    """Kill the three processes. Returns 0 if the arm came to rest each time and every log was
    read."""
    from tactile_tools.dev.process_kills import read_rows, run_kills, summary, write_json

    console = Console(stderr=True)
    said = {"seed": options.seed, "cores": os.cpu_count(), "rigs": options.rigs}
    try:
        done = read_rows(options.out, options.seed, restart=options.force)
        with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
            task = bar.add_task("killing", total=options.kills, completed=len(done))

            def save(rows: list[dict[str, Any]]) -> None:
                bar.update(task, completed=len(rows))
                if options.out is not None:
                    options.out.parent.mkdir(parents=True, exist_ok=True)
                    write_json(options.out, said | {"summary": summary(rows)}, rows)

            rows = run_kills(
                options.kills,
                options.seed,
                done,
                rigs=options.rigs,
                seconds=options.duration,
                save=save,
            )
        save(rows)
    except OSError as error:
        print(f"tactile crash: {error.filename}: {error.strerror}", file=sys.stderr)
        return 3
    found = summary(rows)
    print(json.dumps(said | found, indent=2))
    if len(rows) < options.kills:
        print("the same command goes on where this one ended", file=sys.stderr)
    return 1 if found["problems"] else 0


def run(options: argparse.Namespace) -> int:
    """Kill and check. Returns 0 if every file was read and recovered with at most 1 s lost, else
    1."""
    if options.processes:
        return _run_processes(options)
    started = time.monotonic()
    result = Result(writers=options.writers, seed=options.seed)
    losses: list[float] = []
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("killing", total=options.kills)
        for kill in _kills(options.kills, options.writers, options.seed, options.keep):
            bar.advance(task)
            result.kills += 1
            result.files += kill.files
            result.files_empty += kill.empty
            result.messages_written += kill.written
            result.messages_lost += max(kill.written - kill.read, 0)
            result.problems += kill.problems
            if kill.written:
                losses.append(kill.lost_s)
            else:
                result.kills_before_the_first_message += 1
    if losses:
        p50, p99 = np.percentile(losses, [50, 99]).tolist()
        result.lost_s_p50, result.lost_s_p99 = round(p50, 3), round(p99, 3)
        result.lost_s_max = round(max(losses), 3)
    result.cores, result.load_average = os.cpu_count() or 0, round(os.getloadavg()[1], 1)
    result.seconds = round(time.monotonic() - started, 1)
    text = json.dumps(asdict(result), indent=2)
    if options.out is not None:
        try:
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(text + "\n", encoding="utf-8")
        except OSError as error:
            print(f"tactile crash: cannot write {options.out}: {error.strerror}", file=sys.stderr)
            return 3
    print(text)
    return 1 if result.problems else 0


def _kills(count: int, writers: int, seed: int, keep: Path | None) -> Iterator[Kill]:
    """Kill ``count`` writers, several at a time; what each kill does depends only on ``seed``."""
    seeds = np.random.SeedSequence(seed).spawn(count)
    with ThreadPoolExecutor(writers) as pool:
        running: set[Future[Kill]] = set()
        for child in seeds:
            if len(running) >= writers:
                done, running = wait(running, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
            running.add(pool.submit(kill_one, child, keep))
        yield from (future.result() for future in running)


def kill_one(seed: np.random.SeedSequence, keep: Path | None = None) -> Kill:
    """Start a writer, kill it at a random moment, and judge what it left."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="tactile-crash-") as name:
        place = Path(name)
        truth = place / "truth"
        truth.write_bytes(bytes(TRUTH.size))
        logs = place / "logs"
        command = [sys.executable, "-m", "tactile_tools.dev.crash_writer", str(logs), str(truth)]
        command += ["--seed", str(int(rng.integers(1 << 31)))]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        try:
            if rng.random() < START_SHARE:
                time.sleep(rng.uniform(0, START_S))
            else:
                _await_first(truth, process)
                time.sleep(rng.uniform(0, RUN_S))
        finally:
            process.kill()
            _, errors = process.communicate()
        kill = judge(logs, truth)
        if process.returncode != -signal.SIGKILL:
            kill.problems.append(f"the writer ended by itself: {errors.decode()[-500:]}")
        if kill.problems and keep is not None:
            shutil.copytree(place, keep / place.name)
        return kill


def _await_first(truth: Path, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while TRUTH.unpack(truth.read_bytes())[0] == 0 and process.poll() is None:
        if time.monotonic() > deadline:
            return
        time.sleep(0.01)


def judge(logs: Path, truth: Path) -> Kill:
    """Read and recover every file in ``logs`` and compare with what the writer recorded."""
    kill = Kill()
    kill.written, first_written_ns, last_written_ns = TRUTH.unpack(truth.read_bytes())
    last_read_ns = 0
    seen: dict[str, int] = {}
    for path in sorted(logs.glob("*.mcap")) if logs.exists() else []:
        kill.files += 1
        try:
            found = info(path)
            target = path.with_name(f"recovered_{path.name}")
            recover(path, target)
            again = info(target)
        except LogError as error:
            if path.stat().st_size < 9:  # killed between the creation and the first record
                kill.empty += 1
            else:
                kill.problems.append(f"{path.name}: {error}")
            continue
        kill.problems += _compare(path.name, found, again)
        for channel in again.channels:
            repeated = channel.topic.endswith("/geometry") and channel.topic in seen
            seen[channel.topic] = seen.get(channel.topic, 0) + channel.messages - repeated
        if again.span_ns is not None:
            last_read_ns = max(last_read_ns, again.span_ns[1])
    kill.read = sum(seen.values())
    if kill.written:
        kill.lost_s = (last_written_ns - (last_read_ns or first_written_ns)) / NS_PER_S
    if kill.lost_s > ALLOWED_LOSS_S:
        kill.problems.append(f"{kill.lost_s:.3f} s lost")
    return kill


def _compare(name: str, found: LogInfo, again: LogInfo) -> list[str]:
    problems = []
    if not again.whole:
        problems.append(f"{name}: the recovered file is not whole")
    if again.messages != found.messages:
        problems.append(f"{name}: {found.messages} messages read, {again.messages} recovered")
    for channel in again.channels:
        if channel.missing:
            problems.append(f"{name}: {channel.missing} messages missing amid {channel.topic}")
    if found.damage_count > 1:
        problems.append(f"{name}: {found.damage_count} damaged places")
    return problems
