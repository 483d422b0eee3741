"""The safety gate: the last hand on every command, pure, one object an arm.

Any fault ends in the zero twist, never in the last velocity. A latch is undone only by a fresh
request of the operator, with every condition healthy. Nothing here is a certified safety function.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from reachd.finite import finite, usable
from reachd.limits import (
    approach_left,
    constrained,
    fastest_point,
    load,
    within_acceleration,
    within_speed,
    workspace_constraints,
    wrench_constraints,
)
from reachd.safety_settings import MOVING_MODES, PAUSED_MODE, Check, SafetySettings
from reachd.seam import ZERO, ArmState, Goal, Touch, Twist
from reachd.stillness import Stillness
from tactile_bus.instant import Instant, seconds_between
from tactile_bus.records import record

Effect = Literal["ignored", "limited", "stopped", "latched", "refused"]

ON_THE_WAY = 0.003
"""s from a cycle's deadline to the arm: what the loop is late and what the bus takes. An input is
too old by so much and a period before its age is reached, so that zero is there in time."""
FEATURES_ON_THE_WAY = 0.008  # on a busy machine 3 ms were not enough in one of forty kills

CONFIRMED_WITHIN = 1e-3
"""Part by which a limit read back may differ from the one sent: arms round theirs. A lower one is
refused too, for the arm would clip what the strategy wants without a word."""


@dataclass(frozen=True, slots=True)
class Intervention:
    """What the gate did and why. ``code`` is stable; ``text`` is for people."""

    code: Check
    effect: Effect
    text: str


@record
class Decision:
    """The twist to send, s for which the arm may follow it, and why it is not the one wanted.

    ``held`` is the reason for which the gate is disarmed or latched, None when it is armed.
    """

    twist: Twist
    expiry: float
    interventions: tuple[Intervention, ...]
    held: Check | None


class SafetyGate:
    """Disarmed at first. ``step`` every cycle of the control loop, armed or not."""

    def __init__(self, settings: SafetySettings) -> None:
        self._settings = settings
        self._off = settings.disabled
        # Asked in every cycle, and an enum takes its time to be found in a set.
        self._bounds_speed = Check.SPEED not in self._off
        self._bounds_turning = Check.TURN_RATE not in self._off
        self._bounds_acceleration = Check.ACCELERATION not in self._off
        self._slows = Check.SLOW_DOWN not in self._off
        self._bounds_workspace = Check.WORKSPACE not in self._off
        self._bounds_wrench = Check.WRENCH not in self._off
        self._confirmed: tuple[float, ...] = ()  # limits last read back and found as asked
        self._hold: Intervention | None = Intervention(
            Check.NOT_ARMED, "stopped", "the gate is not armed: arm it by an operator's request"
        )
        self._held_at: Instant | None = None
        self.latched_at: dict[Check, Instant] = {}
        """When each reason to hold was last seen, even while the gate was holding already."""
        self._proven = False  # the force sensor read next to nothing in free air
        self._last = ZERO
        self._stepped: Instant | None = None
        self._felt: Instant | None = None  # when the last valid features were captured
        self._still = Stillness()

    @property
    def armed(self) -> bool:
        """Whether commands pass."""
        return self._hold is None

    @property
    def held(self) -> Intervention | None:
        """Why commands do not pass, or None."""
        return self._hold

    def disarm(self, now: Instant, why: str) -> None:
        """Hold at the operator's wish, or at the end of the daemon."""
        self._latch(Intervention(Check.NOT_ARMED, "stopped", why), now)

    def arm(
        self,
        requested: Instant,
        touch: Touch | None,
        arm: ArmState | None,
        now: Instant,
        *,
        duplicate: bool = False,
        free_air: bool = True,
    ) -> tuple[Intervention, ...]:
        """Arm at an operator's request made at ``requested``; returns why not, empty when armed.

        ``free_air=False`` says that the finger touches something: allowed only after the force
        sensor was once found unbiased in free air.
        """
        if self._hold is None:
            return ()
        refusals = []
        age = seconds_between(requested, now)
        fresh = self._held_at is None or requested > self._held_at
        if not fresh or not -self._settings.future <= age <= self._settings.request_age:
            text = f"the request to arm is {age:.3f} s old, or older than what it is to clear"
            refusals.append(Intervention(Check.REQUEST_STALE, "refused", text))
        faults, stops, _ = self._inputs(touch, arm, now, duplicate)
        # An arm that stopped by itself is revived by the zero commands that follow.
        refusals += [
            Intervention(i.code, "refused", i.text)
            for i in (*faults, *stops)
            if i.code is not Check.ARM_STOPPED
        ]
        if arm is not None and self._on(Check.FREE_AIR) and (free_air or not self._proven):
            refusals += self._biased(arm)
        if not refusals:
            self._hold = None
            self._proven = True
            self._last = ZERO
            self._still = Stillness()
        return tuple(refusals)

    def step(
        self,
        wanted: Twist | None,
        touch: Touch | None,
        arm: ArmState | None,
        goal: Goal | None,
        now: Instant,
        *,
        lateness: float = 0.0,
        duplicate: bool = False,
        failure: str | None = None,
    ) -> Decision:
        """The twist that may be sent.

        ``wanted``: what the strategy wants, None with ``failure`` when it failed. ``touch``,
        ``arm``: the newest, None when there never was one. ``goal``: where to slow down.
        ``lateness``: s by which the loop missed its deadline. ``duplicate``: a second publisher
        was seen on an input.
        """
        passed = 0.0 if self._stepped is None else seconds_between(self._stepped, now)
        faults, stops, notes = self._inputs(touch, arm, now, duplicate)
        faults += self._command(wanted, failure)
        stops += self._timing(passed, lateness)
        self._stepped = now
        for fault in faults:
            self._latch(fault, now)
        if self._hold is not None:
            own = (self._hold, *(i for i in (*faults, *stops) if i.code != self._hold.code))
            return self._stop((*own, *notes), self._hold.code)
        if stops or arm is None or wanted is None:
            return self._stop((*stops, *notes), None)
        twist = self._limited(wanted, arm, goal, passed, notes)
        if not finite(
            twist.vx, twist.vy, twist.omega
        ):  # numbers near the end of the range, with limits disabled
            self._latch(_not_finite(wanted), now)
            return self._stop((_not_finite(wanted),), Check.COMMAND_NOT_FINITE)
        self._last = twist
        return Decision(twist, self._settings.command_expiry, tuple(notes), None)

    def _on(self, check: Check) -> bool:
        return check not in self._off

    def _latch(self, fault: Intervention, now: Instant) -> None:
        """Hold, keeping the first reason; a request to arm must be newer than the last."""
        self._held_at = self.latched_at[fault.code] = now
        if self._hold is None:
            self._hold = fault

    def _stop(self, why: tuple[Intervention, ...], held: Check | None) -> Decision:
        self._last = ZERO
        return Decision(ZERO, self._settings.command_expiry, why, held)

    def _command(self, wanted: Twist | None, failure: str | None) -> list[Intervention]:
        """What is wrong with the command itself."""
        if failure is not None or wanted is None:
            text = f"the strategy failed: {failure or 'it gave no command'}"
            return [Intervention(Check.STRATEGY_FAILED, "latched", text)]
        ok = finite(wanted.vx, wanted.vy, wanted.omega)
        return [] if ok else [_not_finite(wanted)]

    def _timing(self, passed: float, lateness: float) -> list[Intervention]:
        """What is wrong with the loop: its own report, and the time since its last step."""
        s = self._settings
        found = []
        if passed < 0.0 and self._on(Check.CLOCK_BACKWARDS):
            text = f"time went back by {-passed:.3f} s"
            found.append(Intervention(Check.CLOCK_BACKWARDS, "stopped", text))
        late = max(lateness, passed - s.period)
        if not late <= s.lateness and self._on(Check.LOOP_LATE):
            text = f"the control loop is {late * 1e3:.1f} ms late, {s.lateness * 1e3:g} at most"
            found.append(Intervention(Check.LOOP_LATE, "stopped", text))
        return found

    def _inputs(
        self, touch: Touch | None, arm: ArmState | None, now: Instant, duplicate: bool
    ) -> tuple[list[Intervention], list[Intervention], list[Intervention]]:
        """What is wrong with the inputs: what latches, what stops, what is only noted."""
        faults: list[Intervention] = []
        stops: list[Intervention] = []
        notes: list[Intervention] = []
        if duplicate and self._on(Check.DUPLICATE_PUBLISHER):
            text = "a second publisher was seen on an input of control: end one of them"
            faults.append(Intervention(Check.DUPLICATE_PUBLISHER, "latched", text))
        self._features(touch, now, faults, stops, notes)
        self._arm_state(arm, now, faults, stops)
        return faults, stops, notes

    def _features(
        self,
        touch: Touch | None,
        now: Instant,
        faults: list[Intervention],
        stops: list[Intervention],
        notes: list[Intervention],
    ) -> None:
        """Age of the last valid features."""
        s = self._settings
        if touch is not None and usable(touch):
            ahead = seconds_between(now, max(touch.captured, touch.received))
            if ahead > s.future and self._on(Check.FEATURES_FUTURE):
                text = f"features stamped {ahead:.3f} s ahead of now are not used"
                notes.append(Intervention(Check.FEATURES_FUTURE, "ignored", text))
            else:
                oldest = min(touch.captured, touch.received)
                self._felt = oldest if self._felt is None else max(self._felt, oldest)
        age = math.inf if self._felt is None else seconds_between(self._felt, now)
        if age <= s.features_age - s.period - FEATURES_ON_THE_WAY:
            return
        text = f"no valid features for {age:.3f} s"
        if age > s.features_latch and self._on(Check.FEATURES_LOST):
            faults.append(Intervention(Check.FEATURES_LOST, "latched", text))
        if self._on(Check.FEATURES_STALE):
            stops.append(Intervention(Check.FEATURES_STALE, "stopped", text))

    def _arm_state(
        self,
        arm: ArmState | None,
        now: Instant,
        faults: list[Intervention],
        stops: list[Intervention],
    ) -> None:
        """Age, sanity and mode of the arm's state, and the limits it confirms."""
        s = self._settings
        if arm is None:
            stops.append(Intervention(Check.ARM_STALE, "stopped", "no arm state has come"))
            return
        age = seconds_between(min(arm.captured, arm.received), now)
        ahead = seconds_between(now, max(arm.captured, arm.received))
        if ahead > s.future and self._on(Check.ARM_FUTURE):
            text = f"arm state stamped {ahead:.3f} s ahead of now"
            stops.append(Intervention(Check.ARM_FUTURE, "stopped", text))
        if age > s.arm_age - s.period - ON_THE_WAY:
            text = f"no arm state for {age:.3f} s"
            if age > s.arm_latch and self._on(Check.ARM_LOST):
                faults.append(Intervention(Check.ARM_LOST, "latched", text))
            if self._on(Check.ARM_STALE):
                stops.append(Intervention(Check.ARM_STALE, "stopped", text))
        if not finite(arm.x, arm.y, arm.heading, arm.fx, arm.fy, arm.mz):
            text = "the arm's state holds a number that is not finite"
            stops.append(Intervention(Check.ARM_NOT_FINITE, "stopped", text))
        elif self._still.frozen(arm, self._last, now, s) and self._on(Check.ARM_FROZEN):
            text = "the arm's state does not change although the arm is told to move"
            faults.append(Intervention(Check.ARM_FROZEN, "latched", text))
        if arm.mode == PAUSED_MODE:
            if self._on(Check.ARM_STOPPED):
                text = "the arm stopped by itself because commands had ceased"
                stops.append(Intervention(Check.ARM_STOPPED, "stopped", text))
        elif arm.mode not in MOVING_MODES and self._on(Check.ARM_MODE):
            text = f"the arm is in mode {arm.mode!r}: clear it at the arm, then arm again"
            faults.append(Intervention(Check.ARM_MODE, "latched", text))
        limits = (arm.v_max, arm.omega_max, arm.f_max, arm.m_max)
        if limits != self._confirmed and self._on(Check.ARM_LIMITS):
            wrong = self._unconfirmed(arm)
            faults.extend(wrong)
            self._confirmed = () if wrong else limits

    def _unconfirmed(self, arm: ArmState) -> list[Intervention]:
        """Limits that the arm does not confirm as asked, with both values."""
        ask = self._settings.arm_limits
        wrong = [
            f"{name} is {has:g} {unit}, {asked:g} asked"
            for name, has, asked, unit in (
                ("v_max", arm.v_max, ask.v_max, "m/s"),
                ("omega_max", arm.omega_max, ask.omega_max, "rad/s"),
                ("f_max", arm.f_max, ask.f_max, "N"),
                ("m_max", arm.m_max, ask.m_max, "N·m"),
            )
            if not abs(has - asked) <= CONFIRMED_WITHIN * asked
        ]
        if not wrong:
            return []
        text = f"the arm does not confirm its limits: {'; '.join(wrong)}"
        return [Intervention(Check.ARM_LIMITS, "latched", text)]

    def _biased(self, arm: ArmState) -> list[Intervention]:
        """Wrench in free air that shows a bias or a wrong tool."""
        s = self._settings
        force = math.hypot(arm.fx, arm.fy)
        if force < s.free_air_force and abs(arm.mz) < s.free_air_torque:
            return []
        text = (
            f"the arm feels {force:.2f} N and {arm.mz:.3f} N·m in free air (less than "
            f"{s.free_air_force:g} N, {s.free_air_torque:g} N·m wanted): zero its force sensor "
            "and check tool and payload"
        )
        return [Intervention(Check.FREE_AIR, "refused", text)]

    def _limited(
        self,
        wanted: Twist,
        arm: ArmState,
        goal: Goal | None,
        passed: float,
        notes: list[Intervention],
    ) -> Twist:
        """Apply every limit of motion to a healthy command; says in ``notes`` which ones acted."""
        s = self._settings
        twist = self._speed(wanted, notes)
        if self._bounds_acceleration:
            dt = min(max(passed, 0.0), s.period + s.lateness)
            before = twist
            twist = within_acceleration(
                twist, self._last, s.acceleration * dt, s.turn_acceleration * dt
            )
            _note(notes, Check.ACCELERATION, before, twist, "the command changes too fast")
        if goal is not None and self._slows:
            tip_x = arm.x + s.tip_length * math.cos(arm.heading)
            tip_y = arm.y + s.tip_length * math.sin(arm.heading)
            if math.hypot(goal.x - tip_x, goal.y - tip_y) < s.slow_radius:
                before = twist
                left = s.slow_fraction
                twist = within_speed(twist, left * s.speed, left * s.turn_rate)
                _note(notes, Check.SLOW_DOWN, before, twist, "the goal is near")
        return self._held_back(twist, arm, notes)

    def _speed(self, wanted: Twist, notes: list[Intervention]) -> Twist:
        """Greatest speed and turn rate; the path stays."""
        s = self._settings
        twist = wanted
        if self._bounds_speed:
            twist = within_speed(wanted, s.speed, math.inf)
            _note(notes, Check.SPEED, wanted, twist, "the command is too fast")
        if self._bounds_turning:
            before = twist
            twist = within_speed(twist, math.inf, s.turn_rate)
            _note(notes, Check.TURN_RATE, before, twist, "the command turns too fast")
        return twist

    def _held_back(self, twist: Twist, arm: ArmState, notes: list[Intervention]) -> Twist:
        """Workspace and wrench together, for either alone could undo the other."""
        s = self._settings
        kept, rules = twist, []
        if self._bounds_workspace:
            rules = workspace_constraints(arm, s, fastest_point(twist, s))
            kept = constrained(twist, rules)
            _note(notes, Check.WORKSPACE, twist, kept, "the edge of the workspace is near")
        part = load(arm, s)
        if part <= s.soft_fraction or not self._bounds_wrench:
            return kept
        left = approach_left(part, s.soft_fraction)
        held = wrench_constraints(twist, arm, left)
        text = f"the load is {part:.0%} of its limit: {left:.0%} of the approach is left"
        _note(notes, Check.WRENCH, twist, constrained(twist, held), text)
        return constrained(twist, rules + held)


def _note(
    notes: list[Intervention], code: Check, before: Twist, after_it: Twist, text: str
) -> None:
    if after_it is not before:  # what changes nothing hands back the very same twist
        notes.append(Intervention(code, "limited", text))


def _not_finite(wanted: Twist) -> Intervention:
    text = f"the command is not finite: {wanted.vx}, {wanted.vy}, {wanted.omega}"
    return Intervention(Check.COMMAND_NOT_FINITE, "latched", text)
