"""Three touched points that say where the cupboard stands before a robot."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Final, TextIO

import numpy as np

from armd.config import ArmConfig, frame_text
from armd.driver import Driver, Float, RobotState
from armd.frames import FrameError, frame_from_points

POINTS: Final = {
    "origin": "the middle of the cupboard's front edge",
    "inside": "a point straight behind it, deep in the cupboard, at the same height",
    "left": "a point on the front edge or parallel to it, to the left seen from outside, at the "
    "same height",
}

STILL: Final = 0.002
"""m/s above which a tip is not at rest."""

WAIT: Final = 2.0
"""s for a state of the robot."""

_TABLE = re.compile(r"^\[frame\][^\[]*", re.MULTILINE)


class TeachError(Exception):
    """Points that cannot be used; the message names the remedy."""


def teach(
    driver: Driver, config: ArmConfig, path: Path, reach: float, lines: TextIO, out: TextIO
) -> None:
    """Ask for each of `POINTS`, a line a point, and write ``[frame]`` to ``path``; `TeachError`.

    ``reach``: m from the pivot to the tip that touches.
    """
    up = (0.0, 0.0, 1.0) if config.frame is None else config.frame.up
    points: dict[str, Float] = {}
    for name, words in POINTS.items():
        print(f"Touch {words} with the tip, then press Enter. ", end="", file=out, flush=True)
        if not lines.readline():
            raise TeachError(f"the input ended before the point {name}: nothing was written")
        robot = _newest(driver)
        if float(np.linalg.norm(robot.twist[:3])) > STILL:
            raise TeachError(f"the robot moved while {name} was taken: begin again, at rest")
        points[name] = _tip(robot, config, reach)
        shown = ", ".join(f"{v * 1e3:.1f}" for v in points[name])
        print(f"{name}: {shown} mm in the robot's base", file=out, flush=True)
    try:
        frame_from_points(points["origin"], points["inside"], points["left"], np.array(up))
    except FrameError as error:
        raise TeachError(f"{error}; nothing was written") from error
    _write(path, frame_text(points, up))
    print(f"{path}: [frame] written. Jog the tip to the front edge before armd is started.",
          file=out, flush=True)  # fmt: skip


def _tip(robot: RobotState, config: ArmConfig, reach: float) -> Float:
    pivot = config.pivot
    in_tool = pivot.position + pivot.rotation @ np.array([reach, 0.0, 0.0])
    return np.asarray(robot.position + robot.rotation @ in_tool, dtype=np.float64)


def _newest(driver: Driver) -> RobotState:
    found = None
    deadline = time.monotonic() + WAIT
    # What waited since the last point is old: the third new one is not.
    for _ in range(3):
        state = driver.read()
        while state is None:
            if time.monotonic() > deadline:
                raise TeachError("the robot sends no states: look at its network, begin again")
            state = driver.read()
        found = state
    if found is None:
        raise TeachError("the robot sends no states: look at its network, begin again")
    return found


def _write(path: Path, table: str) -> None:
    text = path.read_text(encoding="utf-8")
    if _TABLE.search(text):
        text = _TABLE.sub(table + "\n", text, count=1)
    else:
        text = text.rstrip("\n") + "\n\n" + table
    new = path.with_name(f".{path.name}.new")
    new.write_text(text, encoding="utf-8")
    new.replace(path)
