"""Report of a strategies study: tables and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from statistics import fmean, median

from tactile_tools.experiments import findings
from tactile_tools.experiments.compare import comparison
from tactile_tools.experiments.document import (
    Picture,
    Section,
    TableData,
    in_words,
    percent,
    points,
    shown_p,
    slug,
    whole,
)
from tactile_tools.experiments.findings import ByStrategy, means_of, rate_of
from tactile_tools.experiments.plots import Bracket, boxes, rates
from tactile_tools.experiments.reference import (
    REFERENCES,
    Reference,
)
from tactile_tools.experiments.rows import DIRECTIONS, TRIGGERS, Row
from tactile_tools.experiments.statistics import (
    PairedValues,
    Rate,
    all_pairs,
    contrast,
    holm,
    mean_interval,
    paired_rates,
    stars,
)
from tactile_tools.experiments.tables import GROUP, Run, title_of

MEASURES = {
    "normalized_distance": ("distance", "d_goal / d_scene at the end"),
    "normalized_time": ("time", "t_comp / t_tot"),
}

SHOWN_PAIRS = (
    ("straight", "burrow"),
    ("straight", "excavate"),
    ("straight", "hybrid_clock"),
    ("straight", "hybrid_event"),
    ("burrow", "hybrid_event"),
    ("hybrid_clock", "hybrid_event"),
)
"""Pairs that a figure marks: all ten would hide the boxes. The tables have all."""


def strategy_sections(run: Run) -> list[Section]:
    """One section for each parameter set, engine and depth, and one that compares them."""
    order = run.study.definition["strategies"]
    sections, headline = [], []
    several = len(run.groups()) > 1
    for group, rows in run.groups().items():
        by = {name: [r for r in rows if r["strategy"] == name and r["error"] is None]
              for name in order}  # fmt: skip
        by = {name: of for name, of in by.items() if of}
        if not by:
            continue
        name = title_of(group)
        headline.append([name, *(percent(rate_of(by.get(n, []))) for n in order)])
        own = run.options.source in (None, group[0]) and not run.options.parameters
        references = REFERENCES.get(group[0], ()) if own else ()
        sections.append(
            _section(name, by, references, slug(" ".join(group)) + "-" if several else "")
        )
    if several:
        tables = [
            TableData(
                "Success by parameter set, engine and sensing",
                ["", *(in_words(n) for n in order)],
                headline,
                name="headline",
            ),
            *_across(run),
        ]
        sections.insert(0, Section("At a glance", tables=tables))
    return sections


def _across(run: Run) -> list[TableData]:
    """Compare groups of the same scenes that differ only in engine or only in depth."""
    tables = []
    for (left, a), (right, b) in combinations(run.groups().items(), 2):
        apart = [i for i in range(len(GROUP)) if left[i] != right[i]]
        if apart not in ([GROUP.index("engine")], [GROUP.index("depth")]):
            continue
        shared = " · ".join(v for i, v in enumerate(left) if i not in apart)
        names = f"A {left[apart[0]]}, B {right[apart[0]]} ({shared})"
        good = ([r for r in rows if r["error"] is None] for rows in (a, b))
        tables += [
            replace(t, caption=f"{t.caption}: {names}", name=f"{slug(names)}-{t.name}")
            for t in comparison(*good)
        ]
    return tables


def _section(name: str, by: ByStrategy, references: Sequence[Reference], prefix: str) -> Section:
    distance, time = (all_pairs(_values(by, column)) for column in MEASURES)
    ours = {n: rate_of(of) for n, of in by.items()}
    means = {column: means_of(by, column) for column in MEASURES}
    paper = references[0] if references else None
    sentences = [
        findings.worst_is_straight(means["normalized_distance"], distance, "distance to the goal"),
        findings.worst_is_straight(means["normalized_time"], time, "time"),
        findings.faster_by_touch(means["normalized_time"], time),
        findings.order_of_success(ours, paper),
        *(findings.beside(ours, r) for r in references),
        findings.solved_by_touch(by),
        findings.pushed_out(by),
    ]
    return Section(
        title=name,
        findings=[text for text in sentences if text],
        tables=[
            _success_table(by, references, prefix),
            _entered_table(by, references, prefix),
            _measures_table(by, references, prefix),
            _pairs_table("Normalised distance, all pairs", distance, prefix + "pairs-distance"),
            _pairs_table("Normalised time, all pairs", time, prefix + "pairs-time"),
            _mcnemar_table(by, prefix),
            _behaviour_table(by, prefix),
        ],
        pictures=_pictures(by, references, {"distance": distance, "time": time}, prefix),
    )


def _values(by: ByStrategy, column: str) -> dict[str, dict[int, float]]:
    return {n: {r["scene_seed"]: r[column] for r in of} for n, of in by.items()}


def _success_table(by: ByStrategy, references: Sequence[Reference], prefix: str) -> TableData:
    return _beside(
        "Success",
        "success",
        by,
        {r.label: r.success for r in references},
        "; ".join(f"{r.label}: {r.what}" for r in references),
        prefix,
    )


def _entered_table(by: ByStrategy, references: Sequence[Reference], prefix: str) -> TableData:
    return _beside(
        "Tip ever within 7.5 mm of the goal, the region that the paper calls the goal",
        "entered",
        by,
        {r.label: r.entered for r in references if r.entered},
        "",
        prefix,
    )


def _beside(
    caption: str,
    column: str,
    by: ByStrategy,
    others: Mapping[str, Mapping[str, Rate]],
    sources: str,
    prefix: str,
) -> TableData:
    """Rate at which ``column`` is true, beside the rates of others."""
    head = ["strategy", "scenes", "ours [95 %]"]
    for label in others:
        head += [label, "difference [95 %]", "p"]
    body = []
    for name, rows in by.items():
        rate = rate_of(rows, column)
        cells = [in_words(name), str(len(rows)), percent(rate)]
        for theirs in others.values():
            if name not in theirs:
                cells += ["–"] * 3
                continue
            found = contrast(rate, theirs[name])
            cells += [
                f"{whole(theirs[name].value)} %",
                points(found.difference, found.interval),
                shown_p(found.p),
            ]
        body.append(cells)
    note = "Wilson intervals of rates"
    if others:
        note += "; Newcombe's of differences, in percentage points; p by Fisher's exact test"
    return TableData(
        caption,
        head,
        body,
        note=note + "." + (f" {sources[0].upper()}{sources[1:]}." if sources else ""),
        name=prefix + column,
    )


def _measures_table(by: ByStrategy, references: Sequence[Reference], prefix: str) -> TableData:
    others = [r for r in references if r.distance and r.time]
    theirs = [f"{r.label}, mean" for r in others]
    body = []
    for name, rows in by.items():
        cells = [in_words(name)]
        for column, means in (
            ("normalized_distance", [r.distance for r in others]),
            ("normalized_time", [r.time for r in others]),
        ):
            values = [r[column] for r in rows]
            low, high = mean_interval(values)
            cells += [f"{fmean(values):.3f} [{low:.3f}, {high:.3f}]", f"{median(values):.3f}"]
            cells += [f"{of[name]:.3f}" if name in of else "–" for of in means]
        body.append(cells)
    return TableData(
        "Distance to the goal at the end and time, normalised",
        [
            "strategy",
            *("distance: mean [95 %]", "median", *theirs),
            *("time: mean [95 %]", "median", *theirs),
        ],
        body,
        note="A trial that does not reach the goal takes all the time there is.",
        name=prefix + "measures",
    )


def _pairs_table(caption: str, pairs: Sequence[PairedValues], name: str) -> TableData:
    return TableData(
        caption,
        ["pair", "scenes", "mean difference", "rank effect", "p", "p (Holm)", ""],
        [
            [
                f"{in_words(pair.a)} – {in_words(pair.b)}",
                str(pair.scenes),
                f"{pair.mean_difference:+.3f}",
                f"{pair.effect:+.2f}",
                shown_p(pair.p),
                shown_p(pair.adjusted),
                stars(pair.adjusted),
            ]
            for pair in pairs
        ],
        note="Wilcoxon's signed ranks over the same scenes, corrected for all pairs by Holm. The "
        "rank effect runs from −1 (the first is always less) to 1. **** p < 0.0001, *** 0.001, "
        "** 0.01, * 0.05, ns not significant.",
        name=name,
    )


def _mcnemar_table(by: ByStrategy, prefix: str) -> TableData:
    found = []
    for a, b in combinations(by, 2):
        left = {r["scene_seed"]: r["success"] for r in by[a]}
        right = {r["scene_seed"]: r["success"] for r in by[b]}
        scenes = sorted(left.keys() & right.keys())
        result = paired_rates([left[s] for s in scenes], [right[s] for s in scenes])
        found.append((a, b, result))
    adjusted = holm([result.p for _, _, result in found])
    return TableData(
        "Success in the same scenes, all pairs",
        ["pair", "only the first", "only the second", "difference [95 %]", "p", "p (Holm)", ""],
        [
            [
                f"{in_words(a)} – {in_words(b)}",
                str(r.only_a),
                str(r.only_b),
                points(r.difference, r.interval),
                shown_p(r.p),
                shown_p(q),
                stars(q),
            ]
            for (a, b, r), q in zip(found, adjusted, strict=True)
        ],
        note="Scenes that one solved and the other did not; McNemar's exact test.",
        name=prefix + "pairs-success",
    )


def _behaviour_table(by: ByStrategy, prefix: str) -> TableData:
    def mean(rows: Sequence[Row], column: str) -> float:
        return fmean(row[column] for row in rows)

    body = []
    for name, rows in by.items():
        parts = [
            " / ".join(f"{mean(rows, f'excavations_{d}_{t}'):.2f}" for d in DIRECTIONS)
            for t in TRIGGERS[:3]
        ]
        body.append(
            [
                in_words(name),
                *parts,
                f"{25 * mean(rows, 'ejected'):.1f}",
                f"{mean(rows, 'peak_contact_n'):.1f}",
                f"{mean(rows, 'peak_load_n'):.1f}",
                f"{mean(rows, 'mean_load_n'):.2f}",
                f"{mean(rows, 'interventions'):.2f}",
            ]
        )
    return TableData(
        "What happened on the way, means of a trial",
        [
            "strategy", "by clock, ccw / cw", "by stall, ccw / cw", "by push, ccw / cw",
            "pushed out, per 25", "peak contact, N", "peak load, N", "mean load, N",
            "gate set in",
        ],
        body,
        note="Excavations by what triggered them and their direction; objects pushed out of the "
        "front per 25 trials (paper, hardware: clock 5, event 1); the greatest contact force felt; "
        "greatest and mean sum of normal forces on the finger; how often the safety gate set in.",
        name=prefix + "behaviour",
    )  # fmt: skip


def _pictures(
    by: ByStrategy,
    references: Sequence[Reference],
    pairs: Mapping[str, Sequence[PairedValues]],
    prefix: str,
) -> list[Picture]:
    names = list(by)
    made = [
        Picture(
            prefix + "success",
            rates(
                {n: rate_of(of) for n, of in by.items()},
                [(r.label, r.success) for r in references],
                "Success",
            ),
            "Success of each strategy with its 95 % interval"
            + ("; beside it " + " and ".join(r.what for r in references) if references else "")
            + ".",
        )
    ]
    for column, (word, label) in MEASURES.items():
        brackets = [
            _bracket(names.index(p.a), names.index(p.b), p) for p in pairs[word] if _shown(p)
        ]
        values = {n: [r[column] for r in of] for n, of in by.items()}
        made.append(
            Picture(
                prefix + word,
                boxes(values, brackets, label, f"Normalised {word}"),
                f"Normalised {word}: boxes from the first to the third quartile with the median, "
                "diamonds the means, points the trials. Brackets: Wilcoxon's signed ranks, "
                "corrected by Holm; ns not significant.",
            )
        )
    return made


def _bracket(a: int, b: int, pair: PairedValues) -> Bracket:
    return Bracket(min(a, b), max(a, b), stars(pair.adjusted))


def _shown(pair: PairedValues) -> bool:
    return any({pair.a, pair.b} == set(shown) for shown in SHOWN_PAIRS)
