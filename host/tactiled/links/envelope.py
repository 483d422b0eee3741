"""Line along the earliest arrivals: delays only ever add, so the lowest points are the truest."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class _Fit:
    x: float
    y: float
    slope: float
    spread: float


class LowerEnvelope:
    """Least-squares line through the lowest point of each of the last ``buckets`` buckets.

    ``bucket``: width in units of x. ``slope``: first guess, kept until two buckets hold points;
    the line's slope stays within ``tolerance`` of it.
    """

    def __init__(
        self, bucket: float, buckets: int, slope: float, tolerance: float = math.inf
    ) -> None:
        self._bucket = bucket
        self._points: deque[tuple[float, float]] = deque(maxlen=buckets)
        self._guess = slope
        self._tolerance = tolerance
        self._fit: _Fit | None = None

    @property
    def ready(self) -> bool:
        """Whether there is a point to go by."""
        return self._fit is not None

    @property
    def buckets(self) -> int:
        """Number of buckets that hold a point."""
        return len(self._points)

    @property
    def span(self) -> float:
        """Width of what the points cover, in units of x; 0 before the second."""
        return self._points[-1][0] - self._points[0][0] if self._points else 0.0

    @property
    def middle(self) -> float:
        """Where the line is best known, in x; 0 before the first point."""
        return 0.0 if self._fit is None else self._fit.x

    @property
    def slope(self) -> float:
        """Present slope, or the first guess."""
        return self._guess if self._fit is None else self._fit.slope

    @property
    def spread(self) -> float:
        """Root mean square distance of the points from the line, in units of y."""
        return 0.0 if self._fit is None else self._fit.spread

    def at(self, x: float) -> float:
        """Height of the line at ``x``; ValueError before the first point."""
        if self._fit is None:
            raise ValueError("no point yet")
        return self._fit.y + (x - self._fit.x) * self._fit.slope

    def add(self, x: float, y: float) -> None:
        """Take one arrival."""
        if self._points:
            last_x, last_y = self._points[-1]
            if x // self._bucket == last_x // self._bucket:
                if y - last_y >= self.slope * (x - last_x):
                    return
                self._points[-1] = (x, y)
            elif x > last_x:
                self._points.append((x, y))
            else:
                return
        else:
            self._points.append((x, y))
        self._fit = self._solve()

    def _solve(self) -> _Fit:
        n = len(self._points)
        mean_x = sum(x for x, _ in self._points) / n
        mean_y = sum(y for _, y in self._points) / n
        sxx = sum((x - mean_x) ** 2 for x, _ in self._points)
        slope = self._guess
        if n > 1 and sxx > 0:
            slope = sum((x - mean_x) * (y - mean_y) for x, y in self._points) / sxx
            slope = min(max(slope, self._guess - self._tolerance), self._guess + self._tolerance)
        total = sum((y - mean_y - slope * (x - mean_x)) ** 2 for x, y in self._points)
        return _Fit(mean_x, mean_y, slope, math.sqrt(total / n))
