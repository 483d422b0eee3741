"""The interface between reachd and an arm; a driver for another arm implements it."""

from __future__ import annotations

from typing import Protocol

from tactile_core.types import ArmLimits, ArmState, Instant, Twist


class ArmError(Exception):
    """The arm is not available or does not obey; the text names the remedy."""


class Arm(Protocol):
    """A planar velocity-controlled arm.

    The control loop calls `state`, `command`, `duplicated` and `rivalled`, which must never block;
    other threads call the other methods, which may block. Every driver must ensure that the arm
    rests within 0.1 s after commands cease (each carries its expiry), even when this process is
    killed.
    """

    name: str
    """Name on the bus and in logs."""

    def open(self) -> None:
        """Connect to the arm without moving it; `ArmError` when that fails."""
        ...

    def state(self, now: Instant) -> ArmState | None:
        """Newest state; None before the first."""
        ...

    def command(self, twist: Twist, expiry: float, now: Instant) -> bytes:
        """Move the pivot with ``twist``, m/s and rad/s in ``cupboard``, for at most ``expiry`` s.

        ``now``: when the twist was decided, from which the expiry counts. Returns the bytes of the
        ``ArmCommand``, for the log; empty when the arm has not granted its command, so that none
        was sent.
        `ArmError` when the arm can no longer be commanded.
        """
        ...

    @property
    def denied(self) -> str | None:
        """Why the arm does not grant its command; None once it has, and before it answers.

        A thread of the driver requests it repeatedly.
        """
        ...

    def duplicated(self, now: Instant) -> bool:
        """Whether another publisher of the arm's state was seen."""
        ...

    def rivalled(self, now: Instant) -> bool:
        """Whether another sender of commands was seen; the arm does not obey it."""
        ...

    def request_limits(self, limits: ArmLimits) -> ArmLimits:
        """Request limits; returns those that the arm confirms. `ArmError` without confirmation."""
        ...

    def request_clear(self) -> str:
        """Clear a fault or stop at an operator's request; returns the arm's mode.

        `ArmError` when that fails.
        """
        ...

    def counters(self) -> dict[str, int]:
        """Counts of states accepted, and of those not used, by reason."""
        ...

    def close(self) -> None:
        """Disconnect from the arm."""
        ...
