"""Findings of a strategies study in plain sentences, each computed from the rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean

from tactile_tools.experiments.document import in_words, listed, p_text, whole
from tactile_tools.experiments.reference import PAPER_EJECTED, Reference
from tactile_tools.experiments.rows import Row
from tactile_tools.experiments.statistics import (
    SIGNIFICANT,
    PairedValues,
    Rate,
    contrast,
    signed_rank,
)

ByStrategy = Mapping[str, Sequence[Row]]


def rate_of(rows: Sequence[Row], column: str = "success") -> Rate:
    """Rate at which ``column`` is true."""
    return Rate(sum(bool(row[column]) for row in rows), len(rows))


def means_of(rows: ByStrategy, column: str) -> dict[str, float]:
    """Mean of ``column`` by strategy."""
    return {name: fmean(row[column] for row in of) for name, of in rows.items() if of}


def worst_is_straight(means: Mapping[str, float], pairs: Sequence[PairedValues], what: str) -> str:
    """Say whether straight is significantly worst in a measure where less is better."""
    others = [name for name in means if name != "straight"]
    if "straight" not in means or not others:
        return ""
    against = {pair.b if pair.a == "straight" else pair.a: pair for pair in pairs
               if "straight" in (pair.a, pair.b)}  # fmt: skip
    beyond = {n for n in others if against[n].adjusted < SIGNIFICANT}
    worse = [n for n in others if n in beyond and _signed(against[n], "straight") > 0]
    better = [n for n in others if n in beyond and n not in worse]
    start = (
        f"In {what}, straight has a mean of {means['straight']:.3f}, the others "
        f"{_range([means[n] for n in others])}"
    )
    if len(worse) == len(others):
        p = max(against[n].adjusted for n in others)
        return f"{start}: it is significantly worse than each of them (the greatest {p_text(p)})."
    parts = []
    for word, names in (
        ("significantly worse than", worse),
        ("not significantly different from", [n for n in others if n not in beyond]),
        ("significantly better than", better),
    ):
        if names:
            parts.append(
                f"{word} "
                + listed([f"{in_words(n)} ({p_text(against[n].adjusted)})" for n in names])
            )
    return f"{start}: it is {'; '.join(parts)}."


def faster_by_touch(means: Mapping[str, float], pairs: Sequence[PairedValues]) -> str:
    """Say whether hybrid event is significantly faster than hybrid clock."""
    pair = _pair(pairs, "hybrid_clock", "hybrid_event")
    if pair is None:
        return ""
    gain = _signed(pair, "hybrid_clock")
    figures = (
        f"mean normalised time {means['hybrid_event']:.3f} against {means['hybrid_clock']:.3f}, "
        f"{p_text(pair.adjusted)}"
    )
    if pair.adjusted >= SIGNIFICANT:
        return f"Hybrid event is not significantly faster than hybrid clock ({figures})."
    how = "faster" if gain > 0 else "slower"
    return f"Hybrid event, guided by touch, is significantly {how} than hybrid clock ({figures})."


def order_of_success(rates: Mapping[str, Rate], reference: Reference | None) -> str:
    """Order from least to most successful, with the paper's order."""
    ranked = sorted(rates, key=lambda name: rates[name].value)
    text = "By success, from least to most: " + ", ".join(
        f"{in_words(n)} {whole(rates[n].value)} %" for n in ranked
    )
    if reference is None or not set(reference.success) >= set(rates):
        return text + "."
    theirs = sorted(rates, key=lambda name: reference.success[name].value)
    if theirs == ranked:
        return f"{text}. The order is the paper's."
    order = ", ".join(in_words(n) for n in theirs)
    return f"{text}. The paper's order is {order}."


def beside(rates: Mapping[str, Rate], reference: Reference, column: str = "success") -> str:
    """Say which rates differ from those of ``reference`` beyond chance."""
    theirs = reference.success if column == "success" else reference.entered
    differ, agree = [], []
    for name, rate in rates.items():
        if name not in theirs:
            continue
        p = contrast(rate, theirs[name]).p
        if p < SIGNIFICANT:
            word = "above" if rate.value > theirs[name].value else "below"
            differ.append(
                f"{in_words(name)} ({whole(rate.value)} %, {word} its "
                f"{whole(theirs[name].value)} %, {p_text(p)})"
            )
        else:
            agree.append(in_words(name))
    what = f"the success in {reference.what}"
    if not differ and not agree:
        return ""
    if not differ:
        return f"No rate differs significantly from {what}."
    text = f"Significantly different from {what}: {listed(differ)}"
    return text + (f"; not different: {listed(agree)}." if agree else ".")


def solved_by_touch(rows: ByStrategy) -> str:
    """The paper's count: scenes that only event fails, and scenes that only event solves."""
    if "hybrid_event" not in rows or len(rows) < 2:
        return ""
    solved = {name: {r["scene_seed"] for r in of if r["success"]} for name, of in rows.items()}
    seen = set.intersection(*({r["scene_seed"] for r in of} for of in rows.values()))
    event = solved.pop("hybrid_event")
    lost = len((set.union(*solved.values()) - event) & seen)
    gained = {name: len((event - of) & seen) for name, of in solved.items()}
    least = min(gained, key=lambda name: gained[name])
    every = len((event | set.union(*solved.values())) & seen)
    return (
        f"Of {len(seen)} scenes, {every} were solved by at least one strategy. Hybrid event failed "
        f"in {lost} that another strategy solved; every other strategy failed in at least "
        f"{gained[least]} that hybrid event solved (the least is {in_words(least)})."
    )


def pushed_out(rows: ByStrategy) -> str:
    """Objects pushed out of the front by the two hybrids, with the paper's numbers."""
    if not {"hybrid_clock", "hybrid_event"} <= set(rows):
        return ""
    parts, counts = [], {}
    for name in ("hybrid_clock", "hybrid_event"):
        counts[name] = 25 * fmean(row["ejected"] for row in rows[name])
        objects, trials = PAPER_EJECTED[name]
        parts.append(
            f"{in_words(name)} {counts[name]:.1f} (paper, hardware: {objects} in {trials})"
        )
    clock, event = ({r["scene_seed"]: r["ejected"] for r in rows[n]} for n in counts)
    scenes = sorted(clock.keys() & event.keys())
    p = signed_rank([clock[s] for s in scenes], [event[s] for s in scenes])[0]
    if p >= SIGNIFICANT:
        verdict = "the difference is not beyond chance"
    elif counts["hybrid_event"] < counts["hybrid_clock"]:
        verdict = "as in the paper, touch disturbs less"
    else:
        verdict = "unlike in the paper, touch disturbs more"
    return (
        f"Objects pushed out of the front, per 25 trials: {listed(parts)}; {verdict} ({p_text(p)})."
    )


def _pair(pairs: Sequence[PairedValues], a: str, b: str) -> PairedValues | None:
    for pair in pairs:
        if {pair.a, pair.b} == {a, b}:
            return pair
    return None


def _signed(pair: PairedValues, name: str) -> float:
    """Rank effect of ``name`` over the other: positive if its values are greater."""
    return pair.effect if pair.a == name else -pair.effect


def _range(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.3f}" if len(values) == 1 else f"{low:.3f} to {high:.3f}"
