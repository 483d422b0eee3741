"""The seam between reachd and an arm. A driver for another arm is another class like this."""

from __future__ import annotations

from typing import Protocol

from tactile_bus.arm_types import ArmLimits, ArmState, Twist
from tactile_bus.instant import Instant


class ArmError(Exception):
    """The arm cannot be had, or does not do as it is told; the message names the remedy."""


class Arm(Protocol):
    """A planar velocity-controlled arm.

    `state`, `command` and `duplicated` are called by the control loop and never block; `open`,
    `request_limits` and `close` by other threads, and may. Every driver must see to it that the
    arm rests within 0.1 s after commands have ceased (each carries its expiry), even when this
    process is killed.
    """

    name: str
    """As it is called on the bus and in logs."""

    def open(self) -> None:
        """Get hold of the arm without moving it; `ArmError` when it cannot be had."""
        ...

    def state(self, now: Instant) -> ArmState | None:
        """Newest state, None before the first."""
        ...

    def command(self, twist: Twist, expiry: float, now: Instant) -> None:
        """Move the pivot at ``twist`` for at most ``expiry`` s, decided at ``now``.

        `ArmError` when it can no longer be commanded at all.
        """
        ...

    def duplicated(self, now: Instant) -> bool:
        """Whether somebody else was seen to speak for the arm, or to command it."""
        ...

    def request_limits(self, limits: ArmLimits) -> ArmLimits:
        """Ask for limits; returns those that the arm confirms; `ArmError` when it does not say."""
        ...

    def counters(self) -> dict[str, int]:
        """States received, and what was not used, by reason."""
        ...

    def close(self) -> None:
        """Let go of the arm."""
        ...
