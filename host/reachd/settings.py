"""Settings of reachd from a TOML file and flags, checked once, as one frozen value.

Flags take precedence over the file. `SettingsError` says what was given and what is allowed; the
command then exits with 2.
"""

from __future__ import annotations

import argparse
import math
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from reachd.arguments import DEFAULT_SET, DEFAULT_WAIT_S
from reachd.interfaces import Goal
from reachd.services import make_goal, parse_target
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.parameters import SETS, ParameterTable, parameters
from reachd.trial import Pose
from tactile_core.bus.session import BusConfig
from tactile_core.bus.topics import NAME
from tactile_core.cli import DEFAULT_STRATEGY
from tactile_core.config import ConfigError, Document, Duration, Metres, unit
from tactile_core.log.recorder import RecorderSettings
from tactile_core.options import BusTable, LogTable, bus_config, log_destination

DEFAULT_PRIORITY = 20
"""Real-time priority of the control loop, below the kernel's interrupt threads (50)."""

SEEDS = 1 << 32
"""Range of seeds drawn when none is given: short enough to type."""

Clock = Literal["same", "remote"]


class SettingsError(Exception):
    """Arguments or configuration that are refused; the text names the remedy."""


class InputsTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[inputs]``: features and arm."""

    board_clock: Annotated[
        Clock, Meta(description="remote where tactiled is on another machine")
    ] = "same"
    arm_clock: Annotated[
        Clock, Meta(description="remote where the arm's driver is on another machine")
    ] = "same"
    wait_s: Annotated[
        Duration, Meta(description="time for features and arm to come; a first tare takes a few s")
    ] = DEFAULT_WAIT_S


class LoopTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[loop]``: the control loop."""

    priority: Annotated[
        int,
        Meta(ge=0, le=98, description="real-time priority where the system grants it; 0: none"),
    ] = DEFAULT_PRIORITY


class ConfigFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Configuration of reachd."""

    strategy: Annotated[
        str, Meta(description="name of a strategy, or module:Class of one of your own")
    ] = DEFAULT_STRATEGY
    set: Annotated[str, Meta(description="parameter set: hardware or authors_sim")] = DEFAULT_SET
    board: Annotated[str, Meta(description="board whose features are followed")] = "board0"
    arm: Annotated[str, Meta(description="arm that is commanded")] = "arm"
    name: Annotated[str, Meta(description="of this reachd in keys and logs")] = "reach"
    target: Annotated[
        tuple[float, float] | None,
        unit("m"),
        Meta(description="x, y in `cupboard` of a first reach; left out: goals come over the bus"),
    ] = None
    radius: Annotated[
        Annotated[Metres, Meta(gt=0)] | None,
        Meta(description="distance that counts as success; left out: the set's"),
    ] = None
    time_limit: Annotated[
        Duration | None, Meta(description="time the first reach may take; left out: the set's")
    ] = None
    seed: Annotated[
        Annotated[int, Meta(ge=0)] | None,
        Meta(description="of the strategy's random draws; left out: a new one is drawn and said"),
    ] = None
    home: Annotated[
        tuple[float, float, float] | None,
        Meta(description="x, y in m and heading in ° of the pivot, where a reset goes"),
    ] = None
    auto_reset: Annotated[bool, Meta(description="go home by itself after every reach")] = False
    parameters: ParameterTable = ParameterTable()
    inputs: InputsTable = InputsTable()
    loop: LoopTable = LoopTable()
    log: LogTable = LogTable()
    bus: BusTable = BusTable()


@dataclass(frozen=True, slots=True)
class Settings:
    """All settings. ``goal``: of the first reach; None: wait for one. ``serve``: stay after it.

    ``log``: folder or file; None: no log. ``wait``: s to wait for the inputs. ``json``: file for
    outcomes. ``remote_board``, ``remote_arm``: the sender runs on another machine.
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
    """Make settings from parsed flags and the file they name; `SettingsError` for any mistake."""
    path: Path | None = options.config
    document = Document({})
    try:
        if path is not None:
            document = Document.read(path)
        file = document.convert(ConfigFile)
        values = _parameters(options.set or file.set, file.parameters, document)
    except ConfigError as error:
        raise SettingsError(str(error)) from error
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
        json=options.out,
        log=log_destination(options, file.log),
        recorder=file.log.recorder,
        bus=bus_config(options, file.bus, "reachd"),
        config_path=path,
    )


def _parameters(name: str, overrides: ParameterTable, document: Document) -> Parameters:
    try:
        return parameters(name, overrides)
    except ConfigError as error:
        if name not in SETS or "parameters" not in document.data:
            raise
        keys = ("parameters", *error.keys)
        raise document.error(keys, f"parameters: {error}") from error


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
    except ConfigError as error:
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
