"""Fitted models in the pipeline: what the contact as a whole is, shared among its taxels.

The matrices of the arrays say which taxels bear how much of a contact, the models say how much
there is. Where the models predict a component of the force, the taxels' components are scaled so
that they add up to it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import Instant, seconds_between
from tactile_bus.net_types import NetModel
from tactiled.sensing.layout import Layout
from tactiled.sensing.net_force import NetEstimator

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

_LEAST_SHEAR_N = 1e-9  # below it a shear has no direction


class NetStage:
    """The models of one board, frame by frame; nothing to do where it has none."""

    def __init__(self, nets: Sequence[NetModel], layout: Layout) -> None:
        self._layout = layout
        self._estimators = tuple(NetEstimator(net) for net in nets)
        self._last: Instant | None = None

    @property
    def fitted(self) -> bool:
        """Whether there is any model."""
        return bool(self._estimators)

    def reset(self) -> None:
        """A tare has said what rest is: forget what was before."""
        for estimator in self._estimators:
            estimator.reset()
        self._last = None

    def pause(self) -> None:
        """The stream began anew: the next frame follows none, the rest stays as followed."""
        self._last = None

    def update(self, field: Float, captured: Instant) -> dict[str, float]:
        """Prediction by target; ``field`` (A, 3, n) µT over rest, ambient and all, all healthy."""
        elapsed = 0.0 if self._last is None else max(0.0, seconds_between(self._last, captured))
        self._last = captured
        flat = self._layout.flat_vectors(field).ravel()
        out: dict[str, float] = {}
        for estimator in self._estimators:
            values = estimator.step(flat, elapsed).tolist()
            out.update(zip(estimator.model.targets, values, strict=True))
        return out

    def share(self, forces: Float, net: dict[str, float]) -> None:
        """Scale ``forces`` (A, 3, n) N in place so that they add up to ``net``."""
        press = np.where(self._layout.real, np.maximum(-forces[:, 2], 0.0), 0.0)
        total = float(press.sum())
        part = press / total if total > 0.0 else self._layout.real / self._layout.taxels
        if "normal" in net:
            forces[:, 2] = -net["normal"] * part
        if "shear" in net:
            # a rig that measures one axis gives the size; the matrices give the direction
            along = forces[:, :2].sum(axis=(0, 2))
            size = float(np.hypot(along[0], along[1]))
            if size > _LEAST_SHEAR_N:
                forces[:, :2] = (along / size * net["shear"])[:, None] * part[:, None]
        for axis, target in enumerate(("shear_x", "shear_y")):
            if target in net:
                forces[:, axis] = net[target] * part
