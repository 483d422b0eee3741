"""``tactile demo``: cupboard, tactiled and reachd as three processes, in real time."""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from tactile_tools.plot.series import LogUnreadableError
from tactile_tools.processes import command, running, socket_at, wait_for

BOARD = "finger"

MAGIC = b"\x89MCAP"
ORDERLY_S = 5.0  # for zero twist and the end of a log; both take a second at most

SEED = 35
"""A scene in which hybrid_event needs all it has: it goes straight, burrows past objects at the
front, stalls at a heavy disc before the target and excavates. It gets there in every run so far,
in lockstep and in real time, also on a machine with four times the work it can do."""

TIME_LIMIT_S = 30.0
"""The authors' 20 s, and what a busy machine takes: whatever is stale there holds the arm."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``demo`` to the umbrella command."""
    parser = subparsers.add_parser(
        "demo",
        help="reach into a simulated cupboard with three processes, leave a log and a picture",
        description="Starts a simulated cupboard with arm and finger, tactiled on the finger's "
        "board, and reachd; prints the outcome, leaves a log and a picture of the reach. "
        "Exit: 0 reached, 1 not reached, 2 bad argument, 3 refused by the system.",
    )
    parser.add_argument("--out", type=Path, default=Path("demo.mcap"), help="log to leave")
    parser.add_argument("--png", type=Path, default=Path("demo.png"), help="picture to leave")
    parser.add_argument("--strategy", default="hybrid_event", help="default %(default)s")
    parser.add_argument("--scene", default="authors_sim", help="default %(default)s")
    parser.add_argument(
        "--seed",
        type=int,
        default=SEED,
        help="of scene and trial (default %(default)s)",
    )
    parser.set_defaults(func=run)


def run(options: argparse.Namespace) -> int:
    """Run the demo; the exit code says whether the target was reached."""
    for flag, path in (("--out", options.out), ("--png", options.png)):
        if not path.resolve().parent.is_dir():
            print(
                f"tactile demo: {flag} {path}: there is no folder {path.parent}; create it or "
                "name another",
                file=sys.stderr,
            )
            return 2
    from reachd.strategies import StrategyError, load_strategy
    from reachd.strategies.parameters import parameters
    from tactile_tools.plot.reach import draw_reach

    try:
        # Before three processes are started in vain.
        load_strategy(options.strategy, parameters(_set(options)), np.random.default_rng(0))
        with tempfile.TemporaryDirectory(prefix="tactile-demo-") as name:
            code = _run(options, Path(name))
        if code not in (0, 1):
            return code
        draw_reach(options.out, options.png)
    except (BadArgumentError, StrategyError) as error:
        print(f"tactile demo: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        raise  # whoever read our words has gone, which is the umbrella's affair
    except (RuntimeError, OSError, LogUnreadableError) as error:
        print(f"tactile demo: {error}", file=sys.stderr)
        return 3
    print(f"wrote {options.out} and {options.png}")
    return code


class BadArgumentError(Exception):
    """One of our commands refused what it was given; the text is its own."""


def _ask(words: list[str]) -> str:
    """What a command printed; `BadArgumentError` when it refused."""
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    if done.returncode == 2:
        raise BadArgumentError(done.stderr.strip().splitlines()[-1])
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip() or f"{words[0]} ended with {done.returncode}")
    return done.stdout.strip()


def _start_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(len(MAGIC))


def _make_room(log: Path) -> None:
    """Delete the log of an earlier demo; `BadArgumentError` for what is no log."""
    if log.is_dir() or (log.exists() and _start_of(log) != MAGIC):
        raise BadArgumentError(f"--out {log} is there and is no log: name another")
    log.unlink(missing_ok=True)


def _set(options: argparse.Namespace) -> str:
    """Parameter set that belongs to the scene."""
    return "hardware" if options.scene == "hardware" else "authors_sim"


def _run(options: argparse.Namespace, folder: Path) -> int:
    simdevice, tactiled, reachd = command("simdevice"), command("tactiled"), command("reachd")
    board = folder / BOARD
    calibration = folder / "finger.cal.toml"
    scene = ["--scene", options.scene, "--seed", str(options.seed)]
    goal = _ask([simdevice, "cupboard", *scene, "--print-goal"])
    _ask([simdevice, "calibration", "--seed", str(options.seed), "--out", str(calibration)])
    _make_room(options.out)
    arm, skin, reach = (socket_at(folder, n) for n in ("arm", "tactiled", "reachd"))
    cupboard = [simdevice, "cupboard", *scene, "--pty", str(board), "--listen", arm]
    sensing = [
        *(tactiled, "--port", str(board), "--name", BOARD, "--calibration", str(calibration)),
        *("--listen", skin, "--connect", arm, "--no-log"),
    ]
    print(
        f"A cupboard ({options.scene} {options.seed}), the target at {goal} m, three processes.",
        flush=True,
    )
    with contextlib.ExitStack() as stack:
        said = folder / "cupboard.txt"
        first = stack.enter_context(running([*cupboard, "--connect", skin], said))
        wait_for(board, first, said)
        stack.enter_context(running(sensing, folder / "tactiled.txt"))
        reaching = subprocess.Popen(
            [
                *(reachd, "--strategy", options.strategy, "--target", goal),
                *("--set", _set(options), "--time-limit", f"{TIME_LIMIT_S:g}"),
                *("--board", BOARD, "--seed", str(options.seed), "--log", str(options.out)),
                *("--listen", reach, "--connect", arm, "--connect", skin),
            ],
            # Its arm is its own: another reach on this machine is no reason to refuse this one.
            env=os.environ | {"TACTILE_RUNTIME_DIR": str(folder)},
        )
        code = _ended(reaching)
        if code == 3:
            for name in ("cupboard.txt", "tactiled.txt"):
                print(f"--- {name}\n{(folder / name).read_text(errors='replace')[-1500:]}")
    return code


def _ended(process: subprocess.Popen[bytes]) -> int:
    """Exit code of a process; one that Ctrl-C has reached, too, is given time to end in order."""
    try:
        return process.wait()
    except KeyboardInterrupt:
        try:
            process.wait(timeout=ORDERLY_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        raise
