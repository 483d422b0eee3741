"""The rest field while a pipeline runs: whether it is known, how it is tared, how it drifts."""

from __future__ import annotations

import math
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from tactile_bus.instant import Instant
from tactiled.blocks import Reason
from tactiled.sensing.candidates import PLANE_TAXELS
from tactiled.sensing.force_model import ForceModel
from tactiled.sensing.layout import Layout
from tactiled.sensing.pipeline_settings import PipelineSettings
from tactiled.sensing.tare import Tare, TareReport

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

ROUGH_ATTEMPTS = 3
"""Refused tares after which a board whose rest was never known gets a rough one all the same: a
skin that is never left alone shall show something, marked as what it is."""


SUSPECT_TARE_S = 1.0
"""s that a suspect skin must be still, at least, before its rest field is taken anew."""


UNRECOVERED_SHARE = 0.06
"""Share of an array's recent peak that a released skin may still read: 89 to 178 µT of 3.9 mT were
seen on eFlesh boards."""
PEAK_MEMORY_S = 60.0
"""s, time constant with which that peak is forgotten."""
RECOVERY_S = 2.0
"""s, time constant with which the rest field then follows."""
STILL_TAU_S = 0.7
"""s of the mean that a still skin stays close to."""
STILL_UT = 4.0
"""µT rms within which it does, the chips' noise apart."""


class Recovery:
    """Lets the rest field of small arrays follow a skin that has been pressed and let go.

    Rubber comes back to within some per cent of its peak at once and takes minutes for the rest;
    on a few chips that reads as a contact of newtons. A still skin that reads no more than that
    share of what it has just borne is taken to be at rest.
    """

    def __init__(self, layout: Layout) -> None:
        self._small = layout.counts < PLANE_TAXELS
        self._any = bool(self._small.any())
        self.reset(layout)

    def reset(self, layout: Layout) -> None:
        """Nothing has been pressed."""
        self._peak = np.zeros(layout.arrays)
        self._mean = np.zeros((layout.arrays, 3, layout.width))

    def step(
        self, left_over: Float, healthy: Bool, noise_ut: float, elapsed: float
    ) -> Float | None:
        """Change of the rest field, (A, 3, n) µT, in one cycle; None when there is none.

        ``left_over``: (A, 3, n) µT in taxel axes, what compensation leaves. ``noise_ut``: µT rms.
        """
        if not self._any:
            return None
        size = np.where(healthy, np.linalg.norm(left_over, axis=1), 0.0).max(axis=1)
        self._peak = np.maximum(size, self._peak * math.exp(-elapsed / PEAK_MEMORY_S))
        away = left_over - self._mean
        self._mean += -math.expm1(-elapsed / STILL_TAU_S) * away
        spread = np.sqrt((away**2).mean(axis=1) * healthy)
        still = (spread < 2.5 * noise_ut + STILL_UT).all(axis=1)
        low = (size < UNRECOVERED_SHARE * self._peak) & (size > 2.0 * noise_ut)
        follow = self._small & still & low
        if not follow.any():
            return None
        share = -math.expm1(-elapsed / RECOVERY_S)
        use = follow[:, None] & healthy
        return np.where(use[:, None], share * self._mean, 0.0)


class RestState(Enum):
    """What is known of the rest field: nothing, it is being taken, it stands, it is in doubt."""

    UNKNOWN = "unknown"
    TARING = "taring"
    KNOWN = "known"
    SUSPECT = "suspect"


class RestField:
    """Owner of `ForceModel.rest`, in which a tare's result is put.

    ``known``: there is a rest field at all. ``rough``: it was taken while the skin moved, features
    on it are not valid. ``suspicion``: why it may not be what it was, features on it are not valid
    either; it is then taken anew by itself, once the skin is still. ``unrested``: (A, n) bool,
    taxels without one.
    """

    def __init__(
        self, layout: Layout, model: ForceModel, settings: PipelineSettings, known: bool
    ) -> None:
        self._layout, self._model, self._settings = layout, model, settings
        self.known = known
        self.rough = False
        self.unrested: Bool = np.zeros_like(layout.real) if known else layout.real.copy()
        self.suspicion: Reason | None = None
        self.report: TareReport | None = None
        self._tare: Tare | None = None
        self._forced = False
        self.bare: Bool = np.zeros_like(layout.real)
        """(A, n) taxels without a magnet, which feel nothing."""
        self._recovery = Recovery(layout)
        self._peak = 0.0
        self._refused = 0

    @property
    def taring(self) -> bool:
        """Whether a tare is under way."""
        return self._tare is not None

    @property
    def _first(self) -> bool:
        """Whether there is no rest field that could tell a contact."""
        return not self.known or self.rough or self.suspicion is not None

    @property
    def state(self) -> RestState:
        """What is known of the rest field."""
        if self.suspicion is not None:
            return RestState.SUSPECT
        if self.taring:
            return RestState.TARING
        return RestState.KNOWN if self.known and not self.rough else RestState.UNKNOWN

    def begin(self, noise_ut: Float, force: bool = False) -> None:
        """Begin a tare; ``noise_ut`` (3,) µT rms is what one sample is expected to vary by.

        ``force``: whatever the skin reads becomes its rest field, moving or under load.
        """
        seconds = self._settings.tare_s
        if self.suspicion is not None and not force:
            seconds = max(seconds, SUSPECT_TARE_S)
        self._tare = self._make(seconds, noise_ut)
        self._peak = 0.0
        self._refused = 0
        self._forced = force

    def suspect(self, reason: Reason, noise_ut: Float) -> None:
        """The rest field may not be what it was: take it anew once the skin is still."""
        if self.suspicion is None:
            self.suspicion = reason
            if self._tare is None:
                self.begin(noise_ut)

    def trust(self) -> None:
        """The skin reads again what it read before: the suspicion was of something that passed."""
        self.suspicion = None
        self._tare = None

    def forget(self) -> None:
        """Nothing is known of the rest field: another skin may be on, or another board."""
        self.known, self.rough, self.suspicion = False, False, None
        self.unrested = self._layout.real.copy()

    def _make(self, seconds: float, noise_ut: Float) -> Tare:
        return Tare((self._layout.arrays, 3, self._layout.width), seconds, noise_ut)

    def restore(self, rest_ut: Float, unrested: Bool, rough: bool) -> None:
        """Go on from a rest field that was in force before: (A, 3, n) µT, and (A, n) bool."""
        self._model.rest[:] = rest_ut
        self.unrested[:] = unrested
        self.known, self.rough = True, rough
        self._tare = None

    @property
    def rest_ut(self) -> Float:
        """(A, 3, n) µT: the rest field in force."""
        return self._model.rest

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
        averaged = self._forced and tare.cycles and tare.healthy.any()
        trouble = None if averaged else tare.trouble()
        limit = self._settings.tare_limit_n
        if trouble is None and not (self._first or self._forced) and self._peak > limit:
            trouble = (
                f"a taxel bears {self._peak:.1f} N, more than the {limit:g} N that drift may look "
                "like: lift the skin off everything, or force the tare"
            )
        self._tare = None
        if trouble is None:
            return self._accept(tare, sequence)
        self._refused += 1
        rough = self.suspicion is None and self._first and self._refused >= ROUGH_ATTEMPTS
        if rough and tare.cycles:
            return self._accept(tare, sequence, trouble)
        message = f"tare refused: {trouble}"
        self.report = TareReport(False, message, tare.cycles, 0.0, tare.expected, sequence)
        if self._first:
            self._tare = tare.again()
        return None

    def recover(self, left_over: Float, healthy: Bool, noise_ut: float, elapsed: float) -> None:
        """Follow a skin that has been let go; see `Recovery.step`."""
        change = self._recovery.step(left_over, healthy, noise_ut, elapsed)
        if change is not None:
            self._model.rest += change

    def follow(self, left_over: Float, free: Bool, share: float) -> None:
        """Move the rest of ``free`` (A, n) taxels by a share of what compensation left over."""
        self._model.rest += np.where(free[:, None], share * left_over, 0.0)

    def _accept(self, tare: Tare, sequence: int, trouble: str | None = None) -> Float:
        shift = np.where(tare.healthy[:, None], tare.mean, 0.0)
        self._model.rest += shift
        largest = float(np.abs(shift).max())
        left = self._layout.real & ~tare.healthy
        self.unrested &= left
        message = f"tared over {tare.cycles} cycles: rest field {self._moved(largest)}"
        if self._forced:
            message += ", as forced"
        if left.any():
            fate = "stay masked" if self.unrested.any() else "keep theirs"
            message += f"; {int(left.sum())} unhealthy taxels {fate}"
        if trouble is not None:
            message += f"; rough, for {trouble}; tare again when it is still"
        self.known, self.rough, self.suspicion = True, trouble is not None, None
        self._forced = False
        self._recovery.reset(self._layout)
        noise = tare.expected if self.rough else tare.noise()
        self.report = TareReport(True, message, tare.cycles, largest, noise, sequence)
        return shift

    def _moved(self, largest: float) -> str:
        if self.suspicion is not None:
            return f"taken anew ({self.suspicion.code})"
        return f"moved by up to {largest:.1f} µT" if self.known else "set"
