"""The robust fit: closed forms and symmetries."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_core.calibration import nominal
from tactiled.sensing.consensus import Consensus, Prior, design_candidates
from tactiled.sensing.forces import ForceModel
from tactiled.sensing.layout import Layout


class Fitter:
    """A consensus fit of a board, and fields made of planes and contacts."""

    def __init__(self, calibration):
        self.layout = Layout(calibration.geometry)
        self.model = ForceModel(calibration, self.layout)
        self.consensus = Consensus(self.layout, self.model)
        self.shape = (self.layout.arrays, 3, self.layout.width)

    def fit(self, field_ee, healthy=None):
        """Fit to a field (A, 3, n) in ee axes."""
        healthy = self.layout.real if healthy is None else healthy
        taxel = np.einsum("acdn,acn->adn", self.layout.rotation, field_ee)
        return self.consensus.fit(field_ee, self.model.forces(taxel), healthy)

    def in_ee(self, flat):
        """Convert (N, 3) µT in taxel axes to (A, 3, n) in ee axes."""
        padded = np.zeros(self.shape)
        for a in range(self.layout.arrays):
            n = self.layout.counts[a]
            start = int(self.layout.counts[:a].sum())
            padded[a, :, :n] = flat[start : start + n].T
        return self.model.field_in_ee(padded)

    def noise(self, rng, sigma=5.0):
        return rng.normal(0, sigma, self.shape) * self.layout.real[:, None]

    def plane(self, theta):
        return theta @ self.layout.design

    def theta(self, rng, slope=2.0):
        theta = rng.normal(0, 40, (1, 3, 3)).repeat(self.layout.arrays, axis=0)
        theta[:, :, 1:] = rng.normal(0, slope, (self.layout.arrays, 3, 2))
        return theta


@pytest.fixture(params=[0.0, 0.02], ids=["uncoupled", "coupled"])
def fitter(request, board):
    return Fitter(board(coupling=request.param))


def press(rng, fitter, field, share):
    """Press a share of every array's taxels with 0.5–5 N and shear; returns the free ones."""
    force = np.zeros(fitter.shape)
    free = fitter.layout.real.copy()
    for a, n in enumerate(fitter.layout.counts):
        chosen = rng.choice(n, round(share * n), replace=False)
        free[a, chosen] = False
        newton = rng.uniform(0.5, 5.0, len(chosen))
        angle = rng.uniform(0, 2 * np.pi, len(chosen))
        force[a, 0, chosen] = 0.3 * newton * np.cos(angle)
        force[a, 1, chosen] = 0.3 * newton * np.sin(angle)
        force[a, 2, chosen] = -newton
    matrix = fitter.model._matrix
    taxel = np.linalg.solve(matrix, force.reshape(len(force), -1, 1)).reshape(fitter.shape)
    field += fitter.model.field_in_ee(taxel)
    return free


@pytest.mark.parametrize("share", [0.0, 0.25, 0.45])
def test_plane_is_recovered_under_contact(fitter, share):
    """Except for crosstalk left after two passes and the shrinkage of slopes that the free taxels
    hardly determine: both are well below one sample's noise of 5 µT.
    """
    exact = share < 0.3 and not fitter.model.decouples
    rng = np.random.default_rng(1)
    for _ in range(10):
        theta = fitter.theta(rng)
        field = fitter.plane(theta)
        free = press(rng, fitter, field, share)
        fit = fitter.fit(field)
        error = fitter.plane(fit.theta - theta)
        assert np.abs(error).max() < 1e-6 if exact else np.sqrt((error**2).mean()) < 1.5
        assert fit.valid.all()
        np.testing.assert_allclose(fit.support, free.mean(axis=1))
        np.testing.assert_allclose(fit.residual_ut, 0, atol=1e-6 if exact else 1.5)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.1, 0.25, 0.45]))
def test_added_uniform_field_is_removed_exactly(seed, share):
    fitter = FITTER
    rng = np.random.default_rng(seed)
    field = fitter.noise(rng)
    press(rng, fitter, field, share)
    added = fitter.theta(rng, slope=0.0)
    plain, moved = fitter.fit(field), fitter.fit(field + fitter.plane(added))
    np.testing.assert_allclose(moved.theta - plain.theta, added, atol=1e-5)
    np.testing.assert_allclose(moved.support, plain.support)
    np.testing.assert_allclose(moved.residual_ut, plain.residual_ut, atol=1e-5)
    np.testing.assert_array_equal(moved.valid, plain.valid)


def added_plane(seed, share):
    """Difference, µT, of the fits with and without an added plane, minus that plane.

    Proposals from more than three taxels have no slope, so another may win when a plane is added,
    and three refinements still depend on their start. With sixteen refinements the fits agree to
    the last digit, but are no closer to the truth (2.2 µT rms).
    """
    fitter = FITTER
    rng = np.random.default_rng(seed)
    field = fitter.noise(rng)
    press(rng, fitter, field, share)
    added = fitter.theta(rng)
    plain, moved = fitter.fit(field), fitter.fit(field + fitter.plane(added))
    return plain, moved, fitter.plane(moved.theta - plain.theta - added)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.1]))
def test_added_plane_is_removed_to_within_the_noise(seed, share):
    """The noise of two samples of 5 µT rms; the maximum of 16,000 draws was 4.2 µT rms."""
    plain, moved, away = added_plane(seed, share)
    assert np.sqrt((away**2).mean(axis=(1, 2))).max() < 10.0
    np.testing.assert_array_equal(moved.valid, plain.valid)


def test_added_plane_is_mostly_removed_to_a_fraction_of_the_noise():
    draws = [added_plane(seed, share) for share in (0.0, 0.1) for seed in range(200)]
    assert np.sqrt(np.mean([away**2 for *_, away in draws])) < 0.2
    same = [np.array_equal(moved.support, plain.support) for plain, moved, _ in draws]
    assert np.mean(same) > 0.98


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_fit_rotates_with_the_axes(seed):
    """On an uncoupled board no axis of ee is special."""
    fitter = FITTER_UNCOUPLED
    rng = np.random.default_rng(seed)
    field = fitter.noise(rng)
    press(rng, fitter, field, 0.25)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    plain, turned = fitter.fit(field), fitter.fit(turn @ field)
    np.testing.assert_allclose(turned.theta, turn @ plain.theta, atol=1e-4)
    np.testing.assert_array_equal(turned.valid, plain.valid)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), order=st.permutations([0, 1, 2]))
def test_the_order_of_arrays_does_not_matter(seed, order):
    fitter = FITTER
    rng = np.random.default_rng(seed)
    field = fitter.noise(rng)
    press(rng, fitter, field, 0.3)
    plain = fitter.fit(field)
    # the three arrays have the same shape; only their axes in ee differ, on which the fit of an
    # uncoupled board does not depend
    other = Fitter(PERMUTED[tuple(order)])
    swapped = other.fit(field[list(order)])
    np.testing.assert_allclose(swapped.theta, plain.theta[list(order)], atol=1e-6)
    np.testing.assert_array_equal(swapped.valid, plain.valid[list(order)])


def test_forces_do_not_change_with_a_uniform_field(board, field_of):
    fitter = Fitter(board(coupling=0.02))
    rng = np.random.default_rng(3)
    field = fitter.in_ee(rng.normal(0, 5, (48, 3)))
    ambient = np.array([20.0, -30.0, 45.0])
    moved = field + ambient[:, None]
    forces = []
    for each in (field, moved):
        taxel = np.einsum("acdn,acn->adn", fitter.layout.rotation, each)
        fit = fitter.fit(each)
        forces.append(fitter.model.forces(taxel) - fitter.model.plane_forces(fit.theta))
    np.testing.assert_allclose(forces[0], forces[1], atol=1e-7)


def test_fit_holds_with_half_an_array_in_one_patch(fitter):
    """Two of four rows are pressed: the slope across them is unknown, but not the field."""
    rng = np.random.default_rng(6)
    theta = np.zeros((3, 3, 3))
    theta[:, :, 0] = [30.0, -20.0, 25.0]
    worst = []
    for _ in range(20):
        field = fitter.plane(theta) + fitter.noise(rng)
        normals = fitter.layout.rotation[1, :, 2, 0]
        field[1, :, :8] += normals[:, None] * rng.uniform(60, 500, 8)
        fit = fitter.fit(field)
        assert fit.valid.all()
        away = fitter.plane(fit.theta) - fitter.plane(theta)
        worst.append(np.abs(away[1]).max())
    assert np.mean(worst) < 10.0  # two sigma of one sample, at the worst taxel


def test_uniform_press_is_distinguished_from_the_ambient_field(board):
    """One whole array reads 100 µT more; the rest of the board does not."""
    fitter = Fitter(board())
    rng = np.random.default_rng(9)
    ambient = np.array([10.0, 20.0, -30.0])
    field = fitter.noise(rng) + ambient[:, None]
    field[2, 0] += 100.0
    fit = fitter.fit(field)
    assert fit.valid.tolist() == [True, True, False]
    np.testing.assert_allclose(fit.common, ambient, atol=3)
    # with two arrays under such a press, the earlier field of the board is used
    field[1, 1] -= 100.0
    assert fitter.consensus.fit(
        field, np.zeros_like(field), fitter.layout.real, Prior(ambient.tolist(), 50.0)
    ).valid.tolist() == [True, False, False]


def test_linear_pressure_is_not_ambient_field(board):
    fitter = Fitter(board())
    rng = np.random.default_rng(9)
    field = fitter.noise(rng)
    field[0, 1] += 100.0 * fitter.layout.design[0, 1]  # 100 µT in 18 mm
    assert fitter.fit(field).valid.tolist() == [False, True, True]


def test_missing_support_is_reported(board):
    fitter = Fitter(board())
    rng = np.random.default_rng(2)
    field = rng.uniform(-500, 500, fitter.shape)
    fit = fitter.fit(field)
    assert not fit.valid.any()
    assert np.isnan(fit.common).all()
    assert (fit.support < 0.4).all()
    assert np.isfinite(fit.theta).all()


def test_masked_taxels_are_ignored(board):
    fitter = Fitter(board())
    rng = np.random.default_rng(4)
    field = fitter.noise(rng)
    healthy = fitter.layout.real.copy()
    healthy[:, [0, 5, 10]] = False
    garbage = field.copy()
    garbage[:, :, [0, 5, 10]] = 1e4
    a, b = fitter.fit(field, healthy), fitter.fit(garbage, healthy)
    np.testing.assert_allclose(a.theta, b.theta, atol=1e-9)
    assert b.valid.all()


def test_array_without_healthy_taxels_is_invalid_alone(fitter):
    rng = np.random.default_rng(4)
    field = fitter.noise(rng)
    healthy = fitter.layout.real.copy()
    healthy[1] = False
    fit = fitter.fit(field, healthy)
    assert fit.valid.tolist() == [True, False, True]
    assert fit.support[1] == 0
    assert np.isfinite(fit.theta).all()


def test_few_taxels_get_a_constant_fit():
    """A plane on five taxels absorbs 46 % of a contact's energy; this fit absorbs almost none."""
    fitter = Fitter(nominal("anyskin", "A"))
    rng = np.random.default_rng(5)
    kept = []
    for _ in range(50):
        field = fitter.noise(rng, 4.0) + np.array([30.0, 10.0, -20.0])[:, None]
        contact = np.zeros(fitter.shape)
        contact[0, :, rng.choice(5, 2, replace=False)] = rng.normal(0, 200, (2, 3))
        fit = fitter.consensus.fit(
            field + contact,
            np.zeros_like(field),
            fitter.layout.real,
            Prior([30.0, 10.0, -20.0], 50.0),
        )
        assert np.abs(fit.theta[0, :, 1:]).max() < 1e-6
        if fit.valid[0]:
            left = field + contact - fitter.plane(fit.theta)
            kept.append((left**2).sum() / ((field + contact - [[30], [10], [-20]]) ** 2).sum())
    assert len(kept) >= 40
    assert 0.97 < np.mean(kept) < 1.03


def test_candidates_are_deterministic_planes():
    layout = Layout(nominal("finger", "A").geometry)
    design = layout.design[0].T
    operators, uses = design_candidates(design)
    again, _ = design_candidates(design)
    np.testing.assert_array_equal(operators, again)
    assert uses.any(axis=0).all()  # every taxel is in some subset
    constant = operators @ np.ones(len(design))
    np.testing.assert_allclose(constant, np.tile([1.0, 0, 0], (len(operators), 1)), atol=1e-9)
    triples = operators[uses.sum(axis=1) == 3]
    np.testing.assert_allclose(
        triples @ design, np.broadcast_to(np.eye(3), (*triples.shape[:1], 3, 3)), atol=1e-9
    )


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 2), (1, 20), (8, 16)])
def test_any_size_of_array_can_be_fitted(board, shape):
    fitter = Fitter(board(shapes=(shape, (4, 4))))
    rng = np.random.default_rng(1)
    fit = fitter.fit(fitter.noise(rng, 3.0) + 40.0 * fitter.layout.real[:, None])
    assert np.isfinite(fit.theta).all()
    assert fit.valid[1]
    assert bool(fit.valid[0]) == (shape[0] * shape[1] >= 3)


def _permuted(calibration, order):
    import dataclasses

    return dataclasses.replace(calibration, arrays=tuple(calibration.arrays[a] for a in order))


def _boards():
    import importlib.util
    from itertools import permutations
    from pathlib import Path

    spec = importlib.util.spec_from_file_location(
        "sensing_conftest", Path(__file__).with_name("conftest.py")
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    plain = module.board()
    return (
        Fitter(module.board(coupling=0.02)),
        Fitter(plain),
        {order: _permuted(module.board(coupling=0.02), order) for order in permutations(range(3))},
    )


FITTER, FITTER_UNCOUPLED, PERMUTED = _boards()
