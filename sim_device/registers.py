"""What a host can set on a board: sample rate, and gain and filter of each array."""

from __future__ import annotations

import numpy as np

from sensor_proto.packets import AckResult, ArrayDescriptor, ChipType, SetGain
from sim_device.parameters import ChipSetting
from sim_device.skin import SkinModel
from tactile_bus.geometry import ArrayGeometry

ALL_ARRAYS = 255

MIN_RATE_MHZ = 100
"""mHz; slower than a sample in ten seconds is no stream."""


class Registers:
    """Present settings of the chips behind ``skin``; `restore` brings back those of a boot."""

    def __init__(self, skin: SkinModel, rate: float) -> None:
        """``rate``: Hz after a boot; ValueError when the chips do not manage it."""
        self._skin = skin
        top = _max_rate_mhz([skin.parameters.chip.setting])
        if not MIN_RATE_MHZ <= rate * 1000 <= top:
            raise ValueError(f"rate {rate:g} Hz: {MIN_RATE_MHZ / 1000} to {top / 1000:.0f} Hz")
        self._boot_rate_mhz = round(rate * 1000)
        self.restore()

    def restore(self) -> None:
        """Settings as after a boot."""
        skin = self._skin
        self.rate_mhz = self._boot_rate_mhz
        self._settings = [skin.parameters.chip.setting] * len(skin.geometry.arrays)
        skin.chips.configure(slice(None), skin.parameters.chip.setting)

    @property
    def max_rate_mhz(self) -> int:
        """mHz that the slowest array manages."""
        return _max_rate_mhz(self._settings)

    @property
    def conversion_time(self) -> float:
        """s of one conversion of the slowest array."""
        return max(s.conversion_time for s in self._settings)

    def set_rate(self, rate_mhz: int) -> AckResult:
        """Refused outside `MIN_RATE_MHZ` to `max_rate_mhz`."""
        if not MIN_RATE_MHZ <= rate_mhz <= self.max_rate_mhz:
            return AckResult.BAD_ARGUMENT
        self.rate_mhz = rate_mhz
        return AckResult.OK

    def set_gain(self, command: SetGain) -> AckResult:
        """Refused for codes that the chip lacks and for filters too slow for the present rate."""
        slices = self._skin.geometry.slices
        if command.array == ALL_ARRAYS:
            chosen = range(len(slices))
        elif command.array < len(slices):
            chosen = range(command.array, command.array + 1)
        else:
            return AckResult.BAD_ARGUMENT
        try:
            setting = ChipSetting(
                command.gain, command.resolution, command.oversampling, command.filter
            )
        except ValueError:
            return AckResult.BAD_ARGUMENT
        settings = [setting if i in chosen else s for i, s in enumerate(self._settings)]
        if self.rate_mhz > _max_rate_mhz(settings):
            return AckResult.BAD_ARGUMENT
        self._settings = settings
        for i in chosen:
            self._skin.chips.configure(slices[i], setting)
        return AckResult.OK

    def arrays(self) -> tuple[ArrayDescriptor, ...]:
        """Arrays as the descriptor lists them, with their present scales."""
        arrays = self._skin.geometry.arrays
        return tuple(
            _describe(number, array, setting)
            for number, (array, setting) in enumerate(zip(arrays, self._settings, strict=True))
        )


def _max_rate_mhz(settings: list[ChipSetting]) -> int:
    return int(min(s.max_rate for s in settings) * 1000)


def _describe(number: int, array: ArrayGeometry, setting: ChipSetting) -> ArrayDescriptor:
    x_ut, _, z_ut = setting.lsb_ut
    return ArrayDescriptor(
        number,
        array.name,
        ChipType.MLX90393,
        array.rows,
        array.columns,
        _pitch_um(array),
        round(x_ut * 1000),
        round(z_ut * 1000),
    )


def _pitch_um(array: ArrayGeometry) -> int:
    """Smallest distance of two taxels on the unrolled skin, µm; 1 for a single taxel."""
    if array.taxels == 1:
        return 1
    difference = array.surface[:, None] - array.surface[None]
    distance = np.linalg.norm(difference, axis=2)
    return round(1e6 * float(distance[np.triu_indices(array.taxels, 1)].min()))
