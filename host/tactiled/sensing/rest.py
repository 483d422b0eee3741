"""The rest field while a pipeline runs: whether it is known, how it is tared, how it drifts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import Instant
from tactiled.sensing.force_model import ForceModel
from tactiled.sensing.layout import Layout
from tactiled.sensing.pipeline_settings import PipelineSettings
from tactiled.sensing.tare import Tare, TareReport

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

ROUGH_ATTEMPTS = 3
"""Refused tares after which a board whose rest was never known gets a rough one all the same: a
skin that is never left alone shall show something, marked as what it is."""


class RestField:
    """Owner of `ForceModel.rest`, in which a tare's result is put.

    ``known``: there is a rest field at all. ``rough``: it was taken while the skin moved, features
    on it are not valid. ``unrested``: (A, n) bool, taxels without one.
    """

    def __init__(
        self, layout: Layout, model: ForceModel, settings: PipelineSettings, known: bool
    ) -> None:
        self._layout, self._model, self._settings = layout, model, settings
        self.known = known
        self.rough = False
        self.unrested: Bool = np.zeros_like(layout.real) if known else layout.real.copy()
        self.report: TareReport | None = None
        self._tare: Tare | None = None
        self._peak = 0.0
        self._refused = 0
        self._force = False

    @property
    def taring(self) -> bool:
        """Whether a tare is under way."""
        return self._tare is not None

    @property
    def _first(self) -> bool:
        """Whether there is no rest field yet that could tell a contact."""
        return not self.known or self.rough

    def begin(self, noise_ut: Float, force: bool = False) -> None:
        """Begin a tare; ``noise_ut`` (3,) µT rms is what one sample is expected to vary by.

        ``force``: its result is taken whatever speaks against it.
        """
        self._force = force
        shape = (self._layout.arrays, 3, self._layout.width)
        self._tare = Tare(shape, self._settings.tare_s, noise_ut)
        self._peak = 0.0
        self._refused = 0

    def note_peak(self, newton: float) -> None:
        """Largest force of a taxel in this cycle, N: a tare under way must not take it for rest."""
        self._peak = max(self._peak, newton)

    def advance(
        self, field: Float, healthy: Bool, whole: bool, captured: Instant, sequence: int
    ) -> Float | None:
        """Take one cycle into the tare under way.

        ``field``: (A, 3, n) µT over the rest field in force. Returns by how much the rest field
        has moved when this cycle ends the tare and its result is in force; else None.
        """
        tare = self._tare
        if tare is None or not tare.add(field, healthy, whole, captured):
            return None
        trouble = tare.trouble()
        limit = self._settings.tare_limit_n
        if trouble is None and not self._first and self._peak > limit:
            trouble = (
                f"a taxel bears {self._peak:.1f} N, more than the {limit:g} N that drift may look "
                "like: lift the skin off everything"
            )
        self._tare = None
        if self._force and tare.cycles and tare.healthy.any():
            trouble = None
        if trouble is None:
            return self._accept(tare, sequence)
        self._refused += 1
        if self._first and self._refused >= ROUGH_ATTEMPTS and tare.cycles:
            return self._accept(tare, sequence, trouble)
        message = f"tare refused: {trouble}"
        self.report = TareReport(False, message, tare.cycles, 0.0, tare.expected, sequence)
        if self._first:
            self._tare = tare.again()
        return None

    def follow(self, left_over: Float, free: Bool, share: float) -> None:
        """Move the rest of ``free`` (A, n) taxels by a share of what compensation left over."""
        self._model.rest += np.where(free[:, None], share * left_over, 0.0)

    def _accept(self, tare: Tare, sequence: int, trouble: str | None = None) -> Float:
        shift = np.where(tare.healthy[:, None], tare.mean, 0.0)
        self._model.rest += shift
        largest = float(np.abs(shift).max())
        left = self._layout.real & ~tare.healthy
        self.unrested &= left
        message = f"tared over {tare.cycles} cycles: rest fields moved by up to {largest:.1f} µT"
        if left.any():
            fate = "stay masked" if self.unrested.any() else "keep theirs"
            message += f"; {int(left.sum())} unhealthy taxels {fate}"
        if trouble is not None:
            message += f"; rough, for {trouble}; tare again when it is still"
        self.known, self.rough = True, trouble is not None
        noise = tare.expected if self.rough else tare.noise()
        self.report = TareReport(True, message, tare.cycles, largest, noise, sequence)
        return shift
