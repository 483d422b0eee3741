"""``arm.toml``: which robot, what it carries, and where the cupboard is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from armd.driver import Float, RobotFacts, SetupError
from armd.frames import FrameError, Plane, Transform, frame_from_points, rotation_matrix
from armd.guard import FACTORY
from tactile_core.config import (
    ConfigError,
    Hertz,
    Metres,
    MetresPerSecond,
    MetresPerSecond2,
    NewtonMetres,
    Newtons,
    Radians,
    RadiansPerSecond,
    load_toml,
    unit,
)
from tactile_core.options import BusTable
from tactile_core.types import ArmLimits

Place = tuple[Metres, Metres, Metres]
Turn = tuple[Radians, Radians, Radians]
Direction = tuple[float, float, float]
Mass = Annotated[float, unit("kg"), Meta(ge=0)]

PAYLOAD_ERROR = 0.05
"""Allowed difference between the robot's payload and the configuration's, kg."""

TOOL_ERROR = 0.002
"""Allowed difference between the tool centres, m."""

TOOL_TURN_ERROR = 0.02
"""Allowed difference between the axes of the tools, rad."""


class RobotTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[robot]``: how to reach the robot, and how it starts and stops."""

    address: Annotated[
        str, Meta(description="host name or IP of the robot; Flexiv: its serial number")
    ] = ""
    acceleration: Annotated[
        MetresPerSecond2,
        Meta(
            gt=0, description="with which the robot starts and stops; at least what reachd asks for"
        ),
    ] = 2.0
    watchdog: Annotated[
        Hertz,
        Meta(
            ge=20,
            le=100,
            description="rate of commands below which the robot stops by itself; a lower one "
            "would stop it too late",
        ),
    ] = 20.0
    rate: Annotated[
        Hertz,
        Meta(ge=100, le=1000, description="rate of commands, if the driver leaves it free"),
    ] = 125.0
    priority: Annotated[
        int,
        Meta(ge=0, le=98, description="real-time priority where the system grants it; 0: none"),
    ] = 20
    port: (
        Annotated[int, Meta(ge=1, le=65535, description="TCP port, if it is not the vendor's own")]
        | None
    ) = None
    zero_force: Annotated[
        bool,
        Meta(description="whether to zero the force at the start; nothing may touch then"),
    ] = True
    simulated: Annotated[
        bool, Meta(description="whether its clock may run slower than ours, as a simulator's does")
    ] = False
    user: Annotated[str, Meta(description="user to log in as, if the robot asks for one")] = ""
    password: Annotated[str, Meta(description="password of that user")] = ""


class LimitsTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[limits]``: never exceeded, whatever is asked."""

    v_max: Annotated[MetresPerSecond, Meta(gt=0, description="speed")] = FACTORY.v_max
    omega_max: Annotated[RadiansPerSecond, Meta(gt=0, description="turning speed")] = (
        FACTORY.omega_max
    )
    f_max: Annotated[Newtons, Meta(gt=0, description="force on each axis")] = FACTORY.f_max
    m_max: Annotated[NewtonMetres, Meta(gt=0, description="moment")] = FACTORY.m_max


class ToolTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[tool]``: what is on the flange. A robot that was set up otherwise is refused.

    ``ee``: the finger's frame, at its wrist pivot, x along the finger, z up.
    """

    payload: Annotated[Mass, Meta(description="as the robot itself was set up")]
    position: Annotated[
        Place, Meta(description="tool centre from the flange, as the robot was set up")
    ] = (0.0, 0.0, 0.0)
    rotation: Annotated[
        Turn, Meta(description="rotation vector of the tool centre, as the robot was set up")
    ] = (0.0, 0.0, 0.0)
    pivot: Annotated[Place, Meta(description="origin of ee from the tool centre")] = (0.0, 0.0, 0.0)
    pivot_rotation: Annotated[
        Turn, Meta(description="rotation vector of ee in the tool's axes")
    ] = (0.0, 0.0, 0.0)


class FrameTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[frame]``: three touched points in the robot's base, which `armd teach` writes."""

    origin: Annotated[Place, Meta(description="middle of the cupboard's front edge")]
    inside: Annotated[Place, Meta(description="a point straight behind it")]
    left: Annotated[Place, Meta(description="a point to its left, seen from outside")]
    up: Annotated[Direction, Meta(description="which way is up in the base")] = (0.0, 0.0, 1.0)


class ArmConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The whole file."""

    tool: ToolTable
    robot: RobotTable = RobotTable()
    frame: FrameTable | None = None
    limits: LimitsTable = LimitsTable()
    bus: BusTable = BusTable()

    @property
    def caps(self) -> ArmLimits:
        """Limits that the arm never exceeds."""
        own = self.limits
        return ArmLimits(own.v_max, own.omega_max, own.f_max, own.m_max)

    @property
    def pivot(self) -> Transform:
        """``T_tool_ee``."""
        return Transform(_array(self.tool.pivot), rotation_matrix(_array(self.tool.pivot_rotation)))


def load_config(path: Path) -> ArmConfig:
    """Read and check the file; `ConfigError`."""
    return load_toml(path, ArmConfig)


def plane_of(config: ArmConfig, name: str) -> Plane:
    """The cupboard's plane in front of this robot; `ConfigError` if it was not taught."""
    frame = config.frame
    if frame is None:
        raise ConfigError(
            f"{name}: [frame] is missing, which says where the cupboard is: touch its three "
            f"points with `armd teach --driver KIND --config {name}`"
        )
    try:
        cupboard = frame_from_points(
            _array(frame.origin), _array(frame.inside), _array(frame.left), _array(frame.up)
        )
    except FrameError as error:
        raise ConfigError(f"{name}: [frame]: {error}") from error
    return Plane(cupboard, config.pivot)


def check_facts(config: ArmConfig, facts: RobotFacts) -> list[str]:
    """Return what could not be checked; `SetupError` if robot and configuration differ."""
    tool, unchecked = config.tool, []
    if facts.payload is None:
        unchecked.append("payload")
    elif not abs(facts.payload - tool.payload) <= PAYLOAD_ERROR:
        raise SetupError(
            f"the robot is set up for a payload of {facts.payload:.2f} kg, the configuration says "
            f"{tool.payload:.2f}: weigh the tool, and correct whichever is wrong"
        )
    if facts.tool_position is None:
        unchecked.append("tool centre")
        return unchecked
    off = float(np.linalg.norm(facts.tool_position - _array(tool.position)))
    if not off <= TOOL_ERROR:
        shown = ", ".join(f"{v:.4f}" for v in facts.tool_position)
        raise SetupError(
            f"the robot's tool centre is at [{shown}] m, {off * 1e3:.1f} mm from [tool] position: "
            "select the finger's tool at the robot, or mend the configuration"
        )
    if facts.tool_rotation is not None:
        turn = rotation_matrix(facts.tool_rotation).T @ rotation_matrix(_array(tool.rotation))
        angle = float(np.arccos(min(1.0, max(-1.0, (np.trace(turn) - 1) / 2))))
        if not angle <= TOOL_TURN_ERROR:
            raise SetupError(
                f"the robot's tool is turned by {np.degrees(angle):.1f}° from [tool] rotation: "
                "select the finger's tool at the robot, or mend the configuration"
            )
    return unchecked


def frame_text(points: dict[str, Float], up: tuple[float, float, float]) -> str:
    """``[frame]`` as text for the configuration, to the tenth of a millimetre."""
    rows = [f"{name} = {_list(point.tolist())}" for name, point in points.items()]
    return "\n".join(["[frame]", *rows, f"up = {_list(up)}", ""])


def _list(values: Any) -> str:
    return "[" + ", ".join(f"{v:.4f}" for v in values) + "]"


def _array(values: tuple[float, float, float]) -> Float:
    return np.array(values, dtype=np.float64)
