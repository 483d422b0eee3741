"""A reaching strategy of your own.

tactile reach --strategy my_strategy:Wiggle --seed 7 --headless
"""

import math
from typing import Any

from reachd.interfaces import Twist


class Wiggle:
    """Straight at the goal; while something presses, sideways away from it."""

    def __init__(self, parameters: Any, rng: Any) -> None:
        """``rng``: the only source of chance, so that the same seed gives the same reach."""
        self.p, self.rng, self.activity = parameters, rng, "straight"

    def start(self, goal: Any, now: Any) -> None:
        """A reach begins."""
        self.activity = "straight"

    def step(self, touch: Any, arm: Any, goal: Any, now: Any) -> Twist:
        """A hundred times a second: how the wrist should move."""
        tip_x = arm.x + self.p.tip_length * math.cos(arm.heading)
        tip_y = arm.y + self.p.tip_length * math.sin(arm.heading)
        angle = math.atan2(goal.y - tip_y, goal.x - tip_x)
        if touch.valid:
            pressed = touch.peak_force > self.p.burrow_force
            self.activity = "wiggle" if pressed else "straight"
        if self.activity == "wiggle":
            angle -= math.copysign(math.pi / 3, touch.peak_y)
        return Twist(self.p.v_max * math.cos(angle), self.p.v_max * math.sin(angle), 0.0)
