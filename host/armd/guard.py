"""What armd lets a robot do: limits, expiry, and what latches it. Pure.

Every driver is behind one `Guard`. When in doubt, the robot rests. Errors of the robot or of its
states latch: nothing moves until an operator asks to clear them, once the cause is gone.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import Final

from armd.driver import Float, RobotMode, RobotState
from armd.frames import Planar, Plane
from tactile_core.bus.commanding import Order
from tactile_core.types import (
    NS_PER_S,
    ZERO,
    ArmLimits,
    ArmState,
    Echo,
    Instant,
    RemoteClock,
    Twist,
    after,
    seconds_between,
)

HOLD: Final = 0.045
"""s for which a command holds from its receipt at most, as at the simulated arm."""

STALE: Final = 0.05
"""s without a new state of the robot after which it is told to rest."""

SILENT: Final = 0.15
"""s of the same after which it is latched."""

UNANSWERED: Final = 0.15
"""s that a call of the robot's library may take before the robot is taken to be lost."""

RISE: Final = 0.1
"""s in which the speed against what presses may grow from nothing to the limit."""

SLIDES: Final = 0.8
"""Part of the force limit from which each axis gives way alone: reachd takes it for that, too."""

WATCH_NS: Final = 80_000_000
"""Window over which the way that the robot went is compared with the way it was told."""

DELAYS_NS: Final = tuple(range(0, 70_000_000, 10_000_000))
"""Delays with which it may follow."""

ASTRAY: Final = 0.002
"""m by which the pivot may leave the way that it was told."""

TURNED: Final = 0.02
"""rad of the same."""

PUSHED: Final = 2.0
"""N on the finger that explain why it goes where it is pushed."""

TOO_FAST: Final = 1.5
"""Times its speed limit at which a robot is stopped for good."""

SLACK: Final = 0.01
"""m/s and rad/s that its measured speed may err."""

OFF_PLANE: Final = 0.01
"""m over or under the cupboard's plane in which nothing moves."""

TILTED: Final = math.radians(5)
"""rad between the finger's z and the cupboard's in which nothing moves."""

FACTORY: Final = ArmLimits(v_max=0.25, omega_max=1.0, f_max=100.0, m_max=20.0)
"""Limits that a robot has before any were asked for: those of its own reduced speed."""


@dataclass(frozen=True, slots=True)
class Latch:
    """Why nothing moves until an operator clears it. ``mode``: one of `ArmState`'s."""

    mode: str
    reason: str


@dataclass(frozen=True, slots=True)
class _Active:
    twist: Twist
    until: Instant
    echo: Echo


class Guard:
    """Guard of one robot. Not thread-safe: its owner holds the lock.

    ``caps``: limits beyond which it never goes, whatever is asked. ``steady``: whether the robot's
    clock runs as fast as ours; the age of its states is told by it.
    """

    def __init__(self, plane: Plane, caps: ArmLimits = FACTORY, *, steady: bool = True) -> None:
        self._plane = plane
        self._caps = caps
        self._limits = caps
        self._limited_for: str | None = None
        self._clock = RemoteClock() if steady else None
        self._latch: Latch | None = None
        self._robot: RobotState | None = None
        self._state: ArmState | None = None
        self._seen = Instant(0)  # capture of the newest state
        self._heard = Instant(0)  # its arrival
        self._active: _Active | None = None
        self._echo: Echo | None = None
        self._expired = False
        self._yielded = Instant(0)
        self._room = [(math.inf, math.inf)] * 3  # m/s, rad/s that each axis may go, up and down
        self._told: deque[tuple[Instant, Twist]] = deque(maxlen=256)
        self._went: deque[tuple[Instant, float, float, float]] = deque(maxlen=64)
        self.counters: Counter[str] = Counter(
            accepted=0, clamped=0, expired=0, not_finite=0, not_enabled=0, no_limits=0, repeated=0
        )

    @property
    def latch(self) -> Latch | None:
        """Why nothing moves, None where it may."""
        return self._latch

    @property
    def limits(self) -> ArmLimits:
        """Limits in force."""
        return self._limits

    @property
    def state(self) -> ArmState | None:
        """The newest, as `mode` is now; None before the first."""
        return self._state

    @property
    def mode(self) -> str:
        """One of the modes of `ArmState`."""
        if self._latch is not None:
            return self._latch.mode
        if self._active is not None and self._active.twist != ZERO:
            return "moving"
        return "stopped" if self._expired else "ready"

    def request_limits(self, limits: ArmLimits, commander: str) -> ArmLimits:
        """Keep ``limits`` where the caps allow it; returns those in force."""
        caps = self._caps
        self._limits = ArmLimits(
            v_max=min(limits.v_max, caps.v_max),
            omega_max=min(limits.omega_max, caps.omega_max),
            f_max=min(limits.f_max, caps.f_max),
            m_max=min(limits.m_max, caps.m_max),
        )
        self._limited_for = commander
        return self._limits

    def forget_limits(self) -> None:
        """The robot did not take the limits: nothing moves before it has taken some."""
        self._limited_for = None
        self._active = None

    def stop(self, mode: str, reason: str) -> bool:
        """Latch; True where it is news. An e-stop outranks what was latched before."""
        news = self._latch is None or (mode == "estop" != self._latch.mode)
        if news:
            self._latch = Latch(mode, reason)
        self._active = None
        return news

    def clear(self, now: Instant) -> str | None:
        """Let it move again, an operator having asked; returns why not, None when it may."""
        robot = self._robot
        if robot is None or seconds_between(self._heard, now) > STALE:
            return "the robot sends no states"
        if robot.mode is not RobotMode.READY:
            return robot.detail or f"the robot says {robot.mode}"
        problem = self._out_of_plane(robot) if _finite(robot) else "its state is not finite"
        if problem is not None:
            return problem
        self._latch = None
        self._expired = False
        self._clock = None if self._clock is None else RemoteClock()
        self._told.clear()
        self._went.clear()
        return None

    def obey(self, order: Order, now: Instant) -> None:
        """Take the commander's newest command, which came at ``now``."""
        twist = order.twist
        if self._latch is not None:
            self.counters["not_enabled"] += 1
            return
        if not all(math.isfinite(v) for v in (twist.vx, twist.vy, twist.omega)):
            self.counters["not_finite"] += 1
            self._active, self._expired = None, True
            return
        if twist != ZERO and self._limited_for != order.commander:
            self.counters["no_limits"] += 1  # it has asked for none: it would not know them
            twist = ZERO
        held = self._within_limits(twist)
        until = min(order.expires, after(now, HOLD))
        self._active = _Active(held, until, Echo(order.commander, order.sequence, order.decided))
        self._expired = False
        self.counters["accepted"] += 1

    def see(self, robot: RobotState, now: Instant) -> ArmState | None:
        """Take a state that arrived at ``now``; None where it is an old one or not finite."""
        if self._robot is not None and robot.robot_time <= self._robot.robot_time:
            if robot.robot_time < self._robot.robot_time - 1.0:
                self._clock = None if self._clock is None else RemoteClock()
                self.stop("fault", "the robot's clock went back: it was started anew")
                self._robot = None
            else:
                self.counters["repeated"] += 1
                return None
        if not _finite(robot):
            self.counters["not_finite"] += 1
            self.stop("fault", "the robot's state holds NaN or infinity")
            self._robot, self._seen, self._heard = robot, now, now
            return None
        captured = now
        if self._clock is not None:
            captured = self._clock.here(round(robot.robot_time * NS_PER_S), now)
        self._robot, self._seen, self._heard = robot, captured, now
        if robot.mode is not RobotMode.READY:
            self.stop(robot.mode.value, robot.detail or f"the robot says {robot.mode}")
        planar = self._plane.planar(robot)
        self._watch(captured, planar)
        if self.moving:
            problem = self._out_of_plane(robot)
            if problem is not None:
                self.stop("fault", problem)
        limits = self._limits
        self._state = ArmState(
            captured=captured,
            received=now,
            x=planar.x,
            y=planar.y,
            heading=planar.heading,
            twist=planar.twist,
            fx=planar.fx,
            fy=planar.fy,
            mz=planar.mz,
            mode=self.mode,
            v_max=limits.v_max,
            omega_max=limits.omega_max,
            f_max=limits.f_max,
            m_max=limits.m_max,
            echo=self._echo,
        )
        return self._state

    @property
    def moving(self) -> bool:
        """Whether it is told to move."""
        return self._active is not None and self._active.twist != ZERO

    def check(self, now: Instant, call_lasts: float) -> bool:
        """Check for missing states and for a call that has lasted ``call_lasts`` s; True if it
        latches now."""
        if call_lasts > UNANSWERED:
            return self.stop(
                "fault", f"the robot's library has not answered for {call_lasts:.2f} s"
            )
        if self._robot is not None and (age := seconds_between(self._seen, now)) > SILENT:
            return self.stop("fault", f"no new state of the robot for {age:.2f} s")
        return False

    def velocity(self, now: Instant) -> tuple[Float | None, Echo | None]:
        """(6,) of the tool centre to send at ``now``, None for rest; and what it answers."""
        active, robot = self._active, self._robot
        if active is not None and active.until <= now:
            self._active = active = None
            self._expired = True
            self.counters["expired"] += 1
        fresh = robot is not None and seconds_between(self._seen, now) <= STALE
        if active is None or robot is None or self._latch is not None:
            self._told.append((now, ZERO))
            return None, None
        if not fresh or active.twist == ZERO:
            self._told.append((now, ZERO))
            return None, active.echo
        twist = self._yielding(active.twist, now)
        self._told.append((now, twist))
        return self._plane.velocity(twist, robot), active.echo

    def sent(self, echo: Echo | None) -> None:
        """What `velocity` gave last has reached the robot."""
        if echo is not None:
            self._echo = echo

    def _within_limits(self, twist: Twist) -> Twist:
        limits = self._limits
        speed = math.hypot(twist.vx, twist.vy)
        scale = min(1.0, limits.v_max / speed) if speed > 0 else 1.0
        omega = min(max(twist.omega, -limits.omega_max), limits.omega_max)
        if scale < 1.0 or omega != twist.omega:
            self.counters["clamped"] += 1
        return Twist(twist.vx * scale, twist.vy * scale, omega)

    def _yielding(self, twist: Twist, now: Instant) -> Twist:
        """``twist``, slowed against what presses, never turned back.

        A robot is stiff; this makes it as soft as the simulated arm, which pushes with its limit
        of force at most: v ≤ v_max (f_max + f) / f_max against a force f < 0, on each axis alone.
        The bound falls at once and rises slowly, else it would strike again and again.
        """
        state, limits = self._state, self._limits
        if state is None:
            return ZERO
        passed = min(seconds_between(self._yielded, now), RISE)
        self._yielded = now
        loads = (
            (twist.vx, state.fx, limits.f_max, limits.v_max),
            (twist.vy, state.fy, limits.f_max, limits.v_max),
            (twist.omega, state.mz, limits.m_max, limits.omega_max),
        )
        kept = []
        for axis, (speed, force, force_limit, speed_limit) in enumerate(loads):
            rise = speed_limit * passed / RISE
            high = max(0.0, (force_limit + force) / force_limit * speed_limit)
            low = max(0.0, (force_limit - force) / force_limit * speed_limit)
            was_high, was_low = self._room[axis]
            high = min(high, was_high + rise, speed_limit)
            low = min(low, was_low + rise, speed_limit)
            self._room[axis] = (high, low)
            kept.append(min(max(speed, -low), high))
        at_limit = max(abs(state.fx), abs(state.fy)) >= SLIDES * limits.f_max
        if not at_limit:
            # Slower, but the way it was told; only at its limit it slides along what it meets.
            part = min(
                (k / v for k, v in zip(kept[:2], (twist.vx, twist.vy), strict=True) if v), default=1
            )
            kept[:2] = [twist.vx * part, twist.vy * part]
        return Twist(*kept)

    def _out_of_plane(self, robot: RobotState) -> str | None:
        planar = self._plane.planar(robot)
        if abs(planar.height) > OFF_PLANE:
            return (
                f"the pivot is {planar.height * 1e3:.0f} mm from the taught plane, at most "
                f"{OFF_PLANE * 1e3:.0f}: jog it there, or teach the frame again"
            )
        if planar.tilt > TILTED:
            return (
                f"the finger leans by {math.degrees(planar.tilt):.0f}°, at most "
                f"{math.degrees(TILTED):.0f}: jog it level, or mend [tool] pivot_rotation"
            )
        return None

    def out_of_plane(self) -> str | None:
        """Why the robot cannot begin where it is; None where it can."""
        return None if self._robot is None else self._out_of_plane(self._robot)

    def _watch(self, at: Instant, planar: Planar) -> None:
        """Latch where it goes elsewhere than told, or too fast."""
        went, twist = self._went, planar.twist
        x, y, heading, fx, fy = planar.x, planar.y, planar.heading, planar.fx, planar.fy
        went.append((at, x, y, heading))
        limits = self._limits
        speed = math.hypot(twist.vx, twist.vy)
        if (
            speed > TOO_FAST * limits.v_max + SLACK
            or abs(twist.omega) > TOO_FAST * limits.omega_max + SLACK
        ):
            self.stop(
                "fault", f"the robot moves at {speed:.3f} m/s, {twist.omega:.3f} rad/s: too fast"
            )
        while len(went) > 2 and went[1][0] <= at - WATCH_NS:
            went.popleft()
        begin, x0, y0, h0 = went[0]
        if begin > at - WATCH_NS or not self._told:
            return
        moved = (x - x0, y - y0, math.remainder(heading - h0, math.tau))
        off, turned, dx, dy = math.inf, math.inf, 0.0, 0.0
        for delay in DELAYS_NS:
            way = self._way(Instant(begin - delay), Instant(at - delay))
            aside, around, ax, ay = _off(moved, way)
            turned = min(turned, around)
            if aside < off:
                off, dx, dy = aside, ax, ay
        pushed = math.hypot(fx, fy) > PUSHED and fx * dx + fy * dy > 0
        if (off > ASTRAY and not pushed) or (turned > TURNED and math.hypot(fx, fy) <= PUSHED):
            self.stop(
                "fault",
                f"the robot went {off * 1e3:.1f} mm and {math.degrees(turned):.1f}° beside what it "
                "was told within 0.08 s: look at its frames, tool and speed slider",
            )

    def _way(self, begin: Instant, end: Instant) -> tuple[float, float, float]:
        """Path told between two instants."""
        x = y = h = 0.0
        told = self._told
        until = end
        for at, twist in reversed(told):
            start = max(at, begin)
            if start < until:
                dt = (until - start) / NS_PER_S
                x += twist.vx * dt
                y += twist.vy * dt
                h += twist.omega * dt
                until = start
            if at <= begin:
                break
        return x, y, h


def _finite(robot: RobotState) -> bool:
    total = (
        float(robot.position.sum())
        + float(robot.rotation.sum())
        + float(robot.twist.sum())
        + float(robot.wrench.sum())
        + robot.robot_time
    )
    return math.isfinite(total)


def _off(
    moved: tuple[float, float, float], way: tuple[float, float, float]
) -> tuple[float, float, float, float]:
    """m and rad that ``moved`` ends beside the straight ``way``, and the m in x and y."""
    mx, my, mh = moved
    x, y, h = way
    square = x * x + y * y
    part = min(1.0, max(0.0, (mx * x + my * y) / square)) if square > 0.0 else 0.0
    dx, dy = mx - part * x, my - part * y
    low, high = min(0.0, h), max(0.0, h)
    return math.hypot(dx, dy), max(low - mh, mh - high, 0.0), dx, dy
