"""Plan the ports of ``simdevice boards``: which boards are on which port, and their identities."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sensor_proto.anyskin import MAX_MAGNETOMETERS
from sensor_proto.can_transfers import CanFrame
from sim_device.board.anyskin import CONVERSION_RATE_HZ, LOOP_RATE_HZ, AnySkinBoard, writer_of
from sim_device.board.catalogue import build_skin, identity
from sim_device.board.firmware import DEFAULT_RATE_HZ, BoardOptions, CanBoard, Identity, SerialBoard
from sim_device.faults import FaultPlan, Window
from sim_device.ports import PtyPort, PythonCanPort, SlcanPort
from sim_device.runner import Board, CanServer, MakeBoard, PortServer, SerialServer
from sim_device.skin.environment import (
    AttitudeScript,
    Environment,
    EnvironmentParameters,
    parse_rotation,
    rotation_about,
    still,
)
from sim_device.skin.indenter import Indenter, load_script
from sim_device.skin.skin import Contact
from tactile_core.can_bus import DEFAULT_BITRATE, CanSpec
from tactile_core.geometry import ANYSKIN_CHIPS, SkinGeometry

UP = np.array([0.0, 0.0, 1.0])

NODES = range(127)
"""Node ids that a board may have on a CAN bus; 127 addresses all boards."""

BUS_SHARE = 0.85
"""Share of a bus's bit rate that its boards' samples may use together, in equal parts: leaves room
for stuff bits and the host. A board that has more to send overruns whole cycles, as a real one."""

_WINDOW = re.compile(r"(?P<at>\d+(?:\.\d*)?)s\+(?P<for>\d+(?:\.\d*)?)s")
_HEX = re.compile(r"(?:0x)?([0-9A-Fa-f]{1,16})")


@dataclass(frozen=True, slots=True)
class BoardsRequest:
    """What the user of `simdevice boards` asked for; units as in its help.

    For boards on a finger that something else moves, ``touched`` (contacts on the skin now) and
    ``heading`` (rad, counter-clockwise from above) take the place of ``press`` and ``rotate``.
    """

    ptys: tuple[Path, ...] = ()
    slcans: tuple[Path, ...] = ()
    cans: tuple[CanSpec, ...] = ()
    nodes: tuple[int, ...] = (1,)
    fd: bool = False
    adapter: str = "lawicel"
    board: str = "finger"
    arrays: tuple[int, ...] | None = None
    format: str = ""
    banner: bool = False
    seed: int = 0
    serials: tuple[bytes, ...] = ()
    rate: float | None = None
    press: Path | None = None
    rotate: str | None = None
    faults: str = ""
    unplugged: tuple[Window, ...] = ()
    temperature_c: float = EnvironmentParameters().room_c
    field_ut: float = EnvironmentParameters().field_ut
    touched: Callable[[], Sequence[Contact]] | None = None
    heading: Callable[[], float] | None = None


@dataclass(frozen=True, slots=True)
class Planned:
    """Port server that is not yet open. ``lines``: what to tell the user about each of its boards.

    ``connect``: the command that reads it. ``note``: gives its state for a status line.
    """

    server: PortServer
    name: str
    connect: str
    lines: tuple[str, ...] = field(default=())
    note: Callable[[], str] | None = None


def parse_window(text: str) -> Window:
    """Window such as ``5s+1s``: from 5 s on, for 1 s. ValueError says what is allowed."""
    match = _WINDOW.fullmatch(text)
    if match is None or float(match["for"]) == 0:
        raise ValueError(f"{text!r} given; allowed: Ts+Ds, such as 5s+1s (from 5 s on, for 1 s)")
    return Window(float(match["at"]), float(match["for"]))


def parse_serial(text: str) -> bytes:
    """Unique id from up to 16 hex digits, padded with zeros in front; ValueError."""
    match = _HEX.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} given; allowed: 1 to 16 hexadecimal digits")
    return bytes.fromhex(match[1].rjust(16, "0"))


def parse_bus(text: str) -> CanSpec:
    """CAN bus on which to simulate boards; ValueError."""
    spec = CanSpec.parse(text)
    if spec.interface == "slcan":
        raise ValueError(f"{text!r} given; to play an slcan adapter use --slcan LINK")
    return spec


def parse_arrays(text: str) -> tuple[int, ...]:
    """Number of magnetometers on each board of a controller, as in ``5+5``; ValueError."""
    words = text.split("+")
    if not all(word.isdecimal() and int(word) for word in words):
        raise ValueError(f"{text!r} given; allowed: numbers above 0 joined by +, as in 5+5")
    sizes = tuple(int(word) for word in words)
    if sum(sizes) > MAX_MAGNETOMETERS:
        raise ValueError(f"{text!r} given; allowed: at most {MAX_MAGNETOMETERS} magnetometers")
    return sizes


def plan_boards(request: BoardsRequest) -> list[Planned]:
    """Port servers for a request, all boards made. ValueError if options do not fit together."""
    buses: list[tuple[SlcanPort | PythonCanPort, CanSpec]] = [
        (
            SlcanPort(link, dialect=request.adapter),
            CanSpec("slcan", str(link), DEFAULT_BITRATE, fd=request.fd),
        )
        for link in request.slcans
    ]
    buses += [(PythonCanPort(spec), spec) for spec in request.cans]
    if request.board != "anyskin" and (request.arrays or request.format or request.banner):
        raise ValueError(
            f"--arrays, --layout and --banner with --kind {request.board}; they are for boards "
            "that send floats: --kind anyskin"
        )
    count = len(request.ptys) + len(buses) * len(request.nodes)
    if not count:
        raise ValueError("no port given; allowed: --pty, --slcan and --can, each more than once")
    if buses and request.board == "anyskin":
        raise ValueError("--kind anyskin on a CAN bus; such boards have a serial line: use --pty")
    if request.unplugged and buses:
        raise ValueError("--unplug on a CAN bus; it is for --pty (for CAN: --faults busoff@5s+1s)")
    if len(request.serials) > count:
        raise ValueError(f"{len(request.serials)} serial numbers given for {count} boards")
    factory = _BoardFactory(request)
    planned = [_plan_serial(factory, number, link) for number, link in enumerate(request.ptys)]
    number = len(request.ptys)
    for port, spec in buses:
        planned.append(_plan_bus(factory, number, port, spec))
        number += len(request.nodes)
    return planned


def _plan_serial(factory: _BoardFactory, number: int, link: Path) -> Planned:
    request = factory.request
    anyskin = request.board == "anyskin"
    make: MakeBoard[bytes] = factory.anyskin(number) if anyskin else factory.serial(number)
    connect = f"tactiled --port {link}" + (" --kind anyskin" if anyskin else "")
    if request.format and not request.format.endswith("-text"):
        connect = f"tactiled --port {link} --kind {request.format}"
    server = SerialServer(PtyPort(link), make, request.unplugged)
    return Planned(server, str(link), connect, (factory.describe(number),))


def _plan_bus(
    factory: _BoardFactory, number: int, port: SlcanPort | PythonCanPort, spec: CanSpec
) -> Planned:
    nodes = factory.request.nodes
    share = None if spec.bitrate is None else BUS_SHARE * spec.bitrate / len(nodes)
    makes = [factory.can(number + k, node, spec.fd, share) for k, node in enumerate(nodes)]
    lines = tuple(f"{factory.describe(number + k)}, node {node}" for k, node in enumerate(nodes))
    return Planned(CanServer(port, makes), str(spec), f"tactiled --can {spec}", lines)


class _BoardFactory:
    """Makes boards by number. Errors in the request are raised before any port opens."""

    def __init__(self, request: BoardsRequest) -> None:
        self.request = request
        self._plan = FaultPlan.parse(request.faults)
        self._turn = _turn(request)
        self._parameters = EnvironmentParameters(
            room_c=request.temperature_c, field_ut=request.field_ut
        )
        self._indenter: Indenter | None = None
        self._geometry: SkinGeometry | None = None

    def seed(self, number: int) -> int:
        """Seed of board ``number``: no two boards are alike."""
        return self.request.seed + number

    def identity(self, number: int) -> Identity:
        """Identity of board ``number``."""
        own = identity(self.request.board, self.seed(number))
        if number < len(self.request.serials):
            return replace(own, unique_id=self.request.serials[number])
        return own

    def describe(self, number: int) -> str:
        """Board ``number`` in a few words."""
        who = self.identity(number)
        return f"{who.model} {who.unique_id.hex()} (seed {self.seed(number)})"

    def serial(self, number: int) -> MakeBoard[bytes]:
        """Board on a serial line."""

        def make(powered: float) -> Board[bytes]:
            return SerialBoard(
                build_skin(self.request.board, self.seed(number)),
                self.identity(number),
                **self._options(number, powered),
            )

        return make

    def can(
        self, number: int, node: int, fd: bool, bits_per_s: float | None
    ) -> MakeBoard[tuple[CanFrame, ...]]:
        """Board on a CAN bus that may use ``bits_per_s`` of it; None: no limit."""

        def make(powered: float) -> Board[tuple[CanFrame, ...]]:
            options = self._options(number, powered)
            if bits_per_s is not None:
                options["line_rate"] = bits_per_s
            skin = build_skin(self.request.board, self.seed(number))
            return CanBoard(skin, self.identity(number), node, fd, **options)

        return make

    def anyskin(self, number: int) -> MakeBoard[bytes]:
        """Board that sends unframed floats."""
        loop = self.request.rate or LOOP_RATE_HZ
        request = self.request
        chips = sum(request.arrays or (ANYSKIN_CHIPS,))
        write = writer_of(request.format or "anyskin", chips)
        build_skin("anyskin", 0, request.arrays)  # raises now if the arrays are wrong

        def make(powered: float) -> Board[bytes]:
            options = self._options(number, powered)
            return AnySkinBoard(
                build_skin("anyskin", self.seed(number), request.arrays),
                options["environment"],
                options["contacts"],
                options["plan"],
                loop_rate=loop,
                conversion_rate=loop * CONVERSION_RATE_HZ / LOOP_RATE_HZ,
                write=write,
                banner=request.banner,
            )

        return make

    def _options(self, number: int, powered: float) -> BoardOptions:
        """Options of a board powered ``powered`` s after the start, when the world already runs."""
        plan = self._plan if self._plan.seed else replace(self._plan, seed=self.seed(number))
        turn = self._turn
        return BoardOptions(
            environment=Environment(self._parameters, lambda s: turn(s + powered)),
            contacts=self._contacts(powered),
            plan=plan,
            rate=self.request.rate or DEFAULT_RATE_HZ,
        )

    def _contacts(self, powered: float) -> Callable[[float], Sequence[Contact]] | tuple[()]:
        touched = self.request.touched
        if touched is not None:
            return lambda _: touched()
        if self.request.press is None:
            return ()
        if self._indenter is None:
            geometry = build_skin(
                self.request.board, self.request.seed, self.request.arrays
            ).geometry
            self._indenter = load_script(self.request.press, geometry)
        indenter = self._indenter
        return lambda seconds: indenter.contacts(seconds + powered)


def _turn(request: BoardsRequest) -> AttitudeScript:
    """Attitude of the boards over time."""
    heading = request.heading
    if heading is not None:
        return lambda _: rotation_about(UP, heading())
    return parse_rotation(request.rotate) if request.rotate else still
