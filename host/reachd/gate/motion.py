"""Compare an arm's motion with its commands: the gate's check of the arm itself.

Commands are integrated to the commanded path; states give the actual path. A command takes effect
at once or up to its expiry later, and may have been lost, so the arm may be anywhere between
standing still and the end of any such path, but not beside it, before it or beyond it. Translation
of the pivot and turning are checked separately, because either may fail alone.
"""

from __future__ import annotations

import math
from bisect import bisect_right

from reachd.gate.settings import Check, SafetySettings
from reachd.interfaces import ArmState, Twist
from tactile_core.types import NS_PER_S, Instant

TOO_FAST = 1.5
"""Multiple of the confirmed limit. Impacts make simulated fingers 1.3 times as fast."""

SPEED_OVER_NS = 30_000_000
"""Time over which speed is measured from the pose: three states at 100 per second."""

TRACK_NS = 100_000_000
"""Window over which the arm must stay on the commanded path."""

OFF_THE_WAY = 0.001
"""m by which it may leave the path in that window: simulated arms do by 0.3 mm in free motion, and
by up to 0.6 mm when hit. An arm at its own force limit gives way: it may be pushed at up to its
speed limit."""

AT_ITS_LIMIT = 0.8
"""Fraction of the arm's own force or torque limit from which it may give way."""

POSE_NOISE = 0.0003
"""m, error of a pose."""

COMMANDED = 0.002
"""m/s at the pivot, and at the tip from turning: slower commands are not checked, because arms do
not follow them well."""

STEADY = 0.7
"""Least distance of a commanded path's ends, as a fraction of its length; a path that turns back
shows little."""

DISAGREES = 0.5
"""Fraction of the commanded path by which the actual one may differ unless a load explains it."""

ASTRAY = 0.002
"""m, least difference for an arm that goes far enough, or too far, to count as astray: an impact
turns a finger by a millimetre at its tip."""

DEAD = 0.1
"""Fraction of the commanded path below which the arm counts as not moving."""

REPORTED = 0.25
"""Fraction of the commanded motion that a twist must report for a constant pose to count as frozen:
a jammed arm reports none."""

CREEP = 0.001
"""m/s, rad/s of reported motion that contradicts a pose that does not change at all."""

SURE = 3.0
"""Standard errors by which the mean of reported rates may be off: a finger that chatters against
objects turns to and fro by ten times the rate that is meant."""

SAME = 1e-5
"""m, rad within which a pose does not change; jammed arms tremble by more."""

DELAYS_NS = tuple(range(10_000_000, 60_000_001, 10_000_000))
"""Delays with which a command may take effect, besides none."""

LONGEST_GAP_NS = 150_000_000
"""Longest gap between states; after a longer one a new window must fill first."""

JUMP = 0.05
"""m between two states that no arm can move: the pose was set anew and does not show motion."""

DRIFT_NS = 1_000_000_000
"""Window over which an arm that touches nothing must follow its commands."""

DRIFTS = 0.002
"""m beside or beyond the commanded path in that window that count as drift. Falling short is
allowed, because commands may be lost."""

KEPT = 512
"""Commands and states kept, at least."""

Finding = tuple[Check, str]
Path = tuple[float, float, float, float, float]
"""x, y m; heading rad; path length m; total turning rad: integrals of commands, or their rates."""


class MotionWatch:
    """Checks the motion of one arm; `add_command` takes every command, `judge` every state."""

    def __init__(self, settings: SafetySettings) -> None:
        self._s = settings
        self._long_ns = round(settings.frozen_after * NS_PER_S)
        self._longest_ns = round(settings.command_expiry * NS_PER_S)
        self._told_at: list[Instant] = []
        self._told: list[Path] = []  # vx, vy, omega; speed, turn rate
        self._path: list[Path] = []  # commanded path up to the instant of the same index
        self._seen_at: list[Instant] = []
        self._seen: list[ArmState] = []
        self._found: tuple[Finding, ...] = ()
        self._free_since: Instant | None = None  # since when the arm has been without load

    def add_command(self, twist: Twist, at: Instant) -> None:
        """Add a command sent at ``at``."""
        if self._told_at and at <= self._told_at[-1]:
            self._told_at.clear()  # time went back, so earlier commands are useless
        if not self._told_at:
            self._told.clear()
            self._path[:] = [(0.0, 0.0, 0.0, 0.0, 0.0)]
        else:
            self._path.append(self._path_until(len(self._told_at) - 1, at))
        self._told_at.append(at)
        speed = math.hypot(twist.vx, twist.vy)
        self._told.append((twist.vx, twist.vy, twist.omega, speed, abs(twist.omega)))
        if len(self._told_at) > 2 * KEPT:
            del self._told_at[:KEPT], self._told[:KEPT], self._path[:KEPT]

    def restart(self) -> None:
        """Forget earlier states."""
        self._seen_at.clear()
        self._seen.clear()
        self._found = ()
        self._free_since = None

    def is_after_all_commands(self, decided: Instant) -> bool:
        """Whether commands were sent, and ``decided`` is later than all of them."""
        return bool(self._told_at) and decided > self._told_at[-1]

    def first_command_after(self, decided: Instant) -> Instant | None:
        """When the first command after that of ``decided`` was sent; None if none was."""
        index = bisect_right(self._told_at, decided)
        return self._told_at[index] if index < len(self._told_at) else None

    def judge(self, arm: ArmState) -> tuple[Finding, ...]:
        """Check the arm's motion up to the state ``arm``, whose numbers must be finite."""
        at = arm.captured
        if self._seen_at:
            since = at - self._seen_at[-1]
            if -LONGEST_GAP_NS <= since <= 0:
                return self._found  # checked already, or older than one that was
            if abs(since) > LONGEST_GAP_NS or self._jumped(arm):
                self._seen_at.clear()
                self._seen.clear()
                self._free_since = None
        self._seen_at.append(at)
        self._seen.append(arm)
        if len(self._seen) > 2 * KEPT:
            del self._seen_at[:KEPT], self._seen[:KEPT]
        s = self._s
        if math.hypot(arm.fx, arm.fy) >= s.free_air_force or abs(arm.mz) >= s.free_air_torque:
            self._free_since = None
        elif self._free_since is None:
            self._free_since = at
        found = [self._speed(arm), self._tracking(arm) or self._drift(arm), self._disagreement(arm)]
        self._found = tuple([one for one in found if one is not None])
        return self._found

    def _jumped(self, arm: ArmState) -> bool:
        """Whether the pose has jumped, as after a reset of a simulated world."""
        dx, dy, dh = self._motion_since(-1, arm)
        return math.hypot(dx, dy) > JUMP or abs(dh) > JUMP / self._s.tip_length

    def _path_until(self, index: int, at: Instant) -> Path:
        """Commanded path up to ``at``; ``index``: newest command before it."""
        x, y, h, length, turned = self._path[index]
        vx, vy, omega, speed, turning = self._told[index]
        passed = at - self._told_at[index]
        # Not min(), whose call costs more than the rest.
        dt = (passed if passed < self._longest_ns else self._longest_ns) / NS_PER_S
        return x + vx * dt, y + vy * dt, h + omega * dt, length + speed * dt, turned + turning * dt

    def _commanded_path(self, begin: Instant, end: Instant) -> Path:
        """Path commanded between two instants; none before the first command."""
        first = bisect_right(self._told_at, begin) - 1
        last = bisect_right(self._told_at, end) - 1
        x0, y0, h0, l0, t0 = self._path_until(first, begin) if first >= 0 else self._path[0]
        x1, y1, h1, l1, t1 = self._path_until(last, end) if last >= 0 else self._path[0]
        return x1 - x0, y1 - y0, h1 - h0, l1 - l0, t1 - t0

    def _before(self, at: Instant, window_ns: int) -> int | None:
        """Index of the newest state at least ``window_ns`` before ``at``; None if there is none."""
        index = bisect_right(self._seen_at, at - window_ns) - 1
        return index if index >= 0 else None

    def _motion_since(self, index: int, arm: ArmState) -> tuple[float, float, float]:
        old = self._seen[index]
        return arm.x - old.x, arm.y - old.y, math.remainder(arm.heading - old.heading, math.tau)

    def _pose_is_constant(self, index: int) -> bool:
        """Whether all poses from ``index`` on equal the newest to within `SAME`."""
        last = self._seen[-1]
        return all(
            abs(a.x - last.x) <= SAME
            and abs(a.y - last.y) <= SAME
            and abs(a.heading - last.heading) <= SAME
            for a in self._seen[index:]
        )

    def _speed(self, arm: ArmState) -> Finding | None:
        """Check the speed, by twist and by pose, against the limit that the arm confirmed."""
        s, twist = self._s, arm.twist
        speed, turn = math.hypot(twist.vx, twist.vy), abs(twist.omega)
        index = self._before(arm.captured, SPEED_OVER_NS)
        if index is not None:
            seconds = (arm.captured - self._seen_at[index]) / NS_PER_S
            dx, dy, dh = self._motion_since(index, arm)
            speed = max(speed, (math.hypot(dx, dy) - POSE_NOISE) / seconds)
            turn = max(turn, (abs(dh) - POSE_NOISE / s.tip_length) / seconds)
        if speed > TOO_FAST * s.arm_v_max:
            return (
                Check.ARM_SPEED,
                f"the arm moves at {speed:.3f} m/s, its limit is {s.arm_v_max:g}",
            )
        if turn > TOO_FAST * s.arm_omega_max:
            return (
                Check.ARM_SPEED,
                f"the arm turns at {turn:.3f} rad/s, its limit is {s.arm_omega_max:g}",
            )
        return None

    def _tracking(self, arm: ArmState) -> Finding | None:
        """Check for motion against, across or beyond the commanded path, over `TRACK_NS`."""
        index = self._before(arm.captured, TRACK_NS)
        if index is None or not self._told_at:
            return None
        s = self._s
        begin, end = self._seen_at[index], arm.captured
        moved = self._motion_since(index, arm)
        slack, twist_slack = OFF_THE_WAY, OFF_THE_WAY / s.tip_length
        off, off_turn = _deviation(moved, self._commanded_path(begin, end))
        if off <= slack and off_turn <= twist_slack:
            return None
        for delay in DELAYS_NS:
            way = self._commanded_path(Instant(begin - delay), Instant(end - delay))
            aside, turned = _deviation(moved, way)
            off, off_turn = min(off, aside), min(off_turn, turned)
        if self._gives_way(index):
            seconds = (end - begin) / NS_PER_S
            slack, twist_slack = s.arm_v_max * seconds, s.arm_omega_max * seconds
        if off <= slack and off_turn <= twist_slack:
            return None
        return (
            Check.ARM_TRACKING,
            f"the arm went {off * 1e3:.1f} mm and {math.degrees(off_turn):.1f}° away from what it "
            f"was told within {TRACK_NS / NS_PER_S:g} s",
        )

    def _drift(self, arm: ArmState) -> Finding | None:
        """Check for motion beside or beyond the commanded path, over `DRIFT_NS` without load."""
        end, free = arm.captured, self._free_since
        if free is None or end - free < DRIFT_NS or not self._told_at:
            return None
        index = self._before(end, DRIFT_NS)
        if index is None or self._told_at[0] > self._seen_at[index]:
            return None
        begin, lever = self._seen_at[index], self._s.tip_length
        moved = self._motion_since(index, arm)
        least, least_turn = math.inf, math.inf
        for delay in (0, *DELAYS_NS):
            x, y, h, _, _ = self._commanded_path(Instant(begin - delay), Instant(end - delay))
            least = min(least, _astray(moved[0], moved[1], x, y))
            least_turn = min(least_turn, _astray(moved[2] * lever, 0.0, h * lever, 0.0))
            if least <= DRIFTS and least_turn <= DRIFTS:
                return None
        return (
            Check.ARM_TRACKING,
            f"the arm drifted {max(least, least_turn) * 1e3:.1f} mm away from what it was told "
            f"within {DRIFT_NS / NS_PER_S:g} s, and nothing touches it",
        )

    def _gives_way(self, index: int) -> bool:
        """Whether the arm was at its own limits at a state from ``index`` on."""
        s = self._s
        force, torque = AT_ITS_LIMIT * s.arm_f_max, AT_ITS_LIMIT * s.arm_m_max
        for a in self._seen[index:]:  # in every cycle of a jam: any() costs three times as much
            if abs(a.fx) >= force or abs(a.fy) >= force or abs(a.mz) >= torque:
                return True
        return False

    def _disagreement(self, arm: ArmState) -> Finding | None:
        """Check for another path than commanded, over a longer window, that no load explains."""
        index = self._before(arm.captured, self._long_ns)
        if index is None or not self._told_at:
            return None
        begin, end = self._seen_at[index], arm.captured
        moved = self._motion_since(index, arm)
        way = self._commanded_path(begin, end)
        for differs in (self._translation_differs, self._turning_differs):
            told = differs(moved, way, end - begin)
            if told is None:
                continue
            for delay in DELAYS_NS:
                late = self._commanded_path(Instant(begin - delay), Instant(end - delay))
                if differs(moved, late, end - begin) is None:
                    break
            else:
                finding = self._unexplained(index, moved, told, end - begin)
                if finding is not None:
                    return finding
        return None

    def _translation_differs(
        self, moved: tuple[float, float, float], way: Path, window_ns: int
    ) -> tuple[float, float, float] | None:
        """Unit vector and length (m) of a commanded translation that ``moved`` contradicts."""
        x, y, _, length, _ = way
        apart = math.hypot(x, y)
        if apart < COMMANDED * window_ns / NS_PER_S or apart < STEADY * length:
            return None
        off = math.hypot(moved[0] - x, moved[1] - y)
        short = moved[0] * x + moved[1] * y < (1.0 - DISAGREES) * apart * apart
        if off <= max(DISAGREES * apart, POSE_NOISE if short else ASTRAY):
            return None
        return x / apart, y / apart, apart

    def _turning_differs(
        self, moved: tuple[float, float, float], way: Path, window_ns: int
    ) -> tuple[float, float, float] | None:
        """(0, 0) and the commanded angle (rad) that ``moved`` contradicts."""
        _, _, angle, _, turned = way
        lever = self._s.tip_length
        if abs(angle) * lever < COMMANDED * window_ns / NS_PER_S or abs(angle) < STEADY * turned:
            return None
        short = moved[2] * angle < (1.0 - DISAGREES) * angle * angle
        slack = (POSE_NOISE if short else ASTRAY) / lever
        if abs(moved[2] - angle) <= max(DISAGREES * abs(angle), slack):
            return None
        return 0.0, 0.0, angle

    def _unexplained(
        self,
        index: int,
        moved: tuple[float, float, float],
        told: tuple[float, float, float],
        window_ns: int,
    ) -> Finding | None:
        """The finding, unless the environment pushed the arm that way and its twist agrees."""
        s, states = self._s, self._seen[index:]
        ux, uy, length = told
        n, seconds = len(states), window_ns / NS_PER_S
        since = self._before(states[-1].captured, TRACK_NS) or 0
        lately, last = self._seen[since:], states[-1]
        mx, my, mh = self._motion_since(since, last)
        if ux or uy:
            dx, dy = moved[0] - ux * length, moved[1] - uy * length
            pushed = sum([a.fx * dx + a.fy * dy for a in states]) / (n * math.hypot(dx, dy))
            aside = pushed >= s.free_air_force
            went, moves = moved[0] * ux + moved[1] * uy, mx * ux + my * uy
            reports = [a.twist.vx * ux + a.twist.vy * uy for a in states]
            words, noise = (f"{length * 1e3:.1f} mm", f"{went * 1e3:.1f}"), POSE_NOISE
        else:
            sign = math.copysign(1.0, length)
            pushed = math.copysign(1.0, moved[2] - length) * sum([a.mz for a in states]) / n
            aside = pushed >= s.free_air_torque
            went, moves, length = moved[2] * sign, mh * sign, abs(length)
            reports = [sign * a.twist.omega for a in states]
            words = f"{math.degrees(length):.2f}°", f"{math.degrees(went):.2f}"
            noise = POSE_NOISE / s.tip_length
        pace = length / seconds
        dead = abs(moves) < DEAD * pace * TRACK_NS / NS_PER_S
        if -noise <= went < (1.0 - DISAGREES) * length:
            # Held back by anything that presses on the finger, which may be wedged in any
            # direction; or held back for a part of the window and now free. One that stays seems
            # to go back as often as not, by as much as its pose errs.
            explained = any(
                sum([math.hypot(a.fx, a.fy) for a in some]) >= s.free_air_force * len(some)
                or sum([abs(a.mz) for a in some]) >= s.free_air_torque * len(some)
                for some in (states, lately)
            )
        else:
            explained = aside or self._gives_way(index)
        reported = sum(reports[-len(lately) :]) / len(lately)
        lies = (
            reported >= REPORTED * pace and _at_least(reports) - went / seconds >= REPORTED * pace
        ) or (_moving(lately) and self._pose_is_constant(index))
        if explained and not (dead and lies):
            return None
        if dead:
            return (
                Check.ARM_FROZEN,
                "the arm's state does not change although the arm is told to move and no load "
                "holds it",
            )
        return (
            Check.ARM_PATH,
            f"the arm was told to go {words[0]} and went {words[1]} that way within {seconds:.1f} "
            "s, and no load explains it",
        )


def _at_least(rates: list[float]) -> float:
    """Mean of two ``rates`` or more, less what their scatter may have added to it."""
    n = len(rates)
    mean = math.fsum(rates) / n
    variance = math.fsum([(rate - mean) ** 2 for rate in rates]) / (n - 1)
    return mean - SURE * math.sqrt(variance / n)


def _moving(states: list[ArmState]) -> bool:
    """Whether their mean twist shows motion; jammed arms creep more slowly."""
    n = len(states)
    vx = math.fsum(a.twist.vx for a in states) / n
    vy = math.fsum(a.twist.vy for a in states) / n
    omega = math.fsum(a.twist.omega for a in states) / n
    return max(math.hypot(vx, vy), abs(omega)) > CREEP


def _astray(mx: float, my: float, x: float, y: float) -> float:
    """m by which a motion (mx, my) goes beside or beyond (x, y); 0 if it falls short."""
    length = math.hypot(x, y)
    if length <= DRIFTS:
        return math.hypot(mx - x, my - y)
    along = (mx * x + my * y) / length
    return math.hypot(max(-along, along - length, 0.0), (my * x - mx * y) / length)


def _deviation(moved: tuple[float, float, float], way: Path) -> tuple[float, float]:
    """Distance (m) and angle (rad) of ``moved`` from the nearest point of ``way``, taken as
    straight."""
    mx, my, mh = moved
    x, y, h, _, _ = way
    square = x * x + y * y
    part = min(1.0, max(0.0, (mx * x + my * y) / square)) if square > 0.0 else 0.0
    low, high = min(0.0, h), max(0.0, h)
    return math.hypot(mx - part * x, my - part * y), max(low - mh, mh - high, 0.0)
