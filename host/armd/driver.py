"""Interface between armd and a robot: a driver for another robot is a class like `Driver`.

A driver knows one vendor's library, and nothing of the cupboard, the bus or the commander. It uses
the robot's **tool centre** in the robot's **base** frame: SI units, rotations as matrices,
spatial vectors as (6,) arrays, linear part first, in the axes of the base.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_core.types import ArmLimits, record

Float = NDArray[np.float64]


class DriverError(Exception):
    """The robot is not there or does not obey; the message names the remedy."""


class SetupError(DriverError):
    """Configuration and robot disagree: nothing may move."""


class RobotMode(StrEnum):
    """``STOPPED``: nobody's program moves it. ``FAULT``: its controller stopped it (protective
    stop, reflex). ``ESTOP``: an emergency stop or a safeguard (a door, a light curtain)."""

    READY = "ready"
    STOPPED = "stopped"
    FAULT = "fault"
    ESTOP = "estop"


@record
class RobotState:
    """One report of the robot.

    ``robot_time``: s of the robot's own clock; two states with one time are the same state.
    ``position`` (3,) m and ``rotation`` (3, 3) of the tool centre in the base; ``twist`` (6,) m/s
    and rad/s of the tool centre; ``wrench`` (6,) N and N·m that the environment exerts on the tool,
    about the tool centre. All in the axes of the base. ``detail``: why the mode is not ready.
    """

    robot_time: float
    position: Float
    rotation: Float
    twist: Float
    wrench: Float
    mode: RobotMode = RobotMode.READY
    detail: str = ""


@dataclass(frozen=True, slots=True)
class RobotFacts:
    """What a robot reports about itself once connected; None for what it does not report.

    ``tool_position`` (3,) m and ``tool_rotation`` (3,) rotation vector, rad: of the tool centre
    from the flange. ``payload`` kg. ``enforces``: those of `ArmLimits` that the robot's own
    controller keeps; armd keeps all of them besides.
    """

    model: str
    tool_position: Float | None = None
    tool_rotation: Float | None = None
    payload: float | None = None
    enforces: frozenset[str] = frozenset()


class Driver(Protocol):
    """A robot. `read` and `move` are called by one thread each, the rest by `move`'s.

    None may wait for longer than its robot takes to answer; one that hangs is noticed, and the
    robot's own watchdog must have stopped it by then.
    """

    rate: float
    """Hz at which `move` is called, at least 100; also while nothing is commanded."""

    braking: float
    """m/s² with which the robot comes to rest."""

    holds: float
    """s for which the robot goes on moving when this process dies, before it begins to brake."""

    note: str
    """What was and was not verified, in one sentence that is said at each start."""

    def connect(self) -> RobotFacts:
        """Take control of the robot without moving it; `DriverError`, `SetupError`."""
        ...

    def read(self) -> RobotState | None:
        """Return the newest state, None if there is no newer one. Waits for a few ms at most."""
        ...

    def move(self, velocity: Float) -> None:
        """Move the tool centre at ``velocity`` (6,) until the next call or for `holds`."""
        ...

    def halt(self) -> None:
        """Come to rest as fast as is safe, at once and without waiting."""
        ...

    def limit(self, limits: ArmLimits) -> None:
        """Have the robot keep what it can of ``limits``; `DriverError` when it refuses."""
        ...

    def recover(self) -> None:
        """Undo a stop at an operator's request; `DriverError` says what prevents it."""
        ...

    def zero_force(self) -> None:
        """Take the present wrench as zero."""
        ...

    def close(self) -> None:
        """Release the robot, which rests."""
        ...
