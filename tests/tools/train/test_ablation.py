"""What the variants of an ablation leave out, and nothing else."""

from __future__ import annotations

import math

import numpy as np
import pytest

from reachd.strategies.memory import LAGS, WIDTH, Memory, Rows
from sim_device.world.scene_generation import generate

pytest.importorskip("torch", reason="no torch: pip install 'tactile-reach[learn]'")
pytest.importorskip("numba", reason="no numba: pip install 'tactile-reach[train]'")

from tactile_tools.dev.learned_ablation import VARIANTS, bank_of

SPEEDS = np.array([[0.05, 0.2]])


def seen(felt_seed: int, *, until: int, decisions: int = LAGS[-1] + 5) -> Rows:
    """The last of ``decisions`` observations of one way; what was felt in the first ``until``
    depends on ``felt_seed``."""
    way, touch = np.random.default_rng(1), np.random.default_rng(2)
    other = np.random.default_rng(felt_seed)
    memory = Memory(1)
    for k in range(decisions):
        pose, action = way.normal(0, 0.05, (1, 3)), way.normal(0, 1, (1, 3))
        goal, state = way.normal(0, 0.2, (1, 2)), way.uniform(0, 1, (1, 5))
        felt = touch.uniform(0.1, 1, (1, 9))
        if k < until:
            felt = other.uniform(0.1, 1, (1, 9))
        (found,) = memory.observe(felt, pose, action, goal, state, SPEEDS)
    last: Rows = found
    return last


@pytest.mark.parametrize(
    ("variant", "until"),
    [("no touch", 85), ("no memory", 84), ("memory of 0.8 s", 76)],
)
def test_a_variant_does_not_see_what_it_is_to_be_without(variant: str, until: int) -> None:
    blind = list(VARIANTS[variant].blind)
    one, another = seen(3, until=until), seen(4, until=until)
    assert not np.array_equal(one, another)
    one[blind] = another[blind] = 0.0
    np.testing.assert_array_equal(one, another)
    assert len(set(blind)) == len(blind) < WIDTH


def test_a_variant_without_touch_still_sees_its_own_motion() -> None:
    blind = set(VARIANTS["no touch"].blind)
    assert not {9, 10, 11, 12, 13, 14} & blind  # the present record's motion and last action


def test_the_sweep_beneath_is_that_of_the_weights_in_the_package() -> None:
    scenes = [generate("authors_sim", 740_000)]
    bank = bank_of(scenes, swept=True)
    assert bank.agents["sweep_angle"].tolist() == pytest.approx([math.radians(55)] * 2)
    assert bank_of(scenes, swept=False).agents["jam_force"].tolist() == [math.inf] * 2
