"""What is said once, and what that happens again and again comes to: pure, time passed in.

The first few of a kind are told at once. What follows within `WINDOW_S` is counted, and told as
one line at the end of it, so that a flood of one kind hides neither the rest nor its own size.
"""

from __future__ import annotations

from dataclasses import dataclass

from tactile_bus.instant import Instant, seconds_between

WINDOW_S = 10.0
"""s within which what happens again is only counted."""

FEW = 3
"""Of one kind that are told at once: a person who plugs and unplugs is not a flood."""

KINDS = 64
"""Kinds that are followed at a time; others, from boards that make up ever new texts, are told."""


@dataclass(slots=True)
class _Window:
    begun: Instant
    told: int = 1
    count: int = 0
    last: str = ""
    level: int = 0


class Repeats:
    """Events of several kinds, each a text."""

    def __init__(self) -> None:
        self._windows: dict[str, _Window] = {}

    def tell(self, kind: str, text: str, level: int, now: Instant) -> bool:
        """Whether to say ``text`` now; else it is counted. ``level``: of the log."""
        window = self._windows.get(kind)
        if window is not None and window.told < FEW:
            window.told += 1
            return True
        if window is not None:
            window.count += 1
            window.last, window.level = text, level
            return False
        if len(self._windows) < KINDS:
            self._windows[kind] = _Window(now)
        return True

    def due(self, now: Instant) -> list[tuple[int, str]]:
        """Level and text of what to say of the windows that are over."""
        said = []
        for kind, window in list(self._windows.items()):
            past = seconds_between(window.begun, now)
            if past < WINDOW_S:
                continue
            if not window.count:
                del self._windows[kind]
                continue
            times = "once" if window.count == 1 else f"{window.count} times"
            said.append((window.level, f"{times} more in {past:.0f} s: {window.last}"))
            self._windows[kind] = _Window(now, told=FEW)
        return said


class Silences:
    """Silences of one board. Short ones in a row are one line; one that lasts is told by itself."""

    def __init__(self) -> None:
        self._begun: Instant | None = None  # of the window
        self._count = 0
        self._longest = 0.0
        self._since: Instant | None = None  # of the silence under way
        self._before = 0.0  # s it had lasted then
        self._told = False

    def fell(self, seconds: float, now: Instant) -> str | None:
        """A silence has been noticed after so many s; what to say of it at once."""
        self._since, self._before = now, seconds
        self._told = self._begun is None
        if not self._told:
            return None
        self._begun = now
        return f"no samples for {seconds:.2f} s"

    def ended(self, seconds: float) -> str | None:
        """It is over after so many s; what to say at once."""
        self._since = None
        if self._told:
            return f"samples again after {seconds:.2f} s"
        self._count += 1
        self._longest = max(self._longest, seconds)
        return None

    def gone(self) -> None:
        """The board is not there any more: that is told elsewhere."""
        self._since = None

    def due(self, now: Instant) -> str | None:
        """What to say of a silence that lasts, or of a window that is over; to be called often."""
        if self._since is not None and not self._told:
            lasts = self._before + seconds_between(self._since, now)
            if lasts >= max(LASTING_S, 3 * self._before):
                self._told = True
                return f"no samples for {lasts:.1f} s"
        if self._begun is None:
            return None
        past = seconds_between(self._begun, now)
        if past < WINDOW_S:
            return None
        count, longest = self._count, self._longest
        self._begun, self._count, self._longest = (now if count else None), 0, 0.0
        if not count:
            return None
        what = "1 short silence" if count == 1 else f"{count} short silences"
        return f"{what} in {past:.0f} s, longest {longest:.1f} s"


LASTING_S = 2.0
"""s after which a silence that was only counted is told after all."""
