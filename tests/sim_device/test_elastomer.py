"""Elastomer: spreading, compliance, creep and hysteresis."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_device.skin.elastomer import Contact, Elastomer, Spreader
from sim_device.skin.parameters import ElastomerParameters
from sim_device.skin.skin import SkinModel
from tactile_core.geometry import finger

PARAMETERS = ElastomerParameters()
PLAIN = replace(PARAMETERS, creep=0.0, hysteresis_normal=0.0, hysteresis_shear=0.0)
FINGER = finger()
TAXELS = np.concatenate([a.position for a in FINGER.arrays])


def rubber(parameters: ElastomerParameters) -> Elastomer:
    return Elastomer(parameters, np.ones(1), np.array([2.5e-3]))


@given(
    st.integers(0, len(TAXELS) - 1),
    st.tuples(*[st.floats(-6e-3, 6e-3)] * 3),
    st.tuples(*[st.floats(-20, 20)] * 3),
    st.floats(1e-3, 15e-3),
)
@settings(max_examples=60, deadline=None)
def test_total_force_is_conserved_anywhere_on_the_skin(
    taxel: int, off: tuple[float, ...], force: tuple[float, ...], radius: float
) -> None:
    contact = Contact(TAXELS[taxel] + np.array(off), np.array(force), radius)
    shared = Spreader(TAXELS, PARAMETERS).force([contact, contact])
    assert shared.sum(axis=0) == pytest.approx(2 * np.array(force), abs=1e-9)


def test_total_force_is_conserved_in_taxel_axes(real_skin) -> None:
    model: SkinModel = real_skin()
    contact = Contact(np.array([0.004, -0.003, 0.0]), np.array([0.5, -0.2, -3.0]))
    assert model.taxel_force([contact]).sum(axis=0) == pytest.approx([0.5, -0.2, -3.0])


def test_contact_is_shared_by_its_nearest_taxels() -> None:
    spreader = Spreader(TAXELS[:32], PARAMETERS)
    corners = [2 * 8 + 2, 2 * 8 + 3, 8 + 2, 8 + 3]
    between = spreader.weights([Contact(TAXELS[corners].mean(axis=0), np.zeros(3))])[0]
    assert between[corners] == pytest.approx([0.25] * 4, abs=0.005)
    on_it = spreader.weights([Contact(TAXELS[10], np.zeros(3))])[0]
    assert on_it[10] > 0.95


def test_wider_contact_is_spread_wider() -> None:
    spreader = Spreader(TAXELS[:32], PARAMETERS)
    shares = [
        spreader.weights([Contact(TAXELS[10], np.zeros(3), r)])[0, 10] for r in (2e-3, 8e-3, 2e-2)
    ]
    assert shares[0] > shares[1] > shares[2]


def test_force_off_the_skin_is_borne_by_the_body() -> None:
    spreader = Spreader(TAXELS, PARAMETERS)
    push = np.array([0, -1.0, 0])
    far = Contact(np.array([-0.05, 0.0, 0.0]), push)
    assert not spreader.force([far]).any()
    edge = TAXELS[TAXELS[:, 0].argmin()]
    halfway = Contact(edge - [16e-3, 0, 0], push)
    assert spreader.force([halfway]).sum(axis=0)[1] == pytest.approx(-0.5, abs=0.01)


def test_prompt_displacement_is_force_over_stiffness() -> None:
    moved = rubber(PLAIN).load(np.array([[2.0, -1.0, -5.0]]), 0.01)
    assert moved[0] == pytest.approx([2.0 / 25e3, -1.0 / 25e3, -5.0 / 50e3])


def test_crushed_elastomer_yields_no_further() -> None:
    assert rubber(PLAIN).load(np.array([[0, 0, -1000.0]]), 0.01)[0, 2] == pytest.approx(-2.5e-3)


def test_creep_follows_its_time_constant() -> None:
    creeping = replace(PLAIN, creep=0.04, creep_time=8.0)
    body = rubber(creeping)
    force = np.array([[0, 0, -4.0]])
    body.load(force, 0.0)
    prompt = -4.0 / 50e3
    for step in range(1, 2401):
        moved = body.load(force, 0.01)[0, 2]
        if step in (400, 800, 1600):
            expected = 0.04 * (1 - math.exp(-step * 0.01 / 8.0))
            assert moved / prompt - 1 == pytest.approx(expected, rel=1e-3)
    released = body.load(np.zeros((1, 3)), 0.0)[0, 2]
    assert released / prompt == pytest.approx(0.04 * (1 - math.exp(-3)), rel=1e-3)
    assert body.load(np.zeros((1, 3)), 80.0)[0, 2] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("peak", [0.5, 5.0, 20.0])
@pytest.mark.parametrize(("axis", "share"), [(2, 0.03), (0, 0.08)])
def test_hysteresis_is_a_fraction_of_the_peak(peak: float, axis: int, share: float) -> None:
    body = rubber(replace(PARAMETERS, creep=0.0, hysteresis_time=1e9))
    stiffness = 50e3 if axis == 2 else 25e3

    def at(level: float) -> float:
        force = np.zeros((1, 3))
        force[0, axis] = -level
        return -float(body.load(force, 1e-3)[0, axis]) * stiffness

    up = {i: at(peak * i / 100) for i in range(101)}
    down = {i: at(peak * i / 100) for i in range(100, -1, -1)}
    widths = [(down[i] - up[i]) / peak for i in range(101)]
    assert max(widths) == pytest.approx(share, rel=0.02)
    assert min(widths) > -1e-12
    # Loading is a straight line: the loop does not bend the calibration.
    slopes = [up[i] / (peak * i / 100) for i in range(1, 101)]
    assert max(slopes) - min(slopes) < 1e-9


def test_elastomer_forgets_its_peak() -> None:
    body = rubber(replace(PARAMETERS, creep=0.0))
    body.load(np.array([[0, 0, -10.0]]), 0.1)
    remains = -body.load(np.zeros((1, 3)), 0.0)[0, 2] * 50e3
    # Width of the loop over 2 (1 - knee), with the knee at a quarter.
    assert remains == pytest.approx(10 * 0.03 / 1.5)
    later = -body.load(np.zeros((1, 3)), 5.0)[0, 2] * 50e3
    assert later == pytest.approx(remains * math.exp(-1), rel=1e-6)


def test_backward_time_is_not_accepted() -> None:
    with pytest.raises(ValueError, match="back"):
        rubber(PLAIN).load(np.zeros((1, 3)), -0.1)


def test_reset_relaxes_the_elastomer() -> None:
    body = rubber(PARAMETERS)
    body.load(np.array([[3.0, 0, -10.0]]), 5.0)
    body.reset()
    assert body.load(np.zeros((1, 3)), 0.0) == pytest.approx(np.zeros((1, 3)))
