"""The rest field of chips that came late: taken by itself once the skin is untouched and still."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import Instant
from tactiled.sensing.tare import Tare

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


class LateRest:
    """Averages over ``seconds`` what chips without a rest field read."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._tare: Tare | None = None
        self._wanted: Bool | None = None

    def forget(self) -> None:
        """Something moved, or all have their rest."""
        self._tare = self._wanted = None

    def advance(
        self, left_over: Float, wanted: Bool, noise_ut: Float, captured: Instant
    ) -> Float | None:
        """Take one untouched cycle; (A, 3, n) µT to add to the rest field when it is known.

        ``left_over``: (A, 3, n) µT over the present rest field, ambient field taken off.
        ``wanted``: (A, n) healthy taxels without a rest; begins anew when it changes.
        ``noise_ut``: (3,) µT rms of one sample.
        """
        if self._tare is None or self._wanted is None or (self._wanted != wanted).any():
            self._tare = Tare(left_over.shape, self._seconds, noise_ut)
            self._wanted = wanted
        if not self._tare.add(left_over, wanted, True, captured):
            return None
        tare, self._tare = self._tare, None
        if tare.trouble() is not None:
            return None
        return np.where(wanted[:, None], tare.mean, 0.0)
