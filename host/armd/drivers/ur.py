"""Universal Robots through `ur_rtde` (e-series and CB3 with RTDE; the robot in remote control).

Facts that shaped it, seen with ur_rtde 1.6.5: without `setWatchdog` a robot whose client was
killed goes on for ever; the default of 10 Hz is too slow for 0.1 s to rest; every `speedL` kicks
the watchdog; control and receive are two connections, so all that is read comes from one;
`isConnected` stays true for a frozen server, so age is told by the robot's own time stamp; after
any stop the uploaded program is gone, and only an operator's request brings it back.
"""

from __future__ import annotations

import contextlib
import socket
import time
from typing import Any, Final

import dashboard_client
import numpy as np
import rtde_control
import rtde_receive

from armd.config import ArmConfig
from armd.driver import DriverError, Float, RobotFacts, RobotMode, RobotState
from armd.frames import rotation_matrix
from tactile_core.types import ArmLimits

RTDE_PORT: Final = 30004
DASHBOARD_PORT: Final = 29999
PROBE: Final = 2.0
"""s for a robot to take a connection."""

POLL: Final = 0.001
"""s between looks for a new state."""

PATIENCE: Final = 0.02
"""s that `read` waits for one."""

STATES: Final = 125.0
"""Hz of states."""

VARIABLES: Final = [
    "timestamp",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "robot_status_bits",
    "safety_status_bits",
    "payload",
]

PROGRAM_RUNNING: Final = 1 << 1
PROTECTIVE: Final = 1 << 2
SAFEGUARD: Final = 1 << 4
EMERGENCY: Final = 1 << 5 | 1 << 6 | 1 << 7
VIOLATION: Final = 1 << 8 | 1 << 9
"""Bits of ``robot_status_bits`` and ``safety_status_bits``."""

STATUSES: Final = (
    (EMERGENCY, RobotMode.ESTOP, "emergency stop: release the button, then power and brakes on"),
    (SAFEGUARD, RobotMode.ESTOP, "safeguard stop: close the guard and reset it at the robot"),
    (VIOLATION, RobotMode.FAULT, "safety violation or fault: look at the pendant"),
    (PROTECTIVE, RobotMode.FAULT, "protective stop: look what the robot met"),
)


class UrDriver:
    """See `armd.driver.Driver`."""

    note = (
        "proven against an emulator with the vendor's own client; never moved on a real robot, see "
        "docs/arm.md"
    )

    def __init__(self, config: ArmConfig) -> None:
        self._robot = config.robot
        self.rate = config.robot.rate
        self.braking = config.robot.acceleration
        self.holds = 1 / config.robot.watchdog
        self._control: Any = None
        self._receive: Any = None
        self._dashboard: Any = None
        self._stamp = -1.0
        self._running = True
        self._watched = False

    def connect(self) -> RobotFacts:
        """Dashboard, receive, then the program that takes velocities, with its watchdog."""
        address = self._robot.address
        _probe(address, RTDE_PORT)
        _probe(address, DASHBOARD_PORT)
        try:
            self._dashboard = dashboard_client.DashboardClient(address)
            self._dashboard.connect(2000)
            if not self._dashboard.isInRemoteControl():
                raise DriverError(
                    f"the robot at {address} is in local mode: switch the pendant to remote control"
                )
            self._receive = rtde_receive.RTDEReceiveInterface(address, STATES, VARIABLES)
            status = _status(self._receive)
            if status is not None:
                raise DriverError(f"the robot at {address} does not start: {status[1]}")
            self._control = rtde_control.RTDEControlInterface(address, 500.0)
            tool = np.array(self._control.getTCPOffset())
            payload = float(self._receive.getPayload())
        except RuntimeError as error:
            raise DriverError(
                f"the robot at {address} does not take our program ({error}): is it powered, with "
                "brakes released and in remote control?"
            ) from error
        return RobotFacts(
            f"Universal Robots at {address}",
            tool_position=tool[:3],
            tool_rotation=tool[3:],
            payload=payload,
        )

    def read(self) -> RobotState | None:
        """The newest state, by its own time stamp."""
        receive = self._receive
        deadline = time.monotonic() + PATIENCE
        while (stamp := receive.getTimestamp()) == self._stamp:
            if time.monotonic() > deadline:
                return None
            time.sleep(POLL)
        self._stamp = stamp
        pose = np.array(receive.getActualTCPPose())
        mode, detail = _status(receive) or (RobotMode.READY, "")
        if mode is RobotMode.READY and not receive.getRobotStatus() & PROGRAM_RUNNING:
            mode, detail = RobotMode.STOPPED, "its program was stopped: armd's own has to run"
        self._running = mode is RobotMode.READY
        return RobotState(
            float(stamp),
            pose[:3],
            rotation_matrix(pose[3:]) if np.isfinite(pose).all() else np.full((3, 3), np.nan),
            np.array(receive.getActualTCPSpeed()),
            np.array(receive.getActualTCPForce()),
            mode,
            detail,
        )

    def move(self, velocity: Float) -> None:
        """`speedL`, which kicks the watchdog."""
        if not self._running:
            return  # the library would wait for a program that is gone
        try:
            if not self._watched:
                # Not before the loop that kicks it runs; the robot has not moved until then.
                self._watched = bool(self._control.setWatchdog(self._robot.watchdog))
            self._control.speedL(velocity.tolist(), self.braking, 0.0)
        except RuntimeError as error:
            raise DriverError(f"the robot no longer takes commands: {error}") from error

    def halt(self) -> None:
        """Velocity zero: `speedStop` would wait until it rests."""
        self.move(np.zeros(6))

    def limit(self, limits: ArmLimits) -> None:
        """The controller's own limits are part of its safety configuration, under a password."""

    def recover(self) -> None:
        """Unlock a protective stop and bring our program back."""
        dashboard, control = self._dashboard, self._control
        try:
            if not dashboard.isConnected():
                dashboard.connect(2000)
            found = _status(self._receive)
            if found is not None and found[1].startswith("protective"):
                dashboard.closeSafetyPopup()
                dashboard.unlockProtectiveStop()
                _wait(lambda: _status(self._receive) is None, 1.0)
                found = _status(self._receive)
            if found is not None:
                raise DriverError(found[1])
            if not control.isConnected():
                control.reconnect()
            if not self._receive.isConnected():
                self._receive.reconnect()
            if not self._receive.getRobotStatus() & PROGRAM_RUNNING:
                control.reuploadScript()
                _wait(lambda: bool(self._receive.getRobotStatus() & PROGRAM_RUNNING), 2.0)
            self._watched = bool(control.setWatchdog(self._robot.watchdog))
        except RuntimeError as error:
            raise DriverError(
                f"the robot does not recover ({error}): a protective stop may be unlocked 5 s "
                "after it at the earliest"
            ) from error
        self._running = True

    def zero_force(self) -> None:
        """Zero the sensor in the wrist."""
        self._control.zeroFtSensor()

    def close(self) -> None:
        """End our program; the robot rests."""
        for part, ends in (
            (self._control, "stopScript"),
            (self._control, "disconnect"),
            (self._receive, "disconnect"),
            (self._dashboard, "disconnect"),
        ):
            if part is not None:
                with contextlib.suppress(RuntimeError):
                    getattr(part, ends)()


def _probe(address: str, port: int) -> None:
    try:
        socket.create_connection((address, port), PROBE).close()
    except OSError as error:
        raise DriverError(
            f"no robot at {address}:{port} ({error.strerror or error}): look at [robot] address, "
            "cable and whether it is switched on"
        ) from error


def _status(receive: Any) -> tuple[RobotMode, str] | None:
    bits = receive.getSafetyStatusBits()
    for mask, mode, words in STATUSES:
        if bits & mask:
            return mode, words
    return None


def _wait(done: Any, seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while not done() and time.monotonic() < deadline:
        time.sleep(0.01)
