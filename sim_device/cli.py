"""Command ``simdevice``: simulated boards, arms and robots, to try things out and for tests."""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from sim_device.arguments import make_parser
from tactile_core.cli import DONE, REFUSED, USAGE, CommandError, seeds_of, working
from tactile_core.daemon import Shutdown, request_real_time, run

if TYPE_CHECKING:
    from sim_device.arm.cupboard_plan import CupboardRequest
    from sim_device.ports_plan import BoardsRequest, Planned
    from sim_device.runner import Runner

SWITCH_INTERVAL_S = 0.0005
"""Seconds after which Python may switch threads. The default, 5 ms, exceeds a tick."""

CONTROLLER_PRIORITY = 18
"""Real-time priority of an emulated robot if the system grants it, below armd's and reachd's: other
programs do not hold up a robot's controller."""


def main(argv: list[str] | None = None) -> int:
    """Run the command. Returns 0 when done, 2 for a bad argument, 3 if the system refused.

    Without ``argv`` it uses the process's arguments and exits the process.
    """
    return run(make_parser, argv)


def print_version(_: argparse.Namespace) -> int:
    """``simdevice version``."""
    from importlib.metadata import version

    print(f"simdevice {version('tactile-reach')}")
    return DONE


def boards(arguments: argparse.Namespace) -> int:
    """``simdevice boards``."""
    from sim_device.ports_plan import plan_boards

    try:
        planned = plan_boards(_request(arguments))
    except ValueError as error:
        raise CommandError(str(error)) from error
    return _serve(planned, arguments)


def _request(arguments: argparse.Namespace) -> BoardsRequest:
    from sim_device.ports_plan import BoardsRequest

    return BoardsRequest(
        ptys=tuple(arguments.pty),
        slcans=tuple(arguments.slcan),
        cans=tuple(arguments.can),
        nodes=tuple(dict.fromkeys(arguments.node)) or (1,),
        fd=arguments.fd,
        adapter=arguments.adapter,
        board=arguments.kind,
        arrays=arguments.arrays,
        format=arguments.layout,
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


def cupboard(arguments: argparse.Namespace) -> int:
    """``simdevice cupboard``."""
    from sim_device.arm.cupboard_plan import goal_text, plan_cupboard, scene_of

    with _world_errors():
        try:
            request = _cupboard_request(arguments)
            if arguments.print_goal:
                print(goal_text(scene_of(request)))
                return DONE
            planned = plan_cupboard(request)
        except ValueError as error:
            raise CommandError(str(error)) from error
        # Services answer on other threads: the world must get its turn within a tick.
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        return _serve(planned, arguments)


@contextmanager
def _world_errors() -> Iterator[None]:
    """Report that the physics failed, while a world is built or runs, as a `CommandError`."""
    from sim_device.world.base import WorldError

    try:
        yield
    except WorldError as error:
        raise CommandError(str(error), REFUSED) from error


def _cupboard_request(arguments: argparse.Namespace) -> CupboardRequest:
    from sim_device.arm.cupboard_plan import CupboardRequest
    from sim_device.arm.server import arm_settings, parse_arm_faults
    from sim_device.ports_plan import BoardsRequest
    from tactile_core.options import BusTable, bus_config

    scene_seed, seed = seeds_of(arguments)
    return CupboardRequest(
        scene=arguments.scene,
        seed=scene_seed,
        engine=arguments.engine,
        arm=arguments.arm,
        world=arguments.world,
        settings=arm_settings(arguments.arm_rate, arguments.arm_latency, arguments.arm_noise),
        arm_faults=parse_arm_faults(arguments.arm_fault),
        boards=BoardsRequest(
            ptys=tuple(arguments.pty),
            slcans=tuple(arguments.slcan),
            fd=arguments.fd,
            seed=seed,
            rate=arguments.rate,
            faults=arguments.faults,
        ),
        bus=bus_config(arguments, BusTable(), "arm"),
    )


def robot(arguments: argparse.Namespace) -> int:
    """``simdevice ur`` and ``simdevice xarm``."""
    from sim_device.ports_plan import BoardsRequest
    from sim_device.robots.plan import RobotRequest, plan_robot
    from tactile_core.options import BusTable, bus_config

    scene_seed, seed = seeds_of(arguments)
    request = RobotRequest(
        kind=arguments.kind,
        config=arguments.config,
        address=arguments.address,
        scene=arguments.scene,
        seed=scene_seed,
        engine=arguments.engine,
        world=arguments.world or "world",
        latency=arguments.latency,
        loss=arguments.loss,
        stop_force=arguments.stop_force,
        truth=arguments.truth,
        control=arguments.control,
        boards=BoardsRequest(ptys=tuple(arguments.pty), seed=seed),
        bus=bus_config(arguments, BusTable(), "tool") if arguments.world else None,
    )
    with _world_errors():
        try:
            planned = plan_robot(request)
        except ValueError as error:
            raise CommandError(str(error)) from error
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        request_real_time(CONTROLLER_PRIORITY)
        return _serve(planned, arguments)


def replay(arguments: argparse.Namespace) -> int:
    """``simdevice replay``."""
    from sim_device.board.recorded import RecordingError, ReplayBoard, load
    from sim_device.faults import FaultPlan
    from sim_device.ports import PtyPort
    from sim_device.ports_plan import Planned
    from sim_device.runner import ReplayServer

    try:
        recording = load(arguments.recording)
    except RecordingError as error:
        raise CommandError(str(error)) from error
    except OSError as error:
        raise CommandError(f"{arguments.recording}: cannot be read ({error.strerror})") from error
    try:
        faults = FaultPlan.parse(arguments.faults)
        board = ReplayBoard(recording, arguments.speed, arguments.loop, faults)
    except ValueError as error:
        raise CommandError(str(error)) from error
    seconds = float(recording.seconds[-1]) / arguments.speed
    line = (
        f"{recording.magnetometers} magnetometers, {len(board)} rows, {seconds:.1f} s; "
        "begins when a host reads"
    )
    link = arguments.pty
    server = ReplayServer(PtyPort(link), board)
    plan = Planned(server, str(link), f"tactiled --port {link} --kind anyskin", (line,))
    return _serve([plan], arguments)


def calibration(arguments: argparse.Namespace) -> int:
    """``simdevice calibration``."""
    from dataclasses import replace

    from sim_device.board.catalogue import factory_calibration, identity
    from tactile_core.calibration import CalibrationError, load, save

    if len(arguments.serial) > 1:
        raise CommandError("more than one --serial given; a calibration is of one board")
    seed = arguments.seed
    own = identity(arguments.kind, seed).unique_id
    serial_number = (arguments.serial[0] if arguments.serial else own).hex()
    out: Path = arguments.out
    if out.exists() and not arguments.force:
        try:
            ours = load(out).serial_number == serial_number
        except CalibrationError:
            ours = False
        if not ours:
            raise CommandError(
                f"{out} exists and is not a calibration of board {serial_number}; give another "
                "file or --force"
            )
    try:
        with working(f"pressing every taxel of {arguments.kind} {serial_number}"):
            calibration = factory_calibration(arguments.kind, seed, arguments.arrays)
    except ValueError as error:
        raise CommandError(str(error)) from error
    try:
        save(replace(calibration, serial_number=serial_number), out)
    except CalibrationError as error:
        raise CommandError(str(error), REFUSED) from error
    print(f"{out}: calibration of {arguments.kind} {serial_number} (seed {seed})")
    return DONE


def _serve(planned: Sequence[Planned], arguments: argparse.Namespace) -> int:
    """Open the ports, print where they are, and run until told to end or until done."""
    from sim_device.runner import Runner
    from sim_device.status import StatusLine

    shutdown: Shutdown = arguments.shutdown or Shutdown()
    # Set before the first port opens: a signal after that must still remove the links.
    shutdown.orderly = True
    runner = Runner([plan.server for plan in planned])
    status = StatusLine(planned)
    try:
        _open(runner)
        for plan in planned:
            _announce(plan)
        gc.collect()
        gc.freeze()  # boards live as long as the process: the collector need not scan them
        with status:
            runner.run(shutdown.requested.is_set, arguments.duration, status.show_at)
    finally:
        runner.close()
    status.sum_up()
    return DONE


def _open(runner: Runner) -> None:
    from sim_device.ports import LinkRefused
    from sim_device.robots.sockets import SocketError
    from tactile_core.bus.session import BusError
    from tactile_core.can_bus import CanUnavailable, Trouble

    try:
        runner.open()
    except (BusError, SocketError) as error:
        raise CommandError(str(error), REFUSED) from error
    except LinkRefused as error:
        remedy = "give another path, or remove it yourself" if error.foreign else "end that one"
        code = USAGE if error.foreign else REFUSED
        raise CommandError(f"{error}; {remedy}", code) from error
    except CanUnavailable as error:
        code = USAGE if error.trouble is Trouble.UNSUITABLE else REFUSED
        raise CommandError(str(error), code) from error
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _refuse_link(where, error)


def _refuse_link(where: str, error: OSError) -> NoReturn:
    raise CommandError(
        f"{where}cannot make the port ({error.strerror}); give a path in a folder that exists and "
        "that you may write to",
        REFUSED,
    ) from error


def _announce(plan: Planned) -> None:
    for line in plan.lines:
        print(f"{plan.name}: {line} → {plan.connect}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
