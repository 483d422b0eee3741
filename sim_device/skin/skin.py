"""Simulated skin: from contacts in the end-effector's frame to counts of its magnetometers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_device.skin.chips import Magnetometers, Reading, small_rotation, truncated_normal
from sim_device.skin.elastomer import Contact, Elastomer, Spreader
from sim_device.skin.environment import Surroundings
from sim_device.skin.magnets import MagnetArray
from sim_device.skin.parameters import SkinParameters
from tactile_core.arrays import FloatArray
from tactile_core.calibration import ArrayCalibration, BoardCalibration
from tactile_core.geometry import SkinGeometry
from tactile_core.types import Instant, seconds_between

__all__ = ["Contact", "SkinModel", "nominal_calibration"]


class SkinModel:
    """Skin of one board; N taxels, one array after another.

    ``rng`` draws first the tolerances of this skin, then the noise of its samples. Its parts are
    public, so that each effect can be studied alone: ``spreader``, ``elastomer``, ``magnets``,
    ``chips``.
    """

    def __init__(
        self, geometry: SkinGeometry, parameters: SkinParameters, rng: np.random.Generator
    ) -> None:
        self.geometry = geometry
        self.parameters = parameters
        self._rng = rng
        arrays = geometry.arrays
        position = np.concatenate([a.position for a in arrays])
        rotation = np.concatenate([a.rotation for a in arrays])
        yaw = np.concatenate([a.chip_yaw for a in arrays])
        n = geometry.taxels
        self._position = position
        self.rotation = rotation
        self._to_taxel = np.ascontiguousarray(np.transpose(rotation, (0, 2, 1)))
        tolerance, magnet = parameters.tolerance, parameters.magnet

        above = np.zeros((n, 3))
        above[:, :2] = truncated_normal(rng, tolerance.lateral, (n, 2))
        above[:, 2] = magnet.gap + truncated_normal(rng, tolerance.gap, (n,))
        moment = small_rotation(rng, tolerance.magnet_tilt, n) @ np.array([0, 0, magnet.moment])
        moment *= 1.0 + truncated_normal(rng, tolerance.moment, (n, 1))
        stiffness = 1.0 + truncated_normal(rng, tolerance.stiffness, (n,))

        self.spreader = Spreader(position, parameters.elastomer)
        self.elastomer = Elastomer(
            parameters.elastomer, stiffness, above[:, 2] - magnet.minimum_gap
        )
        self.magnets = MagnetArray(
            position,
            position + _turn(rotation, above),
            _turn(rotation, moment),
            magnet.neighbour_radius,
        )
        self.yaw = _yaw_matrices(yaw)
        self.chips = Magnetometers(rotation @ self.yaw, parameters.chip, tolerance, rng)
        self._last: tuple[Instant, FloatArray] | None = None
        self._true_force = np.zeros((n, 3))

    @property
    def true_force(self) -> FloatArray:
        """Force (N, 3) N in taxel axes on each taxel at the last sample."""
        return self._true_force

    def taxel_force(self, contacts: Sequence[Contact]) -> FloatArray:
        """Force (N, 3) N in taxel axes that ``contacts`` put on each taxel."""
        return _turn(self._to_taxel, self.spreader.force(contacts))

    def sample(
        self, now: Instant, contacts: Sequence[Contact], surroundings: Surroundings
    ) -> Reading:
        """Reading of every chip for a conversion that ends at ``now`` with these contacts.

        Force and field are assumed to change linearly between samples. ValueError if time goes
        back.
        """
        last = self._last
        elapsed = 0.0 if last is None else seconds_between(last[0], now)
        force = self.taxel_force(contacts)
        displacement = self.elastomer.load(force, elapsed)
        seen = self.field_ut(displacement, surroundings)
        self._last = now, seen
        self._true_force = force
        if last is not None and elapsed > 0:
            seen = self.chips.skew(seen, last[1], elapsed)
        return self.chips.convert(seen, surroundings.temperature_c, self._rng)

    def field_ut(self, displacement: FloatArray, surroundings: Surroundings) -> FloatArray:
        """Noiseless field (N, 3) µT in chip axes, magnets moved by ``displacement`` (N, 3) m."""
        warmer = surroundings.temperature_c - self.parameters.chip.reference_c
        strength = 1.0 + self.parameters.magnet.drift_per_k * warmer
        field = self.magnets.field_ut(_turn(self.rotation, displacement), strength)
        field += surroundings.field_ut(self._position)
        return self.chips.sense(field, surroundings.temperature_c)

    def settled_field_ut(self, force: FloatArray, temperature_c: float) -> FloatArray:
        """Noiseless field (N, 3) µT some time under ``force`` (N, 3) N, without ambient field.

        Both in taxel axes: a host gets there by undoing the designed yaw of each chip. See
        `Elastomer.settled`. Changes no state.
        """
        displacement = self.elastomer.settled(force)
        in_chip = self.field_ut(displacement, Surroundings(temperature_c=temperature_c))
        return _turn(self.yaw, in_chip)

    def reset(self) -> None:
        """Recover the rubber and forget earlier samples; the tolerances stay."""
        self.elastomer.reset()
        self._last = None
        self._true_force = np.zeros_like(self._true_force)


CALIBRATION_NORMAL_N = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0)
"""Normal loads with which each taxel is calibrated, N."""

CALIBRATION_SHEAR = (0.0, 0.3, -0.3)
"""Shear over normal load in each direction, one at a time: below usual friction."""

_DRIFT_STEP_K = 5.0
"""Temperature steps from the reference, K, at which the drift of the rest field is measured."""


def nominal_calibration(
    model: SkinModel, serial: str, created: str = "1970-01-01T00:00:00Z"
) -> BoardCalibration:
    """Calibration that a rig finds for exactly this skin, tolerances included.

    Each taxel in turn is pressed with 0.5–5 N and sheared. The matrix of an array is the least
    squares fit of force over field, each load weighted by one over its size, so that the relative
    error from the dipole's curvature is spread evenly. ``created``: ISO 8601. The result has
    ``nominal`` False.
    """
    reference = model.parameters.chip.reference_c
    n = model.geometry.taxels
    rest = model.settled_field_ut(np.zeros((n, 3)), reference)
    warm = model.settled_field_ut(np.zeros((n, 3)), reference + _DRIFT_STEP_K)
    cold = model.settled_field_ut(np.zeros((n, 3)), reference - _DRIFT_STEP_K)
    drift = (warm - cold) / (2 * _DRIFT_STEP_K)
    loads, field = _presses(model, reference)
    arrays = []
    for array, taxels in zip(model.geometry.arrays, model.geometry.slices, strict=True):
        arrays.append(
            ArrayCalibration(
                geometry=array,
                rest_ut=rest[taxels],
                drift_ut_per_k=drift[taxels],
                reference_c=reference,
                newton_per_ut=_fit(model, taxels, loads, field),
            )
        )
    return BoardCalibration(
        serial_number=serial,
        model=model.geometry.model,
        frame=model.geometry.frame,
        created=created,
        provenance="simulated calibration rig: each taxel 0.5-5 N normal, 30 % shear",
        nominal=False,
        arrays=tuple(arrays),
    )


def _presses(model: SkinModel, temperature_c: float) -> tuple[FloatArray, FloatArray]:
    """Loads (L, 3) N of the calibration, and the field that each pair of chip and magnet gives.

    The field (L, P, 3) µT is the change in taxel axes when the magnet's own taxel bears the load
    alone: everything else that a chip sees stays as it is at rest.
    """
    sheared = [(s, 0.0) for s in CALIBRATION_SHEAR] + [(0.0, s) for s in CALIBRATION_SHEAR[1:]]
    loads = np.array(
        [[x * n, y * n, -n] for n in CALIBRATION_NORMAL_N for x, y in sheared], dtype=float
    )
    n = model.geometry.taxels
    displacement = model.elastomer.settled(np.repeat(loads[:, None], n, axis=1))
    moved = np.einsum("nij,lnj->lni", model.rotation, displacement)
    change = model.magnets.shares_ut(moved) - model.magnets.shares_ut(np.zeros((n, 3)))
    seen = model.yaw @ model.chips.response(temperature_c)
    chip, _ = model.magnets.pairs
    field: FloatArray = np.einsum("pij,lpj->lpi", seen[chip], change)
    return loads, field


def _fit(model: SkinModel, taxels: slice, loads: FloatArray, field: FloatArray) -> FloatArray:
    """Matrix (3n, 3n) N/µT of one array, from the results of `_presses`."""
    weight = 1.0 / np.linalg.norm(loads, axis=1)
    n = taxels.stop - taxels.start
    forces = np.zeros((n, len(loads), n, 3))
    forces[np.arange(n), :, np.arange(n)] = loads * weight[:, None]
    fields = np.zeros((n, len(loads), n, 3))
    chip, magnet = (index - taxels.start for index in model.magnets.pairs)
    own = (chip >= 0) & (chip < n) & (magnet >= 0) & (magnet < n)
    fields[magnet[own], :, chip[own]] = np.moveaxis(field[:, own], 1, 0) * weight[:, None]
    rows = n * len(loads)
    # QR takes half as many operations as singular values, and the presses ensure full rank.
    q, r = np.linalg.qr(fields.reshape(rows, 3 * n))
    matrix = np.linalg.solve(r, q.T @ forces.reshape(rows, 3 * n))
    return np.ascontiguousarray(matrix.T)


def _turn(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Each (n, 3, 3) matrix times its (n, 3) vector."""
    turned: FloatArray = np.einsum("nij,nj->ni", matrices, vectors)
    return turned


def _yaw_matrices(yaw: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) about z, chip axes to taxel axes."""
    matrices = np.zeros((len(yaw), 3, 3))
    matrices[:, 0, 0] = matrices[:, 1, 1] = np.cos(yaw)
    matrices[:, 1, 0] = np.sin(yaw)
    matrices[:, 0, 1] = -matrices[:, 1, 0]
    matrices[:, 2, 2] = 1.0
    return matrices
