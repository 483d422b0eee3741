"""Data passed between the parts of tactiled: chunks of a port, samples of an array, results."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensor_proto.can_transfers import CanFrame
from tactile_core.arrays import FloatArray
from tactile_core.geometry import Side
from tactile_core.types import Instant


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes or CAN frames from one read of a port. ``received``: instant right after the read."""

    received: Instant
    payload: bytes | tuple[CanFrame, ...]


class TaxelHealth(IntFlag):
    """Why a taxel is unhealthy; the low bits are `sensor_proto.packets.TaxelStatus`."""

    OK = 0
    SATURATED = 1
    STALE = 2
    READ_FAILED = 4
    FROZEN = 8
    OUT_OF_RANGE = 16
    MISSING = 32
    IMPLAUSIBLE = 64


@dataclass(frozen=True, slots=True, eq=False)
class SampleBlock:
    """One conversion of one array, in physical units and on host time.

    ``field_ut``: (n, 3) float µT in chip axes. ``temperature_c``: (1,) or (n,) °C.
    ``status``: (n,) uint8 of `TaxelHealth`. ``captured``: start of the conversion, mapped from
    board ticks (or from arrivals where the board has no clock); ``uncertainty`` in s.
    ``thermometer``: False where the board sends no temperatures, which are then NaN, not a fault.
    ``clock_usable``: False where the board's clock is so wrong that ``captured`` is useless.
    ``lsb_ut``: µT per count of x and y, and of z; None where the board does not report it.
    """

    array: int
    sequence: int
    captured: Instant
    received: Instant
    uncertainty: float
    field_ut: FloatArray
    temperature_c: FloatArray
    status: NDArray[np.uint8]
    thermometer: bool = True
    clock_usable: bool = True
    lsb_ut: tuple[float, float] | None = None

    def split(self, sizes: Sequence[int]) -> tuple[SampleBlock, ...]:
        """Split a block that holds all taxels of a board into one block per array.

        ``sizes``: taxels of each array. Boards without a notion of arrays send such blocks; any
        other block is returned unchanged.
        """
        if len(sizes) < 2 or self.array != 0 or self.field_ut.shape != (sum(sizes), 3):
            return (self,)
        ends = np.cumsum([0, *sizes]).tolist()
        common = len(self.temperature_c) == 1
        return tuple(
            replace(
                self,
                array=a,
                field_ut=self.field_ut[begin:end],
                temperature_c=self.temperature_c if common else self.temperature_c[begin:end],
                status=self.status[begin:end],
            )
            for a, (begin, end) in enumerate(itertools.pairwise(ends))
        )


@dataclass(frozen=True, slots=True, eq=False)
class Ambient:
    """The ambient field that compensation removed in one cycle, for each of A arrays.

    ``plane``: (A, 3, 3) µT; [a, c] = value at the array's centre, slope per m along its surface x,
    along its y, for component c of the field in ``ee``. ``support``: (A,) fraction of healthy
    taxels that agree with the fit. ``residual_ut``: (A,) their rms residual, µT. ``age``: (A,) s
    since the last valid fit. ``valid``: (A,) bool.
    """

    method: str
    plane: FloatArray
    support: FloatArray
    residual_ut: FloatArray
    age: FloatArray
    valid: NDArray[np.bool_]


class Reason(NamedTuple):
    """Why features are degraded or not valid.

    ``code``: stable identifier for programs, with ``:name`` of the array if it concerns one.
    ``text``: for people, with the remedy.
    """

    code: str
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Neighbouring taxels in contact; see ``ContactPatch.msg``. N and m; vectors (3,) in ``ee``.

    ``normal``: unit vector out of the skin. ``bound``: N; in 95 % of cycles the true normal force
    is within this of ``normal_force``.
    """

    array: int
    side: Side
    taxels: int
    normal_force: float
    peak_force: float
    force: FloatArray
    centroid: FloatArray
    normal: FloatArray
    bound: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Contact features; see ``ContactFeatures.msg``. Positions (3,) m and forces (3,) N in ``ee``.

    ``wrench``: (6,) fx, fy, fz in N, mx, my, mz in N·m about the origin of ``ee``. The bounds, N,
    hold the true value in 95 % of cycles.
    """

    valid: bool
    reasons: tuple[Reason, ...]
    peak_force: float
    peak_side: Side
    peak_position: FloatArray
    normal_force: float
    wrench: FloatArray
    tip_force: float
    tip_contact_time: float
    taxels_in_contact: int
    taxels_masked: int
    patches: tuple[Patch, ...] = field(default=())
    peak_force_bound: float = math.inf
    normal_force_bound: float = math.inf
    tip_force_bound: float = math.inf

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of ``reasons``."""
        return tuple(reason.code for reason in self.reasons)


@dataclass(frozen=True, slots=True, eq=False)
class Cycle:
    """Results of one sampling cycle of a board; its N taxels are ordered array by array.

    ``force``: (N, 3) N in taxel axes, NaN where the taxel is unhealthy. ``field_ut``: (N, 3) µT in
    taxel axes with rest field and temperature removed, before compensation; NaN likewise.
    ``normal_bound``: (N,) 95 % bounds of the normal forces' errors, N; NaN likewise. ``health``:
    (N,) uint8 of `TaxelHealth`. ``fault``: (N,) uint8 of `sensing.reasons.Fault`, the exact fault
    of each taxel. ``features_due``: whether the feature rate lets these features be sent; they are
    computed in every cycle.
    """

    sequence: int
    captured: Instant
    received: Instant
    uncertainty: float
    temperature_c: FloatArray
    field_ut: FloatArray
    force: FloatArray
    normal_bound: FloatArray
    health: NDArray[np.uint8]
    ambient: Ambient
    features: Features
    calibrated: bool
    features_due: bool = True
    fault: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
