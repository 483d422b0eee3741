"""Trials of the studies: the paper's grids, and every level of every axis."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tactile_core.config import ConfigError
from tactile_tools.experiments.axes import AXES, levels_of
from tactile_tools.experiments.conditions import parameters_of, scene_of, world_of
from tactile_tools.experiments.runner import StudyError, check, memory_of, summarize
from tactile_tools.experiments.spec import STRATEGIES, Conditions, TrialSpec
from tactile_tools.experiments.studies import (
    Study,
    rebuild,
    robustness_study,
    strategies_study,
    sweep_cells,
    sweep_study,
)

OptionsOf = Callable[..., Any]


def test_strategies_are_crossed_with_all_options(options_of: OptionsOf) -> None:
    options = options_of(
        scenes=3,
        sets=("authors_sim", "hardware"),
        engines=("mujoco", "pymunk"),
        depths=("contacts", "taxels"),
    )
    specs = strategies_study(options).specs
    assert len(specs) == len(set(specs)) == 3 * 2 * 2 * 2 * 5
    assert {s.scene_seed for s in specs} == {5, 6, 7}
    assert all(s.source == s.set and s.trial_seed == s.scene_seed for s in specs)
    assert [s.scene_seed for s in specs] == sorted(s.scene_seed for s in specs)


def test_sweep_is_that_of_the_paper(options_of: OptionsOf) -> None:
    options = options_of(scenes=2, sets=("authors_sim",), parameters={})
    study = sweep_study(options, ("burrow", "excavate"), ("rad", "hz"))
    assert len(study.specs) == 2 * (1 + 3 * 100)
    one = sweep_study(options, ("burrow",), ("rad",))
    assert len(one.specs) == 2 * 101
    cells = sweep_cells(("burrow", "excavate"), ("rad", "hz"))
    burrow = [c for c in cells if c.primitive == "burrow"]
    amplitudes = sorted({c.parameters["burrow_amplitude"] for c in burrow})
    assert amplitudes == [0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9]
    rad = sorted({c.parameters["burrow_frequency"] for c in burrow if c.reading == "rad"})
    assert rad == [0.5, 0.625, 0.75, 0.875, 1.0, 1.125, 1.25, 1.375, 1.5, 1.625]
    hertz = sorted({c.parameters["burrow_frequency"] for c in burrow if c.reading == "hz"})
    assert hertz == pytest.approx([2 * math.pi * f for f in rad])
    excavate = [c for c in cells if c.primitive == "excavate"]
    for name in ("excavate_duration", "trigger_interval"):
        values = sorted({c.parameters[name] for c in excavate})
        assert (values[0], values[1], values[-1], len(values)) == (1.875, 2.5, 7.5, 10)
    for spec in sweep_study(options_of(scenes=1), ("burrow", "excavate"), ("rad", "hz")).specs:
        spec.resolved()


@pytest.mark.parametrize("set_name", ["authors_sim", "hardware"])
def test_every_axis_includes_the_default_and_can_be_run(set_name: str) -> None:
    for name in AXES:
        levels = levels_of(name, set_name)
        assert len(levels) >= 4
        assert len({level.label for level in levels}) == len(levels)
        assert len([level for level in levels if level.nominal]) <= 1
        for level in levels:
            spec = TrialSpec(
                "hardware", 1, set_name, "mujoco", "contacts", "straight", 1,
                json.dumps(dict(level.parameters)), level.conditions.to_json(),
            )  # fmt: skip
            parameters_of(spec)
            if level.conditions.objects is None:
                world_of(spec, scene_of(spec))


def test_default_levels_are_run_once(options_of: OptionsOf) -> None:
    options = options_of(scenes=1, sets=("authors_sim",), parameters={})
    whole = robustness_study(options, STRATEGIES)
    apart = sum(len(levels_of(axis, "authors_sim")) for axis in AXES) * len(STRATEGIES)
    own = [s for s in whole.specs if s.parameters == "{}" and s.conditions == "{}"]
    assert len(own) == len(STRATEGIES)
    assert len(whole.specs) < apart
    assert any(level.nominal for level in levels_of("density", "authors_sim"))


def test_definition_round_trips_to_its_study(options_of: OptionsOf, tmp_path: Path) -> None:
    options = options_of(scenes=2)
    for study in (
        strategies_study(options),
        sweep_study(options, ("excavate",), ("hz",)),
        robustness_study(options, ("straight", "burrow"), ("noise", "width")),
    ):
        stored = json.loads(json.dumps(study.definition))
        again, found = rebuild(tmp_path, stored)
        assert again.specs == study.specs
        assert found == options


def test_empty_study_is_refused() -> None:
    with pytest.raises(StudyError, match="no trials"):
        check(Study({}, ()))


def test_conditions_round_trip_through_text() -> None:
    conditions = Conditions(objects=(12, 16), noise=0.25, finger_width=0.05)
    assert Conditions.from_json(conditions.to_json()) == conditions
    assert Conditions().to_json() == "{}"
    with pytest.raises(ConfigError, match="least first"):
        Conditions(objects=(20, 10))


def test_throughput_is_reported(study: Study, made_row: Callable[..., Any]) -> None:
    # 0.2 CPU-s for 20 simulated seconds is 0.01: thirty times faster than 0.30.
    rows = [made_row(spec) for spec in study.specs]
    summary = summarize(rows)
    assert summary["speedup_vs_reference"] == pytest.approx(30.0)
    assert summary["trials_per_core_minute"] == pytest.approx(60 / 0.3)
    rows[0] = made_row(study.specs[0], error="lost")
    assert summarize(rows)["errors"] == 1


def test_growing_memory_is_detected(study: Study, made_row: Callable[..., Any]) -> None:
    spec = study.specs[0]
    flat = [made_row(spec, worker="a", worker_trials=i, memory_mb=80.0) for i in range(1, 400)]
    leak = [
        made_row(spec, worker="b", worker_trials=i, memory_mb=80 + 0.05 * i) for i in range(1, 400)
    ]
    assert memory_of(flat)["growth_mb_per_1000"] == pytest.approx(0.0)
    found = memory_of([*flat, *leak])
    assert found["growth_mb_per_1000"] == pytest.approx(50.0)
    assert found["workers"] == 2
    assert memory_of(flat[:10])["growth_mb_per_1000"] is None
