"""``tactile hz``: rate and evenness of messages, and how many were lost on the way."""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import dataclass, field

import zenoh

from tactile_reach.client import Stream, stamp_of
from tactile_tools import watching

QUEUE = 65_536
"""Messages that may wait between two reads of the stream; one read takes under a millisecond."""

KEYS = 256
"""Keys with a line of their own; further keys of a wildcard are counted together as "others"."""


@dataclass(slots=True)
class _Key:
    count: int = 0
    size: int = 0
    last: float | None = None
    periods: list[float] = field(default_factory=list)
    sequence: int | None = None
    lost: int = 0

    def take(self, sample: zenoh.Sample, at: float) -> None:
        """Count a message that arrived at monotonic time ``at``, s."""
        self.count += 1
        self.size += len(sample.payload)
        if self.last is not None:
            self.periods.append(at - self.last)
        self.last = at
        stamp = stamp_of(sample)
        if stamp is not None:
            if self.sequence is not None and stamp[0] > self.sequence:
                self.lost += stamp[0] - self.sequence - 1
            self.sequence = stamp[0]

    def line(self, elapsed: float) -> str:
        """Describe the last ``elapsed`` s, then begin counting anew."""
        text = f"{self.count / elapsed:8.1f} Hz  {self.size / elapsed / 1e3:8.1f} kB/s"
        if self.periods:
            usual, longest = statistics.median(self.periods), max(self.periods)
            text += f"  period {usual * 1e3:6.1f} ms, longest {longest * 1e3:6.1f} ms"
        if self.lost:
            text += f"  {self.lost} lost"
        self.count, self.size = 0, 0
        self.periods.clear()
        return text


def hz(options: argparse.Namespace) -> int:
    """Print rates once a second until stopped."""
    keys: dict[str, _Key] = {}
    with watching.open_bus(options) as bus:
        stream = Stream(bus.session, options.key, lambda s: (s, time.monotonic()), queue=QUEUE)
        start = last = time.monotonic()
        heard = told = False
        while options.seconds is None or last - start < options.seconds:
            found = stream.get(0.05)
            if found is not None:
                name = str(found[0].key_expr)
                if name not in keys and len(keys) >= KEYS:
                    name = "others"
                keys.setdefault(name, _Key()).take(*found)
                heard = True
            now = time.monotonic()
            if now - last < 1.0:
                continue
            width = max((len(name) for name in keys), default=0)
            for name, key in sorted(keys.items()):
                print(f"{name:{width}} {key.line(now - last)}", flush=True)
            if not heard and not told and now - start > watching.QUIET_S:
                watching.report_silence("hz", options.key)
                told = True
            last = now
    if not heard:
        if not told:
            watching.report_silence("hz", options.key)
        return watching.REFUSED
    return watching.DONE
