"""Force of ordinary reaches, as the wrist measures it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from reachd.strategies.parameters import parameters
from sim_device.world.scene_generation import generate
from tactile_tools.reach.lockstep import Step, run_trial

SET = "hardware"
STRATEGY = "hybrid_event"
REACHES = 100
REACHES_QUICK = 10
"""Reaches of the whole bench and of a quick one."""

AIMED_PEAK = 18.0
"""Force that no reach should exceed, N; the limit is 15."""


def bench_contact_force(*, quick: bool = False) -> dict[str, float]:
    """Return ``contact_*``: the force of reaches in the grid scenes 0 to 99 of ``hardware``.

    ``peak_n_*``: greatest in-plane force that the arm reports in each reach; its states are means
    over 10 ms. ``above_limit_ms_max``: longest unbroken time above the gate's limit in any reach.
    ``success`` and ``held``: shares of the reaches that arrived, and that the gate ended.
    """
    count = REACHES_QUICK if quick else REACHES
    values = parameters(SET)
    peaks, longest, reasons = [], [], []
    for seed in range(count):
        forces: list[float] = []
        result = run_trial(
            generate(SET, seed),
            STRATEGY,
            values,
            seed,
            watch=_into(forces),
        )
        peaks.append(max(forces))
        longest.append(1e3 * values.safety.period * _longest_run(forces, values.safety.force))
        reasons.append(str(result.outcome.reason))
    return {
        "contact_reaches": float(count),
        "contact_success": reasons.count("reached") / count,
        "contact_held": reasons.count("held") / count,
        "contact_peak_n_p50": float(np.percentile(peaks, 50)),
        "contact_peak_n_p95": float(np.percentile(peaks, 95)),
        "contact_peak_n_max": max(peaks),
        "contact_peak_above_aim": sum(p > AIMED_PEAK for p in peaks) / count,
        "contact_above_limit_ms_max": max(longest),
    }


def _longest_run(forces: list[float], limit: float) -> int:
    """Greatest number of cycles in a row above ``limit``."""
    longest = now = 0
    for force in forces:
        now = now + 1 if force > limit else 0
        longest = max(longest, now)
    return longest


def _into(forces: list[float]) -> Callable[[Step], None]:
    """Watcher that appends the in-plane force of each cycle to ``forces``."""
    return lambda step: forces.append(math.hypot(step.arm.fx, step.arm.fy))
