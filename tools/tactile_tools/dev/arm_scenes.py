"""``tactile arm-scenes``: the same scenes with several arms, each reach in real processes.

The success of an emulated robot, through armd and its vendor's client, beside that of the simulated
arm. The arms take turns scene by scene, so that the machine's load falls on all of them alike. The
result is written after each reach, and a run that was cut off goes on where it ended.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.progress import Progress

from armd.drivers.catalogue import missing
from tactile_core.cli import REFUSED, CommandError, require
from tactile_tools.experiments.statistics import Rate, paired_rates
from tactile_tools.reach.one_reach import EMULATED, ReachRig, ReachScene

Row = dict[str, Any]

TIME_LIMIT_S: Final = 30.0
"""Of one reach, as in `tactile demo`."""

LOCKSTEP_LIMIT_S: Final = 20.0
"""Of a reach on virtual time: the parameter set's own."""

STARTS: Final = 3
"""Starts of reachd before a scene counts as failed because nothing moved: on a busy machine the
inputs may be too old at the one instant at which it arms. The demo does the same."""

HANGS_S: Final = 180.0
"""After which a reach is given up: its limit, and what starting takes on a busy machine."""

SETTINGS: Final = ("scene", "strategy", "time_limit_s", "arms", "lockstep")
"""What must be the same for a run to go on."""

NUMBERS: Final = re.compile(r"-?\d+(\.\d+)?")


def run(options: argparse.Namespace) -> int:
    """Run what is missing of the reaches; 0 once there is a row for each."""
    require("mujoco", extra="sim")
    require("scipy", extra="experiments")
    arms = tuple(dict.fromkeys(options.arm or ("simulated", "ur")))
    for arm in arms:
        if arm in EMULATED and not options.lockstep and (problem := missing(arm)) is not None:
            raise CommandError(problem)
    if not options.out.resolve().parent.is_dir():
        raise CommandError(f"--out {options.out}: no such folder: create it or name another")
    if options.logs is not None:
        options.logs.mkdir(parents=True, exist_ok=True)
    limit_s = LOCKSTEP_LIMIT_S if options.lockstep else TIME_LIMIT_S
    values = (options.scene, options.strategy, limit_s, list(arms), options.lockstep)
    settings = dict(zip(SETTINGS, values, strict=True))
    reach = lockstep_reach if options.lockstep else one_reach
    rows = read_rows(options.out, settings, restart=options.force)
    done = {(row["scene_seed"], row["arm"]) for row in rows}
    scenes = range(options.first, options.first + options.scenes)
    todo = [(seed, arm) for seed in scenes for arm in arms if (seed, arm) not in done]
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("reaches", total=len(todo))
        for seed, arm in todo:
            row = reach(ReachScene(arm, options.scene, seed, seed), options)
            rows.append(row)
            write(options.out, settings, rows)
            word = "reached" if row["success"] else f"{row['reason']}: {row['text']}"
            line = f"scene {seed}, {arm}: {word}"
            bar.console.print(line, highlight=False, markup=False, soft_wrap=True)
            bar.advance(task)
    print(as_text(rows, arms))
    return 0


def read_rows(path: Path, settings: Row, *, restart: bool) -> list[Row]:
    """Rows of an earlier run with the same settings; `CommandError` where they differ."""
    if restart or not path.exists():
        return []
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        rows: list[Row] = found["reaches"]
        earlier = {name: found[name] for name in SETTINGS}
    except (ValueError, KeyError, TypeError) as error:
        raise CommandError(
            f"--out {path} is not a result of this command: name another, or overwrite it with "
            "--force"
        ) from error
    for name, value in earlier.items():
        if value != settings[name]:
            raise CommandError(
                f"--out {path} was made with {name} {value}, not {settings[name]}: name another, "
                "or overwrite it with --force"
            )
    return rows


def one_reach(scene: ReachScene, options: argparse.Namespace) -> Row:
    """Reach once, in processes of its own; the row of it."""
    started = time.monotonic()
    row: Row = {"scene_seed": scene.scene_seed, "arm": scene.arm, "success": False}
    with tempfile.TemporaryDirectory(prefix="tactile-scene-") as name:
        folder = Path(name)
        out, log = folder / "outcome.json", folder / "reach.mcap"
        try:
            with ReachRig(scene, folder) as rig:
                for starts in range(1, STARTS + 1):
                    log.unlink(missing_ok=True)
                    reaching = rig.reachd(
                        options.strategy, TIME_LIMIT_S, "--out", str(out), "--log", str(log),
                        said=folder / "reachd.txt",
                    )  # fmt: skip
                    code, row["starts"] = _ended(reaching), starts
                    if code != REFUSED or out.exists():
                        break
                errors = [_after_level(line) for line in rig.arm_errors()]
            row |= _outcome(code, out, (folder / "reachd.txt").read_text(errors="replace"))
            if errors:
                row["armd"] = errors
        except RuntimeError as error:
            row |= {"reason": "not started", "text": str(error)[-400:]}
        if options.logs is not None and not row["success"] and log.exists():
            kept = options.logs / f"{scene.arm}-{scene.scene_seed}.mcap"
            shutil.copyfile(log, kept)
    row["seconds"] = round(time.monotonic() - started, 1)
    row["load"] = round(os.getloadavg()[0], 1)
    return row


def lockstep_reach(scene: ReachScene, options: argparse.Namespace) -> Row:
    """Reach once on virtual time; an emulated robot is its plant behind armd's guard."""
    from reachd.strategies.parameters import parameters
    from sim_device.world.base import World
    from sim_device.world.scene_loading import load_scene
    from tactile_core.types import Instant
    from tactile_tools.reach.guarded_arm import GuardedArm
    from tactile_tools.reach.lockstep import run_trial

    guarded: list[GuardedArm] = []

    def make_arm(world: World, start: Instant) -> GuardedArm:
        guarded.append(GuardedArm(world, start))
        return guarded[0]

    started = time.monotonic()
    own = parameters(scene.parameter_set)
    found = run_trial(
        load_scene(scene.scene, scene.scene_seed), options.strategy, own, scene.seed,
        make_arm=make_arm if scene.arm in EMULATED else None,
    )  # fmt: skip
    outcome = found.outcome
    row: Row = {
        "scene_seed": scene.scene_seed,
        "arm": scene.arm,
        "success": outcome.success,
        "reason": str(outcome.reason),
        "text": outcome.text,
        "distance": outcome.distance,
        "time": outcome.time,
        "peak_load": outcome.peak_load,
        "interventions": dict(outcome.interventions),
        "seconds": round(time.monotonic() - started, 1),
    }
    latches = [arm.guard.latch for arm in guarded]
    errors = [f"{latch.mode}: {latch.reason}" for latch in latches if latch is not None]
    return row | {"armd": errors} if errors else row


def _ended(process: subprocess.Popen[bytes]) -> int:
    try:
        return process.wait(HANGS_S)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)
        try:
            return process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()
    except BaseException:
        process.kill()
        process.wait()
        raise


def _outcome(code: int, out: Path, said: str) -> Row:
    if not out.exists():
        lines = [line for line in said.splitlines() if line.strip()]
        own = [line for line in lines if line.startswith("reachd: ")] or lines[-1:]
        return {"reason": f"exit status {code}", "text": own[0][:400] if own else ""}
    found = json.loads(out.read_text(encoding="utf-8"))
    kept = ("success", "reason", "text", "distance", "time", "peak_load", "interventions")
    return {name: found[name] for name in kept}


def _after_level(line: str) -> str:
    return line.partition(" ERROR ")[2].strip()


def write(path: Path, settings: Row, rows: Sequence[Row]) -> None:
    """Replace the result at once, so that one that was cut off is whole."""
    found = settings | {"summary": summary(rows, settings["arms"]), "reaches": list(rows)}
    beside = path.with_name(f".{path.name}.part")
    beside.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    beside.replace(path)


def summary(rows: Sequence[Row], arms: Sequence[str]) -> Row:
    """Success of each arm with its 95 % Wilson interval and the reasons of its failures; each
    emulated robot against the first arm in the scenes that both have."""
    found: Row = {}
    for arm in arms:
        own = [row for row in rows if row["arm"] == arm]
        rate = Rate(sum(row["success"] for row in own), len(own))
        low, high = rate.interval
        reasons = Counter(why(row) for row in own if not row["success"])
        found[arm] = {
            "reached": rate.count,
            "scenes": rate.trials,
            "wilson_95": [round(low, 3), round(high, 3)] if own else [],
            "failures": dict(reasons.most_common()),
        }
    for arm in arms[1:]:
        first, other = ({r["scene_seed"]: r["success"] for r in rows if r["arm"] == a}
                        for a in (arms[0], arm))  # fmt: skip
        both = sorted(first.keys() & other.keys())
        if not both:
            continue
        pair = paired_rates([first[s] for s in both], [other[s] for s in both])
        found[f"{arm} against {arms[0]}"] = {
            "scenes": pair.scenes,
            f"only_{arms[0]}": pair.only_a,
            f"only_{arm}": pair.only_b,
            "difference": round((pair.only_b - pair.only_a) / pair.scenes, 3),
            "interval_95": [round(-pair.interval[1], 3), round(-pair.interval[0], 3)],
            "mcnemar_p": round(pair.p, 4),
        }
    return found


def why(row: Row) -> str:
    """Reason of a failure in words that are the same for the same reason: without its numbers."""
    text = (row.get("armd") or [row["text"]])[0]
    return NUMBERS.sub("…", f"{row['reason']}: {text}" if text else row["reason"])


def as_text(rows: Sequence[Row], arms: Sequence[str]) -> str:
    """The summary for people."""
    lines = []
    for name, found in summary(rows, arms).items():
        if "reached" in found:
            low, high = found["wilson_95"] or (0.0, 1.0)
            lines.append(
                f"{name}: {found['reached']} of {found['scenes']} reached "
                f"(95 %: {low:.0%} to {high:.0%})"
            )
            lines += [f"  {count} × {reason}" for reason, count in found["failures"].items()]
        else:
            low, high = found["interval_95"]
            lines.append(
                f"{name}: {found['difference']:+.0%} ({low:+.0%} to {high:+.0%}), "
                f"p = {found['mcnemar_p']:.2g} (McNemar)"
            )
    return "\n".join(lines)
