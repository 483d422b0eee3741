"""Healthy inputs, an armed gate, a finger in free air, and a lab: fake arm, fake board, reachd."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from reachd.gate.gate import Decision, SafetyGate
from reachd.gate.settings import Check, SafetySettings
from reachd.interfaces import ZERO, ArmState, Goal, Strategy, Touch, Twist
from reachd.strategies.parameters import SETS
from tactile_core.types import ArmLimits, Instant, after

if TYPE_CHECKING:
    from tests.support.reachd_lab import ReachdLab

T0 = Instant(5_000_000_000)
GOAL = Goal(0.358, 0.0, 0.0075, 40.0)
SLOWLY = Twist(0.001, 0.0, 0.0)
"""A twist slow enough to be reached in one cycle's acceleration."""


@pytest.fixture(scope="session")
def t0() -> Instant:
    """Begin of the tests' virtual time."""
    return T0


@pytest.fixture(scope="session")
def settings() -> SafetySettings:
    """The gate's settings of the hardware set."""
    return SETS["hardware"].safety


@pytest.fixture(scope="session")
def make_gate(
    make_touch: Callable[..., Touch], make_arm: Callable[..., ArmState]
) -> Callable[[SafetySettings], SafetyGate]:
    """Gate with the given settings, armed at T0 and stepped once."""

    def make(settings: SafetySettings) -> SafetyGate:
        gate = SafetyGate(settings)
        assert gate.arm(T0, make_touch(), make_arm(), T0) == ()
        gate.step(Twist(0.0, 0.0, 0.0), make_touch(), make_arm(), None, T0)
        return gate

    return make


class Rig:
    """A gate with healthy inputs, each of which a test may replace."""

    def __init__(self, gate: SafetyGate, touch: Touch, arm: ArmState, period: float) -> None:
        self.gate, self.touch, self.arm = gate, touch, arm
        self.now = T0
        self.period = round(period * 1e9)

    def step(self, wanted: Twist | None = SLOWLY, **how: Any) -> Decision:
        """Run one cycle, with fresh inputs unless ``touch`` or ``arm`` are given."""
        self.now = Instant(self.now + int(how.pop("passed", self.period)))
        touch = how.pop("touch", self.fresh_touch())
        arm = how.pop("arm", self.fresh_arm())
        return self.gate.step(wanted, touch, arm, GOAL, self.now, **how)

    def fresh_touch(self, age: int = 0) -> Touch:
        at = Instant(self.now - age)
        return replace(self.touch, captured=at, received=at)

    def fresh_arm(self, age: int = 0, **values: Any) -> ArmState:
        at = Instant(self.now - age)
        return replace(self.arm, captured=at, received=at, **values)

    def request(self, **how: Any) -> set[str]:
        """Arm at an operator's request now; returns the codes of the refusals."""
        refusals = self.gate.arm(
            how.pop("requested", self.now),
            how.pop("touch", self.fresh_touch()),
            how.pop("arm", self.fresh_arm()),
            self.now,
            **how,
        )
        assert all(r.effect == "refused" and r.text for r in refusals)
        return {r.code.value for r in refusals}


@pytest.fixture(scope="session")
def rig(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> Callable[..., Rig]:
    """Rig with an armed gate; ``off``: disabled checks."""

    def make(*off: Check, armed: bool = True, **values: Any) -> Rig:
        chosen = replace(settings, disabled=frozenset(off), **values)
        gate = make_gate(chosen) if armed else SafetyGate(chosen)
        return Rig(gate, make_touch(), make_arm(), chosen.period)

    return make


@pytest.fixture(scope="session")
def send(
    make_gate: Callable, make_touch: Callable, make_arm: Callable, settings: SafetySettings
) -> Callable[..., Decision]:
    """Send one command through an armed gate; ACCELERATION is off unless in ``on``."""

    def go(
        wanted: Twist,
        *off: Check,
        on: tuple[Check, ...] = (),
        goal: Goal | None = None,
        values: dict | None = None,
        cycles: int = 1,
        **arm: Any,
    ) -> Decision:
        disabled = frozenset({Check.ACCELERATION, *off}) - set(on)
        gate: SafetyGate = make_gate(replace(settings, disabled=disabled, **(values or {})))
        for k in range(1, cycles + 1):
            now = Instant(T0 + k * 10_000_000)
            decision = gate.step(wanted, make_touch(now), make_arm(now, **arm), goal, now)
        assert decision.held is None
        return decision

    return go


@pytest.fixture(scope="session")
def codes() -> Callable[[Decision], list[str]]:
    """Codes of a decision's interventions, in order."""

    def of(decision: Decision) -> list[str]:
        return [i.code.value for i in decision.interventions]

    return of


@pytest.fixture(scope="session")
def passes() -> Callable[[Decision], bool]:
    """Whether motion passed; also checks that it is never stopped without an intervention."""

    def judge(decision: Decision) -> bool:
        if decision.twist == ZERO:
            assert decision.interventions, "a stop without a reason"
            return False
        assert decision.held is None
        return True

    return judge


@pytest.fixture(scope="session")
def fly(make_touch: Callable[..., Touch], make_arm: Callable[..., ArmState]) -> Callable[..., dict]:
    """Move a finger in free air as a strategy commands, by small Euler steps."""

    def run(
        strategy: Strategy,
        goal: Goal,
        seconds: float,
        *,
        dt: float = 0.01,
        pose: tuple[float, float, float] = (-0.2, 0.0, 0.0),
        feel: Callable[[float], Touch] | None = None,
    ) -> dict[str, np.ndarray]:
        x, y, heading = pose
        rows, activities = [], []
        strategy.start(goal, T0)
        for k in range(round(seconds / dt)):
            now = after(T0, k * dt)
            arm = make_arm(now, x=x, y=y, heading=heading)
            touch = feel(k * dt) if feel else make_touch(now)
            twist = strategy.step(touch, arm, goal, now)
            rows.append((k * dt, x, y, heading, twist.vx, twist.vy, twist.omega))
            activities.append(strategy.activity)
            x, y = x + twist.vx * dt, y + twist.vy * dt
            heading += twist.omega * dt
        table = np.array(rows)
        length = 0.158
        return {
            "t": table[:, 0],
            "pivot": table[:, 1:3],
            "heading": table[:, 3],
            "twist": table[:, 4:],
            "tip": table[:, 1:3]
            + length * np.column_stack([np.cos(table[:, 3]), np.sin(table[:, 3])]),
            "activity": np.array(activities),
            "end": np.array([x + length * math.cos(heading), y + length * math.sin(heading)]),
        }

    return run


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[ReachdLab]:
    # Imported here because the mutation run starts these tests thousands of times without a lab.
    from tests.support.reachd_lab import ReachdLab

    made = ReachdLab(tmp_path)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def hardware_limits() -> ArmLimits:
    return replace(SETS["hardware"].safety.arm_limits)
