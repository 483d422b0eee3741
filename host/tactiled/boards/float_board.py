"""State machine of a board that only sends floats (AnySkin, ReSkin, eFlesh) and has no clock."""

from __future__ import annotations

from collections import Counter

import numpy as np

from sensor_proto.packets import FloatSamples
from tactile_core.types import Instant, seconds_between
from tactiled.blocks import SampleBlock
from tactiled.boards.board import RELINK, Admission, State
from tactiled.boards.clock import ArrivalClock, Pace
from tactiled.boards.events import (
    Event,
    FellSilent,
    Identified,
    Identity,
    Refusal,
    Refused,
    Resumed,
    Sampled,
    Streaming,
)

BACKLOG_GAP = 1e-3
"""s between arrivals, `BACKLOG_GAPS` times in a row, which show that the backlog from before the
port was opened has been read: no such board is faster than 500 Hz."""

BACKLOG_GAPS = 3
"""Such gaps in a row that are needed."""

LONE_GAP = 0.1
"""s before a single frame that show the same: a backlog is read without pauses."""

BACKLOG_LIMIT = 0.5
"""s after the first frame when the backlog counts as read in any case."""


class FloatLink:
    """State machine of one float board. ``serial_number``: of its USB port; it has no other.

    ``model``: name in calibrations. ``arrays``: magnetometers of each array, if the user gave them.
    ``layout``: how it writes, empty for the usual floats; ``thermometer``: whether it sends
    temperatures.
    """

    def __init__(
        self,
        admit: Admission,
        model: str,
        serial_number: str = "",
        arrays: tuple[int, ...] | None = None,
    ) -> None:
        self._admit = admit
        self._model = model
        self.serial_number = serial_number
        self.layout = ""
        self.thermometer = True
        self._arrays = arrays
        self.state = State.DOWN
        self.identity: Identity | None = None
        self.clock = ArrivalClock()
        self.counters: Counter[str] = Counter()
        self._refusal: Refusal | None = None
        self._shape: tuple[int, int] | None = None
        self._last_sample = Instant(0)
        self._silent = False
        self._first: Instant | None = None
        self._heard = Instant(0)
        self._fresh = False
        self._gaps = 0
        self._pace = Pace()
        self._frames = 0

    @property
    def silence_limit(self) -> float:
        """Silence considered normal, s."""
        return self._pace.silence_limit()

    def connect(self) -> None:
        """Start: the line is open."""
        self.state = State.IDENTIFYING
        self.clock.restart()
        self._pace.restart()
        self._silent = self._fresh = False
        self._first, self._gaps = None, 0

    def disconnect(self) -> None:
        """Stop: the line is closed."""
        self.state = State.DOWN

    def receive(
        self,
        message: FloatSamples,
        arrival: Instant,
        behind: int = 0,
        newest: Instant | None = None,
    ) -> list[Event]:
        """Process a frame whose last byte came at ``arrival``.

        ``behind``, ``newest``: later frames in the same read, see `ArrivalClock.arrived`.
        """
        self._frames += 1
        if not self._fresh and self._is_backlog(arrival):
            self.counters["backlog"] += 1
            self._pace.heard(arrival, self._frames)
            if self._gaps:
                self.clock.heard(arrival)
            return []
        events: list[Event] = []
        shape = (1, len(message.temperature_c))
        if self.state is State.IDENTIFYING or shape != self._shape:
            events += self._introduce(shape)
        if self.state is not State.STREAMING:
            self.counters["unidentified"] += 1
            return events
        if self._silent:
            quiet = seconds_between(self._last_sample, arrival)
            events.append(Resumed(quiet))
            if quiet >= max(RELINK, self.silence_limit):
                self.clock.restart()
            self._pace.restart()
        self._silent, self._last_sample = False, arrival
        self._pace.heard(arrival, self._frames)
        placed = self.clock.arrived(arrival, behind, newest)
        with np.errstate(invalid="ignore"):  # a damaged float may be a signalling NaN
            values = message.field_ut.astype(np.float64), message.temperature_c.astype(np.float64)
        block = SampleBlock(
            array=0,
            sequence=placed.sequence % (1 << 32),
            captured=placed.stamp.captured,
            received=arrival,
            uncertainty=placed.stamp.uncertainty,
            field_ut=values[0],
            temperature_c=values[1],
            status=message.status,
            thermometer=self.thermometer,
        )
        events.append(Sampled(block))
        return events

    def tick(self, now: Instant) -> list[Event]:
        """Notice silence."""
        if self.state is not State.STREAMING:
            return []
        quiet = seconds_between(self._last_sample, now)
        if quiet < self.silence_limit or self._silent:
            return []
        self._silent = True
        return [FellSilent(quiet)]

    def retry(self) -> None:
        """Judge a refused board again."""
        if self.state is State.REFUSED:
            self.state = State.IDENTIFYING

    def _is_backlog(self, arrival: Instant) -> bool:
        """Whether a frame may have waited in a buffer, for an unknown time."""
        first, heard = self._first, self._heard
        self._heard = arrival
        if first is None:
            self._first = arrival
            return True
        gap, waited = seconds_between(heard, arrival), seconds_between(first, arrival)
        self._gaps = self._gaps + 1 if gap >= BACKLOG_GAP else 0
        self._fresh = self._gaps >= BACKLOG_GAPS or gap >= LONE_GAP or waited >= BACKLOG_LIMIT
        if self._fresh and self._gaps == 1:
            self.clock.heard(heard)  # the frame before it, from which the period follows
        return not self._fresh

    def _introduce(self, shape: tuple[int, int]) -> list[Event]:
        before, self._shape = self.identity, shape
        identity = Identity(
            self.serial_number, self._model, "", (shape,), None, None, self._arrays, self.layout
        )
        refusal = None
        if before is not None and before.serial_number != self.serial_number:
            refusal = Refusal(
                f"{identity} answers where {before} was before",
                "plug the first one in again, or restart tactiled for the other",
            )
        refusal = refusal or self._admit(identity)
        if refusal is not None:
            self.state = State.REFUSED
            if refusal == self._refusal:
                return []
            self._refusal = refusal
            return [Refused(refusal)]
        self._refusal = None
        self.identity = identity
        self.state = State.STREAMING
        return [Identified(identity, rebooted=False), Streaming(None)]
