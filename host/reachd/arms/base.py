"""The seam between reachd and an arm. A driver for another arm is another class like this."""

from __future__ import annotations

from typing import Protocol

from tactile_core.types import ArmLimits, ArmState, Instant, Twist


class ArmError(Exception):
    """The arm cannot be had, or does not do as it is told; the message names the remedy."""


class Arm(Protocol):
    """A planar velocity-controlled arm.

    `state`, `command`, `duplicated` and `rivalled` are called by the control loop and never
    block; the others by other threads, and may. Every driver must see to it that the
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

    def command(self, twist: Twist, expiry: float, now: Instant) -> bytes:
        """Move the pivot at ``twist`` for at most ``expiry`` s from ``now``, when it was decided.

        Returns the ``ArmCommand`` that was sent, for the log, empty when none was because the arm
        has not granted its command. `ArmError` when it can no longer be commanded at all.
        """
        ...

    @property
    def denied(self) -> str | None:
        """Why the arm does not grant its command; None once it did, or before it answered.

        It is asked for again and again, by a thread of the driver.
        """
        ...

    def duplicated(self, now: Instant) -> bool:
        """Whether somebody else was seen to speak for the arm."""
        ...

    def rivalled(self, now: Instant) -> bool:
        """Whether somebody else was seen to send it commands, which it does not obey."""
        ...

    def request_limits(self, limits: ArmLimits) -> ArmLimits:
        """Ask for limits; returns those that the arm confirms; `ArmError` when it does not say."""
        ...

    def request_clear(self) -> str:
        """Have a fault or stop cleared, at an operator's wish; returns the arm's mode.

        `ArmError` when it is not.
        """
        ...

    def counters(self) -> dict[str, int]:
        """States received, and what was not used, by reason."""
        ...

    def close(self) -> None:
        """Let go of the arm."""
        ...
