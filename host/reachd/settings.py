"""What reachd is to do: a TOML file and flags, checked once, as one frozen value.

Flags win over the file. `SettingsError` says what was given and what is allowed; the command then
exits with 2.
"""

from __future__ import annotations

import argparse
import math
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from reachd.fields import SettingError
from reachd.interfaces import Goal
from reachd.services import make_goal, parse_target
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import SETS, parameters
from reachd.trial import Pose
from tactile_core.bus.session import BusConfig
from tactile_core.bus.topics import NAME
from tactile_core.config import ConfigError, Duration, Positive, load_toml
from tactile_core.log.recorder import RecorderSettings
from tactile_core.options import BusTable, LogTable, bus_config, log_destination
from tactile_core.toml_lines import key_lines

DEFAULT_STRATEGY = "hybrid_event"
"""The paper's best."""

DEFAULT_SET = "hardware"
"""The slower one, with every check of the gate switched on."""

DEFAULT_WAIT = 10.0
"""s for features and arm to come: a board's first tare takes a few."""

DEFAULT_PRIORITY = 20
"""Of the control loop among real-time threads, below those of the kernel's interrupts (50)."""

SEEDS = 1 << 32
"""A seed that nobody gave is drawn from so many: short enough to be typed again."""

Seed = Annotated[int, Meta(ge=0, le=2**63 - 1, description="a whole number, 0 or more")]
Priority = Annotated[int, Meta(ge=0, le=98, description="a whole number from 0 (none) to 98")]
Clock = Literal["same", "remote"]


class SettingsError(Exception):
    """Arguments or configuration that are refused."""


class InputsTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[inputs]``. Clocks: "remote" where tactiled, or the arm's driver, is on another machine."""

    board_clock: Clock = "same"
    arm_clock: Clock = "same"
    wait_s: Duration = DEFAULT_WAIT


class LoopTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[loop]``: real-time priority of the control loop where the system grants it."""

    priority: Priority = DEFAULT_PRIORITY


class ConfigFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The whole file. ``home``: x, y in m and heading in degrees of the pivot."""

    strategy: str = DEFAULT_STRATEGY
    set: str = DEFAULT_SET
    board: str = "board0"
    arm: str = "arm"
    name: str = "reach"
    target: tuple[float, float] | None = None
    radius: Positive | None = None
    time_limit: Duration | None = None
    seed: Seed | None = None
    home: tuple[float, float, float] | None = None
    auto_reset: bool = False
    parameters: dict[str, Any] = {}
    inputs: InputsTable = InputsTable()
    loop: LoopTable = LoopTable()
    log: LogTable = LogTable()
    bus: BusTable = BusTable()


@dataclass(frozen=True, slots=True)
class Settings:
    """Everything. ``goal``: of the first reach, None to wait for one; ``serve``: stay after it.

    ``log``: folder or file, None for none. ``wait``: s for the inputs to come.
    """

    strategy: str
    parameters: Parameters
    seed: int
    goal: Goal | None
    home: Pose | None
    auto_reset: bool
    board: str
    arm: str
    name: str
    remote_board: bool
    remote_arm: bool
    wait: float
    priority: int
    serve: bool
    json: Path | None
    log: Path | None
    recorder: RecorderSettings
    bus: BusConfig
    config_path: Path | None


def make_settings(options: argparse.Namespace) -> Settings:
    """Settings from parsed flags and the file they name; `SettingsError` for anything wrong."""
    path: Path | None = options.config
    try:
        file = ConfigFile() if path is None else load_toml(path, ConfigFile)
    except ConfigError as error:
        raise SettingsError(str(error)) from error
    values = _parameters(options.set or file.set, file.parameters, path)
    goal = _goal(options, file, values)
    serve = goal is None if options.serve is None else options.serve
    if goal is None and not serve:
        raise SettingsError(
            "--once reaches for a target and none is given: add --target X,Y in m, or --serve to "
            "wait for goals over the bus"
        )
    board, arm = options.board or file.board, options.arm or file.arm
    name = options.name or file.name
    for given in (board, arm, name):
        if not NAME.fullmatch(given):
            raise SettingsError(
                f"the name {given!r} cannot be used; allowed: letters, digits, _ and -, at most 64"
            )
    seed = options.seed if options.seed is not None else file.seed
    return Settings(
        strategy=options.strategy or file.strategy,
        parameters=values,
        seed=secrets.randbelow(SEEDS) if seed is None else seed,
        goal=goal,
        home=_home(options, file, values),
        auto_reset=file.auto_reset,
        board=board,
        arm=arm,
        name=name,
        remote_board=file.inputs.board_clock == "remote",
        remote_arm=file.inputs.arm_clock == "remote",
        wait=options.wait if options.wait is not None else file.inputs.wait_s,
        priority=file.loop.priority,
        serve=serve,
        json=options.json,
        log=log_destination(options, file.log),
        recorder=file.log.recorder,
        bus=bus_config(options, file.bus, "reachd"),
        config_path=path,
    )


def _parameters(name: str, overrides: Mapping[str, Any], path: Path | None) -> Parameters:
    try:
        return parameters(name, overrides)
    except SettingError as error:
        raise SettingsError(_where(name, overrides, path) + str(error)) from error


def _where(name: str, overrides: Mapping[str, Any], path: Path | None) -> str:
    """File and line of the first override that fails by itself, or of their table."""
    if path is None or name not in SETS or not overrides:
        return ""
    lines = key_lines(path.read_text())
    line = lines.get(("parameters",), 1)
    gate = overrides.get("safety")
    alone: list[tuple[tuple[str | int, ...], dict[str, Any]]] = [
        (("parameters", key), {key: value}) for key, value in overrides.items()
    ]
    if isinstance(gate, Mapping):
        alone = [
            (("parameters", "safety", key), {"safety": {key: value}}) for key, value in gate.items()
        ] + alone
    for keys, one in alone:
        try:
            parameters(name, one)
        except SettingError:
            line = lines.get(keys, line)
            break
    return f"{path}:{line}: parameters: "


def _goal(options: argparse.Namespace, file: ConfigFile, values: Parameters) -> Goal | None:
    radius = options.radius if options.radius is not None else file.radius
    limit = options.time_limit if options.time_limit is not None else file.time_limit
    try:
        target = parse_target(options.target) if options.target is not None else file.target
        if target is None:
            if options.radius is not None or options.time_limit is not None:
                raise SettingsError("--radius and --time-limit go with --target; none is given")
            return None
        return make_goal(*target, values, radius=radius, time_limit=limit)
    except SettingError as error:
        raise SettingsError(str(error)) from error


def _home(options: argparse.Namespace, file: ConfigFile, values: Parameters) -> Pose | None:
    given = file.home
    if options.home is not None:
        try:
            x, y, degrees = (float(part) for part in options.home.split(","))
        except ValueError as error:
            raise SettingsError(
                f"home {options.home!r} is not X,Y,DEGREES: the pivot's place in m and its heading"
            ) from error
        given = (x, y, degrees)
    if given is None:
        return None
    if not all(math.isfinite(v) for v in given):
        raise SettingsError(f"home {given} is not finite")
    home = Pose(given[0], given[1], math.radians(given[2]))
    safety = values.safety
    tip_x = home.x + safety.tip_length * math.cos(home.heading)
    tip_y = home.y + safety.tip_length * math.sin(home.heading)
    for what, region, x, y in (
        ("pivot", safety.pivot_region, home.x, home.y),
        ("tip", safety.tip_region, tip_x, tip_y),
    ):
        if region.depth(x, y) < 0.0:
            corners = ", ".join(f"({cx:g}, {cy:g})" for cx, cy in region.corners)
            raise SettingsError(
                f"at home {given[0]:g},{given[1]:g},{given[2]:g} the {what} is at {x:.3f}, "
                f"{y:.3f} m, outside the region where it may go, with corners {corners}; change "
                f"the home or safety.{what}_region"
            )
    return home
