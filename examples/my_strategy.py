"""A reaching strategy of your own.

Run it with ``tactile reach --strategy my_strategy:Wiggle --seed 7 --headless``.
"""

import math
from typing import Any

from reachd.interfaces import Twist


class Wiggle:
    """Goes straight to the goal; while something presses, sideways away from it."""

    def __init__(self, parameters: Any, rng: Any) -> None:
        """Keep the parameter set and ``rng``, the only source of chance: same seed, same reach."""
        self.p, self.rng, self.activity = parameters, rng, "straight"

    def start(self, goal: Any, now: Any) -> None:
        """Begin a reach."""
        self.activity = "straight"

    def step(self, touch: Any, arm: Any, goal: Any, now: Any) -> Twist:
        """Return the twist of the wrist pivot; called a hundred times a second."""
        tip_x = arm.x + self.p.tip_length * math.cos(arm.heading)
        tip_y = arm.y + self.p.tip_length * math.sin(arm.heading)
        angle = math.atan2(goal.y - tip_y, goal.x - tip_x)
        if touch.valid:
            pressed = touch.peak_force > self.p.burrow_force
            self.activity = "wiggle" if pressed else "straight"
        if self.activity == "wiggle":
            angle -= math.copysign(math.pi / 3, touch.peak_y)
        return Twist(self.p.v_max * math.cos(angle), self.p.v_max * math.sin(angle), 0.0)
