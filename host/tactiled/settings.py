"""Settings of tactiled from a TOML file and flags, checked once, as one frozen value.

Flags take precedence over the file. `SettingsError` says what was given and what is allowed; the
command then exits with 2.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import msgspec
from msgspec import Meta

from sensor_proto.layouts import Kind
from tactile_core.bus.session import BusConfig
from tactile_core.bus.topics import NAME
from tactile_core.calibration import CalibrationError, load
from tactile_core.calibration.nominal import MAX_ANYSKIN_MAGNETOMETERS
from tactile_core.can_bus import CanSpec
from tactile_core.cli import KINDS, require
from tactile_core.config import ConfigError, Count, Rate, given, load_toml, table_of, unit
from tactile_core.log.recorder import RecorderSettings
from tactile_core.options import BusTable, LogTable, bus_config, log_destination
from tactiled.arguments import DEFAULT_BAUD
from tactiled.boards.line import board_kind
from tactiled.sensing.settings import PipelineSettings
from tactiled.transports import listing
from tactiled.transports.slcan import slcan_commands

REPLAY_PREFIX = "replay"
"""First part of every key of a replay, so that old data is never taken for live data."""

T = TypeVar("T")

BoardKind = Annotated[
    str,
    Meta(
        pattern=rf"^({'|'.join(KINDS)}|({'|'.join(Kind)}):.*)$",
        description="protocol of a serial board; auto: found out",
        extra={"allowed": f"one of {', '.join(KINDS)}, or a layout such as floats:5xyz"},
    ),
]
Arrays = Annotated[
    str,
    Meta(
        pattern=r"^[0-9]+([+][0-9]+)*$",
        description="magnetometers of each array of a controller that does not say it",
        extra={"allowed": "numbers of magnetometers joined by +, as in 5+5"},
    ),
]


class SettingsError(Exception):
    """Arguments or configuration that are refused; the text names the remedy."""


class BoardTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[board]]``: one board, on a serial port or a CAN bus."""

    name: Annotated[
        str | None, Meta(description="of the board in keys and logs; left out: board0, board1, …")
    ] = None
    port: Annotated[
        str | None, Meta(description="serial port: a path, or usb:SERIAL; either this or can")
    ] = None
    can: Annotated[
        str | None, Meta(description="CAN bus, such as socketcan:can0; either this or port")
    ] = None
    node: Annotated[
        Annotated[int, Meta(ge=0, le=126)] | None,
        Meta(description="node of the board, where several are on one bus"),
    ] = None
    kind: BoardKind = "auto"
    arrays: Arrays | None = None
    baud: Annotated[Count, unit("baud"), Meta(description="rate of a serial port")] = DEFAULT_BAUD
    calibration: Annotated[
        str | None,
        Meta(description="calibration of this board, relative to the file; left out: nominal"),
    ] = None


_SENSING = (
    "feature_rate_hz",
    "contact_minimum_n",
    "contact_sigmas",
    "tip_light_n",
    "frozen_after_s",
    "range_limit_ut",
    "tare_s",
    "auto_tare",
    "rest_tracking_s",
    "hold_s",
)
if TYPE_CHECKING:

    class CompensationTable(msgspec.Struct, frozen=True):
        """``[compensation]`` of the ambient field."""

    class SensingTable(msgspec.Struct, frozen=True):
        """``[sensing]``: thresholds of contact, health and taring."""
else:
    CompensationTable = table_of(
        "CompensationTable",
        "``[compensation]``: how the ambient field is removed.",
        PipelineSettings,
        only=("method", "compensation_rate_hz"),
        rename={"compensation_rate_hz": "rate"},
    )
    SensingTable = table_of(
        "SensingTable",
        "``[sensing]``: thresholds of contact, health and taring; see sensing.md.",
        PipelineSettings,
        only=_SENSING,
        rename={"feature_rate_hz": "feature_rate"},
    )


class ConfigFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Configuration of tactiled."""

    rate: Annotated[
        Rate | None, Meta(description="sample rate asked of every board; left out: its own")
    ] = None
    calibration: Annotated[
        tuple[str, ...],
        Meta(description="calibration files, matched to boards by serial number"),
    ] = ()
    board: tuple[BoardTable, ...] = ()
    compensation: CompensationTable = CompensationTable()
    sensing: SensingTable = SensingTable()
    log: LogTable = LogTable()
    bus: BusTable = BusTable()


@dataclass(frozen=True, slots=True)
class PortSettings:
    """One port. ``spec``: path, CAN spec or log. ``nodes``: names of boards on a CAN bus by node.

    ``name``: name of the board on a serial port or alone on a bus; with several boards on a bus,
    their names start with it. ``arrays``: magnetometers of each array, for controllers that do not
    report it.
    """

    name: str
    spec: str
    medium: Literal["serial", "can", "log"]
    kind: str = "auto"
    baud: int = DEFAULT_BAUD
    nodes: dict[int, str] = field(default_factory=dict)
    arrays: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class Settings:
    """All settings. ``log``: folder or file; None: no log. ``duration``: s; None: until stopped.

    ``rate``: Hz; None: the board's own. ``speed``: of a replay, times real time; inf: as fast as
    possible.
    """

    ports: tuple[PortSettings, ...]
    calibrations: tuple[Path, ...]
    pipeline: PipelineSettings
    rate: float | None
    log: Path | None
    recorder: RecorderSettings
    bus: BusConfig
    duration: float | None
    wait: bool
    speed: float
    config_path: Path | None

    @property
    def replay(self) -> bool:
        """Whether a log is played instead of boards being read."""
        return any(port.medium == "log" for port in self.ports)


def make_settings(options: argparse.Namespace) -> Settings:
    """Make settings from parsed flags and the file they name; `SettingsError` for any mistake."""
    path: Path | None = options.config
    try:
        file = ConfigFile() if path is None else load_toml(path, ConfigFile)
    except ConfigError as error:
        raise SettingsError(str(error)) from error
    ports = _ports(options, file, path)
    _check_names(ports)
    calibrations = _calibrations(options, file, path)
    replay = any(port.medium == "log" for port in ports)
    return Settings(
        ports=ports,
        calibrations=calibrations,
        pipeline=_pipeline(options, file, path),
        rate=options.rate if options.rate is not None else file.rate,
        log=_log(options, file, replay),
        recorder=file.log.recorder,
        bus=bus_config(options, file.bus, "tactiled"),
        duration=options.duration,
        wait=options.wait,
        speed=options.speed,
        config_path=path,
    )


def _ports(
    options: argparse.Namespace, file: ConfigFile, path: Path | None
) -> tuple[PortSettings, ...]:
    given: list[tuple[str, str]] = options.ports or []
    names: list[str] = options.name or []
    if options.mcap is not None:
        if given:
            raise SettingsError("--mcap plays a log and takes no --port or --can beside it")
        if len(names) > 1:
            raise SettingsError(f"{len(names)} names for one log; give --name once: a board in it")
        return (PortSettings(names[0] if names else "", str(options.mcap), "log"),)
    if not given:
        if names or options.kind or options.arrays:
            raise SettingsError(
                "--name, --kind and --arrays go with --port or --can; none is given"
            )
        if file.board:
            return _ports_of_file(file.board, path)
        raise SettingsError(
            "no board is named: give --port, --can, --mcap or a --config with [[board]] tables; "
            f"{listing.known_ports()}"
        )
    if names and len(names) != len(given):
        raise SettingsError(
            f"{len(names)} names for {len(given)} ports; give --name for every one, or for none"
        )
    serial = sum(medium == "serial" for medium, _ in given)
    if not serial and set(options.kind or ()) - {"auto", "tactile"}:
        raise SettingsError(f"--kind {options.kind[0]}: such boards are serial; give their --port")
    if not serial and options.arrays:
        raise SettingsError("--arrays: boards on a CAN bus say it themselves; leave it out")
    kinds = iter(_each("--kind", options.kind or ["auto"], serial))
    sizes: list[tuple[int, ...] | None] = options.arrays or [None]
    arrays = iter(_each("--arrays", sizes, serial))
    bauds = iter(_each("--baud", options.baud or [DEFAULT_BAUD], serial))
    out = []
    for i, (medium, spec) in enumerate(given):
        name = names[i] if names else f"board{i}"
        if medium == "can":
            _check_can(spec)
            out.append(PortSettings(name, spec, "can"))
        else:
            out.append(
                PortSettings(name, spec, "serial", next(kinds), next(bauds), arrays=next(arrays))
            )
    return tuple(out)


def _ports_of_file(boards: tuple[BoardTable, ...], path: Path | None) -> tuple[PortSettings, ...]:
    out: list[PortSettings] = []
    buses: dict[str, PortSettings] = {}
    for i, board in enumerate(boards):
        where, name = f"{path}: board[{i}]", board.name or f"board{i}"
        if (board.port is None) == (board.can is None):
            raise SettingsError(f"{where} needs either port or can")
        if board.port is not None:
            if board.node is not None:
                raise SettingsError(f"{where}: node goes with can, not with port")
            try:
                board_kind(board.kind)
                arrays = None if board.arrays is None else array_sizes(board.arrays)
            except ValueError as error:
                raise SettingsError(f"{where}: {error}") from error
            out.append(
                PortSettings(name, board.port, "serial", board.kind, board.baud, arrays=arrays)
            )
            continue
        spec = board.can or ""
        _check_can(spec, where)
        if board.kind not in ("auto", "tactile"):
            raise SettingsError(f"{where}: {board.kind} boards have no CAN; they are serial")
        if board.arrays is not None:
            raise SettingsError(f"{where}: boards on a CAN bus say their arrays; leave it out")
        bus = buses.get(spec)
        if bus is None:
            bus = PortSettings(name, spec, "can")
            buses[spec] = bus
            out.append(bus)
        elif board.node is None or not bus.nodes:
            raise SettingsError(f"{where}: several boards on {spec} need a node each")
        if board.node is not None:
            if board.node in bus.nodes:
                raise SettingsError(f"{where}: node {board.node} of {spec} is named twice")
            bus.nodes[board.node] = name
    return tuple(out)


def array_sizes(text: str) -> tuple[int, ...]:
    """Parse the magnetometers of each array, as in ``5+5``; ValueError says what is allowed."""
    words = text.split("+")
    if not all(word.isdecimal() and int(word) > 0 for word in words):
        raise ValueError(
            f"arrays {text!r} given; allowed: numbers of magnetometers joined by +, as in 5+5"
        )
    sizes = tuple(int(word) for word in words)
    if sum(sizes) > MAX_ANYSKIN_MAGNETOMETERS:
        raise ValueError(
            f"arrays {text!r} are {sum(sizes)} magnetometers; allowed: at most "
            f"{MAX_ANYSKIN_MAGNETOMETERS} on a controller"
        )
    return sizes


def _each(flag: str, values: list[T], ports: int) -> list[T]:
    if len(values) == 1:
        return values * ports
    if len(values) != ports:
        raise SettingsError(
            f"{flag} is given {len(values)} times for {ports} serial ports; give it once for all, "
            "or for each in their order"
        )
    return values


def _check_can(spec: str, where: str = "--can") -> None:
    try:
        parsed = CanSpec.parse(spec)
        if parsed.interface == "slcan":
            slcan_commands(parsed)
    except ValueError as error:
        raise SettingsError(f"{where}: {error}") from error


def _check_names(ports: tuple[PortSettings, ...]) -> None:
    names = [n for p in ports if p.name for n in (p.nodes.values() if p.nodes else (p.name,))]
    for name in names:
        if not NAME.fullmatch(name):
            raise SettingsError(
                f"the name {name!r} cannot be used; allowed: letters, digits, _ and -, at most 64"
            )
    for what, values in (("name", names), ("port", [p.spec for p in ports])):
        twice = [value for value, count in Counter(values).items() if count > 1]
        if twice:
            raise SettingsError(f"the {what} {twice[0]} is given twice")


def _calibrations(
    options: argparse.Namespace, file: ConfigFile, path: Path | None
) -> tuple[Path, ...]:
    """Calibration files of the flags, else of the file, whose paths are relative to it."""
    base = Path() if path is None else path.parent
    named = [Path(p) for p in options.calibration or ()]
    if not named:
        named = [base / p for p in file.calibration]
        named += [base / b.calibration for b in file.board if b.calibration is not None]
    unique = tuple(dict.fromkeys(named))
    owners: dict[str, Path] = {}
    for each in unique:
        try:
            serial = load(each).serial_number
        except CalibrationError as error:
            raise SettingsError(str(error)) from error
        if serial in owners:
            raise SettingsError(f"{owners[serial]} and {each} are both for board {serial}")
        owners[serial] = each
    return unique


def pipeline_settings(file: ConfigFile) -> PipelineSettings:
    """Settings of the sensing core in a file; `ConfigError` for combinations not allowed."""
    return PipelineSettings(**given(file.compensation), **given(file.sensing))


def _pipeline(options: argparse.Namespace, file: ConfigFile, path: Path | None) -> PipelineSettings:
    try:
        settings = pipeline_settings(file)
        method = options.compensation or settings.method
        if method == "ransac":  # check now: later it would fail on the pipeline's thread
            require("sklearn", extra="calibrate", what="compensation ransac")
        return replace(
            settings,
            method=method,
            compensation_rate_hz=options.compensation_rate or settings.compensation_rate_hz,
            feature_rate_hz=options.feature_rate or settings.feature_rate_hz,
        )
    except ValueError as error:
        raise SettingsError(f"{path}: {error}" if path is not None else str(error)) from error


def _log(options: argparse.Namespace, file: ConfigFile, replay: bool) -> Path | None:
    """Destination of the log. A replay is logged only with --log: its data is in a log already."""
    if replay and options.log is None:
        return None
    return log_destination(options, file.log)
