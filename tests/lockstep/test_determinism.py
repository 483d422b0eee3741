"""A trial is a function of scene, strategy, parameters, seed and depth, to the bit."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from reachd.strategies.parameters import parameters
from tactile_tools.reach.lockstep import run_trial

DEPTHS = ("contacts", "taxels")


@pytest.mark.parametrize("depth", DEPTHS)
def test_the_same_seed_gives_the_same_trial_to_the_bit(trace: ModuleType, depth: str) -> None:
    scene = trace.crowded()
    first, digest = trace.traced(scene, "hybrid_event", 3, depth)
    second, again = trace.traced(scene, "hybrid_event", 3, depth)
    assert digest == again
    assert first == second
    assert first.peak_load > 1.0, "nothing was touched: the comparison would say little"


@pytest.mark.parametrize("depth", DEPTHS)
def test_workers_of_their_own_run_the_same_trial(trace: ModuleType, depth: str) -> None:
    """In another process, with another hash seed; in this one another kind of trial came before."""
    here = trace.traced(trace.crowded(), "hybrid_event", 3, depth)[1]
    script = Path(__file__).with_name("trace.py")
    said = subprocess.run(
        [sys.executable, str(script), "hybrid_event", "3", depth],
        env=os.environ | {"PYTHONHASHSEED": "77"},
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    assert said.strip() == here


@pytest.mark.parametrize("depth", DEPTHS)
def test_whoever_watches_changes_nothing(trace: ModuleType, depth: str) -> None:
    scene = trace.crowded()
    watched = trace.traced(scene, "burrow", 5, depth)[0]
    assert trace.traced(scene, "burrow", 5, depth, watched=False)[0] == watched


def test_another_seed_is_another_board(trace: ModuleType) -> None:
    scene = trace.crowded()
    one, other = (trace.traced(scene, "burrow", k, "taxels", seconds=2.0)[1] for k in (1, 2))
    assert one != other


def test_another_seed_is_another_chance_of_the_strategy(trace: ModuleType) -> None:
    """Excavation turns in a random direction."""
    scene = replace(trace.crowded(0), goal=(0.3, 0.0))
    digests = {
        trace.traced(scene, "excavate", seed, "contacts", seconds=15.0)[1] for seed in range(5)
    }
    assert len(digests) > 1


def test_trials_one_after_another_leave_nothing_behind(trace: ModuleType) -> None:
    scene = trace.crowded()
    alone = trace.traced(scene, "hybrid_event", 3, "taxels", seconds=1.5)[1]
    trace.traced(trace.crowded(4), "straight", 9, "taxels", seconds=1.0)
    assert trace.traced(scene, "hybrid_event", 3, "taxels", seconds=1.5)[1] == alone


def test_a_trial_runs_at_the_period_of_its_settings(trace: ModuleType) -> None:
    scene = trace.crowded(4)
    fast = parameters(scene.parameters)
    slow = replace(fast, safety=replace(fast.safety, period=2 * fast.safety.period))
    results = [
        run_trial(scene, "straight", replace(p, time_limit=0.5), seed=0) for p in (fast, slow)
    ]
    assert results[0].cycles > 1.8 * results[1].cycles
    assert results[0].simulated_s == pytest.approx(results[1].simulated_s, abs=0.05)
