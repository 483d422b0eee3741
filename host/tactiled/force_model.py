"""Chip readings to fields and fields to forces, by the calibration, for all arrays at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.calibration_types import BoardCalibration
from tactiled.layout import Layout

Float = NDArray[np.float64]

MAX_OWN_CONDITION = 1e4
"""A taxel whose own 3 × 3 block is worse conditioned feels no three components of force; its
array is then compensated without undoing crosstalk."""


class ForceModel:
    """The calibration of a board as batched matrices; A arrays padded to n taxels.

    Field of taxels → forces is linear, so the part of the ambient plane in every force is a fixed
    matrix times the plane's coefficients (``theta``: (A, 3, 3), [a, coefficient, component in ee],
    over `Layout.design`).
    """

    def __init__(self, calibration: BoardCalibration, layout: Layout) -> None:
        shape = (layout.arrays, layout.width)
        self.layout = layout
        self._matrix = np.zeros((shape[0], 3 * shape[1], 3 * shape[1]))
        self._cos = np.ones(shape)
        self._sin = np.zeros(shape)
        self.rest = np.zeros((*shape, 3))
        self._drift = np.zeros((*shape, 3))
        self._reference = np.zeros((shape[0], 1))
        self._own_to_ee = np.zeros((*shape, 3, 3))
        for a, array in enumerate(calibration.arrays):
            n = array.geometry.taxels
            self._matrix[a, : 3 * n, : 3 * n] = array.newton_per_ut
            self._cos[a, :n] = np.cos(array.geometry.chip_yaw)
            self._sin[a, :n] = np.sin(array.geometry.chip_yaw)
            self.rest[a, :n] = array.rest_ut
            self._drift[a, :n] = array.drift_ut_per_k
            self._reference[a] = array.reference_c
        self._turned = bool(self._sin.any() or (self._cos != 1).any())
        self._drifts = bool(self._drift.any())
        self._derive()

    def _derive(self) -> None:
        """Precompute what depends on geometry and matrix alone."""
        layout = self.layout
        a_, n = layout.arrays, layout.width
        blocks = self._matrix.reshape(a_, n, 3, n, 3)
        own = np.einsum("aicid->aicd", blocks)
        self.own = own.copy()
        self.coupled = bool((np.abs(blocks).sum() - np.abs(own).sum()) > 0)
        self._own_to_ee = layout.rotation.copy()
        self._decouples = np.zeros(a_, dtype=bool)
        for a in range(a_):
            real = layout.real[a]
            sound = np.linalg.cond(own[a][real]) < MAX_OWN_CONDITION
            if sound.all():
                self._decouples[a] = True
                inverse = np.linalg.inv(own[a][real])
                self._own_to_ee[a][real] = layout.rotation[a][real] @ inverse
        # columns: coefficient-major, component-minor, as theta.reshape(9)
        plane_ee = np.einsum("ank,cd->anckd", layout.design, np.eye(3))
        plane_ee = plane_ee.reshape(a_, n, 3, 9)
        plane_taxel = np.einsum("anji,anjp->anip", layout.rotation, plane_ee)
        self._plane_force = self._matrix @ plane_taxel.reshape(a_, 3 * n, 9)
        leak = self._own_to_ee @ self._plane_force.reshape(a_, n, 3, 9) - plane_ee
        leak[~self._decouples] = 0
        self._plane_leak = leak.reshape(a_, 3 * n, 9)

    def taxel_field(self, raw: Float, temperature_c: Float) -> Float:
        """(A, n, 3) µT in taxel axes, rest and drift taken off; ``raw`` in chip axes,
        ``temperature_c`` (A, n)."""
        if self._turned:
            x, y = raw[..., 0], raw[..., 1]
            field = raw.copy()
            field[..., 0] = self._cos * x - self._sin * y
            field[..., 1] = self._sin * x + self._cos * y
            field -= self.rest
        else:
            field = raw - self.rest
        if self._drifts:
            field -= self._drift * (temperature_c - self._reference)[..., None]
        return field

    def forces(self, field: Float) -> Float:
        """(A, n, 3) N in taxel axes that ``field`` stands for, ambient and all."""
        flat = field.reshape(field.shape[0], -1, 1)
        forces: Float = (self._matrix @ flat).reshape(field.shape)
        return forces

    def field_in_ee(self, field: Float) -> Float:
        """(A, n, 3) µT in ``ee`` axes, where a uniform ambient field is the same at every taxel."""
        turned: Float = (self.layout.rotation @ field[..., None])[..., 0]
        return turned

    def decoupled_in_ee(self, field_ee: Float, forces: Float) -> Float:
        """(A, n, 3) µT in ``ee`` axes without what neighbours' contacts add, from `forces`.

        A uniform field comes out changed too; `plane_leak` says by how much.
        """
        undone: Float = (self._own_to_ee @ forces[..., None])[..., 0]
        undone[~self._decouples] = field_ee[~self._decouples]
        return undone

    def plane_leak(self, theta: Float) -> Float:
        """(A, n, 3) µT by which `decoupled_in_ee` changes the plane ``theta``."""
        leak: Float = (self._plane_leak @ theta.reshape(-1, 9, 1)).reshape(
            self.layout.arrays, self.layout.width, 3
        )
        return leak

    def plane_forces(self, theta: Float) -> Float:
        """(A, n, 3) N in taxel axes that the plane ``theta`` adds to `forces`."""
        forces: Float = (self._plane_force @ theta.reshape(-1, 9, 1)).reshape(
            self.layout.arrays, self.layout.width, 3
        )
        return forces

    def plane_field(self, theta: Float) -> Float:
        """(A, n, 3) µT of the plane ``theta`` in taxel axes."""
        in_ee = self.layout.design @ theta
        field: Float = (in_ee[..., None, :] @ self.layout.rotation)[..., 0, :]
        return field

    def normal_sigma(self, noise_ut: Float) -> Float:
        """(A, n) N rms of the normal force, from independent noise ``noise_ut`` (A, n, 3) µT."""
        rows = self._matrix.reshape(self.layout.arrays, self.layout.width, 3, -1)[:, :, 2, :]
        variance = rows**2 @ (noise_ut.reshape(self.layout.arrays, -1, 1) ** 2)
        return np.sqrt(variance[..., 0])
