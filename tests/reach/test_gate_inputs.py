"""The gate's eyes: ages, modes, confirmed limits, and how it is armed, latched and armed again.

Rows 4, 14, 16, 18, 22, 24, 26, 27 and 28 of the fault table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from reachd.safety import Decision, SafetyGate
from reachd.safety_settings import Check, SafetySettings
from reachd.seam import ZERO, ArmState, Goal, Touch, Twist
from reachd.workspace import Region
from tactile_bus.instant import Instant, after

MS = 1_000_000
T0 = Instant(5_000_000_000)
GOAL = Goal(0.358, 0.0, 0.0075, 40.0)
SLOWLY = Twist(0.001, 0.0, 0.0)
"""So slow that one cycle's acceleration reaches it."""


class Rig:
    """A gate with inputs in good health, each of which a test may spoil."""

    def __init__(self, gate: SafetyGate, touch: Touch, arm: ArmState, period: float) -> None:
        self.gate, self.touch, self.arm = gate, touch, arm
        self.now = T0
        self.period = round(period * 1e9)

    def step(self, wanted: Twist | None = SLOWLY, **how: object) -> Decision:
        """One cycle later, with fresh inputs unless ``touch`` or ``arm`` say otherwise."""
        self.now = Instant(self.now + int(how.pop("passed", self.period)))  # type: ignore[call-overload]
        touch = how.pop("touch", self.fresh_touch())
        arm = how.pop("arm", self.fresh_arm())
        return self.gate.step(wanted, touch, arm, GOAL, self.now, **how)  # type: ignore[arg-type]

    def fresh_touch(self, age: int = 0) -> Touch:
        at = Instant(self.now - age)
        return replace(self.touch, captured=at, received=at)

    def fresh_arm(self, age: int = 0, **values: object) -> ArmState:
        at = Instant(self.now - age)
        return replace(self.arm, captured=at, received=at, **values)  # type: ignore[arg-type]

    def request(self, **how: object) -> set[str]:
        """An operator's request now; returns the codes of the refusals."""
        refusals = self.gate.arm(
            how.pop("requested", self.now),  # type: ignore[arg-type]
            how.pop("touch", self.fresh_touch()),  # type: ignore[arg-type]
            how.pop("arm", self.fresh_arm()),  # type: ignore[arg-type]
            self.now,
            **how,  # type: ignore[arg-type]
        )
        assert all(r.effect == "refused" and r.text for r in refusals)
        return {r.code.value for r in refusals}


@pytest.fixture
def rig(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> Callable[..., Rig]:
    """Rig with an armed gate; ``off`` names disabled checks."""

    def make(*off: Check, armed: bool = True, **values: object) -> Rig:
        chosen = replace(settings, disabled=frozenset(off), **values)  # type: ignore[arg-type]
        gate = make_gate(chosen) if armed else SafetyGate(chosen)
        return Rig(gate, make_touch(), make_arm(), chosen.period)

    return make


def codes(decision: Decision) -> set[str]:
    return {i.code.value for i in decision.interventions}


def passes(decision: Decision) -> bool:
    """Whether motion came through, and nothing was said if it did."""
    if decision.twist == ZERO:
        assert decision.interventions, "a stop without a reason"
        return False
    assert decision.held is None
    return True


def test_a_healthy_command_passes_as_it_is(rig: Callable[..., Rig]) -> None:
    decision = rig().step()
    assert decision.twist == SLOWLY
    assert decision.interventions == ()
    assert decision.held is None
    assert decision.expiry == 0.06


# --- ages -------------------------------------------------------------------------------------

FEATURE_AGES = [
    (1 * MS, True),
    (100 * MS, True),
    (187 * MS - 1, True),
    (187 * MS, True),
    (187 * MS + 1, False),
    (200 * MS, False),
    (990 * MS, False),
]


@pytest.mark.parametrize(("age", "moves"), FEATURE_AGES)
def test_motion_ends_before_features_are_200_ms_old(
    age: int, moves: bool, rig: Callable[..., Rig]
) -> None:
    """A period and 3 ms early: the next command would otherwise still move beyond 200 ms."""
    r = rig()
    decision = aged(r, r.fresh_touch(), age)
    assert passes(decision) == moves
    assert (Check.FEATURES_STALE in {i.code for i in decision.interventions}) == (not moves)
    off = rig(Check.FEATURES_STALE)
    assert passes(aged(off, off.fresh_touch(), age))


def aged(r: Rig, touch: Touch, age: int) -> Decision:
    """Cycles until ``touch``, captured at T0, is ``age`` ns old; the last cycle's decision."""
    while r.now + r.period < T0 + age:
        r.step(touch=touch)
    return r.step(touch=touch, passed=T0 + age - r.now)


@pytest.mark.parametrize(
    ("age", "latches"),
    [(900 * MS, False), (1000 * MS, False), (1000 * MS + 1, True), (5000 * MS, True)],
)
def test_features_lost_for_a_second_latch(age: int, latches: bool, rig: Callable[..., Rig]) -> None:
    r = rig()
    decision = aged(r, r.fresh_touch(), age)
    assert (decision.held is Check.FEATURES_LOST) == latches
    assert r.step().held == decision.held, "fresh features alone do not arm it again"
    assert passes(r.step()) == (not latches)
    off = rig(Check.FEATURES_LOST)
    assert aged(off, off.fresh_touch(), age).held is None


def test_the_older_of_capture_and_arrival_counts(rig: Callable[..., Rig]) -> None:
    for captured, received in ((195 * MS, 0), (0, 195 * MS)):
        r = rig()
        for _ in range(30):
            touch = replace(r.touch, captured=r.now - captured, received=Instant(r.now - received))
            decision = r.step(touch=touch, passed=0)
            r.now = Instant(r.now + r.period)
        assert codes(decision) == {"features_stale"}


@pytest.mark.parametrize("spoil", [{"valid": False}, {"tip_force": math.nan}, {"peak_x": math.inf}])
def test_only_valid_features_count(spoil: dict, rig: Callable[..., Rig]) -> None:
    r = rig()
    moved = 0
    for _ in range(30):
        moved += passes(r.step(touch=replace(r.fresh_touch(), **spoil)))
    assert moved == 18


def test_features_out_of_order_do_not_make_older(rig: Callable[..., Rig]) -> None:
    r = rig()
    r.step()
    assert passes(r.step(touch=r.fresh_touch(age=500 * MS)))


@pytest.mark.parametrize(
    ("ahead", "used"), [(0, True), (10 * MS, True), (10 * MS + 1, False), (10**12, False)]
)
def test_features_from_the_future_are_not_used(
    ahead: int, used: bool, rig: Callable[..., Rig]
) -> None:
    for field in ("captured", "received"):
        r = rig()
        for _ in range(17):
            r.step(touch=r.touch)
        r.now = Instant(r.now + r.period)
        spoiled = replace(r.fresh_touch(), **{field: Instant(r.now + ahead)})
        decision = r.step(touch=spoiled, passed=0)
        assert (codes(decision) == set()) == used
        if not used:
            assert codes(decision) == {"features_future"}
            assert passes(decision), "the last good ones are 180 ms old: this once"
            assert codes(r.step(touch=spoiled)) == {"features_future", "features_stale"} or (
                ahead <= 20 * MS
            )
    off = rig(Check.FEATURES_FUTURE)
    assert codes(off.step(touch=replace(off.touch, captured=Instant(T0 + 10**12)))) == set()


@pytest.mark.parametrize(
    ("age", "moves"),
    [(0, True), (37 * MS, True), (37 * MS + 1, False), (50 * MS, False), (1000 * MS, False)],
)
def test_motion_ends_before_the_arms_state_is_50_ms_old(
    age: int, moves: bool, rig: Callable[..., Rig]
) -> None:
    for captured, received in ((age, 0), (0, age), (age, age)):
        r, off = rig(), rig(Check.ARM_STALE)
        for one, expected in ((r, moves), (off, True)):
            now = one.now + one.period
            arm = replace(one.arm, captured=now - captured, received=now - received)
            decision = one.step(arm=arm)
            assert passes(decision) == expected
            assert codes(decision) == (set() if expected else {"arm_stale"})


@pytest.mark.parametrize(("age", "latches"), [(1000 * MS, False), (1000 * MS + 1, True)])
def test_an_arm_that_was_away_latches(age: int, latches: bool, rig: Callable[..., Rig]) -> None:
    r = rig()
    assert (r.step(arm=r.fresh_arm(age=age - r.period)).held is Check.ARM_LOST) == latches
    r = rig(Check.ARM_LOST)
    assert r.step(arm=r.fresh_arm(age=age)).held is None


@pytest.mark.parametrize(("ahead", "moves"), [(10 * MS, True), (10 * MS + 1, False)])
def test_arm_state_from_the_future_stops(ahead: int, moves: bool, rig: Callable[..., Rig]) -> None:
    for field in ("captured", "received"):
        for off, expected in (((), moves), ((Check.ARM_FUTURE,), True)):
            r = rig(*off)
            stamp = Instant(r.now + r.period + ahead)
            arm = replace(r.fresh_arm(age=-r.period), **{field: stamp})
            assert passes(r.step(arm=arm)) == expected


def test_without_any_input_nothing_moves(rig: Callable[..., Rig]) -> None:
    r = rig(Check.ARM_STALE, Check.ARM_LOST)
    decision = r.step(arm=None)
    assert not passes(decision)
    assert codes(decision) == {"arm_stale"}
    decision = rig(armed=False).step(touch=None, arm=None)
    assert decision.held is Check.NOT_ARMED
    assert {"not_armed", "features_stale", "arm_stale"} <= codes(decision)


@pytest.mark.parametrize("field", ["x", "y", "heading", "fx", "fy", "mz"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_arm_state_that_is_not_finite_stops(
    field: str, value: float, rig: Callable[..., Rig]
) -> None:
    r = rig()
    decision = r.step(arm=r.fresh_arm(-r.period, **{field: value}))
    assert codes(decision) == {"arm_not_finite"}
    assert not passes(decision)
    assert passes(r.step())


STEP = Twist(0.04, 0.0, 0.0)


def still(r: Rig, cycles: int, wanted: Twist = STEP, **values: object) -> list[Decision]:
    """Cycles in which the arm, told to move, reports the same values with fresh stamps."""
    return [r.step(wanted, arm=r.fresh_arm(-r.period, **values)) for _ in range(cycles)]


def test_a_frozen_arm_state_latches(rig: Callable[..., Rig]) -> None:
    """The first cycle commands, the second sees the first, and 300 ms after it is too long."""
    r = rig()
    held = [d.held for d in still(r, 33)]
    assert held.index(Check.ARM_FROZEN) == 32
    assert passes(still(rig(Check.ARM_FROZEN), 100)[-1])
    r.now = after(r.now, 0.01)
    assert r.request() == set()
    assert all(passes(d) for d in still(r, 30)), "it begins to count anew"


@pytest.mark.parametrize(
    ("values", "frozen"),
    [
        ({"fx": -math.nextafter(1.0, 0)}, True),
        ({"y": 0.1, "heading": 0.2}, True),
        ({"fx": -1.0}, False),
        ({"fx": -9.0}, False),
        ({"fx": -9.0, "twist": Twist(0.03, 0.0, 0.0)}, True),
        ({"fx": -9.0, "twist": Twist(0.0, 0.0011, 0.0)}, True),
        ({"fx": -9.0, "twist": Twist(0.001, 0.0, 0.001)}, False),
        ({"fx": -9.0, "twist": Twist(0.0, 0.0, -0.002)}, True),
    ],
)
def test_a_jammed_arm_is_not_a_frozen_one(
    values: dict, frozen: bool, rig: Callable[..., Rig]
) -> None:
    assert (still(rig(), 60, **values)[-1].held is Check.ARM_FROZEN) == frozen


@pytest.mark.parametrize(
    ("wanted", "frozen"),
    [
        (ZERO, False),
        (Twist(0.0019, 0.0, 0.0), False),
        (Twist(0.0021, 0.0, 0.0), True),
        (Twist(0.0, 0.0, 0.012), False),  # 1.9 mm/s at the tip
        (Twist(0.0, 0.0, -0.014), True),
    ],
)
def test_an_arm_at_rest_is_not_a_frozen_one(
    wanted: Twist, frozen: bool, rig: Callable[..., Rig]
) -> None:
    assert (still(rig(), 60, wanted)[-1].held is Check.ARM_FROZEN) == frozen


@pytest.mark.parametrize("name", ["x", "y", "heading"])
@pytest.mark.parametrize(("step", "frozen"), [(1.1e-5, False), (1e-6, True)])
def test_an_arm_that_moves_is_not_a_frozen_one(
    name: str, step: float, frozen: bool, rig: Callable[..., Rig]
) -> None:
    for sign in (1.0, -1.0):
        r = rig()
        at = 0.0 if name != "x" else -0.2
        for k in range(40):
            decision = r.step(STEP, arm=r.fresh_arm(-r.period, **{name: at + sign * k * step}))
        # A creep of a micrometre a cycle adds up to motion after ten of them.
        assert decision.held is (Check.ARM_FROZEN if frozen and k * step < 1e-5 else None)


# --- loop -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("late", "moves"),
    [
        (0.0, True),
        (-1.0, True),
        (0.05, True),
        (math.nextafter(0.05, 1), False),
        (1.0, False),
        (math.nan, False),
        (math.inf, False),
    ],
)
def test_a_late_loop_does_not_move(late: float, moves: bool, rig: Callable[..., Rig]) -> None:
    decision = rig().step(lateness=late)
    assert passes(decision) == moves
    assert codes(decision) == (set() if moves else {"loop_late"})
    assert passes(rig(Check.LOOP_LATE).step(lateness=late))


@pytest.mark.parametrize(("passed", "moves"), [(60 * MS, True), (60 * MS + 1, False)])
def test_a_gap_between_cycles_counts_as_late(
    passed: int, moves: bool, rig: Callable[..., Rig]
) -> None:
    r = rig()
    now = Instant(r.now + passed)
    decision = r.step(passed=passed, arm=replace(r.arm, captured=now, received=now))
    assert passes(decision) == moves
    assert passes(r.step()), "one late cycle does not latch"


@pytest.mark.parametrize(("passed", "moves"), [(0, True), (-1, False), (-(10**9), False)])
def test_time_that_goes_back_stops(passed: int, moves: bool, rig: Callable[..., Rig]) -> None:
    for off in ((), (Check.CLOCK_BACKWARDS,)):
        r = rig(Check.ACCELERATION, *off)
        now = Instant(r.now + passed)
        arm = replace(r.arm, captured=now, received=now)
        decision = r.step(passed=passed, arm=arm, touch=replace(r.touch, captured=now))
        assert passes(decision) == (moves or bool(off))


# --- command ----------------------------------------------------------------------------------


@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_command_that_is_not_finite_latches(
    index: int, value: float, rig: Callable[..., Rig]
) -> None:
    parts = [0.001, 0.001, 0.001]
    parts[index] = value
    r = rig()
    decision = r.step(Twist(*parts))
    assert decision.twist == ZERO
    assert decision.held is Check.COMMAND_NOT_FINITE
    assert r.step().twist == ZERO, "it stays so"


def test_what_overflows_on_the_way_latches(rig: Callable[..., Rig]) -> None:
    """With the speed limit off, a slanted border takes a huge number beyond the range."""
    slanted = Region(((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)))
    off = (Check.SPEED, Check.TURN_RATE, Check.ACCELERATION)
    r = rig(*off, tip_region=slanted)
    decision = r.step(Twist(1.7e308, 1.0, 0.0))
    assert all(map(math.isfinite, (decision.twist.vx, decision.twist.vy)))
    r = rig(*off, tip_region=Region(((-1.0, -1.0), (1.0, -1.0), (1.0, 0.2), (-0.9, -0.9))))
    decision = r.step(Twist(-1.7e308, 1.7e308, 0.0), arm=r.fresh_arm(-r.period, x=0.0, y=-0.5))
    assert decision.twist == ZERO
    assert decision.held is Check.COMMAND_NOT_FINITE
    assert codes(decision) == {"command_not_finite"}
    assert r.step().held is Check.COMMAND_NOT_FINITE


@pytest.mark.parametrize(
    ("wanted", "failure", "words"),
    [
        (None, "ValueError: lost", "ValueError: lost"),
        (SLOWLY, "late thought", "late thought"),
        (None, None, "no command"),
    ],
)
def test_a_strategy_that_fails_latches(
    wanted: Twist | None, failure: str | None, words: str, rig: Callable[..., Rig]
) -> None:
    r = rig()
    decision = r.step(wanted, failure=failure)
    assert decision.twist == ZERO
    assert decision.held is Check.STRATEGY_FAILED
    assert words in decision.interventions[0].text
    assert r.step().held is Check.STRATEGY_FAILED


# --- mode and limits of the arm ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "moves", "held"),
    [
        ("ready", True, None),
        ("moving", True, None),
        ("stopped", False, None),
        ("estop", False, Check.ARM_MODE),
        ("fault", False, Check.ARM_MODE),
        ("teach", False, Check.ARM_MODE),
        ("", False, Check.ARM_MODE),
    ],
)
def test_the_arms_mode_decides(
    mode: str, moves: bool, held: Check | None, rig: Callable[..., Rig]
) -> None:
    r = rig()
    decision = r.step(arm=r.fresh_arm(mode=mode))
    assert passes(decision) == moves
    assert decision.held is held
    assert passes(r.step()) == (held is None), "a latch outlives its cause; a pause does not"
    r = rig(Check.ARM_MODE, Check.ARM_STOPPED)
    assert passes(r.step(arm=r.fresh_arm(mode=mode)))


LIMITS = ("v_max", "omega_max", "f_max", "m_max")


@pytest.mark.parametrize("name", LIMITS)
@pytest.mark.parametrize(
    ("factor", "confirmed"),
    [
        (1.0, True),
        (1.0009, True),
        (0.9991, True),
        (1.0011, False),
        (0.9989, False),
        (11.0, False),
        (0.0, False),
        (-1.0, False),
        (math.nan, False),
        (math.inf, False),
    ],
)
def test_the_arm_must_confirm_every_limit(
    name: str, factor: float, confirmed: bool, rig: Callable[..., Rig]
) -> None:
    r = rig(armed=False)
    arm = r.fresh_arm(**{name: factor * getattr(r.arm, name)})
    assert (r.request(arm=arm) == set()) == confirmed
    r = rig()
    decision = r.step(arm=r.fresh_arm(**{name: factor * getattr(r.arm, name)}))
    assert (decision.held is None) == confirmed, "nor may it change them later"
    r = rig(Check.ARM_LIMITS, armed=False)
    assert r.request(arm=r.fresh_arm(**{name: factor * getattr(r.arm, name)})) == set()


def test_the_refusal_names_both_values(rig: Callable[..., Rig]) -> None:
    r = rig(armed=False)
    arm = r.fresh_arm(v_max=0.5, omega_max=1.0)
    (refusal,) = r.gate.arm(T0, r.touch, arm, T0)
    assert "v_max is 0.5 m/s, 0.0608 asked; omega_max is 1 rad/s, 0.1 asked" in refusal.text


# --- arming, latching, arming again -----------------------------------------------------------


def test_it_begins_disarmed(rig: Callable[..., Rig]) -> None:
    r = rig(armed=False)
    assert not r.gate.armed
    decision = r.step()
    assert (decision.twist, decision.held, codes(decision)) == (
        ZERO,
        Check.NOT_ARMED,
        {"not_armed"},
    )
    assert r.request() == set()
    assert r.gate.armed
    assert r.gate.held is None
    assert passes(r.step())


@pytest.mark.parametrize(
    ("force", "torque", "arms"),
    [
        ((0.0, 0.0), 0.0, True),
        ((math.nextafter(1.0, 0), 0.0), 0.0, True),
        ((1.0, 0.0), 0.0, False),
        ((0.0, -1.0), 0.0, False),
        ((0.8, 0.6001), 0.0, False),
        ((0.7, -0.7), 0.0, True),
        ((0.0, 0.0), math.nextafter(0.158, 0), True),
        ((0.0, 0.0), 0.158, False),
        ((0.0, 0.0), -0.2, False),
    ],
)
def test_a_biased_force_sensor_does_not_arm(
    force: tuple[float, float], torque: float, arms: bool, rig: Callable[..., Rig]
) -> None:
    for off, expected in (((), arms), ((Check.FREE_AIR,), True)):
        r = rig(*off, armed=False)
        arm = r.fresh_arm(fx=force[0], fy=force[1], mz=torque)
        assert r.request(arm=arm) == (set() if expected else {"free_air"})
        assert r.gate.armed == expected


def test_in_contact_it_arms_only_after_free_air_was_once_seen(rig: Callable[..., Rig]) -> None:
    r = rig(armed=False)
    pressed = {"fx": -6.0}
    assert r.request(arm=r.fresh_arm(**pressed), free_air=False) == {"free_air"}
    assert r.request() == set()
    r.gate.disarm(r.now, "operator")
    r.now = after(r.now, 0.1)
    assert r.request(arm=r.fresh_arm(**pressed)) == {"free_air"}
    assert r.request(arm=r.fresh_arm(**pressed), free_air=False) == set()


@pytest.mark.parametrize(
    ("age", "arms"),
    [
        (0, True),
        (2000 * MS, True),
        (2000 * MS + 1, False),
        (-10 * MS, True),
        (-10 * MS - 1, False),
    ],
)
def test_only_a_fresh_request_arms(age: int, arms: bool, rig: Callable[..., Rig]) -> None:
    r = rig(armed=False)
    refused = r.request(requested=Instant(r.now - age))
    assert refused == (set() if arms else {"request_stale"})


def estop(r: Rig) -> Decision:
    return r.step(arm=r.fresh_arm(mode="estop"))


@pytest.mark.parametrize(("delay", "arms"), [(-1, False), (0, False), (1, True)])
def test_only_a_request_newer_than_the_latch_arms_again(
    delay: int, arms: bool, rig: Callable[..., Rig]
) -> None:
    r = rig()
    estop(r)
    latched = r.now
    r.step()
    r.step()
    refused = r.request(requested=Instant(latched + delay))
    assert refused == (set() if arms else {"request_stale"})


def test_a_request_made_while_the_fault_lasts_is_not_kept(rig: Callable[..., Rig]) -> None:
    r = rig()
    estop(r)
    asked = Instant(r.now + 1)
    assert r.request(requested=asked, arm=r.fresh_arm(mode="estop")) == {"arm_mode"}
    estop(r)
    r.step()
    assert r.request(requested=asked) == {"request_stale"}
    assert not passes(r.step())
    assert r.request(requested=r.now) == set()
    assert passes(r.step())


@pytest.mark.parametrize(
    ("how", "code"),
    [
        ({"touch": None}, "features_stale"),
        ({"arm": None}, "arm_stale"),
        ({"duplicate": True}, "duplicate_publisher"),
    ],
)
def test_every_condition_must_be_healthy_to_arm(
    how: dict, code: str, rig: Callable[..., Rig]
) -> None:
    r = rig(armed=False)
    assert code in r.request(**how)
    assert not r.gate.armed


def test_an_arm_that_stopped_by_itself_may_be_armed_but_not_moved(
    rig: Callable[..., Rig],
) -> None:
    r = rig(armed=False)
    assert r.request(arm=r.fresh_arm(mode="stopped")) == set()
    assert codes(r.step(arm=r.fresh_arm(mode="stopped"))) == {"arm_stopped"}
    assert passes(r.step())


def test_an_invalid_first_feature_does_not_arm(rig: Callable[..., Rig]) -> None:
    r = rig(armed=False)
    assert "features_stale" in r.request(touch=replace(r.fresh_touch(), valid=False))
    ahead = replace(r.fresh_touch(), captured=Instant(r.now + 10**9))
    assert "features_stale" in r.request(touch=ahead)


def test_a_second_publisher_latches(rig: Callable[..., Rig]) -> None:
    r = rig()
    assert r.step(duplicate=True).held is Check.DUPLICATE_PUBLISHER
    assert r.step().held is Check.DUPLICATE_PUBLISHER
    r = rig(Check.DUPLICATE_PUBLISHER)
    assert passes(r.step(duplicate=True))


def test_the_first_reason_stays_and_later_ones_are_told(rig: Callable[..., Rig]) -> None:
    r = rig()
    estop(r)
    decision = r.step(Twist(math.nan, 0, 0), lateness=1.0)
    assert decision.held is Check.ARM_MODE
    assert codes(decision) == {"arm_mode", "command_not_finite", "loop_late"}
    assert decision.interventions[0].code is Check.ARM_MODE
    r.gate.disarm(r.now, "end")
    assert r.gate.held is not None
    assert r.gate.held.code is Check.ARM_MODE
    assert [i.code for i in estop(r).interventions] == [Check.ARM_MODE]


def test_disarming_holds_until_a_newer_request(rig: Callable[..., Rig]) -> None:
    r = rig()
    r.gate.disarm(r.now, "the operator said so")
    decision = r.step()
    assert (decision.twist, decision.held) == (ZERO, Check.NOT_ARMED)
    assert decision.interventions[0].text == "the operator said so"
    assert r.request(requested=T0) == {"request_stale"}
    assert r.request() == set()


def test_arming_an_armed_gate_changes_nothing(rig: Callable[..., Rig]) -> None:
    r = rig()
    assert r.request(arm=None) == set()
    assert passes(r.step())


def test_after_arming_motion_grows_from_rest(rig: Callable[..., Rig]) -> None:
    """Not from what was last sent before the latch: 0.5 m/s² is 5 mm/s a cycle."""
    r = rig()
    for _ in range(20):
        r.step(Twist(0.04, 0.0, 0.0))
    estop(r)
    r.step()
    assert r.request() == set()
    assert r.step(Twist(0.04, 0.0, 0.0)).twist.vx == pytest.approx(0.005)


def test_a_limit_may_be_off_by_a_thousandth_at_most(rig: Callable[..., Rig]) -> None:
    for has, confirmed in ((1001.0, True), (999.0, True), (1001.01, False), (998.99, False)):
        r = rig(armed=False, arm_f_max=1000.0)
        assert (r.request(arm=r.fresh_arm(f_max=has)) == set()) == confirmed


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"lateness": 0.075}, "75.0 ms late, 50 at most"),
        ({"passed": -20_000_000}, "went back by 0.020 s"),
    ],
)
def test_the_loops_faults_are_told_in_figures(
    how: dict, words: str, rig: Callable[..., Rig]
) -> None:
    assert words in rig().step(**how).interventions[0].text


def test_interventions_have_words(rig: Callable[..., Rig]) -> None:
    r = rig()
    for decision in (
        r.step(lateness=1.0),
        r.step(arm=r.fresh_arm(age=60 * MS)),
        r.step(Twist(9.0, 9.0, 9.0)),
        estop(r),
    ):
        for one in decision.interventions:
            assert len(one.text) > 15
            assert one.effect in {"stopped", "limited", "latched", "ignored"}
