"""One line on a terminal that says how the simulation goes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TextIO

from sim_device.ports_plan import Planned


class StatusLine:
    """Rewrites one line on ``stream`` when it is a terminal; at the end, a line for each port."""

    def __init__(self, planned: Sequence[Planned], stream: TextIO) -> None:
        self._planned = planned
        self._stream = stream
        self._live = stream.isatty()
        self._width = 0
        self._last = (0.0, [0] * len(planned))

    def show(self, seconds: float) -> None:
        """Rates since the last call, and losses so far."""
        if not self._live:
            return
        before, counts = self._last
        now = [plan.station.sent for plan in self._planned]
        self._last = seconds, now
        span = seconds - before
        parts = []
        for plan, count, earlier in zip(self._planned, now, counts, strict=True):
            rate = (count - earlier) / span if span > 0 else 0.0
            part = f"{plan.name} {rate:.0f}/s"
            if plan.note is not None:
                part += f"  {plan.note()}"
            elif losses := sum(plan.station.losses.values()):
                part += f" lost {losses}"
            parts.append(part)
        text = f"{seconds:8.1f} s  " + "  ".join(parts)
        self._stream.write("\r" + text.ljust(self._width))
        self._stream.flush()
        self._width = len(text)

    def end(self) -> None:
        """Leave the line; say what each port sent and lost."""
        if self._live and self._width:
            self._stream.write("\r" + " " * self._width + "\r")
        for plan in self._planned:
            losses = {k: v for k, v in plan.station.losses.items() if v}
            lost = ", ".join(f"{name} {count}" for name, count in sorted(losses.items()))
            self._stream.write(
                f"{plan.name}: {plan.station.sent} sent" + (f"; {lost}" if lost else "") + "\n"
            )
        self._stream.flush()
