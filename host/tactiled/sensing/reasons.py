"""Reasons why features are degraded or not valid: a stable code, and a text with the remedy.

Codes are for programs, texts for people; docs/faults.md lists them. A code never changes its
meaning. Codes that concern one array end in ``:name``.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from tactiled.blocks import Reason, TaxelHealth

# Faults of a chip's reading: codes, texts and health bits.


UInt8 = NDArray[np.uint8]


class Fault(IntEnum):
    """Why a taxel is masked, in more detail than `TaxelHealth`; the first fault found counts."""

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
        """What the chip does; follows its name in messages."""
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
    Fault.SATURATED: ("is saturated, by the board's report", _RANGE),
    Fault.STALE: ("sends an old reading, by the board's report", "lower the sample rate"),
    Fault.FAILED: ("does not answer, by the board's report or its temperature", _CABLE),
    Fault.NOT_FINITE: ("sends values that are not numbers", _CABLE),
    Fault.BEYOND_RANGE: ("reads more than any such chip can", _CABLE),
    Fault.TEMPERATURE: ("sends an impossible temperature: the read failed", _CABLE),
    Fault.ZEROS: ("reads zero on every axis: the read failed", _CABLE),
    Fault.ONES: ("reads the same count on every axis: the read failed", _CABLE),
    Fault.RAIL: ("is at the end of its range", _RANGE),
    Fault.WRAPPED: ("wrapped around its 16 bits by an unknown amount", _RANGE),
    Fault.JUMPED: ("jumped in a way that no contact does", _CABLE),
    Fault.SAME_BITS: (
        "sends the same bits as another chip",
        "check that every chip has an address of its own",
    ),
    Fault.COPY: ("sends a frame that came before", "update the board's firmware"),
    Fault.FROZEN: ("repeats one reading", _POWER),
    Fault.DITHER: ("is frozen except for its last bits", _POWER),
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


TARING = Reason("taring", "taring: leave the skin untouched")
REST_UNCERTAIN = Reason(
    "rest_uncertain", "the skin was never still while it tared: leave it untouched, then tare"
)
CLOCK_UNUSABLE = Reason(
    "clock_unusable",
    "the board's clock cannot be used, so nothing says when this was: see tactile status",
)
MODEL_PAUSED = Reason(
    "model_paused", "fitted model paused: taxels masked; forces are the taxels' own"
)


def array_missing(array: str) -> Reason:
    """An array's samples are missing from this cycle."""
    return Reason(f"array_missing:{array}", f"array {array} missing: check its cable")


def taxels_masked(array: str, share: float) -> Reason:
    """Too many of an array's taxels are masked."""
    return Reason(f"taxels_masked:{array}", f"taxels masked: {array} {share:.0%}")


def compensation_borrowed(array: str) -> Reason:
    """The array's ambient field is updated from the board's other arrays."""
    return Reason(f"compensation_borrowed:{array}", f"compensation borrowed: {array}")


def compensation_held(array: str) -> Reason:
    """The array's last good fit is still in use."""
    return Reason(f"compensation_held:{array}", f"compensation held: {array}")


def compensation_invalid(array: str) -> Reason:
    """The array's last good fit is too old."""
    return Reason(
        f"compensation_invalid:{array}", f"compensation invalid: {array}; lift the skin off"
    )


def uncertain(array: str, bound_n: float) -> Reason:
    """The bound of the forces exceeds the limit of the settings."""
    return Reason(
        f"uncertain:{array}",
        f"forces of {array} uncertain by {bound_n:.1f} N: the ambient field is not seen under "
        "this contact; lift the skin off",
    )


def too_warm(kelvin: float) -> Reason:
    """The temperature has changed by more than an unknown drift allows."""
    return Reason(
        "temperature_moved", f"temperature moved by {kelvin:+.0f} K since the tare: tare again"
    )


def field_jump(size_ut: float) -> Reason:
    """The field of all taxels has jumped at once, by more than the earth's can change."""
    return Reason(
        "field_jump",
        f"field changed on all taxels at once by {_field(size_ut)}: magnet near, or skin changed; "
        "lift off and tare",
    )


def gain_changed(gain: float) -> Reason:
    """All fields have changed by the same factor."""
    return Reason(
        "gain_changed",
        f"all fields changed by a factor of {gain:.2f}: gain or resolution changed; tare",
    )


def skin_off(array: str) -> Reason:
    """Most chips of an array read no magnet."""
    return Reason(f"skin_off:{array}", f"no magnets over {array}: put the skin on, then tare")


def magnet_lost(array: str, taxel: int) -> Reason:
    """A chip reads no magnet."""
    return Reason(
        f"magnet_lost:{array}", f"no magnet over taxel {taxel} of {array}: mend the skin, then tare"
    )


REPLUGGED = Reason(
    "replugged", "a board without a serial number was plugged in: taring, leave it untouched"
)


def _field(size_ut: float) -> str:
    return f"{size_ut / 1000:.1f} mT" if size_ut >= 950 else f"{size_ut:.0f} µT"


def chip_masked(array: str, chip: int, fault: Fault) -> Reason:
    """A chip of a small array is masked, and its neighbours bear no force."""
    return Reason(f"chip_masked:{array}", f"chip {chip} of {array} {fault.text}")


def masked_contact(array: str, taxels: list[int]) -> Reason:
    """There is a contact at or beside masked taxels, whose force is unknown."""
    which = ", ".join(str(taxel) for taxel in taxels[:3]) + (", …" if len(taxels) > 3 else "")
    several = "s" if len(taxels) > 1 else ""
    return Reason(
        f"masked_contact:{array}",
        f"contact at or beside masked taxel{several} {which} of {array}: its force is not known",
    )
