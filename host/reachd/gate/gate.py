"""The safety gate: the final check on every command. Pure; one instance per arm.

Any fault results in the zero twist, never in the last velocity. A latch is cleared only by a fresh
request of the operator while every condition is healthy. Nothing here is a certified safety
function.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal

from reachd.gate.limits import (
    Constraint,
    approach_left,
    braked,
    constrained,
    fastest_point,
    finite,
    force_constraints,
    largest_skin_force,
    load,
    squeeze_constraints,
    touch_constraints,
    usable,
    within_acceleration,
    within_speed,
    workspace_constraints,
    wrench_constraints,
)
from reachd.gate.motion import MotionWatch
from reachd.gate.settings import MOVING_MODES, PAUSED_MODE, Check, SafetySettings
from reachd.interfaces import ZERO, ArmState, Goal, Touch, Twist
from tactile_core.types import Echo, Instant, record, seconds_between

Effect = Literal["ignored", "limited", "stopped", "latched", "refused"]

ON_THE_WAY = 0.003
"""s from a cycle's deadline until its command is at the arm: lateness of the loop and transport. An
input counts as too old this much, and one period, before it reaches its age limit, so that the zero
twist arrives in time."""
FEATURES_ON_THE_WAY = 0.008
"""The same for features: on a busy machine 3 ms were not enough in one of forty kills."""

ECHO_LOST = 0.05
"""s for which commands must take effect late before the gate latches; a single delay only stops."""

SPARSE_OVER = 0.2
"""s of which touch must have been valid for at least half."""

HARD_STATES = 2
"""States in a row that must be overloaded for the gate to latch."""

HARD_AT_ONCE = 2.0
"""Multiple of the overload at which one state is enough."""

SKIN_LATCH = 2.0
"""Multiple of the limit of force on the skin at which the gate latches."""

CONFIRMED_WITHIN = 1e-3
"""Relative difference allowed between a limit read back and the one sent: arms round. A lower limit
is refused as well, because the arm would silently clip the strategy's twists."""


@dataclass(frozen=True, slots=True)
class Intervention:
    """Effect of a check and its reason. ``code`` is stable; ``text`` is for people."""

    code: Check
    effect: Effect
    text: str


@record
class Decision:
    """The twist to send, its ``expiry`` in s, and why it is not the one wanted.

    ``held``: why the gate is disarmed or latched; None when it is armed.
    """

    twist: Twist
    expiry: float
    interventions: tuple[Intervention, ...]
    held: Check | None


class SafetyGate:
    """The gate of one arm; disarmed at first. Call `step` in every cycle, armed or not."""

    def __init__(self, settings: SafetySettings) -> None:
        self._settings = settings
        self._off = settings.disabled
        # Cached because they are used in every cycle, and finding an enum in a set is slow.
        self._bounds_speed = Check.SPEED not in self._off
        self._bounds_turning = Check.TURN_RATE not in self._off
        self._bounds_acceleration = Check.ACCELERATION not in self._off
        self._slows = Check.SLOW_DOWN not in self._off
        self._bounds_workspace = Check.WORKSPACE not in self._off
        self._bounds_wrench = Check.WRENCH not in self._off
        self._bounds_skin = Check.SKIN_FORCE not in self._off
        self._bounds_touch = Check.TOUCH_RISING not in self._off
        self._confirmed: tuple[float, ...] = ()  # limits last read back that equal those asked
        self._hold: Intervention | None = Intervention(
            Check.NOT_ARMED, "stopped", "the gate is not armed: arm it by an operator's request"
        )
        self._held_at: Instant | None = None
        self.latched_at: dict[Check, Instant] = {}
        """When each latching fault was last seen, also while the gate was latched already."""
        self._proven = False  # whether the force sensor has read about zero in free air
        self._last = ZERO
        self._stepped: Instant | None = None
        self._felt: Instant | None = None  # when the last valid features were captured
        self._motion = MotionWatch(settings)
        self._own_since: Instant | None = None  # since when the arm says that we command it
        self._late_since: Instant | None = None  # since when commands take effect late
        self._passes: deque[Instant] = deque()  # when force or torque passed its limit
        self._hard = 0  # overloaded states in a row
        self._beyond = False  # whether load passed its limit and has not fallen below soft since
        self._seen: deque[tuple[Instant, bool]] = deque()  # whether touch was valid up to then
        self._without = 0  # of these, how many without valid touch
        self._touched: Touch | None = None  # the newest usable touch
        self._rising = 0.0  # rate at which the force on the skin grew at that touch, N/s
        self._loaded_at: Instant | None = None  # capture of the newest state
        self._state_at: Instant | None = None  # capture of the state of the last cycle

    @property
    def armed(self) -> bool:
        """Whether commands may pass."""
        return self._hold is None

    @property
    def held(self) -> Intervention | None:
        """Why the gate is disarmed or latched, or None."""
        return self._hold

    def disarm(self, now: Instant, why: str) -> None:
        """Disarm, at the operator's request or for the reason ``why``."""
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

        ``free_air=False``: the finger touches something, which is allowed only after the force
        sensor has once been found unbiased in free air.
        """
        if self._hold is None:
            return ()
        refusals = []
        age = seconds_between(requested, now)
        fresh = self._held_at is None or requested > self._held_at
        if not fresh or not -self._settings.future <= age <= self._settings.request_age:
            text = f"the request to arm is {age:.3f} s old, or older than what it is to clear"
            refusals.append(Intervention(Check.REQUEST_STALE, "refused", text))
        self._motion.restart()  # earlier motion is the operator's responsibility
        faults, stops, _ = self._check_inputs(touch, arm, now, duplicate)
        # An arm that stopped by itself resumes with the zero commands that follow.
        refusals += [
            Intervention(i.code, "refused", i.text)
            for i in (*faults, *stops)
            if i.code is not Check.ARM_STOPPED
        ]
        if arm is not None and self._enabled(Check.FREE_AIR) and (free_air or not self._proven):
            refusals += self._check_free_air(arm)
        if not refusals:
            self._hold = None
            self._proven = True
            self._last = ZERO
            self._passes.clear()
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
        rivalled: bool = False,
        failure: str | None = None,
    ) -> Decision:
        """Decide the twist to send.

        ``wanted``: the strategy's twist; None, with ``failure``, when it failed. ``touch``,
        ``arm``: newest inputs; None before the first. ``goal``: where to slow down. ``lateness``:
        s by which the loop missed its deadline. ``duplicate``: a second publisher was seen on an
        input. ``rivalled``: another sender of commands was seen.
        """
        decision = self._decide(
            wanted, touch, arm, goal, now, lateness, duplicate, rivalled, failure
        )
        self._motion.add_command(decision.twist, now)
        return decision

    def _decide(
        self,
        wanted: Twist | None,
        touch: Touch | None,
        arm: ArmState | None,
        goal: Goal | None,
        now: Instant,
        lateness: float,
        duplicate: bool,
        rivalled: bool,
        failure: str | None,
    ) -> Decision:
        passed = 0.0 if self._stepped is None else seconds_between(self._stepped, now)
        faults, stops, notes = self._check_inputs(touch, arm, now, duplicate)
        if rivalled and self._enabled(Check.RIVAL_COMMANDS):
            text = "somebody else sends commands to the arm, which does not obey them"
            notes.append(Intervention(Check.RIVAL_COMMANDS, "ignored", text))
        faults += self._check_command(wanted, failure)
        stops += self._check_timing(passed, lateness)
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
        ):  # possible for numbers near the end of the range when limits are disabled
            self._latch(_not_finite(wanted), now)
            return self._stop((_not_finite(wanted),), Check.COMMAND_NOT_FINITE)
        self._last = twist
        return Decision(twist, self._settings.command_expiry, tuple(notes), None)

    def _enabled(self, check: Check) -> bool:
        return check not in self._off

    def _latch(self, fault: Intervention, now: Instant) -> None:
        """Latch; the first reason is kept, but a request to arm must be newer than the last."""
        self._held_at = self.latched_at[fault.code] = now
        if self._hold is None:
            self._hold = fault

    def _stop(self, why: tuple[Intervention, ...], held: Check | None) -> Decision:
        self._last = ZERO
        return Decision(ZERO, self._settings.command_expiry, why, held)

    def _check_command(self, wanted: Twist | None, failure: str | None) -> list[Intervention]:
        """Check the command itself."""
        if failure is not None or wanted is None:
            text = f"the strategy failed: {failure or 'it gave no command'}"
            return [Intervention(Check.STRATEGY_FAILED, "latched", text)]
        ok = finite(wanted.vx, wanted.vy, wanted.omega)
        return [] if ok else [_not_finite(wanted)]

    def _check_timing(self, passed: float, lateness: float) -> list[Intervention]:
        """Check the loop: its reported lateness, and the time since the last step."""
        s = self._settings
        found = []
        if passed < 0.0 and self._enabled(Check.CLOCK_BACKWARDS):
            text = f"time went back by {-passed:.3f} s"
            found.append(Intervention(Check.CLOCK_BACKWARDS, "stopped", text))
        late = max(lateness, passed - s.period)
        if not late <= s.lateness and self._enabled(Check.LOOP_LATE):
            text = f"the control loop is {late * 1e3:.1f} ms late, {s.lateness * 1e3:g} at most"
            found.append(Intervention(Check.LOOP_LATE, "stopped", text))
        return found

    def _check_inputs(
        self, touch: Touch | None, arm: ArmState | None, now: Instant, duplicate: bool
    ) -> tuple[list[Intervention], list[Intervention], list[Intervention]]:
        """Check the inputs; returns faults, which latch, then stops, then mere notes."""
        faults: list[Intervention] = []
        stops: list[Intervention] = []
        notes: list[Intervention] = []
        if duplicate and self._enabled(Check.DUPLICATE_PUBLISHER):
            text = "a second publisher was seen on an input of control: end one of them"
            faults.append(Intervention(Check.DUPLICATE_PUBLISHER, "latched", text))
        self._check_features(touch, now, faults, stops, notes)
        self._check_arm(arm, now, faults, stops)
        return faults, stops, notes

    def _check_features(
        self,
        touch: Touch | None,
        now: Instant,
        faults: list[Intervention],
        stops: list[Intervention],
        notes: list[Intervention],
    ) -> None:
        """Check the age of the last valid features, and their force."""
        s = self._settings
        if touch is not None and usable(touch):
            ahead = seconds_between(now, max(touch.captured, touch.received))
            if ahead > s.future and self._enabled(Check.FEATURES_FUTURE):
                text = f"features stamped {ahead:.3f} s ahead of now are not used"
                notes.append(Intervention(Check.FEATURES_FUTURE, "ignored", text))
            else:
                oldest = min(touch.captured, touch.received)
                self._felt = oldest if self._felt is None else max(self._felt, oldest)
                self._keep_touch(touch)
        self._check_skin_force(faults)
        self._check_sparse(touch, now, stops)
        age = math.inf if self._felt is None else seconds_between(self._felt, now)
        if age <= s.features_age - s.period - FEATURES_ON_THE_WAY:
            return
        text = f"no valid features for {age:.3f} s"
        if age > s.features_latch and self._enabled(Check.FEATURES_LOST):
            faults.append(Intervention(Check.FEATURES_LOST, "latched", text))
        if self._enabled(Check.FEATURES_STALE):
            stops.append(Intervention(Check.FEATURES_STALE, "stopped", text))

    def _keep_touch(self, touch: Touch) -> None:
        """Keep the newest usable touch, and the rate at which its force grew."""
        last = self._touched
        if last is not None and touch.captured <= last.captured:
            return
        self._rising = 0.0
        if last is not None:
            passed = seconds_between(last.captured, touch.captured)
            if passed <= SPARSE_OVER:
                self._rising = max(0.0, touch.total_force - last.total_force) / passed
        self._touched = touch

    def _check_skin_force(self, faults: list[Intervention]) -> None:
        """Check for force on the skin far above its limit; the last touch counts until the next."""
        if self._touched is None or not self._enabled(Check.SKIN_OVERLOAD):
            return
        force, limit = largest_skin_force(self._touched), self._settings.skin_force
        if force >= SKIN_LATCH * limit:
            text = f"the skin feels up to {force:.1f} N, its limit is {limit:g} N"
            faults.append(Intervention(Check.SKIN_OVERLOAD, "latched", text))

    def _check_sparse(self, touch: Touch | None, now: Instant, stops: list[Intervention]) -> None:
        """Check for touch that is valid now and then, but less than half of the time."""
        seen = self._seen
        if seen and now <= seen[-1][0]:
            if now < seen[-1][0]:
                seen.clear()
                self._without = 0
            return
        good = touch is not None and usable(touch)
        seen.append((now, good))
        self._without += not good
        while seconds_between(seen[0][0], now) > SPARSE_OVER:
            self._without -= not seen.popleft()[1]
        if not self._without:
            return
        without, before = 0.0, seen[0][0]
        for at, good in seen:
            without += 0.0 if good else seconds_between(before, at)
            before = at
        if without > SPARSE_OVER / 2 and self._enabled(Check.FEATURES_SPARSE):
            text = f"the features were not valid for {without:.2f} of the last {SPARSE_OVER:g} s"
            stops.append(Intervention(Check.FEATURES_SPARSE, "stopped", text))

    def _check_arm(
        self,
        arm: ArmState | None,
        now: Instant,
        faults: list[Intervention],
        stops: list[Intervention],
    ) -> None:
        """Check age, sanity and mode of the arm's state, and the limits that it confirms."""
        s = self._settings
        if arm is None:
            stops.append(Intervention(Check.ARM_STALE, "stopped", "no arm state has come"))
            return
        age = seconds_between(min(arm.captured, arm.received), now)
        ahead = seconds_between(now, max(arm.captured, arm.received))
        if ahead > s.future and self._enabled(Check.ARM_FUTURE):
            text = f"arm state stamped {ahead:.3f} s ahead of now"
            stops.append(Intervention(Check.ARM_FUTURE, "stopped", text))
        if age > s.arm_age - s.period - ON_THE_WAY:
            text = f"no arm state for {age:.3f} s"
            if age > s.arm_latch and self._enabled(Check.ARM_LOST):
                faults.append(Intervention(Check.ARM_LOST, "latched", text))
            if self._enabled(Check.ARM_STALE):
                stops.append(Intervention(Check.ARM_STALE, "stopped", text))
        last, self._state_at = self._state_at, arm.captured
        if last is not None and arm.captured < last and self._enabled(Check.CLOCK_BACKWARDS):
            text = f"the arm's stamps went back by {seconds_between(arm.captured, last):.3f} s"
            stops.append(Intervention(Check.CLOCK_BACKWARDS, "stopped", text))
        twist = arm.twist
        if not finite(
            arm.x, arm.y, arm.heading, arm.fx, arm.fy, arm.mz, twist.vx, twist.vy, twist.omega
        ):
            text = "the arm's state holds a number that is not finite"
            stops.append(Intervention(Check.ARM_NOT_FINITE, "stopped", text))
        else:
            faults.extend(
                Intervention(check, "latched", text)
                for check, text in self._motion.judge(arm)
                if self._enabled(check)
            )
            self._check_overload(arm, now, faults)
        if arm.echo is not None:
            self._check_echo(arm.echo, arm.captured, faults, stops)
        if arm.mode == PAUSED_MODE:
            if self._enabled(Check.ARM_STOPPED):
                text = "the arm stopped by itself because commands had ceased"
                stops.append(Intervention(Check.ARM_STOPPED, "stopped", text))
        elif arm.mode not in MOVING_MODES and self._enabled(Check.ARM_MODE):
            text = f"the arm is in mode {arm.mode!r}: clear it at the arm, then arm again"
            faults.append(Intervention(Check.ARM_MODE, "latched", text))
        limits = (arm.v_max, arm.omega_max, arm.f_max, arm.m_max)
        if limits != self._confirmed and self._enabled(Check.ARM_LIMITS):
            wrong = self._check_limits(arm)
            faults.extend(wrong)
            self._confirmed = () if wrong else limits

    def _check_overload(self, arm: ArmState, now: Instant, faults: list[Intervention]) -> None:
        """Check for a load far beyond its limit, or beyond it repeatedly.

        An impact lasts only one state, so it counts only from twice the overload.
        """
        s = self._settings
        part = load(arm, s)
        if arm.captured != self._loaded_at:
            self._loaded_at = arm.captured
            self._hard = self._hard + 1 if part >= s.overload else 0
        hard = self._hard >= HARD_STATES or part >= HARD_AT_ONCE * s.overload
        if hard and self._enabled(Check.OVERLOAD):
            text = f"the load is {part:.0%} of its limit"
            faults.append(Intervention(Check.OVERLOAD, "latched", text))
        if part < s.soft_fraction:
            self._beyond = False
        elif part >= 1.0 and not self._beyond:
            self._beyond = True
            self._passes.append(now)
        while self._passes and seconds_between(self._passes[0], now) > s.overload_within:
            self._passes.popleft()
        if len(self._passes) >= s.overload_passes and self._enabled(Check.OVERLOAD_REPEATED):
            text = (
                f"the load passed its limit {len(self._passes)} times within "
                f"{s.overload_within:g} s"
            )
            faults.append(Intervention(Check.OVERLOAD_REPEATED, "latched", text))
            self._passes.clear()

    def _check_echo(
        self,
        echo: Echo,
        captured: Instant,
        faults: list[Intervention],
        stops: list[Intervention],
    ) -> None:
        """Check whose commands the arm obeys, and how late they take effect."""
        s = self._settings
        if not echo.own:
            self._own_since = self._late_since = None
            who = f"{echo.commander!r}'s" if echo.commander else "nobody's"
            text = f"the arm obeys {who} commands, not ours: see who else runs, then arm again"
            faults.append(Intervention(Check.COMMANDER, "latched", text))
            return
        if self._own_since is None:
            self._own_since = captured
        if (
            echo.sequence
            and self._motion.is_after_all_commands(echo.decided)
            and self._enabled(Check.ECHO_LOST)
        ):
            text = "the arm echoes a command that was never sent: see what drives it"
            faults.append(Intervention(Check.ECHO_LOST, "latched", text))
        due = self._motion.first_command_after(echo.decided)
        if due is not None and echo.sequence == 0:
            due = max(due, self._own_since)  # none has been obeyed yet
        # How long the command after the one in effect has been on its way, plus one period.
        late = -math.inf if due is None else seconds_between(due, captured) + s.period
        if late <= s.echo_age:
            self._late_since = None
            return
        if self._late_since is None:
            self._late_since = captured
        text = (
            f"commands come into force at the arm {late * 1e3:.0f} ms late, or not at all: "
            f"{s.echo_age * 1e3:g} ms are allowed"
        )
        lost = seconds_between(self._late_since, captured) >= ECHO_LOST
        if lost and self._enabled(Check.ECHO_LOST):
            faults.append(Intervention(Check.ECHO_LOST, "latched", text))
        if self._enabled(Check.ECHO_LATE):
            stops.append(Intervention(Check.ECHO_LATE, "stopped", text))

    def _check_limits(self, arm: ArmState) -> list[Intervention]:
        """Check the limits that the arm confirms; the text names both values."""
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

    def _check_free_air(self, arm: ArmState) -> list[Intervention]:
        """Check the wrench in free air, which reveals a bias or a wrong tool."""
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
        """Apply all limits of motion; adds those that acted to ``notes``."""
        s = self._settings
        twist = self._limit_speed(wanted, notes)
        fastest, fastest_turn = math.inf, math.inf
        if goal is not None and self._slows:
            tip_x = arm.x + s.tip_length * math.cos(arm.heading)
            tip_y = arm.y + s.tip_length * math.sin(arm.heading)
            if math.hypot(goal.x - tip_x, goal.y - tip_y) < s.slow_radius:
                before = twist
                fastest, fastest_turn = s.slow_fraction * s.speed, s.slow_fraction * s.turn_rate
                twist = within_speed(twist, fastest, fastest_turn)
                _note(notes, Check.SLOW_DOWN, before, twist, "the goal is near")
        twist, rules = self._constrained(twist, arm, notes)
        if self._bounds_acceleration:
            dt = min(max(passed, 0.0), s.period + s.lateness)
            before, last = twist, self._last
            twist = within_acceleration(twist, last, s.acceleration * dt, s.turn_acceleration * dt)
            if twist is not before and (
                within_speed(twist, fastest, fastest_turn) is not twist
                or any(rule.broken_by(twist) for rule in rules)
            ):
                # The change from the last command to the new one would break a rule: brake first.
                twist = braked(last, rules, fastest, fastest_turn)
            _note(notes, Check.ACCELERATION, before, twist, "the command changes too fast")
        return twist

    def _limit_speed(self, wanted: Twist, notes: list[Intervention]) -> Twist:
        """Limit speed and turn rate by scaling the twist, which keeps the path."""
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

    def _constrained(
        self, twist: Twist, arm: ArmState, notes: list[Intervention]
    ) -> tuple[Twist, list[Constraint]]:
        """Apply workspace, wrench and touch together, because each alone could undo the others.

        Returns the remaining twist and the rules that it obeys.
        """
        s = self._settings
        rules: list[Constraint] = []
        if self._bounds_workspace:
            # While the command changes, the arm may still be as fast as the last one.
            fastest = max(fastest_point(twist, s), fastest_point(self._last, s))
            rules = workspace_constraints(arm, s, fastest)
            kept = constrained(twist, rules)
            _note(notes, Check.WORKSPACE, twist, kept, "the edge of the workspace is near")
        part = load(arm, s)
        if part > s.soft_fraction and self._bounds_wrench:
            left = approach_left(part, s.soft_fraction)
            held = wrench_constraints(twist, arm, left)
            text = f"the load is {part:.0%} of its limit: {left:.0%} of the approach is left"
            _note(notes, Check.WRENCH, twist, constrained(twist, held), text)
            rules = rules + held
        rules = rules + self._touch_rules(twist, arm, notes)
        return constrained(twist, rules) if rules else twist, rules

    def _touch_rules(
        self, twist: Twist, arm: ArmState, notes: list[Intervention]
    ) -> list[Constraint]:
        """Rules from the force on the skin, now and as predicted from its growth."""
        s, touch = self._settings, self._touched
        if touch is None:
            return []
        rules: list[Constraint] = []
        force = largest_skin_force(touch)
        part = force / s.skin_force
        if part > s.soft_fraction and self._bounds_skin:
            left = approach_left(part, s.soft_fraction)
            rules = squeeze_constraints(twist, arm, left)
            text = f"the skin feels {part:.0%} of its limit: {left:.0%} of the motion is left"
            _note(notes, Check.SKIN_FORCE, twist, constrained(twist, rules), text)
        if self._bounds_touch:
            ahead = touch.total_force + self._rising * s.touch_lead
            left = min(1.0, max(0.0, (s.touch_hard - ahead) / (s.touch_hard - s.touch_soft)))
            speed = left * s.speed
            if touch.total_force > s.touch_light:
                speed = min(speed, s.touch_speed)
            if speed < s.speed:
                slow = touch_constraints(touch, arm, speed) + force_constraints(arm, speed)
                text = f"the finger touches, up to {ahead:.1f} N soon: {speed:.3f} m/s against it"
                _note(notes, Check.TOUCH_RISING, twist, constrained(twist, slow), text)
                rules = rules + slow
        return rules


def _note(
    notes: list[Intervention], code: Check, before: Twist, after_it: Twist, text: str
) -> None:
    if after_it is not before:  # a limit that does not act returns the same object
        notes.append(Intervention(code, "limited", text))


def _not_finite(wanted: Twist) -> Intervention:
    text = f"the command is not finite: {wanted.vx}, {wanted.vy}, {wanted.omega}"
    return Intervention(Check.COMMAND_NOT_FINITE, "latched", text)
