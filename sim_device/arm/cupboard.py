"""Cupboard in real time: the world and the arm, advanced to whatever instant it is. Pure.

The world keeps to the host's clock. If the process was held up, the missed steps are made up for at
once, in order, so nothing ever jumps: a controller sees old states with their true, old stamps,
then new ones. Beyond `MAX_CATCH_UP_S` the world is suspended for the rest. That is longer than any
command holds: the arm has come to rest before, so nothing moves meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sim_device.arm.arm import STEP_NS, ArmFault, ArmSettings, SimulatedArm
from sim_device.faults import Window
from sim_device.skin.elastomer import Contact
from sim_device.world.base import World
from sim_device.world.touch import on_skin
from tactile_core.geometry import TIP_X
from tactile_core.types import NS_PER_S, ArmLimits, ArmState, Echo, Instant, Twist, seconds_between

COMMAND_EXPIRY_S: Final = 0.045
"""Longest time, s, that a command holds from its receipt, however much of its own expiry is left.
With its braking, the period of states and the way over the bus, an observer sees the arm at rest
within 100 ms of the last command; with 50 ms the longest of twenty times was 101 ms."""

MAX_CATCH_UP_S: Final = 0.25
"""Longest time, s, that is made up for: 3 ms of work, and three times what a command may hold."""


@dataclass(frozen=True, slots=True)
class ScheduledFault:
    """Fault of the arm, in a window of s since the start."""

    kind: ArmFault
    window: Window


class NotNow(Exception):  # noqa: N818 - a request that the present state forbids
    """The arm's state forbids what was asked. The message says why and what to do."""


class Cupboard:
    """World and arm from `begin` on. ``counters``: those of the arm, and of lateness.

    ``late_steps``: physics steps made at least a step after their time. ``suspended_ms``: time in
    which the world stood still because the process did.
    """

    def __init__(
        self,
        world: World,
        settings: ArmSettings,
        faults: Sequence[ScheduledFault],
        rng: np.random.Generator,
    ) -> None:
        self._world = world
        self._settings = settings
        self._faults = tuple(faults)
        self._rng = rng
        self._active: frozenset[ScheduledFault] = frozenset()
        self._arm: SimulatedArm | None = None
        self._start = Instant(0)
        self._suspended = 0
        self._late = {"late_steps": 0, "late_commands": 0}
        self._counted: dict[str, int] = {}
        self.resets = 0

    @property
    def world(self) -> World:
        """World of the present trial."""
        return self._world

    @property
    def arm(self) -> SimulatedArm:
        """The arm; RuntimeError before `begin`."""
        if self._arm is None:
            raise RuntimeError("the cupboard has not begun")
        return self._arm

    @property
    def counters(self) -> dict[str, int]:
        """Counters of all trials together."""
        own = self._late | {"suspended_ms": self._suspended // 1_000_000}
        counts = {} if self._arm is None else self._arm.counters
        return {k: v + self._counted.get(k, 0) for k, v in counts.items()} | own

    @property
    def distance(self) -> float:
        """Distance from the tip to the scene's goal, m."""
        finger, (gx, gy) = self._world.finger(), self._world.scene.goal
        x = finger.x + TIP_X * math.cos(finger.heading)
        y = finger.y + TIP_X * math.sin(finger.heading)
        return math.hypot(gx - x, gy - y)

    def contacts(self) -> list[Contact]:
        """Contacts on the skin now."""
        world = self._world
        return on_skin(world.contacts(), world.scene)

    def heading(self) -> float:
        """Heading of the finger, rad, counter-clockwise from above."""
        return self._world.finger().heading

    def begin(self, now: Instant) -> None:
        """Start the clock of world and arm at ``now``."""
        self._start = now
        self._arm = SimulatedArm(self._world, self._settings, now, self._rng)
        self._apply_faults(0.0)

    def advance(self, now: Instant) -> list[ArmState]:
        """Advance to ``now``. Returns the states received meanwhile, in order."""
        self._apply_faults(seconds_between(self._start, now))
        arm = self.arm
        behind = now - self._suspended - arm.now
        if behind >= 2 * STEP_NS:
            self._late["late_steps"] += behind // STEP_NS - 1
        states: list[ArmState] = []
        excess = behind - round(MAX_CATCH_UP_S * NS_PER_S)
        if excess > 0:
            states = self._advance_arm(Instant(arm.now + behind - excess))
            self._suspended += excess
        return states + self._advance_arm(Instant(now - self._suspended))

    def command(
        self,
        twist: Twist,
        now: Instant,
        waited: float,
        left: float = COMMAND_EXPIRY_S,
        echo: Echo | None = None,
    ) -> bool:
        """Obey ``twist`` for ``left`` s more; False if refused. Call it after `advance` to ``now``.

        The command arrived at most ``waited`` s before ``now``, and holds no longer than if it had
        arrived that early.
        """
        expiry = min(left, COMMAND_EXPIRY_S - waited)
        if expiry <= 0:
            self._late["late_commands"] += 1
            return False
        return self.arm.command(twist, Instant(now - self._suspended), expiry, echo)

    def request_limits(self, limits: ArmLimits) -> ArmLimits:
        """Request ``limits`` of the arm. Returns those in force."""
        return self.arm.request_limits(limits)

    def clear(self) -> str:
        """Enable the arm after a stop. Returns its mode; `NotNow` while the cause remains."""
        if not self.arm.enable():
            raise NotNow(f"the cause of {self.arm.mode!r} is still there: wait until it is gone")
        return self.arm.mode

    def reset(self, world: World) -> None:
        """Go on with ``world``, the arm at its start; limits, faults and stops remain.

        `NotNow` while the arm moves.
        """
        old = self.arm
        if old.mode == "moving":
            raise NotNow("the arm is moving: stop it first")
        for name, count in old.counters.items():
            self._counted[name] = self._counted.get(name, 0) + count
        new = SimulatedArm(world, self._settings, old.now, self._rng)
        new.request_limits(old.limits)
        if old.mode in (ArmFault.FAULT, ArmFault.ESTOP):  # latched even if the cause has gone
            cause = ArmFault(old.mode)
            new.inject(cause)
            new.clear(cause)
        for fault in self._active:
            new.inject(fault.kind)
        self._world, self._arm = world, new
        self.resets += 1

    def _advance_arm(self, simulated: Instant) -> list[ArmState]:
        """States up to an instant of the simulation, restamped with the host's time."""
        states = self.arm.advance(simulated)
        if not self._suspended:
            return states
        gap = self._suspended
        return [
            replace(s, captured=Instant(s.captured + gap), received=Instant(s.received + gap))
            for s in states
        ]

    def _apply_faults(self, seconds: float) -> None:
        """Begin and end the faults that are due."""
        if not self._faults:
            return
        active = frozenset(f for f in self._faults if f.window.covers(seconds))
        if active == self._active:
            return
        kinds, before = {f.kind for f in active}, {f.kind for f in self._active}
        for kind in sorted(kinds - before):
            self.arm.inject(kind)
        for kind in sorted(before - kinds):
            self.arm.clear(kind)
        self._active = active
