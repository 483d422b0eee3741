"""Simulated arm: the interface of a real arm's driver on top of a `World`.

Pure: time is passed in, and whoever owns the threads calls `SimulatedArm.advance`.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np

from sim_device.world.base import PHYSICS_STEP, FingerState, World
from tactile_core.types import (
    NS_PER_S,
    ZERO,
    ArmLimits,
    ArmState,
    Echo,
    Instant,
    Twist,
    after,
    record,
)

STEP_NS: Final = round(PHYSICS_STEP * NS_PER_S)

MAX_EXPIRY_S: Final = 0.075
"""Longest time, s, that a command holds. Braking takes up to 20 ms, so the arm rests within 100 ms
of its last command."""

DEFAULT_EXPIRY_S: Final = 0.05
"""Seconds that a command holds by default: five cycles of a controller at 100 Hz."""

MAX_PENDING: Final = 64
"""Most commands on their way to the joints: 100 a second at a latency of half a second."""

MAX_UNREAD: Final = 400
"""Most states not yet fetched: one second at the highest rate. Older ones are of no use."""

FAST: Final = 5.0
"""Factor by which an arm with the fault ``FAST`` moves too fast."""

FACTORY_LIMITS: Final = ArmLimits(v_max=0.5, omega_max=1.0, f_max=100.0, m_max=20.0)
"""Limits of an arm that nobody has set up: ten times too much for a cupboard (v_max and ω_max are
the defaults of Flexiv's RDK; force and moment are ours)."""


class ArmFault(StrEnum):
    """What may go wrong with an arm.

    ``SILENT``: no state is sent. ``FROZEN``: states with fresh stamps and old values. ``STALE``:
    the same state over and over, stamps included. ``BIASED``: a constant wrench is added.
    ``REFUSES_LIMITS``: keeps and confirms its own limits. ``BACKWARDS``, ``SIDEWAYS``: moves so
    because it is mounted the wrong way round. ``FAST``: moves `FAST` times as fast as commanded.
    ``FAULT``: the drives have failed and brake. ``ESTOP``: the button is pressed.
    """

    SILENT = "silent"
    FROZEN = "frozen"
    STALE = "stale"
    BIASED = "biased"
    REFUSES_LIMITS = "refuses_limits"
    BACKWARDS = "backwards"
    SIDEWAYS = "sideways"
    FAST = "fast"
    FAULT = "fault"
    ESTOP = "estop"


@dataclass(frozen=True, slots=True)
class ArmSettings:
    """Rate, latency and noise of the arm and its connection.

    ``state_rate``: Hz, a whole number of physics steps apart. ``command_latency``: s from receipt
    to effect; ``state_latency``: s from capture to receipt. Noise: standard deviations of pose (m,
    rad), twist (m/s, rad/s) and wrench (N, N·m). ``bias``: N, N, N·m in the frame ``ee``, added by
    the fault `BIASED`.
    """

    state_rate: float = 100.0
    command_latency: float = 0.0
    state_latency: float = 0.0
    position_noise: float = 0.0
    heading_noise: float = 0.0
    speed_noise: float = 0.0
    turn_noise: float = 0.0
    force_noise: float = 0.0
    moment_noise: float = 0.0
    bias: tuple[float, float, float] = (3.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check rates and figures; ValueError."""
        period = NS_PER_S / self.state_rate if self.state_rate > 0 else math.nan
        if not (self.state_rate >= 100 and abs(period / STEP_NS - round(period / STEP_NS)) < 1e-9):
            raise ValueError(
                f"state_rate is {self.state_rate} Hz; it must be 100 or 200, a whole number of "
                f"physics steps of {PHYSICS_STEP} s"
            )
        for name in (
            "command_latency",
            "state_latency",
            "position_noise",
            "heading_noise",
            "speed_noise",
            "turn_noise",
            "force_noise",
            "moment_noise",
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} is {value}; it must be finite and not negative")
        if not all(math.isfinite(b) for b in self.bias):
            raise ValueError(f"bias {self.bias} is not finite")


@record
class _Command:
    """Twist, the instant it takes effect and the instant it expires; ``echo`` identifies it."""

    twist: Twist
    effective: Instant
    expires: Instant
    echo: Echo | None


class SimulatedArm:
    """Planar velocity-controlled arm whose wrist pivot carries the finger of ``world``.

    It runs on the physics grid from ``start`` on, and begins with `FACTORY_LIMITS`; others are set
    with `request_limits`. ``rng`` is drawn from only if ``settings`` has noise. ``counters``:
    commands by what became of them, and states that nobody fetched.
    """

    def __init__(
        self, world: World, settings: ArmSettings, start: Instant, rng: np.random.Generator
    ) -> None:
        self._world = world
        self._settings = settings
        self._rng = rng
        self._clock = start
        self._period = round(NS_PER_S / settings.state_rate / STEP_NS) * STEP_NS
        self._next_state = Instant(start + self._period)
        self._pending: deque[_Command] = deque()
        self._active: _Command | None = None
        self._echo: Echo | None = None
        self._unread: deque[ArmState] = deque()
        self._faults: frozenset[ArmFault] = frozenset()
        self._latched: str | None = None
        self._stopped_itself = False
        self._limits = FACTORY_LIMITS
        self._noise = np.array(
            [
                settings.position_noise,
                settings.position_noise,
                settings.heading_noise,
                settings.speed_noise,
                settings.speed_noise,
                settings.turn_noise,
                settings.force_noise,
                settings.force_noise,
                settings.moment_noise,
            ]
        )
        self._noisy = bool(self._noise.any())
        self._last: ArmState | None = None
        self.counters = {
            "accepted": 0,
            "clamped": 0,
            "not_finite": 0,
            "bad_expiry": 0,
            "not_enabled": 0,
            "overflow": 0,
            "expired": 0,
            "states_lost": 0,
        }
        world.limit_wrench(self._limits.f_max, self._limits.m_max)

    @property
    def world(self) -> World:
        """World in which the arm moves."""
        return self._world

    @property
    def now(self) -> Instant:
        """Instant up to which it has been simulated."""
        return self._clock

    @property
    def limits(self) -> ArmLimits:
        """Limits in force, as every state confirms them."""
        return self._limits

    @property
    def mode(self) -> str:
        """Mode, one of those of `ArmState`."""
        if self._latched is not None:
            return self._latched
        if self._active is not None and self._active.twist != ZERO:
            return "moving"
        return "stopped" if self._stopped_itself else "ready"

    def request_limits(self, limits: ArmLimits) -> ArmLimits:
        """Request ``limits``. Returns those now in force, which may differ."""
        if ArmFault.REFUSES_LIMITS not in self._faults:
            rated = FACTORY_LIMITS
            self._limits = ArmLimits(
                v_max=min(limits.v_max, rated.v_max),
                omega_max=min(limits.omega_max, rated.omega_max),
                f_max=min(limits.f_max, rated.f_max),
                m_max=min(limits.m_max, rated.m_max),
            )
            self._world.limit_wrench(self._limits.f_max, self._limits.m_max)
        return self._limits

    def command(
        self,
        twist: Twist,
        now: Instant,
        expiry: float = DEFAULT_EXPIRY_S,
        echo: Echo | None = None,
    ) -> bool:
        """Move at ``twist`` until ``expiry`` s from ``now``, or until the next command.

        ``echo``: what states report of the command once it is in force. Longer expiries are cut to
        `MAX_EXPIRY_S`, speeds to the limits.

        Returns False, counts the command and stops the arm where it refuses: a twist that is not
        finite, an expiry that is not finite or not above 0, or an arm that is not enabled.
        """
        if not (math.isfinite(twist.vx) and math.isfinite(twist.vy) and math.isfinite(twist.omega)):
            return self._refuse("not_finite")
        if not (math.isfinite(expiry) and expiry > 0):
            return self._refuse("bad_expiry")
        if self._latched is not None:
            return self._refuse("not_enabled")
        expiry = min(expiry, MAX_EXPIRY_S)
        effective = after(now, self._settings.command_latency)
        if len(self._pending) == MAX_PENDING:
            self._pending.popleft()
            self.counters["overflow"] += 1
        held = self._within_limits(twist)
        self._pending.append(_Command(held, effective, after(now, expiry), echo))
        self.counters["accepted"] += 1
        return True

    def advance(self, now: Instant) -> list[ArmState]:
        """Simulate up to ``now`` and return the states received since the last call, in order."""
        while True:
            at = self._clock
            self._take_commands(at)
            end = min(Instant(at + (now - at) // STEP_NS * STEP_NS), self._next_state)
            if end <= at:
                break
            end = self._next_change(at, end)
            target = self._active.twist if self._active is not None else ZERO
            if self._faults:
                target = self._distorted(target)
            self._world.step((end - at) / NS_PER_S, target)
            self._clock = end
            if end == self._next_state:
                self._next_state = Instant(end + self._period)
                self._emit(end)
        received = []
        while self._unread and self._unread[0].received <= now:
            received.append(self._unread.popleft())
        return received

    def inject(self, fault: ArmFault) -> None:
        """Start ``fault``; it lasts until `clear`."""
        self._faults |= {fault}
        if fault in (ArmFault.FAULT, ArmFault.ESTOP):
            # An e-stop outranks a fault: whichever came first, users must see the button.
            self._latched = "estop" if ArmFault.ESTOP in self._faults else "fault"
            self._active = None
            self._pending.clear()

    def clear(self, fault: ArmFault) -> None:
        """End the cause of ``fault``. After a fault or e-stop the arm stays off until `enable`."""
        self._faults -= {fault}

    def enable(self) -> bool:
        """Let the arm go on, as an operator asks. False while the cause of a stop remains."""
        if self._faults & {ArmFault.FAULT, ArmFault.ESTOP}:
            return False
        self._latched = None
        self._stopped_itself = False
        return True

    def _refuse(self, reason: str) -> bool:
        """Count a command that is refused, and stop: its sender is faulty."""
        self.counters[reason] += 1
        self._active = None
        self._pending.clear()
        self._stopped_itself = True
        return False

    def _within_limits(self, twist: Twist) -> Twist:
        """``twist`` slowed down to the limits, in the same direction."""
        limits = self._limits
        speed = math.hypot(twist.vx, twist.vy)
        scale = min(1.0, limits.v_max / speed) if speed > 0 else 1.0
        omega = min(max(twist.omega, -limits.omega_max), limits.omega_max)
        if scale == 1.0 and omega == twist.omega:
            return twist
        self.counters["clamped"] += 1
        return Twist(twist.vx * scale, twist.vy * scale, omega)

    def _distorted(self, twist: Twist) -> Twist:
        """Twist that an arm with faults of mounting or scale makes of ``twist``."""
        if ArmFault.BACKWARDS in self._faults:
            twist = Twist(-twist.vx, -twist.vy, -twist.omega)
        if ArmFault.SIDEWAYS in self._faults:
            twist = Twist(-twist.vy, twist.vx, twist.omega)
        if ArmFault.FAST in self._faults:
            twist = Twist(FAST * twist.vx, FAST * twist.vy, FAST * twist.omega)
        return twist

    def _take_commands(self, at: Instant) -> None:
        """Start and expire the commands that are due at ``at``."""
        while self._pending and self._pending[0].effective <= at:
            self._active = self._pending.popleft()
            self._echo = self._active.echo
            self._stopped_itself = False
        if self._active is not None and self._active.expires < at + STEP_NS:
            # Steps are whole: stopping before the step in which it expires never holds too long.
            self._stopped_itself = True
            self._active = None
            self.counters["expired"] += 1

    def _next_change(self, at: Instant, end: Instant) -> Instant:
        """Last grid instant up to ``end`` until which the command in force at ``at`` stays."""
        if self._pending:
            wait = -((at - self._pending[0].effective) // STEP_NS)
            end = min(end, Instant(at + max(1, wait) * STEP_NS))
        if self._active is not None:
            left = (self._active.expires - at) // STEP_NS
            end = min(end, Instant(at + max(1, left) * STEP_NS))
        return end

    def _emit(self, at: Instant) -> None:
        """Queue the state of ``at`` for sending, as the faults leave it."""
        if ArmFault.SILENT in self._faults:
            return
        received = after(at, self._settings.state_latency)
        if self._last is not None and ArmFault.STALE in self._faults:
            state = replace(self._last, received=received)
        elif self._last is not None and ArmFault.FROZEN in self._faults:
            state = replace(self._last, captured=at, received=received)
        else:
            state = self._measure(self._world.finger(), at, received)
            self._last = state
        if len(self._unread) == MAX_UNREAD:
            self._unread.popleft()
            self.counters["states_lost"] += 1
        self._unread.append(state)

    def _measure(self, finger: FingerState, captured: Instant, received: Instant) -> ArmState:
        """State of the finger as the arm's sensors measure it."""
        twist = finger.twist
        fx, fy, mz = finger.fx, finger.fy, finger.mz
        x, y, heading = finger.x, finger.y, finger.heading
        if self._noisy:
            noise = (self._rng.standard_normal(9) * self._noise).tolist()
            x, y, heading = x + noise[0], y + noise[1], heading + noise[2]
            twist = Twist(twist.vx + noise[3], twist.vy + noise[4], twist.omega + noise[5])
            fx, fy, mz = fx + noise[6], fy + noise[7], mz + noise[8]
        if ArmFault.BIASED in self._faults:
            bx, by, bm = self._settings.bias
            c, s = math.cos(finger.heading), math.sin(finger.heading)
            fx, fy, mz = fx + c * bx - s * by, fy + s * bx + c * by, mz + bm
        limits = self._limits
        return ArmState(
            captured=captured,
            received=received,
            x=x,
            y=y,
            heading=heading,
            twist=twist,
            fx=fx,
            fy=fy,
            mz=mz,
            mode=self.mode,
            v_max=limits.v_max,
            omega_max=limits.omega_max,
            f_max=limits.f_max,
            m_max=limits.m_max,
            echo=self._echo,
        )
