"""Magnetometers of a skin: from the field at each chip to the counts it sends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensor_proto.packets import TaxelStatus
from sim_device.skin.parameters import ChipParameters, ChipSetting, ToleranceParameters
from tactile_core.arrays import FloatArray

COUNT_MAX = 32767
THERMOMETER_RAW_25 = 46244
THERMOMETER_LSB_PER_K = 45.2
"""Thermometer of the MLX90393: T = 25 °C + (raw - 46244) / 45.2 (datasheet)."""


def temperature_of_raw(raw: FloatArray) -> FloatArray:
    """Temperature, °C, of the 16-bit thermometer value ``raw``."""
    return 25.0 + (raw - THERMOMETER_RAW_25) / THERMOMETER_LSB_PER_K


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One conversion of every chip.

    ``counts`` (N, 3) int16 in chip axes, ``status`` (N,) uint8 of `TaxelStatus`,
    ``temperature_c`` (N,) °C as the chips measure it. ``infinite`` (N,) bool: chips for which the
    firmware sends infinities and NaN, possible only on boards that send floats; None: no such chip.
    """

    counts: NDArray[np.int16]
    status: NDArray[np.uint8]
    temperature_c: FloatArray
    infinite: NDArray[np.bool_] | None = None


def truncated_normal(rng: np.random.Generator, sigma: float, shape: tuple[int, ...]) -> FloatArray:
    """Normal draws cut off at two sigma: parts beyond fail inspection."""
    return np.clip(rng.standard_normal(shape), -2.0, 2.0) * sigma


def small_rotation(rng: np.random.Generator, sigma: float, n: int) -> FloatArray:
    """Rotations (n, 3, 3) by small angles about each axis, ``sigma`` rad."""
    x, y, z = truncated_normal(rng, sigma, (n, 3)).T
    cx, cy, cz, sx, sy, sz = np.cos(x), np.cos(y), np.cos(z), np.sin(x), np.sin(y), np.sin(z)
    rows = [
        [cy * cz, -cy * sz, sy],
        [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
        [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


class Magnetometers:
    """N chips. ``rotation`` (N, 3, 3): chip axes to ``ee`` as designed; tolerances are drawn."""

    def __init__(
        self,
        rotation: FloatArray,
        parameters: ChipParameters,
        tolerance: ToleranceParameters,
        rng: np.random.Generator,
    ) -> None:
        n = len(rotation)
        p = self.parameters = parameters
        tilted = rotation @ small_rotation(rng, tolerance.chip_tilt, n)
        response = np.eye(3) + rng.uniform(-p.cross_axis, p.cross_axis, (n, 3, 3)) * (
            1.0 - np.eye(3)
        )
        trim = 1.0 + truncated_normal(rng, tolerance.sensitivity, (n, 3))
        # From the field in ee to the chip's output: rotated, trimmed, with cross-axis parts.
        self._view = (response * trim[:, None, :]) @ np.transpose(tilted, (0, 2, 1))
        bound = np.array(
            [p.offset_drift_xy_ut_per_k, p.offset_drift_xy_ut_per_k, p.offset_drift_z_ut_per_k]
        )
        self._offset_drift = rng.uniform(-1.0, 1.0, (n, 3)) * bound
        self._sensitivity_drift = rng.uniform(-1.0, 1.0, (n, 1)) * p.sensitivity_drift_per_k
        self._oscillator = 1.0 + rng.uniform(-p.oscillator_trim, p.oscillator_trim, n)
        self._thermometer = rng.standard_normal(n) * p.thermometer_error_k
        self._lsb = np.empty((n, 3))
        self._noise = np.empty((n, 3))
        self._lag = np.empty((n, 3))
        self.configure(slice(None), p.setting)

    @property
    def lsb_ut(self) -> FloatArray:
        """µT per count (N, 3), read-only."""
        view: FloatArray = self._lsb.view()
        view.flags.writeable = False
        return view

    def configure(self, chips: slice, setting: ChipSetting) -> None:
        """Set the registers of ``chips``; scale, noise and conversion time follow."""
        p = self.parameters
        self._lsb[chips] = setting.lsb_ut
        # White noise averages down with the number of conversions in a value.
        quieter = math.sqrt(p.setting.averaging / setting.averaging)
        self._noise[chips] = np.array([p.noise_xy_ut, p.noise_xy_ut, p.noise_z_ut]) * quieter
        # The chip converts X, Y, Z one after another: when Z ends, X is two conversions old.
        self._lag[chips] = self._oscillator[chips, None] * setting.axis_time * [2.0, 1.0, 0.0]

    def response(self, temperature_c: float) -> FloatArray:
        """Matrices (N, 3, 3): from the field in ``ee`` to each chip's output, without offsets."""
        warmer = temperature_c - self.parameters.reference_c
        matrices: FloatArray = self._view * (1.0 + self._sensitivity_drift * warmer)[:, :, None]
        return matrices

    def sense(self, field_ut: FloatArray, temperature_c: float) -> FloatArray:
        """Noiseless, unrounded field (N, 3) µT in chip axes of ``field_ut`` (N, 3) in ``ee``."""
        warmer = temperature_c - self.parameters.reference_c
        seen: FloatArray = np.einsum("nij,nj->ni", self._view, field_ut)
        seen *= 1.0 + self._sensitivity_drift * warmer
        seen += self._offset_drift * warmer
        return seen

    def skew(self, now: FloatArray, before: FloatArray, elapsed: float) -> FloatArray:
        """Field (N, 3) µT that each axis saw when it was converted.

        ``now``: field at the end of the conversion of z; ``before``: field ``elapsed`` s earlier.
        """
        seen: FloatArray = now + (before - now) * np.minimum(self._lag / elapsed, 1.0)
        return seen

    def convert(
        self, field_ut: FloatArray, temperature_c: float, rng: np.random.Generator
    ) -> Reading:
        """Add noise, saturate, round to counts and wrap to 16 bits as the chip does.

        A wrap is silent, as in the chip; saturated Hall plates and a count at either end of
        int16 are flagged.
        """
        noisy = field_ut + self._noise * rng.standard_normal(field_ut.shape)
        limit = self.parameters.saturation_ut
        beyond = np.abs(noisy) >= limit
        np.clip(noisy, -limit, limit, out=noisy)
        noisy /= self._lsb
        counts = np.rint(noisy).astype(np.int64).astype(np.int16)
        beyond |= (counts == COUNT_MAX) | (counts == -COUNT_MAX - 1)
        status = np.zeros(len(counts), np.uint8)
        status[beyond.any(axis=1)] = TaxelStatus.SATURATED
        raw = np.rint((temperature_c - 25.0 + self._thermometer) * THERMOMETER_LSB_PER_K)
        return Reading(counts, status, temperature_of_raw(raw + THERMOMETER_RAW_25))
