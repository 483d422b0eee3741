"""What can be wrong with a chip's reading: codes, the health bits that go with them, and words."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from tactiled.blocks import TaxelHealth

UInt8 = NDArray[np.uint8]


class Fault(IntEnum):
    """Why a taxel is masked, in more detail than `TaxelHealth`; what is first found counts."""

    NONE = 0
    MISSING = 1
    SATURATED = 2
    STALE = 3
    FAILED = 4
    NOT_FINITE = 5
    BEYOND_RANGE = 6
    TEMPERATURE = 7
    ZEROS = 8
    ONES = 9
    RAIL = 10
    WRAPPED = 11
    JUMPED = 12
    SAME_BITS = 13
    COPY = 14
    FROZEN = 15
    DITHER = 16
    AXIS_STUCK = 17
    TEMPERATURE_JUMP = 18
    TEMPERATURE_STUCK = 19
    UNRESTED = 20
    NO_MAGNET = 21

    @property
    def text(self) -> str:
        """What the chip does, after its name."""
        return _WORDS[self][0]

    @property
    def remedy(self) -> str:
        """What to do about it."""
        return _WORDS[self][1]


_CABLE = "check its cable and solder joints"
_POWER = "switch the board off and on; if it stays so, the chip is broken"
_RANGE = "set a lower gain or a coarser resolution on the board, or move the magnets away"

_WORDS = {
    Fault.NONE: ("reads well", "nothing to do"),
    Fault.MISSING: ("is missing: its array's samples did not come", "check the array's cable"),
    Fault.SATURATED: ("is saturated, says the board", _RANGE),
    Fault.STALE: ("sends an old reading, says the board", "lower the sample rate"),
    Fault.FAILED: ("does not answer, says the board or its temperature", _CABLE),
    Fault.NOT_FINITE: ("sends what is not a number", _CABLE),
    Fault.BEYOND_RANGE: ("reads more than any such chip can", _CABLE),
    Fault.TEMPERATURE: ("sends an impossible temperature: the read failed", _CABLE),
    Fault.ZEROS: ("reads zero on every axis: the read failed", _CABLE),
    Fault.ONES: ("reads the same count on every axis: the read failed", _CABLE),
    Fault.RAIL: ("is at the end of its range", _RANGE),
    Fault.WRAPPED: ("went over the end of its 16 bits, how far is not sure", _RANGE),
    Fault.JUMPED: ("jumped as no contact makes it", _CABLE),
    Fault.SAME_BITS: (
        "sends the same bits as another chip",
        "check that every chip has an address of its own",
    ),
    Fault.COPY: ("sends a frame that came before", "update the board's firmware"),
    Fault.FROZEN: ("repeats one reading", _POWER),
    Fault.DITHER: ("is frozen but for its last bits", _POWER),
    Fault.AXIS_STUCK: ("has an axis that repeats one reading", _POWER),
    Fault.TEMPERATURE_JUMP: ("has a temperature that jumps", _CABLE),
    Fault.TEMPERATURE_STUCK: ("has a temperature that stands still", _POWER),
    Fault.UNRESTED: (
        "has no rest field yet",
        "leave the skin untouched: it is taken once still, or by tare",
    ),
    Fault.NO_MAGNET: ("has no magnet above it any more", "mend or change the skin"),
}

_BITS = {
    Fault.NONE: TaxelHealth.OK,
    Fault.MISSING: TaxelHealth.MISSING,
    Fault.SATURATED: TaxelHealth.SATURATED,
    Fault.STALE: TaxelHealth.STALE,
    Fault.FAILED: TaxelHealth.READ_FAILED,
    Fault.NOT_FINITE: TaxelHealth.OUT_OF_RANGE,
    Fault.BEYOND_RANGE: TaxelHealth.OUT_OF_RANGE,
    Fault.TEMPERATURE: TaxelHealth.OUT_OF_RANGE,
    Fault.ZEROS: TaxelHealth.READ_FAILED,
    Fault.ONES: TaxelHealth.READ_FAILED,
    Fault.RAIL: TaxelHealth.SATURATED,
    Fault.WRAPPED: TaxelHealth.IMPLAUSIBLE,
    Fault.JUMPED: TaxelHealth.IMPLAUSIBLE,
    Fault.SAME_BITS: TaxelHealth.IMPLAUSIBLE,
    Fault.COPY: TaxelHealth.STALE,
    Fault.FROZEN: TaxelHealth.FROZEN,
    Fault.DITHER: TaxelHealth.FROZEN,
    Fault.AXIS_STUCK: TaxelHealth.FROZEN,
    Fault.TEMPERATURE_JUMP: TaxelHealth.OUT_OF_RANGE,
    Fault.TEMPERATURE_STUCK: TaxelHealth.OUT_OF_RANGE,
    Fault.UNRESTED: TaxelHealth.OUT_OF_RANGE,
    Fault.NO_MAGNET: TaxelHealth.OUT_OF_RANGE,
}

BITS: UInt8 = np.array([int(_BITS[fault]) for fault in Fault], np.uint8)
"""`TaxelHealth` of each `Fault`."""
