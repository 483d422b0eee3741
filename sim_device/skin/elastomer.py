"""Rubber between a contact and the magnets: spreading, compliance, creep, hysteresis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_device.skin.parameters import ElastomerParameters
from tactile_core.arrays import FloatArray

CALIBRATION_DWELL_S = 2.0
"""Seconds that a calibration rig waits at each load: about as long as a contact in use lasts."""

_HERTZ_VARIANCE = 0.2
"""Variance per axis of Hertz's pressure sqrt(1 - r²/a²), in units of a²."""


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """One contact on a skin, in ``ee``: ``position`` (3,) m, ``force`` (3,) N, ``radius`` m.

    The force is what the environment exerts on the skin; the radius is that of the patch.
    """

    position: FloatArray
    force: FloatArray
    radius: float = 4e-3


class Spreader:
    """Distributes contacts over taxels at ``position`` (N, 3) m in ``ee``."""

    def __init__(self, position: FloatArray, parameters: ElastomerParameters) -> None:
        self._position = position
        self._parameters = parameters
        self._norm2 = (position**2).sum(axis=1)

    def weights(self, contacts: Sequence[Contact]) -> FloatArray:
        """Share (C, N) of each contact that each taxel bears.

        Rows sum to one within ``full_reach`` of a taxel, and to zero beyond ``no_reach``: there the
        rigid body bears the contact and no taxel feels it.
        """
        p = self._parameters
        points = np.array([c.position for c in contacts])
        radius = np.array([c.radius for c in contacts])
        # |p - x|² multiplied out: exact to 1e-9 m here, and several times faster. Rounding can
        # make a distance of zero slightly negative.
        squared = self._norm2 - 2.0 * points @ self._position.T
        squared += (points**2).sum(axis=1)[:, None]
        nearest = np.maximum(squared.min(axis=1), 0.0)
        width = p.spread**2 + _HERTZ_VARIANCE * radius**2
        # Measured from the nearest taxel so that far contacts do not underflow to 0/0.
        share: FloatArray = np.exp((nearest[:, None] - squared) / (2.0 * width[:, None]))
        borne = (p.no_reach - np.sqrt(nearest)) / (p.no_reach - p.full_reach)
        share *= (np.clip(borne, 0.0, 1.0) / share.sum(axis=1))[:, None]
        return share

    def force(self, contacts: Sequence[Contact]) -> FloatArray:
        """Force (N, 3) N in ``ee`` on each taxel."""
        if not contacts:
            return np.zeros_like(self._position)
        force: FloatArray = self.weights(contacts).T @ np.array([c.force for c in contacts])
        return force


class Elastomer:
    """Displacement of each magnet under the force on its taxel, both in taxel axes.

    Prompt compliance, one Kelvin-Voigt branch for creep, and for hysteresis a play operator whose
    half-width is a fixed share of the greatest recent load: the loop is the same share of its
    peak whatever the peak, and fades as the rubber forgets it.
    """

    def __init__(
        self, parameters: ElastomerParameters, stiffness_factor: FloatArray, travel: FloatArray
    ) -> None:
        """``stiffness_factor`` (N,) of each taxel; ``travel`` (N,) m that its magnet can sink."""
        p = self._parameters = parameters
        n = len(stiffness_factor)
        nominal = np.array([p.shear_stiffness, p.shear_stiffness, p.normal_stiffness])
        self._compliance = 1.0 / (nominal * stiffness_factor[:, None])
        self._travel = travel
        loop = np.array([p.hysteresis_shear, p.hysteresis_shear, p.hysteresis_normal])
        # The play lags by knee · load on the way up and leads by knee · peak on the way down. They
        # are farthest apart at (1 - 2 knee) · peak, where the loop should be loop · peak wide.
        self._play_weight = loop / (2.0 * p.hysteresis_knee * (1.0 - p.hysteresis_knee))
        self._force = np.zeros((n, 3))
        self._creep = np.zeros((n, 3))
        self._play = np.zeros((n, 3))
        self._peak = np.zeros((n, 3))

    def reset(self) -> None:
        """Return to fully recovered rubber."""
        for state in (self._force, self._creep, self._play, self._peak):
            state[:] = 0.0

    def load(self, force: FloatArray, dt: float) -> FloatArray:
        """Displacement (N, 3) m after ``dt`` s in which the force went to ``force`` (N, 3) N."""
        if not dt >= 0:
            raise ValueError(f"time went back by {-dt} s")
        p = self._parameters
        mean = 0.5 * (self._force + force)
        self._creep += (mean - self._creep) * -math.expm1(-dt / p.creep_time)
        self._force = force
        self._peak = np.maximum(np.abs(force), self._peak * math.exp(-dt / p.hysteresis_time))
        slack = p.hysteresis_knee * self._peak
        self._play = np.minimum(np.maximum(self._play, force - slack), force + slack)
        effective = force + p.creep * self._creep + self._play_weight * (self._play - force)
        return self._displace(effective)

    def settled(self, force: FloatArray) -> FloatArray:
        """Displacement (..., N, 3) m of recovered rubber `CALIBRATION_DWELL_S` after loading.

        ``force``: (..., N, 3) N. This is what a calibration rig sees, which loads and never unloads
        before it reads. Changes no state.
        """
        p = self._parameters
        crept = -p.creep * math.expm1(-CALIBRATION_DWELL_S / p.creep_time)
        return self._displace(force * (1.0 + crept - self._play_weight * p.hysteresis_knee))

    def _displace(self, effective: FloatArray) -> FloatArray:
        displacement: FloatArray = effective * self._compliance
        np.maximum(displacement[..., 2], -self._travel, out=displacement[..., 2])
        return displacement
