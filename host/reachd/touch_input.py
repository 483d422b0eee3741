"""The contact features of one board from the bus."""

from __future__ import annotations

import zenoh

from reachd.seam import Touch
from reachd.snapshot import Input, SourcePin, make_touch
from tactile_bus.instant import Instant, monotonic_now
from tactile_bus.streams import BusSample, Latest, Tap, latest
from tactile_bus.topics import FEATURES


class TouchInput:
    """Newest features of ``board``; `newest` and `duplicated` are the control loop's."""

    def __init__(
        self, session: zenoh.Session, board: str, takeover: float, *, remote: bool = False
    ) -> None:
        key = FEATURES.key(board)
        self._input: Input[Touch] = Input(FEATURES, make_touch, takeover, remote=remote)
        self._watch = SourcePin(takeover)
        self._latest: Latest = latest(session, key)
        # The newest sample may hide another publisher's, so all of them are watched beside it.
        self._tap = Tap(session, key, self._watch_features)

    def newest(self, now: Instant) -> Touch | None:
        """Newest features, None before the first."""
        sample = self._latest.newest()
        if sample is not None:
            self._input.take(sample, now)
        return self._input.value

    def duplicated(self, now: Instant) -> bool:
        """Whether a second publisher was heard of late."""
        return self._input.pin.duplicated(now) or self._watch.duplicated(now)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the newest features are not valid."""
        message = self._input.message
        return () if message is None else tuple(message.reasons)

    @property
    def calibrated(self) -> bool:
        """Whether the newest features come from a calibrated board."""
        message = self._input.message
        return message is not None and bool(message.calibrated)

    def counters(self) -> dict[str, int]:
        """Features received, and what was not used, by reason."""
        return self._input.counters | {"oversized": self._latest.refused}

    def close(self) -> None:
        """Take the subscriptions back."""
        self._tap.close()
        self._latest.close()

    def _watch_features(self, sample: BusSample) -> None:
        self._watch.judge(sample, monotonic_now())
