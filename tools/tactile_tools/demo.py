"""``tactile demo``: a reach in real time with simulator, tactiled and reachd as three processes."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tactile_core.cli import FAILED, REFUSED, CommandError, require, seeds_of, working
from tactile_tools.plot.series import LogUnreadableError
from tactile_tools.processes import busy_text, command, free_port, running
from tactile_tools.reach.one_reach import EMULATED, ReachRig, ReachScene, parameter_set_of

MAGIC = b"\x89MCAP"
ORDERLY_S = 5.0  # s, for the zero twist and the end of the log; both take a second at most

SEED = 35
"""A scene that shows everything hybrid_event can do: it goes straight, burrows past objects at the
front, stalls at a heavy disc before the target and excavates. It has arrived in every run so far,
in lockstep and in real time, also on a machine with four times the work it can do."""

VIEW_PORT = 8420

PAGE_S = 20.0
"""Time for the live page to answer on a busy machine, s."""

PROCESSES = {False: "three processes", True: "four processes and a robot's own client"}

TRIES = 3
"""Starts of reachd, which refuses to move anything while a busy machine brings its inputs late."""

INPUTS_S = 60.0
"""Time for features and the arm's state to come: a busy machine starts programs slowly."""

TIME_LIMIT_S = 30.0
"""The authors' 20 s, and reserve for a busy machine: stale inputs hold the arm there."""


def run(options: argparse.Namespace) -> int:
    """Run the demo. Exit status 0: the target was reached; 1: it was not."""
    require("mujoco", extra="sim")
    require("matplotlib", "scipy", extra="plot")
    options.log, options.png = demo_files("demo", options)
    options.scene_seed, options.seed = seeds_of(options, SEED)
    if busy := busy_text():
        print(f"note: {busy}; the reach may be held now and then, and fail", file=sys.stderr)
    from reachd.strategies import StrategyError, load_strategy
    from reachd.strategies.parameters import parameters
    from tactile_tools.plot.reach import draw_reach

    try:
        # Before three processes are started in vain.
        own = parameters(parameter_set_of(options.scene))
        load_strategy(options.strategy, own, np.random.default_rng(0))
        with tempfile.TemporaryDirectory(prefix="tactile-demo-") as name:
            code = _run(options, Path(name))
        if code not in (0, 1):
            return code
        with working("drawing"):
            draw_reach(options.log, options.png)
    except StrategyError as error:
        raise CommandError(str(error)) from error
    except BrokenPipeError:
        raise  # the reader of our output has gone; `run_command` deals with it
    except (RuntimeError, OSError, LogUnreadableError) as error:
        busy = busy_text()
        raise CommandError(f"{error}{'; ' if busy else ''}{busy}", REFUSED) from error
    print(what_next(options.log, options.png))
    if code == FAILED:
        why = busy_text() or "the machine was not busy: the picture and the log say what held it"
        print(f"tactile demo: the target was not reached; {why}", file=sys.stderr)
    return code


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(len(MAGIC))


def demo_files(stem: str, options: argparse.Namespace) -> tuple[Path, Path]:
    """Choose the log and picture to write: the named ones, or the first free numbers.

    `CommandError` for a file that exists, unless --force is given, and even then unless it is a
    log.
    """
    log, png = options.log, options.png
    if log is None:
        numbers = itertools.count(2)
        log = Path(f"{stem}.mcap")
        while not options.force and (
            log.exists() or (png is None and _picture_beside(log).exists())
        ):
            log = Path(f"{stem}-{next(numbers)}.mcap")
    png = _picture_beside(log) if png is None else png
    for flag, path in (("--log", log), ("--png", png)):
        if not path.resolve().parent.is_dir():
            raise CommandError(
                f"{flag} {path}: no such folder: {path.parent}; create it or name another"
            )
        if path.exists() and not options.force:
            raise CommandError(f"{flag} {path} exists: name another, or overwrite it with --force")
    if log.is_dir() or (log.exists() and _first_bytes(log) != MAGIC):
        raise CommandError(f"--log {log} exists and is not a log: name another")
    return log, png


def _picture_beside(log: Path) -> Path:
    return log.with_suffix(".png")


def what_next(log: Path, png: Path) -> str:
    """Name the files that were left, and what to do with them."""
    return (
        f"wrote {log} and {png}\n"
        f"Next: open {png}; `tactile log info {log}` says what the log holds, `tactile plot {log} "
        f"--what forces` draws it otherwise, `tactile view {log}` plays it."
    )


def _run(options: argparse.Namespace, folder: Path) -> int:
    scene = ReachScene(options.arm, options.scene, options.scene_seed, options.seed)
    rig = ReachRig(scene, folder)
    print(
        f"A cupboard ({options.scene} {options.scene_seed}), the target at {rig.goal} m, "
        f"{PROCESSES[options.arm in EMULATED]}.",
        flush=True,
    )
    with contextlib.ExitStack() as stack:
        if not options.no_view:
            port = _page_port(options.view_port)
            page = [command("tactile"), "view", "--port", str(port)]
            page += [word for at in (rig.arm, rig.skin, rig.reach) for word in ("--connect", at)]
            said = folder / "view.txt"
            showing = stack.enter_context(running(page, said))
            address = f"http://127.0.0.1:{port}"
            if _is_served(port, showing):
                print(f"Watch it at {address}", flush=True)
            else:
                print(f"The live page could not be opened: {said.read_text()[-300:]}", flush=True)
        stack.enter_context(rig)
        words = ("--log", str(options.log), "--wait", f"{INPUTS_S:g}")
        for left in reversed(range(TRIES)):
            options.log.unlink(missing_ok=True)
            code = _wait_for_exit(rig.reachd(options.strategy, TIME_LIMIT_S, *words))
            if code != 3 or not left or not busy_text():
                break
            print("Nothing moved, because this machine is busy: trying again.", flush=True)
        if code == 1:
            print(*rig.arm_errors(), sep="\n", end="")
        if code == 3:
            for name in ("cupboard", "tactiled", "armd"):
                if text := rig.said(name):
                    print(f"--- {name}\n{text[-1500:]}")
    return code


def _page_port(wanted: int) -> int:
    """Return port ``wanted``, or another one when it is in use."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            return free_port()
        return int(probe.getsockname()[1])


def _is_served(port: int, process: subprocess.Popen[bytes]) -> bool:
    """Wait until the page answers; False when its process ended or did not answer in time."""
    deadline = time.monotonic() + PAGE_S
    while process.poll() is None and time.monotonic() < deadline:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return True
        time.sleep(0.05)
    return False


def _wait_for_exit(process: subprocess.Popen[bytes]) -> int:
    """Wait for a process and return its exit code.

    After Ctrl-C, which the process receives as well, it gets time to end in order.
    """
    try:
        return process.wait()
    except KeyboardInterrupt:
        try:
            process.wait(timeout=ORDERLY_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        raise
