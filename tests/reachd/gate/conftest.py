"""An arm at 100 Hz whose motion is watched, in a scene that is turned and mirrored at will."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from reachd.gate.motion import Finding, MotionWatch
from reachd.gate.settings import SafetySettings
from reachd.interfaces import ZERO, Twist
from tactile_core.types import Instant

STEP = 10_000_000
"""ns between states, and between commands."""


class View:
    """How a scene is looked at: turned by ``angle`` (rad), after it was ``mirrored`` at y = 0."""

    def __init__(self, angle: float, mirrored: bool) -> None:
        self.angle, self.sign = angle, -1.0 if mirrored else 1.0
        self._c, self._s = math.cos(angle), math.sin(angle)

    def vector(self, x: float, y: float) -> tuple[float, float]:
        y *= self.sign
        return self._c * x - self._s * y, self._s * x + self._c * y

    def twist(self, twist: Twist) -> Twist:
        return Twist(*self.vector(twist.vx, twist.vy), self.sign * twist.omega)

    def state(
        self,
        x: float = 0.0,
        y: float = 0.0,
        heading: float = 0.0,
        twist: Twist = ZERO,
        fx: float = 0.0,
        fy: float = 0.0,
        mz: float = 0.0,
    ) -> dict[str, Any]:
        """Values of the arm's state as they look."""
        pivot, force = self.vector(x, y), self.vector(fx, fy)
        return {
            "x": pivot[0],
            "y": pivot[1],
            "heading": self.angle + self.sign * heading,
            "twist": self.twist(twist),
            "fx": force[0],
            "fy": force[1],
            "mz": self.sign * mz,
        }


VIEWS = [(0.0, False), (0.7, True), (2.2, False), (-1.9, True)]


class Watched:
    """An arm whose states a `MotionWatch` judges; it may be told one thing and do another."""

    def __init__(self, settings: SafetySettings, make_arm: Callable[..., Any], view: View) -> None:
        self.watch = MotionWatch(settings)
        self.now = Instant(5_000_000_000)
        self.view = view
        self.x, self.y, self.heading = 0.1, -0.07, 0.3
        self._make_arm = make_arm

    def judge(self, **values: Any) -> tuple[Finding, ...]:
        """Findings about a state now, with values of the scene as it is not turned."""
        pose = {"x": self.x, "y": self.y, "heading": self.heading}
        return self.watch.judge(self._make_arm(self.now, **self.view.state(**pose | values)))

    def tell(self, twist: Twist) -> None:
        self.watch.add_command(self.view.twist(twist), self.now)

    def move(self, twist: Twist, ns: int = STEP) -> None:
        self.now = Instant(self.now + ns)
        self.x += twist.vx * ns / 1e9
        self.y += twist.vy * ns / 1e9
        self.heading += twist.omega * ns / 1e9

    def run(
        self, cycles: int, told: Twist | None, does: Twist | None = None, **state: Any
    ) -> tuple[Finding, ...]:
        """First findings within ``cycles`` in which it ``does`` what it is ``told``, or not."""
        moves = does if does is not None else told or ZERO
        for _ in range(cycles):
            found = self.judge(**({"twist": moves} | state))
            if told is not None:
                self.tell(told)
            if found:
                return found
            self.move(moves)
        return ()


@pytest.fixture(scope="session")
def make_view() -> Callable[[float, bool], View]:
    return View


@pytest.fixture(params=VIEWS, ids=[f"{a:g}{'m' * m}" for a, m in VIEWS])
def view(request: pytest.FixtureRequest) -> View:
    """The views in which a scene must look the same."""
    return View(*request.param)


@pytest.fixture
def watched(
    settings: SafetySettings, make_arm: Callable[..., Any], view: View
) -> Callable[[], Watched]:
    """Makes watched arms at rest, which are seen from every `view`."""
    return lambda: Watched(settings, make_arm, view)
