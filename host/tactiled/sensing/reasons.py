"""Every reason for which features are degraded or not valid: a stable code, words and remedy.

Programs act on codes, people read texts; `docs/faults` lists them. A code never changes its
meaning. Those that concern one array end in ``:name``.
"""

from __future__ import annotations

from tactiled.blocks import Reason
from tactiled.sensing.readings import Fault

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
    """An array's samples did not come in this cycle."""
    return Reason(f"array_missing:{array}", f"array {array} missing: check its cable")


def taxels_masked(array: str, share: float) -> Reason:
    """More of an array's taxels are masked than features can do without."""
    return Reason(f"taxels_masked:{array}", f"taxels masked: {array} {share:.0%}")


def compensation_borrowed(array: str) -> Reason:
    """The array's ambient field is carried on by what the board's other arrays see."""
    return Reason(f"compensation_borrowed:{array}", f"compensation borrowed: {array}")


def compensation_held(array: str) -> Reason:
    """The array's last good fit is still in force."""
    return Reason(f"compensation_held:{array}", f"compensation held: {array}")


def compensation_invalid(array: str) -> Reason:
    """The array's last good fit is too old."""
    return Reason(
        f"compensation_invalid:{array}", f"compensation invalid: {array}; lift the skin off"
    )


def uncertain(array: str, bound_n: float) -> Reason:
    """The bound of the forces has passed the limit of the settings."""
    return Reason(
        f"uncertain:{array}",
        f"forces of {array} uncertain by {bound_n:.1f} N: the ambient field is not seen under "
        "this contact; lift the skin off",
    )


def too_warm(kelvin: float) -> Reason:
    """The temperature has changed more than an unknown drift allows."""
    return Reason(
        "temperature_moved", f"temperature moved by {kelvin:+.0f} K since the tare: tare again"
    )


def field_jump(size_ut: float) -> Reason:
    """The field of all taxels has leapt at once, by more than the earth's can change."""
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
    """A chip of a board of few is masked; its neighbours feel nothing."""
    return Reason(f"chip_masked:{array}", f"chip {chip} of {array} {fault.text}")


def masked_contact(array: str, taxels: list[int]) -> Reason:
    """A contact at or beside masked taxels: what they bear is not known."""
    which = ", ".join(str(taxel) for taxel in taxels[:3]) + (", …" if len(taxels) > 3 else "")
    several = "s" if len(taxels) > 1 else ""
    return Reason(
        f"masked_contact:{array}",
        f"contact at or beside masked taxel{several} {which} of {array}: its force is not known",
    )
