"""Chip readings to fields and fields to forces, by the calibration, for all arrays at once.

Shapes as in `Layout`: vectors (A, 3, n). A plane is ``theta`` (A, 3, 3), [a, component in ``ee``,
coefficient over `Layout.design`], in µT.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bus.calibration_types import BoardCalibration
from tactiled.sensing.layout import Layout

Float = NDArray[np.float64]

MAX_OWN_CONDITION = 1e4
"""A taxel whose own 3 × 3 block is worse conditioned does not feel three components of force; its
array is then compensated without undoing crosstalk."""

MAGNET_DRIFT_PER_K = -0.0012
"""Reversible loss of remanence of sintered NdFeB, −0.12 %/K (makers' datasheets)."""


class ForceModel:
    """The calibration of a board as batched matrices.

    Force is linear in the field, so what a plane adds to every force is a fixed matrix times the
    plane's nine coefficients. ``press_direction``: (A, 3, n), unit vectors in ``ee`` along which
    a press changes a taxel's field.
    """

    def __init__(self, calibration: BoardCalibration, layout: Layout) -> None:
        arrays, n = layout.arrays, layout.width
        self.layout = layout
        self._cos = np.ones((arrays, n))
        self._sin = np.zeros((arrays, n))
        self.rest = np.zeros((arrays, 3, n))
        self._drift = np.zeros((arrays, 3, n))
        self._reference = np.zeros((arrays, n))
        self._nominal = calibration.nominal
        blocks = np.zeros((arrays, 3, n, 3, n))
        for a, array in enumerate(calibration.arrays):
            m = array.geometry.taxels
            blocks[a, :, :m, :, :m] = array.newton_per_ut.reshape(m, 3, m, 3).transpose(1, 0, 3, 2)
            self._cos[a, :m] = np.cos(array.geometry.chip_yaw)
            self._sin[a, :m] = np.sin(array.geometry.chip_yaw)
            self.rest[a, :, :m] = array.rest_ut.T
            self._drift[a, :, :m] = array.drift_ut_per_k.T
            self._reference[a] = array.reference_c
        self._rested_at = self._reference.copy()
        self._turned = bool(self._sin.any() or (self._cos != 1).any())
        self._drifts = bool(self._drift.any())
        self._matrix = blocks.reshape(arrays, 3 * n, 3 * n)
        self._derive(blocks)

    def _derive(self, blocks: Float) -> None:
        """Precompute what depends on geometry and matrix alone."""
        layout = self.layout
        arrays, n = layout.arrays, layout.width
        own = np.einsum("acidi->aicd", blocks)
        self._undo = layout.rotation.copy()
        self._decouples = np.zeros(arrays, dtype=bool)
        for a in range(arrays):
            mine = own[a][layout.real[a]]
            coupled = np.abs(blocks[a]).sum() > np.abs(mine).sum() * (1 + 1e-12)
            if coupled and (np.linalg.cond(mine) < MAX_OWN_CONDITION).all():
                self._decouples[a] = True
                turn = layout.rotation[a].transpose(2, 0, 1)[layout.real[a]]
                self._undo[a][:, :, layout.real[a]] = (turn @ np.linalg.inv(mine)).transpose(
                    1, 2, 0
                )
        self.decouples = bool(self._decouples.any())
        self.press_direction = np.zeros((arrays, 3, n))
        for a in range(arrays):
            for i in np.flatnonzero(layout.real[a]).tolist():
                block = own[a, i]
                along = np.array([0.0, 0.0, 1.0])
                if abs(np.linalg.det(block)) > 0 and np.linalg.cond(block) < MAX_OWN_CONDITION:
                    along = np.linalg.solve(block, [0.0, 0.0, -1.0])
                along = layout.rotation[a, :, :, i] @ along
                self.press_direction[a, :, i] = along / np.linalg.norm(along)
        in_ee = np.einsum("akn,cd->acndk", layout.design, np.eye(3)).reshape(arrays, 3, n, 9)
        in_taxel = np.einsum("adcn,adnp->acnp", layout.rotation, in_ee)
        self._plane_force = self._matrix @ in_taxel.reshape(arrays, 3 * n, 9)
        undone = np.einsum(
            "acdn,adnp->acnp", self._undo, self._plane_force.reshape(arrays, 3, n, 9)
        )
        leak = undone - in_ee
        leak[~self._decouples] = 0
        self._plane_leak = leak.reshape(arrays, 3 * n, 9)

    def rested_at(self, temperature_c: Float) -> None:
        """The rest field was taken at ``temperature_c`` (A, n) °C.

        Of a board nobody has measured the makers' drift of its magnets is taken off from there on.
        """
        self._rested_at = temperature_c.copy()
        if self._nominal:
            self._reference = temperature_c.copy()
            self._drift = MAGNET_DRIFT_PER_K * self.rest
            self._drifts = bool(self._drift.any())

    @property
    def rested_c(self) -> Float:
        """(A, n) °C at which the rest field in force was taken."""
        return self._rested_at

    def warmer(self, temperature_c: Float) -> Float:
        """(A, n) K since the rest field was taken."""
        return np.asarray(temperature_c - self._rested_at)

    def taxel_field(self, raw: Float, temperature_c: Float) -> Float:
        """µT in taxel axes, rest and drift taken off; ``raw`` µT in chip axes, ``temperature_c``
        (A, n).
        """
        if self._turned:
            x, y = raw[:, 0], raw[:, 1]
            field = raw.copy()
            field[:, 0] = self._cos * x - self._sin * y
            field[:, 1] = self._sin * x + self._cos * y
            field -= self.rest
        else:
            field = raw - self.rest
        if self._drifts:
            field -= self._drift * (temperature_c - self._reference)[:, None, :]
        return field

    def chip_rest(self) -> Float:
        """(A, 3, n) µT in chip axes that the untouched chips read."""
        out = self.rest.copy()
        out[:, 0] = self._cos * self.rest[:, 0] + self._sin * self.rest[:, 1]
        out[:, 1] = self._cos * self.rest[:, 1] - self._sin * self.rest[:, 0]
        return out

    def forces(self, field: Float) -> Float:
        """N in taxel axes that ``field`` in taxel axes stands for, ambient and all."""
        forces: Float = (self._matrix @ field.reshape(len(field), -1, 1)).reshape(field.shape)
        return forces

    def field_in_ee(self, field: Float) -> Float:
        """µT in ``ee`` axes, where a uniform ambient field is the same at every taxel."""
        return np.asarray((self.layout.rotation * field[:, None]).sum(axis=2))

    def decoupled_in_ee(self, field_ee: Float, forces: Float) -> Float:
        """µT in ``ee`` axes without what neighbours' contacts add, from all of the `forces`.

        A uniform field comes out changed too; `plane_leak` says by how much.
        """
        undone: Float = (self._undo * forces[:, None]).sum(axis=2)
        if not self._decouples.all():
            undone[~self._decouples] = field_ee[~self._decouples]
        return undone

    def plane_leak(self, theta: Float) -> Float:
        """µT in ``ee`` axes by which `decoupled_in_ee` changes the plane ``theta``."""
        return self._of_plane(self._plane_leak, theta)

    def plane_forces(self, theta: Float) -> Float:
        """N in taxel axes that the plane ``theta`` adds to `forces`."""
        return self._of_plane(self._plane_force, theta)

    def plane_field(self, theta: Float) -> Float:
        """µT of the plane ``theta`` in taxel axes."""
        in_ee = theta @ self.layout.design
        field: Float = (self.layout.rotation * in_ee[:, :, None]).sum(axis=1)
        return field

    def normal_slopes(self) -> Float:
        """(A, n, 3, 3) N/µT, what the normal forces lose to a plane: [a, taxel, component in
        ``ee``, coefficient over `Layout.design`].
        """
        arrays, n = self.layout.arrays, self.layout.width
        rows = self._plane_force.reshape(arrays, 3, n, 3, 3)[:, 2]
        return np.ascontiguousarray(rows)

    def normal_sigma(self, noise_ut: Float) -> Float:
        """(A, n) N rms of the normal force, from independent noise ``noise_ut`` (3,) µT rms."""
        arrays, n = self.layout.arrays, self.layout.width
        rows = self._matrix.reshape(arrays, 3, n, 3, n)[:, 2]
        sigma: Float = np.sqrt(np.einsum("aicj,c->ai", rows**2, noise_ut**2))
        return sigma

    def _of_plane(self, matrix: Float, theta: Float) -> Float:
        vectors: Float = (matrix @ theta.reshape(-1, 9, 1)).reshape(
            self.layout.arrays, 3, self.layout.width
        )
        return vectors
