"""Faults, noise and latency of the simulated arm as a user writes them."""

from __future__ import annotations

import math
import re
from typing import Any, Final

from sim_device.cupboard import ScheduledFault
from sim_device.faults import Window
from sim_device.world.arm import ArmFault, ArmSettings

PRESS: Final = 0.2
"""s that a button is pressed, and drives report a fault, when no time is given."""

MOMENTARY = (ArmFault.ESTOP, ArmFault.FAULT)
"""Faults that latch, so that a moment of them is enough."""

NOISES: Final = {
    "position": ("position_noise", "m"),
    "heading": ("heading_noise", "rad"),
    "speed": ("speed_noise", "m/s"),
    "turn": ("turn_noise", "rad/s"),
    "force": ("force_noise", "N"),
    "moment": ("moment_noise", "N·m"),
}
"""What may be noisy: field of `ArmSettings`, and unit."""

MAX_LATENCY: Final = 0.04
"""s each way; commands die 0.05 s after their receipt, so later ones would never take effect."""

_FAULT = re.compile(r"(?P<kind>[a-z_]+)(?:@(?P<at>\d+(?:\.\d*)?)s(?:\+(?P<for>\d+(?:\.\d*)?)s)?)?")


def parse_arm_faults(text: str) -> tuple[ScheduledFault, ...]:
    """Faults such as ``silent@5s+1s,estop@8s,biased``; ValueError says what is allowed."""
    return tuple(_fault(item) for item in text.split(",")) if text else ()


def _fault(text: str) -> ScheduledFault:
    match = _FAULT.fullmatch(text)
    kinds = ", ".join(ArmFault)
    allowed = f"allowed: KIND, KIND@Ts or KIND@Ts+Ds, parted by commas; KIND one of {kinds}"
    if match is None or match["kind"] not in tuple(ArmFault):
        raise ValueError(f"arm fault {text!r} is not understood; {allowed}")
    kind = ArmFault(match["kind"])
    lasting = PRESS if kind in MOMENTARY else math.inf
    duration = float(match["for"]) if match["for"] else lasting
    if duration == 0:
        raise ValueError(f"arm fault {text!r} lasts 0 s; {allowed}")
    return ScheduledFault(kind, Window(float(match["at"] or 0), duration))


def parse_noise(text: str) -> dict[str, Any]:
    """Fields of `ArmSettings` from such as ``force=0.1,position=1e-4``; ValueError."""
    fields: dict[str, Any] = {}
    units = ", ".join(f"{name} ({unit})" for name, (_, unit) in NOISES.items())
    allowed = f"allowed: NAME=STD, parted by commas; NAME one of {units}"
    for item in text.split(",") if text else ():
        name, _, figure = item.partition("=")
        try:
            value = float(figure)
        except ValueError:
            value = math.nan
        if name not in NOISES or not 0 <= value < math.inf:
            raise ValueError(f"arm noise {item!r} is not understood; {allowed}")
        fields[NOISES[name][0]] = value
    return fields


def arm_settings(rate: float, latency: float, noise: str) -> ArmSettings:
    """Arm with ``latency`` s each way and noise as `parse_noise` takes it; ValueError."""
    if not 0 <= latency <= MAX_LATENCY:
        raise ValueError(
            f"arm latency {latency:g} s given; allowed: 0 to {MAX_LATENCY:g} s, as commands die "
            "0.05 s after their receipt"
        )
    return ArmSettings(
        state_rate=rate, command_latency=latency, state_latency=latency, **parse_noise(noise)
    )
