"""An emulated robot behind armd's guard on virtual time: what is between reachd and a real robot,
without the vendor's client, the network and the load of the machine.

What `tactile arm-scenes --lockstep` reaches with: force law, watches and limits are judged here
without a busy machine's stalls.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np

from armd.driver import Float, RobotState
from armd.frames import Plane, Transform, frame_from_points, rotation_matrix
from armd.guard import FACTORY, Guard
from sim_device.robots.plant import STEP_NS, Mount, Plant
from sim_device.world.base import World
from tactile_core.bus.commanding import Order
from tactile_core.types import NS_PER_S, ArmLimits, ArmState, Instant, Twist, after

COMMANDER: Final = "reach"

STATE_NS: Final = 8_000_000
"""Time between two states, and between two commands to the robot: 125 Hz."""

DELAY_NS: Final = 4_000_000
"""Time that a command and a state take to arrive: p99 of a quiet machine."""

ACCELERATION: Final = 10.0
"""m/s² with which the robot starts and stops, as in `tactile_tools.reach.one_reach`."""


class GuardedArm:
    """Arm of ``world`` from ``start`` on, as `sim_device.arm.arm.SimulatedArm` is one."""

    def __init__(self, world: World, start: Instant, acceleration: float = ACCELERATION) -> None:
        points = ((0.4, -0.2, 0.3), (0.4, -0.5, 0.3), (0.6, -0.2, 0.3), (0.0, 0.0, 1.0))
        cupboard = frame_from_points(*(np.array(p) for p in points))
        turn = rotation_matrix(np.array([0.0, -math.pi / 2, 0.0]))
        pivot = Transform(np.array([0.0, 0.03, 0.02]), turn)
        begin = world.scene.start
        mount = Mount(cupboard, pivot)
        self.plant = Plant(mount, (begin.x, begin.y, begin.heading), world, acceleration)
        self.guard = Guard(Plane(cupboard, pivot), FACTORY)
        self._clock = start
        self._next_state = start
        self._next_move = start
        self._sequence = 0
        self._heard: deque[tuple[Instant, Order]] = deque()
        self._sent: deque[tuple[Instant, Float | None]] = deque()
        self._seen: deque[tuple[Instant, RobotState]] = deque()

    def request_limits(self, limits: ArmLimits) -> ArmLimits:
        """Ask for ``limits``; returns those in force."""
        return self.guard.request_limits(limits, COMMANDER)

    def command(self, twist: Twist, now: Instant, expiry: float) -> bool:
        """Move at ``twist`` until ``expiry`` s from ``now``, or the next command."""
        self._sequence += 1
        order = Order(twist, COMMANDER, self._sequence, now, after(now, expiry))
        self._heard.append((now, order))
        return self.guard.latch is None

    def advance(self, now: Instant) -> list[ArmState]:
        """Simulate up to ``now`` and return the states that came, in order."""
        states = []
        while self._clock + STEP_NS <= now:
            at = self._clock = Instant(self._clock + STEP_NS)
            while self._sent and self._sent[0][0] <= at:
                velocity = self._sent.popleft()[1]
                self.plant.target = np.zeros(6) if velocity is None else velocity
            self.plant.step()
            if at >= self._next_state:
                self._next_state = Instant(self._next_state + STATE_NS)
                self._seen.append((Instant(at + DELAY_NS), self._measured(at)))
            while self._seen and self._seen[0][0] <= at:
                state = self.guard.see(self._seen.popleft()[1], at)
                if state is not None:
                    states.append(state)
            self._move(at)
        return states

    def _measured(self, at: Instant) -> RobotState:
        m = self.plant.measured()
        return RobotState(at / NS_PER_S, m.position, m.rotation, m.twist, m.wrench)

    def _move(self, at: Instant) -> None:
        """As armd's moving thread: at its rate, and at once when a command has come."""
        if not self._heard and at < self._next_move:
            return
        self._next_move = Instant(at + STATE_NS)
        while self._heard:
            self.guard.obey(self._heard.popleft()[1], at)
        velocity, _ = self.guard.velocity(at)  # nobody asks for its echo
        self._sent.append((Instant(at + DELAY_NS), velocity))
