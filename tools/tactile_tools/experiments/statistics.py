"""Statistics of rates and of paired samples; pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

Z95 = float(stats.norm.ppf(0.975))
"""Two-sided 95 % quantile of the normal distribution."""

SIGNIFICANT = 0.05
"""p below which a difference is called significant."""


@dataclass(frozen=True, slots=True)
class Rate:
    """``count`` of ``trials`` with its 95 % Wilson score interval; NaN without trials."""

    count: int
    trials: int

    @property
    def value(self) -> float:
        """Count over trials."""
        return self.count / self.trials if self.trials else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval (Wilson 1927)."""
        if not self.trials:
            return math.nan, math.nan
        found = stats.binomtest(self.count, self.trials).proportion_ci(method="wilson")
        return float(found.low), float(found.high)


@dataclass(frozen=True, slots=True)
class Contrast:
    """Two independent rates: difference a − b, its 95 % interval and Fisher's exact p."""

    difference: float
    interval: tuple[float, float]
    p: float


@dataclass(frozen=True, slots=True)
class PairedRates:
    """Successes of a and b in the same ``scenes``: difference a − b, 95 % interval, McNemar's p.

    ``only_a``, ``only_b``: scenes where only one succeeded.
    """

    scenes: int
    only_a: int
    only_b: int
    difference: float
    interval: tuple[float, float]
    p: float


@dataclass(frozen=True, slots=True)
class PairedValues:
    """Compare a and b in the same ``scenes`` by Wilcoxon's signed ranks.

    ``mean_difference`` a − b. ``effect``: matched-pairs rank-biserial correlation, −1 (a always
    less) to 1. ``p``: two-sided; ``adjusted``: by Holm within its family.
    """

    a: str
    b: str
    scenes: int
    mean_difference: float
    effect: float
    p: float
    adjusted: float


def contrast(a: Rate, b: Rate) -> Contrast:
    """Compare two rates of independent samples (Newcombe 1998, method 10; Fisher's exact test)."""
    difference = a.value - b.value
    (low_a, high_a), (low_b, high_b) = a.interval, b.interval
    low = difference - math.hypot(a.value - low_a, high_b - b.value)
    high = difference + math.hypot(high_a - a.value, b.value - low_b)
    table = [[a.count, a.trials - a.count], [b.count, b.trials - b.count]]
    p = float(stats.fisher_exact(table)[1]) if a.trials and b.trials else math.nan
    return Contrast(difference, (low, high), p)


def paired_rates(a: Sequence[bool], b: Sequence[bool]) -> PairedRates:
    """Compare successes in the same scenes, in the same order.

    McNemar's exact test: the discordant pairs against a fair coin. Interval: Agresti and Min 2005,
    half a pair added to each of the four cells.
    """
    n = len(a)
    only_a = sum(x and not y for x, y in zip(a, b, strict=True))
    only_b = sum(y and not x for x, y in zip(a, b, strict=True))
    if not n:
        return PairedRates(0, 0, 0, math.nan, (math.nan, math.nan), math.nan)
    discordant = only_a + only_b
    p = float(stats.binomtest(only_a, discordant, 0.5).pvalue) if discordant else 1.0
    total, more, less = n + 2.0, only_a + 0.5, only_b + 0.5
    middle = (more - less) / total
    spread = Z95 * math.sqrt(more + less - (more - less) ** 2 / total) / total
    interval = max(-1.0, middle - spread), min(1.0, middle + spread)
    return PairedRates(n, only_a, only_b, (only_a - only_b) / n, interval, p)


def signed_rank(a: Sequence[float], b: Sequence[float]) -> tuple[float, float]:
    """Wilcoxon's two-sided p of a − b, and the rank-biserial effect; ties are dropped.

    1 and 0 if all pairs tie.
    """
    difference = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    difference = difference[difference != 0]
    if not difference.size:
        return 1.0, 0.0
    ranks = stats.rankdata(np.abs(difference))
    effect = float((np.sign(difference) * ranks).sum() / ranks.sum())
    return float(stats.wilcoxon(difference).pvalue), effect


def holm(values: Sequence[float]) -> list[float]:
    """p-values adjusted for their number (Holm 1979); NaN is left out of the count."""
    p = np.asarray(values, dtype=np.float64)
    adjusted = np.full(p.shape, np.nan)
    order = [int(i) for i in np.argsort(p) if not math.isnan(p[i])]
    least = 0.0
    for rank, index in enumerate(order):
        least = max(least, min(1.0, (len(order) - rank) * float(p[index])))
        adjusted[index] = least
    return [float(v) for v in adjusted]


def all_pairs(values: Mapping[str, Mapping[int, float]]) -> list[PairedValues]:
    """Every pair of strategies over the scenes both have, corrected as one family.

    ``values``: by strategy, by scene.
    """
    names = list(values)
    found: list[tuple[str, str, int, float, float, float]] = []
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            scenes = sorted(values[a].keys() & values[b].keys())
            x = [values[a][s] for s in scenes]
            y = [values[b][s] for s in scenes]
            if not scenes:
                found.append((a, b, 0, math.nan, math.nan, math.nan))
                continue
            p, effect = signed_rank(x, y)
            found.append((a, b, len(scenes), float(np.mean(x) - np.mean(y)), effect, p))
    adjusted = holm([f[-1] for f in found])
    return [PairedValues(*f, q) for f, q in zip(found, adjusted, strict=True)]


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """95 % interval of a mean by Student's t; NaN for fewer than two values."""
    n = len(values)
    if n < 2:
        return math.nan, math.nan
    half = float(stats.t.ppf(0.975, n - 1)) * float(np.std(values, ddof=1)) / math.sqrt(n)
    mean = float(np.mean(values))
    return mean - half, mean + half


def stars(p: float) -> str:
    """Marks as in the paper: **** below 0.0001, *** 0.001, ** 0.01, * 0.05, else "ns"."""
    for mark, bound in (("****", 1e-4), ("***", 1e-3), ("**", 1e-2), ("*", SIGNIFICANT)):
        if p < bound:
            return mark
    return "ns" if p == p else ""
