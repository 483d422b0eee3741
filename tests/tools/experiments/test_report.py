"""Reports say what is in the rows; the rows are made up, so that the answer is known."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_tools.experiments import report_sweep
from tactile_tools.experiments.compare import comparison
from tactile_tools.experiments.document import Document, points, shown_p, typeset, whole
from tactile_tools.experiments.report import build, write_report
from tactile_tools.experiments.report_robustness import FLIPS, HOLDS
from tactile_tools.experiments.rows import TableError
from tactile_tools.experiments.spec import STRATEGIES, TrialSpec
from tactile_tools.experiments.studies import (
    Options,
    robustness_study,
    strategies_study,
    sweep_study,
)
from tactile_tools.experiments.tables import load_run

Filled = Callable[..., Path]
Rng = np.random.Generator

SUCCESS = {
    "straight": 0.2,
    "burrow": 0.65,
    "excavate": 0.55,
    "hybrid_clock": 0.67,
    "hybrid_event": 0.72,
}
TIME = {
    "straight": 0.9,
    "burrow": 0.6,
    "excavate": 0.65,
    "hybrid_clock": 0.8,
    "hybrid_event": 0.55,
}


def options(**changed: Any) -> Options:
    settings: dict[str, Any] = {
        "scenes": 100,
        "seed": 0,
        "sets": ("authors_sim",),
        "engines": ("mujoco",),
        "depths": ("contacts",),
        "source": None,
        "parameters": {},
    }
    return Options(**{**settings, **changed})


def like_the_paper(spec: TrialSpec, rng: Rng) -> dict[str, Any]:
    """Success in the first scenes, as many as in the paper; failures are far from the goal."""
    return ends(spec.scene_seed < round(100 * SUCCESS[spec.strategy]), spec.strategy, rng)


def ends(reached: bool, strategy: str, rng: Rng) -> dict[str, Any]:
    left = 0.003 if reached else 0.05 + 0.2 * float(rng.random())
    time = TIME[strategy] + 0.05 * float(rng.random()) if reached else 1.0
    return {
        "success": reached,
        "entered": reached,
        "normalized_distance": left,
        "normalized_time": time,
        "ejected": int(strategy == "hybrid_clock" and rng.random() < 0.3),
    }


class Links(HTMLParser):
    """Collects everything that a page would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [v or "" for k, v in attrs if k in ("src", "href")]


def text_of(document: Document) -> str:
    return "\n".join(f for s in document.sections for f in s.findings)


def test_findings_of_the_paper_are_found_in_similar_rows(filled: Filled, tmp_path: Path) -> None:
    run = filled(strategies_study(options()), tmp_path / "run", like_the_paper)
    text = text_of(build(load_run(run)))
    assert re.search(r"distance to the goal.* significantly worse than each of them", text)
    assert re.search(r"In time.* significantly worse than each of them", text)
    assert "is significantly faster than hybrid clock" in text
    assert "The order is the paper's." in text
    assert "No rate differs significantly from the success in the paper's 300" in text
    assert "straight 20 %, excavate 55 %, burrow 65 %" in text
    assert "Of 100 scenes, 72 were solved by at least one strategy" in text
    assert "touch disturbs less" in text


def test_opposite_findings_are_found_in_opposite_rows(filled: Filled, tmp_path: Path) -> None:
    def reverse(spec: TrialSpec, rng: Rng) -> dict[str, Any]:
        share = {"straight": 0.9, "hybrid_event": 0.05}.get(spec.strategy, 0.5)
        return ends(spec.scene_seed < round(100 * share), spec.strategy, rng)

    run = filled(strategies_study(options()), tmp_path / "run", reverse)
    text = text_of(build(load_run(run)))
    assert "significantly better than burrow" in text
    assert "is significantly slower than hybrid clock" in text
    assert "The paper's order is straight, excavate, burrow, hybrid clock, hybrid event" in text
    assert re.search(r"Significantly different .*straight \(90 %, above its 22 %", text)


def test_report_page_is_self_contained_with_tables_first(filled: Filled, tmp_path: Path) -> None:
    run = filled(strategies_study(options(scenes=30)), tmp_path / "run", like_the_paper)
    path = write_report(run, tmp_path / "out")
    page = path.read_text()
    links = Links()
    links.feed(page)
    assert links.found
    assert all(link.startswith("data:image/png;base64,") for link in links.found)
    assert page.index("<table>") < page.index("<img")
    pictures = sorted(p.name for p in path.parent.glob("*.png"))
    assert pictures == ["distance.png", "success.png", "time.png"]
    assert all((path.parent / p).read_bytes().startswith(b"\x89PNG\r\n\x1a\n") for p in pictures)
    with (path.parent / "success.csv").open(newline="") as stream:
        rows = list(csv.reader(stream))
    assert [row[0].replace(" ", "_") for row in rows[1:]] == list(STRATEGIES)
    assert sum(p.stat().st_size for p in path.parent.iterdir()) < 1_000_000


def test_one_trial_per_strategy_is_enough_for_a_report(filled: Filled, tmp_path: Path) -> None:
    run = filled(strategies_study(options(scenes=1)), tmp_path / "run", like_the_paper)
    assert write_report(run, run).exists()


def test_unfinished_run_is_marked(filled: Filled, tmp_path: Path) -> None:
    run = filled(strategies_study(options(scenes=4)), tmp_path / "run", like_the_paper)
    lines = (run / "trials.jsonl").read_bytes().splitlines(keepends=True)
    (run / "trials.jsonl").write_bytes(b"".join(lines[:12]))
    assert "not finished: 8 of its 20 trials are missing" in build(load_run(run)).lead[0]
    (run / "trials.jsonl").write_bytes(b"")
    with pytest.raises(TableError, match="no finished trials"):
        build(load_run(run))


def test_failed_trials_are_reported_and_excluded(filled: Filled, tmp_path: Path) -> None:
    def half(spec: TrialSpec, rng: Rng) -> dict[str, Any]:
        if spec.scene_seed % 2:
            return {"error": "WorldError: <physics> gave up", "success": None}
        return ends(True, spec.strategy, rng)

    run = filled(strategies_study(options(scenes=10)), tmp_path / "run", half)
    page = write_report(run, tmp_path / "out").read_text()
    assert "25 of 50 trials" in page
    assert "&lt;physics&gt; gave up" in page  # text of a trial is never taken for markup
    assert "100\u00a0% [57, 100]" in page


def test_groups_are_reported_separately(filled: Filled, tmp_path: Path) -> None:
    both = options(scenes=6, depths=("contacts", "taxels"))
    run = filled(strategies_study(both), tmp_path / "run", like_the_paper)
    document = build(load_run(run))
    titles = [s.title for s in document.sections]
    assert titles[0] == "At a glance"
    assert titles[1:] == [
        "authors_sim · MuJoCo · exact contacts",
        "authors_sim · MuJoCo · touch through taxels",
    ]
    names = [p.name for s in document.sections for p in s.pictures]
    assert len(names) == len(set(names)) == 6
    headline, success, values = document.sections[0].tables
    assert [row[0] for row in headline.rows] == titles[1:]
    assert "A contacts, B taxels (authors_sim · mujoco)" in success.caption
    assert [row[5] for row in success.rows] == ["6"] * 5
    assert len(values.rows) == 5


def test_archived_run_can_be_reported_and_rerun(filled: Filled, tmp_path: Path) -> None:
    run = filled(strategies_study(options(scenes=30)), tmp_path / "run", like_the_paper)
    first = write_report(run, tmp_path / "put", rows=True)
    assert {"experiment.json", "trials.parquet"} <= {p.name for p in first.parent.iterdir()}
    assert load_run(first.parent).rows == load_run(run).rows
    again = write_report(first.parent, tmp_path / "again")
    assert again.read_bytes() == first.read_bytes()
    assert sum(p.stat().st_size for p in first.parent.iterdir()) < 1_000_000


def test_sweep_is_smoothed_and_judged(filled: Filled, tmp_path: Path) -> None:
    def surface(spec: TrialSpec, rng: Rng) -> dict[str, Any]:
        if spec.strategy == "straight":
            return {"normalized_distance": 0.1, "normalized_time": 0.8, "success": False}
        # Four times better everywhere, except for the greatest amplitude, which is half as good.
        high = json.loads(spec.parameters)["burrow_amplitude"] == 0.9
        return {
            "normalized_distance": 0.05 if high else 0.025,
            "normalized_time": 0.6,
            "success": True,
        }

    run = load_run(
        filled(sweep_study(options(scenes=2), ("burrow",), ("rad",)), tmp_path / "run", surface)
    )
    straight = [r for r in run.rows if r["strategy"] == "straight"]
    (grid,) = report_sweep.grids_of(run, run.rows, straight)
    assert grid.ratio["distance"][9] == pytest.approx(np.full(10, 0.5))
    assert grid.ratio["distance"][:9] == pytest.approx(np.full((9, 10), 0.25))
    # A Gaussian of one cell cut off at four: weights of the cell and what lies beyond the edge.
    weights = np.exp(-0.5 * np.arange(-4, 5) ** 2)
    inside = weights[:4].sum() / weights.sum()
    assert grid.smooth("distance")[9, 0] == pytest.approx(0.25 * inside + 0.5 * (1 - inside))
    assert grid.smooth("time") == pytest.approx(np.full((10, 10), 0.75))
    text = text_of(build(run))
    assert "the claim about time holds here, the other does not" in text
    assert "The least success of a setting is 100 %" in text


def test_smoothing_skips_missing_cells() -> None:
    values = np.full((10, 10), 2.0)
    values[4, 4] = np.nan
    smooth = report_sweep.smoothed(values)
    assert np.isnan(smooth[4, 4])
    assert np.nanmin(smooth) == pytest.approx(2.0)
    assert np.nanmax(smooth) == pytest.approx(2.0)


def test_barely_started_sweep_can_be_reported(filled: Filled, tmp_path: Path) -> None:
    study = sweep_study(options(scenes=1), ("burrow", "excavate"), ("rad", "hz"))
    run = filled(study, tmp_path / "run", lambda spec, rng: {"success": True})
    lines = (run / "trials.jsonl").read_bytes().splitlines(keepends=True)
    (run / "trials.jsonl").write_bytes(b"".join(lines[:3]))
    assert write_report(run, tmp_path / "out").exists()


def test_robustness_report_says_where_a_conclusion_flips(filled: Filled, tmp_path: Path) -> None:
    def outcome(spec: TrialSpec, rng: Rng) -> dict[str, Any]:
        crowded = "30" in spec.conditions
        if spec.strategy == "burrow":
            return ends(not crowded, "burrow", rng)
        if crowded and spec.scene_seed == 3:
            return {
                "error": "RuntimeError: the gate refuses to arm: no valid features",
                "success": None,
                "normalized_time": None,
            }
        return ends(crowded, "straight", rng)

    study = robustness_study(options(scenes=12), ("straight", "burrow"), ("density",))
    run = filled(study, tmp_path / "run", outcome)
    document = build(load_run(run))
    (finding,) = document.sections[0].findings
    assert finding == (
        "Burrow succeeds more than straight: at 3 of 4 conditions beyond chance. It flips beyond "
        "chance at objects in the cupboard 30–34."
    )
    claims, density = document.sections[0].tables
    assert [row[1] for row in claims.rows] == [HOLDS, HOLDS, HOLDS, FLIPS]
    assert density.head == ["strategy", "12–16", "16–20", "20–30 (own)", "30–34"]
    # A trial that the gate did not let begin has not reached the goal.
    assert density.rows[0][-1].startswith("92 %")
    assert "30–34 (1)" in density.note
    assert [p.name for p in document.sections[0].pictures] == ["density"]


def test_runs_without_common_scenes_are_compared_unpaired(filled: Filled, tmp_path: Path) -> None:
    a = filled(strategies_study(options(scenes=20)), tmp_path / "a", like_the_paper)
    other = strategies_study(options(scenes=20, seed=50))
    b = filled(other, tmp_path / "b", like_the_paper)
    success, values = comparison(load_run(a).rows, load_run(b).rows)
    assert success.rows[0][:3] == ["straight", "100 % [84, 100]", "0 % [0, 16]"]
    assert success.rows[0][5] == "0"
    assert not values.rows


def test_parameter_sets_are_compared_separately(filled: Filled, tmp_path: Path) -> None:
    study = strategies_study(options(scenes=20))
    slower = strategies_study(options(scenes=20, parameters={"time_limit": 30}))
    a = filled(study, tmp_path / "a", like_the_paper)
    b = filled(slower, tmp_path / "b", lambda s, r: ends(True, s.strategy, r))
    success, values = comparison(load_run(a).rows, load_run(b).rows)
    burrow = {row[0]: row for row in success.rows}["burrow"]
    assert burrow[3].startswith("+0 [")
    assert burrow[5:] == ["20", "100 %"]
    assert len(values.rows) == 5


@pytest.mark.parametrize(
    ("p", "text"), [(0.5, "0.50"), (0.031, "0.031"), (0.0042, "0.0042"), (1e-9, "< 0.0001")]
)
def test_p_values_are_formatted_readably(p: float, text: str) -> None:
    assert shown_p(p) == text


def test_minus_signs_stay_with_their_numbers() -> None:
    assert typeset("61 % (p = 0.03)") == "61\u00a0% (p\u00a0=\u00a00.03)"
    assert typeset("-8 [-20, +2] of t-test 12-16") == "−8 [−20, +2] of t-test 12-16"


def test_rates_are_rounded_as_in_print() -> None:
    assert whole(55 / 88) == "63"  # 62.5
    assert whole(float("nan")) == "–"
    assert points(-0.001, (-0.04, 0.03)) == "+0 [-4, +3]"
