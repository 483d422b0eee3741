"""The command ``simdevice``: boards without hardware, for trying out and for testing."""

from __future__ import annotations

import argparse
import gc
import signal
import sys
import threading
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from sim_device.arguments import Handler, make_parser
from tactile_core.ending import leave

if TYPE_CHECKING:
    from sim_device.arm.cupboard_plan import CupboardRequest
    from sim_device.ports_plan import BoardsRequest, Planned
    from sim_device.runner import Runner

OK, BAD_ARGUMENT, REFUSED = 0, 2, 3

SWITCH_INTERVAL = 0.0005
"""s after which Python hands the interpreter on, where several threads work."""

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def main(argv: list[str] | None = None) -> int:
    """Run the command; 0 done, 2 bad argument, 3 refused by the environment.

    Without ``argv`` this is the whole process, which then ends here.
    """
    code = _main(argv)
    if argv is None:
        leave(code)
    return code


def _main(argv: list[str] | None) -> int:
    handlers: dict[str, Handler] = {
        "boards": _boards,
        "cupboard": _cupboard,
        "replay": _replay,
        "calibration": _calibration,
        "version": _version,
    }
    arguments = make_parser(handlers).parse_args(argv)
    handler: Handler = arguments.handler
    try:
        return handler(arguments)
    except _Refusal as refusal:
        print(f"simdevice: {refusal}", file=sys.stderr)
        return refusal.code
    except BrokenPipeError:
        return OK  # whoever read our lines has seen enough


class _Refusal(Exception):  # noqa: N818 - ends the command, with its exit code
    def __init__(self, code: int, problem: object) -> None:
        super().__init__(str(problem))
        self.code = code


def _version(_: argparse.Namespace) -> int:
    print(f"simdevice {version('tactile-reach')}")
    return OK


def _boards(arguments: argparse.Namespace) -> int:
    from sim_device.ports_plan import plan_boards

    try:
        planned = plan_boards(_request(arguments))
    except ValueError as error:
        raise _Refusal(BAD_ARGUMENT, error) from error
    return _serve(planned, arguments.duration)


def _request(arguments: argparse.Namespace) -> BoardsRequest:
    from sim_device.ports_plan import BoardsRequest

    return BoardsRequest(
        ptys=tuple(arguments.pty),
        slcans=tuple(arguments.slcan),
        cans=tuple(arguments.can),
        nodes=tuple(dict.fromkeys(arguments.node)) or (1,),
        fd=arguments.fd,
        adapter=arguments.adapter,
        board=arguments.board,
        arrays=arguments.arrays,
        format=arguments.format,
        banner=arguments.banner,
        seed=arguments.seed,
        serials=tuple(arguments.serial),
        rate=arguments.rate,
        press=arguments.press,
        rotate=arguments.rotate,
        faults=arguments.faults,
        unplugged=tuple(arguments.unplug),
        temperature_c=arguments.temperature,
        field_ut=arguments.field,
    )


def _cupboard(arguments: argparse.Namespace) -> int:
    from sim_device.arm.cupboard_plan import goal_text, plan_cupboard, scene_of
    from sim_device.world.base import WorldError
    from sim_device.world.engines import EngineMissing

    try:
        request = _cupboard_request(arguments)
        if arguments.print_goal:
            print(goal_text(scene_of(request)))
            return OK
        planned = plan_cupboard(request)
    except (EngineMissing, WorldError) as error:
        raise _Refusal(REFUSED, error) from error
    except ValueError as error:
        raise _Refusal(BAD_ARGUMENT, error) from error
    # Services answer on other threads: the world must get its turn within a tick.
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        return _serve(planned, arguments.duration)
    except WorldError as error:
        raise _Refusal(REFUSED, error) from error


def _cupboard_request(arguments: argparse.Namespace) -> CupboardRequest:
    from sim_device.arm.cupboard_plan import CupboardRequest
    from sim_device.arm.server import arm_settings, parse_arm_faults
    from sim_device.ports_plan import BoardsRequest
    from tactile_core.options import BusTable, bus_config

    return CupboardRequest(
        scene=arguments.scene,
        seed=arguments.seed,
        engine=arguments.engine,
        arm=arguments.arm,
        world=arguments.world,
        settings=arm_settings(arguments.arm_rate, arguments.arm_latency, arguments.arm_noise),
        arm_faults=parse_arm_faults(arguments.arm_fault),
        boards=BoardsRequest(
            ptys=tuple(arguments.pty),
            slcans=tuple(arguments.slcan),
            fd=arguments.fd,
            seed=arguments.seed,
            rate=arguments.rate,
            faults=arguments.faults,
        ),
        bus=bus_config(arguments, BusTable(), "arm"),
    )


def _replay(arguments: argparse.Namespace) -> int:
    from sim_device.board.recorded import RecordingError, ReplayBoard, load
    from sim_device.faults import FaultPlan
    from sim_device.ports import PtyPort
    from sim_device.ports_plan import Planned
    from sim_device.runner import ReplayStation

    try:
        recording = load(arguments.recording)
    except RecordingError as error:
        raise _Refusal(BAD_ARGUMENT, error) from error
    except OSError as error:
        raise _Refusal(
            BAD_ARGUMENT, f"{arguments.recording}: cannot be read ({error.strerror})"
        ) from error
    try:
        faults = FaultPlan.parse(arguments.faults)
        board = ReplayBoard(recording, arguments.speed, arguments.loop, faults)
    except ValueError as error:
        raise _Refusal(BAD_ARGUMENT, error) from error
    seconds = float(recording.seconds[-1]) / arguments.speed
    line = (
        f"{recording.magnetometers} magnetometers, {len(board)} rows, {seconds:.1f} s; "
        "begins when a host reads"
    )
    link = arguments.pty
    station = ReplayStation(PtyPort(link), board)
    plan = Planned(station, str(link), f"tactiled --port {link} --board anyskin", (line,))
    return _serve([plan], arguments.duration)


def _calibration(arguments: argparse.Namespace) -> int:
    from dataclasses import replace

    from sim_device.board.catalogue import factory_calibration, identity
    from tactile_core.calibration import CalibrationError, load, save

    if len(arguments.serial) > 1:
        raise _Refusal(BAD_ARGUMENT, "more than one --serial given; a calibration is of one board")
    own = identity(arguments.board, arguments.seed).unique_id
    serial_number = (arguments.serial[0] if arguments.serial else own).hex()
    out: Path = arguments.out
    if out.exists() and not arguments.force:
        try:
            ours = load(out).serial_number == serial_number
        except CalibrationError:
            ours = False
        if not ours:
            raise _Refusal(
                BAD_ARGUMENT,
                f"{out} exists and is no calibration of board {serial_number}; give another file "
                "or --force",
            )
    print(f"pressing every taxel of {arguments.board} {serial_number} …", file=sys.stderr)
    try:
        calibration = factory_calibration(arguments.board, arguments.seed, arguments.arrays)
    except ValueError as error:
        raise _Refusal(BAD_ARGUMENT, error) from error
    try:
        save(replace(calibration, serial_number=serial_number), out)
    except CalibrationError as error:
        raise _Refusal(REFUSED, error) from error
    print(f"{out}: calibration of {arguments.board} {serial_number} (seed {arguments.seed})")
    return OK


def _serve(planned: Sequence[Planned], duration: float | None) -> int:
    """Open the ports, say where they are, and run until a signal or the end."""
    from sim_device.runner import Runner
    from sim_device.status import StatusLine

    stop = threading.Event()
    # Before the first port is open: a signal in between would leave links behind.
    former = {number: signal.signal(number, lambda *_: stop.set()) for number in SIGNALS}
    runner = Runner([plan.station for plan in planned])
    status = StatusLine(planned, sys.stderr)
    try:
        _open(runner)
        for plan in planned:
            _announce(plan)
        gc.collect()
        gc.freeze()  # boards live as long as the process: nothing for the collector to look at
        runner.run(stop.is_set, duration, status.show)
    finally:
        status.end()
        runner.close()
        for number, handler in former.items():
            signal.signal(number, handler)
    return OK


def _open(runner: Runner) -> None:
    from sim_device.ports import LinkRefused
    from tactile_core.bus.session import BusError
    from tactile_core.can_bus import CanUnavailable, Trouble

    try:
        runner.open()
    except BusError as error:
        raise _Refusal(REFUSED, error) from error
    except LinkRefused as error:
        remedy = "give another path, or remove it yourself" if error.foreign else "end that one"
        code = BAD_ARGUMENT if error.foreign else REFUSED
        raise _Refusal(code, f"{error}; {remedy}") from error
    except CanUnavailable as error:
        code = BAD_ARGUMENT if error.trouble is Trouble.UNSUITABLE else REFUSED
        raise _Refusal(code, error) from error
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _refuse_link(where, error)


def _refuse_link(where: str, error: OSError) -> NoReturn:
    raise _Refusal(
        REFUSED,
        f"{where}cannot make the port ({error.strerror}); give a path in a folder that exists and "
        "that you may write to",
    ) from error


def _announce(plan: Planned) -> None:
    for line in plan.lines:
        print(f"{plan.name}: {line} → {plan.connect}", flush=True)
