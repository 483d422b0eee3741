"""Whether numbers can be computed with."""

from __future__ import annotations

import math

from reachd.seam import Touch


def finite(*values: float) -> bool:
    """Whether all are finite, and so is their sum: what overflows it is no measurement.

    One sum is several times faster than asking each, and this is asked in every control cycle.
    """
    return math.isfinite(sum(values))


def usable(touch: Touch) -> bool:
    """Whether ``touch`` may be acted on: valid, and every number in it finite."""
    return touch.valid and finite(
        touch.peak_force, touch.peak_x, touch.peak_y, touch.total_force, touch.tip_force
    )
