"""What a log says of its losses: one metadata record called ``gap`` a reason and flush."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

GAP = "gap"
"""Name of those metadata records."""

DROPPED = "dropped:"
"""Keys of a gap record that start so count the messages one channel lost."""


MAX_CHANNELS = 64
"""Channels that one gap record names; what others lost is counted under `OTHERS`."""

OTHERS = "others"


@dataclass(slots=True)
class Gap:
    """Losses of one kind. ``first_ns`` to ``last_ns``: wall-clock times it covers, ends included.

    ``messages`` is 0 where writing failed but nothing was lost.
    """

    first_ns: int
    last_ns: int
    messages: int = 0
    detail: str = ""
    channels: dict[str, int] = field(default_factory=dict)

    def count(self, channel: str, messages: int) -> None:
        """Add what one channel lost."""
        self.messages += messages
        if channel not in self.channels and len(self.channels) >= MAX_CHANNELS:
            channel = OTHERS
        self.channels[channel] = self.channels.get(channel, 0) + messages

    def cover(self, first_ns: int, last_ns: int) -> None:
        """Stretch over another span."""
        self.first_ns = min(self.first_ns, first_ns)
        self.last_ns = max(self.last_ns, last_ns)

    def metadata(self, reason: str) -> dict[str, str]:
        """Contents of the record."""
        head = {
            "reason": reason,
            "first_ns": str(self.first_ns),
            "last_ns": str(self.last_ns),
            "messages": str(self.messages),
            "detail": self.detail,
        }
        return head | {f"{DROPPED}{name}": str(n) for name, n in sorted(self.channels.items())}


class Gaps:
    """Losses not yet written, one `Gap` a reason."""

    def __init__(self) -> None:
        self._gaps: dict[str, Gap] = {}

    def __len__(self) -> int:
        return len(self._gaps)

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self._gaps))

    def __getitem__(self, reason: str) -> Gap:
        return self._gaps[reason]

    def __delitem__(self, reason: str) -> None:
        del self._gaps[reason]

    def count(self, reason: str, channel: str, log_ns: int, messages: int = 1) -> None:
        """One message of ``channel`` was lost, or several at about that time."""
        gap = self._gaps.setdefault(reason, Gap(log_ns, log_ns))
        gap.cover(log_ns, log_ns)
        gap.count(channel, messages)

    def note(self, reason: str, detail: str, now_ns: int) -> None:
        """Something went wrong at ``now_ns``, whether or not messages are lost by it."""
        gap = self._gaps.setdefault(reason, Gap(now_ns, now_ns))
        gap.cover(now_ns, now_ns)
        gap.detail = detail

    def merge(self, other: Gaps) -> None:
        """Add what another has."""
        for reason, gap in other._gaps.items():
            mine = self._gaps.setdefault(reason, Gap(gap.first_ns, gap.last_ns))
            mine.cover(gap.first_ns, gap.last_ns)
            mine.detail = gap.detail or mine.detail
            for channel, count in gap.channels.items():
                mine.count(channel, count)
