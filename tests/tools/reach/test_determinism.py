"""A trial depends only on scene, strategy, parameters, seed and depth, bit for bit."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache

import pytest

from reachd.strategies.parameters import parameters
from tactile_tools.reach.lockstep import Result, run_trial
from tests.support import trial_trace

DEPTHS = ("contacts", "taxels")


@cache
def first_trial(depth: str) -> tuple[Result, str]:
    """The one that others are compared with."""
    return trial_trace.traced(trial_trace.crowded(), "hybrid_event", 3, depth)


@pytest.mark.parametrize("depth", DEPTHS)
def test_same_seed_gives_the_same_trial_bit_for_bit(depth: str) -> None:
    """Also when other trials ran in between."""
    first, digest = first_trial(depth)
    trial_trace.traced(trial_trace.crowded(4), "straight", 9, depth, seconds=1.0)
    second, again = trial_trace.traced(trial_trace.crowded(), "hybrid_event", 3, depth)
    assert digest == again
    assert first == second
    assert first.peak_load > 1.0, "nothing was touched: the comparison would say little"


@pytest.mark.parametrize("depth", DEPTHS)
def test_separate_process_runs_the_same_trial(depth: str) -> None:
    """In another process, with another hash seed; in this one another kind of trial came before."""
    here = first_trial(depth)[1]
    printed = subprocess.run(
        [sys.executable, trial_trace.__file__, "hybrid_event", "3", depth],
        env=os.environ | {"PYTHONHASHSEED": "77"},
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    assert printed.strip() == here


@pytest.mark.parametrize("depth", DEPTHS)
def test_watching_changes_nothing(depth: str) -> None:
    scene = trial_trace.crowded()
    watched, unwatched = (
        trial_trace.traced(scene, "burrow", 5, depth, watched=watched, seconds=2.0)[0]
        for watched in (True, False)
    )
    assert unwatched == watched


def test_another_seed_gives_another_board() -> None:
    scene = trial_trace.crowded()
    one, other = (trial_trace.traced(scene, "burrow", k, "taxels", seconds=2.0)[1] for k in (1, 2))
    assert one != other


def test_another_seed_gives_other_random_choices() -> None:
    """Excavation turns in a random direction."""
    scene = replace(trial_trace.crowded(0), goal=(0.3, 0.0))
    digests = (
        trial_trace.traced(scene, "excavate", seed, "contacts", seconds=15.0)[1]
        for seed in range(5)
    )
    first = next(digests)
    assert any(digest != first for digest in digests)


def test_a_trial_runs_at_the_period_of_its_settings() -> None:
    scene = trial_trace.crowded(4)
    fast = parameters(scene.parameters)
    slow = replace(fast, safety=replace(fast.safety, period=2 * fast.safety.period))
    results = [
        run_trial(scene, "straight", replace(p, time_limit=0.5), seed=0) for p in (fast, slow)
    ]
    assert results[0].cycles > 1.8 * results[1].cycles
    assert results[0].simulated_s == pytest.approx(results[1].simulated_s, abs=0.05)
