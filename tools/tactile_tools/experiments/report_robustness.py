"""Report of a robustness study: heat maps, and which conclusions survive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from tactile_core.arrays import FloatArray
from tactile_tools.experiments.axes import AXES, Level, levels_of
from tactile_tools.experiments.document import (
    Picture,
    Section,
    TableData,
    in_words,
    percent,
    slug,
)
from tactile_tools.experiments.plots import heat_map
from tactile_tools.experiments.rows import Row
from tactile_tools.experiments.spec import canonical
from tactile_tools.experiments.statistics import SIGNIFICANT, Rate, paired_rates, signed_rank
from tactile_tools.experiments.tables import Run, title_of

REFUSED = "the gate refuses to arm"
"""Part of the error of a trial whose touch is so bad that the safety gate does not let it begin.
That is an outcome: the goal was not reached."""


OWN = "the set's own values"

EXPLAINED = (
    "One condition at a time is varied, everything else stays as the parameter set has it; the "
    "outlined column is the set's own. Holds and flips are beyond chance at p < 0.05 in the same "
    "scenes (McNemar for success, Wilcoxon for time, not corrected for their number); tends so "
    "and tends not are not. With few scenes only large differences are beyond chance."
)


@dataclass(frozen=True, slots=True)
class Claim:
    """Conclusion of the paper: ``better`` does better than ``worse`` in ``column``."""

    text: str
    better: str
    worse: str
    column: str


CLAIMS = (
    Claim("burrow succeeds more than straight", "burrow", "straight", "success"),
    Claim("excavate succeeds more than straight", "excavate", "straight", "success"),
    Claim("hybrid event succeeds more than straight", "hybrid_event", "straight", "success"),
    Claim("hybrid event succeeds more than burrow", "hybrid_event", "burrow", "success"),
    Claim("hybrid event succeeds more than the clock", "hybrid_event", "hybrid_clock", "success"),
    Claim("hybrid event is faster than the clock", "hybrid_event", "hybrid_clock", "time"),
)

HOLDS, TENDS, EVEN, TENDS_NOT, FLIPS = "holds", "tends so", "even", "tends not", "flips"
UNKNOWN = "–"


@dataclass(frozen=True, slots=True)
class Point:
    """Trials at one level: by strategy, by scene."""

    level: Level
    rows: Mapping[str, Mapping[int, Row]]

    def rate(self, strategy: str) -> Rate:
        """Rate of success; a trial that the gate did not let begin has failed."""
        rows = self.rows.get(strategy, {}).values()
        return Rate(sum(bool(r["success"]) for r in rows), len(rows))

    def verdict(self, claim: Claim) -> str:
        """Whether ``claim`` holds here, beyond chance or by tendency."""
        a, b = self.rows.get(claim.better, {}), self.rows.get(claim.worse, {})
        scenes = sorted(a.keys() & b.keys())
        if not scenes:
            return UNKNOWN
        if claim.column == "success":
            x = [bool(a[s]["success"]) for s in scenes]
            y = [bool(b[s]["success"]) for s in scenes]
            found = paired_rates(x, y)
            gain, p = found.difference, found.p
        else:
            times = [[1.0 if r["error"] else r["normalized_time"] for r in (a[s], b[s])]
                     for s in scenes]  # fmt: skip
            gain = fmean(t[1] - t[0] for t in times)
            p = signed_rank([t[1] for t in times], [t[0] for t in times])[0]
        if gain == 0:
            return EVEN
        if gain > 0:
            return HOLDS if p < SIGNIFICANT else TENDS
        return FLIPS if p < SIGNIFICANT else TENDS_NOT


def robustness_sections(run: Run) -> list[Section]:
    """For each parameter set, engine and depth: what survives, then a heat map for each axis."""
    several = len(run.groups()) > 1
    sections = []
    for group, rows in run.groups().items():
        name = title_of(group)
        prefix = slug(" ".join(group)) + "-" if several else ""
        axes = {a: points_of(run, a, group[0], rows) for a in run.study.definition["axes"]}
        strategies = run.study.definition["strategies"]
        tables = [_rate_table(a, points, strategies, prefix) for a, points in axes.items()]
        sections.append(
            Section(
                title=name,
                findings=_findings(axes, strategies),
                text=[EXPLAINED],
                tables=[_verdict_table(axes, strategies, prefix), *tables],
                pictures=[_picture(a, p, strategies, prefix) for a, p in axes.items()],
            )
        )
    return sections


def points_of(run: Run, axis: str, set_name: str, rows: Sequence[Row]) -> list[Point]:
    """Trials at every level of ``axis``, without those that could not be run at all."""
    base = dict(run.options.parameters)
    found = []
    for level in levels_of(axis, set_name):
        parameters = canonical({**base, **level.parameters})
        conditions = level.conditions.to_json()
        by: dict[str, dict[int, Row]] = {}
        for row in rows:
            if row["parameters"] != parameters or row["conditions"] != conditions:
                continue
            if row["error"] is None or REFUSED in row["error"]:
                by.setdefault(row["strategy"], {})[row["scene_seed"]] = row
        found.append(Point(level, by))
    return found


def _findings(axes: Mapping[str, Sequence[Point]], strategies: Sequence[str]) -> list[str]:
    """A sentence for each claim for which all its strategies were run."""
    sentences = []
    for claim in _testable(strategies):
        verdicts = [(axis, p.level, p.verdict(claim)) for axis, p in _conditions(axes)]
        known = [v for v in verdicts if v[2] != UNKNOWN]
        if not known:
            continue
        flips = [v for v in known if v[2] == FLIPS]
        against = [v for v in known if v[2] == TENDS_NOT]
        holds = sum(v[2] == HOLDS for v in known)
        tends = sum(v[2] == TENDS for v in known)
        text = f"{claim.text[0].upper()}{claim.text[1:]}: at {holds} of {len(known)} conditions "
        text += "beyond chance"
        if tends:
            text += f", at {tends} more by tendency"
        if even := sum(v[2] == EVEN for v in known):
            text += f", at {even} neither way"
        if flips:
            text += f". It flips beyond chance at {_places(flips)}"
        if against:
            text += f". By tendency it is the other way at {_places(against)}"
        if not flips and not against:
            text += ", nowhere the other way"
        sentences.append(text + ".")
    return sentences


def _conditions(axes: Mapping[str, Sequence[Point]]) -> list[tuple[str, Point]]:
    """Every level with its axis; the set's own values, which most axes have, only once."""
    own = [(axis, p) for axis, points in axes.items() for p in points if p.level.nominal]
    rest = [(axis, p) for axis, points in axes.items() for p in points if not p.level.nominal]
    return [*own[:1], *rest]


def _places(found: Sequence[tuple[str, Level, str]]) -> str:
    """Levels by axis in words."""
    by: dict[str, list[str]] = {}
    for axis, level, _ in found:
        by.setdefault("" if level.nominal else axis, []).append(level.label)
    return "; ".join(AXES[axis].at(*labels) if axis else OWN for axis, labels in by.items())


def _testable(strategies: Sequence[str]) -> list[Claim]:
    return [c for c in CLAIMS if {c.better, c.worse} <= set(strategies)]


def _verdict_table(
    axes: Mapping[str, Sequence[Point]], strategies: Sequence[str], prefix: str
) -> TableData:
    claims = _testable(strategies)
    body = [
        [
            OWN if point.level.nominal else AXES[axis].at(point.level.label),
            *(point.verdict(c) for c in claims),
        ]
        for axis, point in _conditions(axes)
    ]
    return TableData(
        "Which conclusions survive where",
        ["condition", *(c.text for c in claims)],
        body,
        name=prefix + "claims",
    )


def _rate_table(
    axis: str, points: Sequence[Point], strategies: Sequence[str], prefix: str
) -> TableData:
    return TableData(
        f"Success: {AXES[axis].title}",
        ["strategy", *(_label(point) for point in points)],
        [[in_words(s), *(percent(point.rate(s)) for point in points)] for s in strategies],
        note=_remarks(points),
        name=f"{prefix}{axis}",
    )


def _label(point: Point) -> str:
    return point.level.label + (" (own)" if point.level.nominal else "")


def _remarks(points: Sequence[Point]) -> str:
    """Say what was refused, and where there are no trials."""
    refused = [
        f"{point.level.label} ({n})"
        for point in points
        if (n := sum(bool(r["error"]) for by in point.rows.values() for r in by.values()))
    ]
    empty = [point.level.label for point in points if not point.rows]
    sentences = []
    if refused:
        sentences.append(
            "Trials that the safety gate did not let begin, as no valid touch came, count as not "
            f"reached: {', '.join(refused)}."
        )
    if empty:
        sentences.append(f"No trials could be run at {', '.join(empty)}.")
    return " ".join(sentences)


def _picture(axis: str, points: Sequence[Point], strategies: Sequence[str], prefix: str) -> Picture:
    values: FloatArray = np.array([[point.rate(s).value for point in points] for s in strategies])
    own = [i for i, point in enumerate(points) if point.level.nominal]
    return Picture(
        f"{prefix}{axis}",
        heat_map(
            "Success, %",
            strategies,
            [point.level.label for point in points],
            values,
            own[0] if own else None,
            AXES[axis].title,
        ),
        f"Success over {AXES[axis].title}.",
    )
