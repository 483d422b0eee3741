"""Commands from the bus to twists: one sender at a time, and only what makes sense. Pure."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Final

from tactile_bus.arm_types import Twist
from tactile_bus.instant import Instant, seconds_between
from tactile_bus.messages import DecodeError, codec
from tactile_bus.streams import BusSample
from tactile_bus.topics import COMMAND

FRAME = "cupboard"

TAKEOVER: Final = 0.5
"""s of a commander's silence after which another is obeyed; the arm rests long before."""

REFUSALS = ("anonymous", "foreign", "repeated", "malformed", "wrong_frame", "not_planar")


class CommandInput:
    """Tells whose commands are obeyed, and counts the others in ``refused``, by reason.

    ``anonymous``: sent without sequence and source. ``foreign``: from a second sender, or with a
    sequence that is not above the last: somebody else under the first one's name. ``repeated``:
    the very sample before. ``not_planar``: along z, or about x or y.
    """

    def __init__(self) -> None:
        self._codec = codec()
        self._lock = threading.Lock()
        self._source: bytes | None = None
        self._heard = Instant(0)
        self._last = (0, b"")  # sequence and data of the newest sample seen
        self._taken = 0  # sequence of the newest command taken
        self._counts: Counter[str] = Counter()

    @property
    def commander(self) -> str | None:
        """Id of whose commands are obeyed, as hex digits; None before the first."""
        source = self._source
        return None if source is None else source.hex()

    @property
    def refused(self) -> dict[str, int]:
        """Samples refused so far, by reason."""
        return {reason: self._counts[reason] for reason in REFUSALS}

    def watch(self, sample: BusSample, now: Instant) -> None:
        """Look at every sample, in any thread, and count those that come from others."""
        with self._lock:
            refusal = self._judge(sample, now)
            if refusal is None:
                sequence = sample.sequence or 0
                if (sequence, sample.data) == self._last:
                    refusal = "repeated"
                elif sequence <= self._last[0]:
                    refusal = "foreign"
                else:
                    self._last, self._heard = (sequence, sample.data), now
            if refusal is not None:
                self._counts[refusal] += 1

    def take(self, sample: BusSample, now: Instant) -> Twist | None:
        """Twist of the newest sample, None where it is not to be obeyed.

        What `watch` counts is not counted again. Numbers that are not finite are passed on: the
        arm stops at them.
        """
        with self._lock:
            if self._judge(sample, now) is not None or (sample.sequence or 0) <= self._taken:
                return None
            self._taken, self._heard = sample.sequence or 0, now
        try:
            message = self._codec.decode(COMMAND, sample.data)
        except DecodeError:
            self._refuse("malformed")
            return None
        if message.header.frame_id != FRAME:
            self._refuse("wrong_frame")
            return None
        linear, angular = message.twist.linear, message.twist.angular
        if any(part != 0.0 for part in (linear.z, angular.x, angular.y)):
            self._refuse("not_planar")
            return None
        return Twist(float(linear.x), float(linear.y), float(angular.z))

    def _judge(self, sample: BusSample, now: Instant) -> str | None:
        """Why a sample's sender is not heeded; holds on to the sender where there is none."""
        if sample.source is None or sample.sequence is None:
            return "anonymous"
        if sample.source == self._source:
            return None
        if self._source is not None and seconds_between(self._heard, now) < TAKEOVER:
            return "foreign"
        self._source, self._heard = sample.source, now
        self._last, self._taken = (0, b""), 0
        return None

    def _refuse(self, reason: str) -> None:
        with self._lock:
            self._counts[reason] += 1
