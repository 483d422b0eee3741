"""The oscillator of a board: ticks that are never quite what the descriptor says."""

from __future__ import annotations

from dataclasses import dataclass

from tactile_bus.instant import Instant, seconds_between

TICK_MASK = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True)
class ClockParameters:
    """Figures of a board's oscillator."""

    tick_hz: int = 1_000_000
    """Nominal; what the descriptor says."""
    error: float = 30e-6
    """Relative error at 25 °C; a crystal has up to ±50 ppm, an RC oscillator 1 %."""
    error_per_k: float = -0.5e-6
    """Relative error per K: crystals and resonators near room temperature (assumed)."""
    start_ticks: int = 0
    """Ticks at power-on, to bring the wrap of 32 bits near."""


class BoardClock:
    """Unwrapped ticks since power-on or reset; `BoardClock.wire` gives the 32 bits sent."""

    def __init__(self, parameters: ClockParameters, start: Instant) -> None:
        self.parameters = parameters
        self._instant = start
        self._ticks = float(parameters.start_ticks)
        self._hz = parameters.tick_hz * (1 + parameters.error)

    def warm(self, now: Instant, temperature_c: float) -> None:
        """From ``now`` on run at the frequency of ``temperature_c``."""
        p = self.parameters
        self._ticks = self.ticks(now)
        self._instant = now
        self._hz = p.tick_hz * (1 + p.error + p.error_per_k * (temperature_c - 25.0))

    def ticks(self, now: Instant) -> float:
        """Ticks at ``now``, fractional and unwrapped."""
        return self._ticks + seconds_between(self._instant, now) * self._hz

    def instant(self, ticks: float) -> Instant:
        """Instant at which the unwrapped count reaches ``ticks``."""
        return Instant(self._instant + round((ticks - self._ticks) / self._hz * 1e9))

    def wire(self, now: Instant) -> int:
        """Count at ``now`` as it is sent: whole and 32 bits."""
        return int(self.ticks(now)) & TICK_MASK
