"""Parameters of the simulated skin, each with its source.

"table" means the table of magnetometer facts that the project works from: the MLX90393 datasheet
and measurements on real AnySkin and eFlesh boards.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

_LSB_XY_UT = (0.751, 0.601, 0.451, 0.376, 0.300, 0.250, 0.200, 0.150)
_LSB_Z_UT = (1.210, 0.968, 0.726, 0.605, 0.484, 0.403, 0.323, 0.242)
"""µT per LSB at RES 0 and HALLCONF 0xC for GAIN_SEL 0 to 7 (MLX90393 datasheet, table 17)."""

_AXIS_UNIT_S = 0.064e-3
"""Unit of an axis conversion in the datasheet, s: it takes (2 + 2^DIG_FILT) · 2^OSR of these."""

_CYCLE_OVERHEAD_S = 0.688e-3
"""Part of a T+X+Y+Z cycle that no axis uses, s: 1.84 ms at OSR 0, DIG_FILT 2 less 3 × 0.384 ms."""

_OSCILLATOR_MARGIN = 1.10
"""Slowest oscillator, ±5 % trim and ±5 % thermal: why 1.84 ms allow 493 Hz and not 543."""


@dataclass(frozen=True, slots=True)
class ChipSetting:
    """Registers of an MLX90393. ValueError for codes that the chip does not have.

    Gain 4 is the finest at which 10 mT of rest field and a press of 20 N stay below the wrap of
    z (15.9 mT).
    """

    gain: int = 4
    resolution: int = 0
    oversampling: int = 0
    filter: int = 3

    def __post_init__(self) -> None:
        """Check that codes are in range; ValueError."""
        for name, value, top in (
            ("gain", self.gain, 7),
            ("resolution", self.resolution, 3),
            ("oversampling", self.oversampling, 3),
            ("filter", self.filter, 7),
        ):
            if not 0 <= value <= top:
                raise ValueError(f"{name} {value}: 0 to {top}")

    @property
    def lsb_ut(self) -> tuple[float, float, float]:
        """µT per LSB of x, y, z."""
        scale = 2.0**self.resolution
        xy = _LSB_XY_UT[self.gain] * scale
        return xy, xy, _LSB_Z_UT[self.gain] * scale

    @property
    def averaging(self) -> int:
        """Elementary conversions in one value: (2 + 2^DIG_FILT) · 2^OSR."""
        return (2 + (1 << self.filter)) << self.oversampling

    @property
    def axis_time(self) -> float:
        """Conversion time of one axis, s."""
        return self.averaging * _AXIS_UNIT_S

    @property
    def conversion_time(self) -> float:
        """Time of one T+X+Y+Z cycle, s: 1.84, 2.61, 4.15 ms at DIG_FILT 2, 3, 4 (table)."""
        return _CYCLE_OVERHEAD_S + 3 * self.axis_time

    @property
    def max_rate(self) -> float:
        """Cycles per second that even the slowest oscillator reaches: 493 Hz at DIG_FILT 2."""
        return 1 / (self.conversion_time * _OSCILLATOR_MARGIN)


@dataclass(frozen=True, slots=True)
class MagnetParameters:
    """One point dipole per taxel, above its chip, with its moment along the outward normal."""

    moment: float = 3.25e-3
    """Dipole moment, A·m²: disc of 2 × 1 mm, Br 1.3 T (table)."""
    gap: float = 4e-3
    """Distance from chip to magnet at rest, m: 10.2 mT, as the eFlesh recordings show (table)."""
    minimum_gap: float = 1.5e-3
    """Smallest distance, m; the elastomer is crushed and yields no further."""
    neighbour_radius: float = 25e-3
    """Radius in m beyond which a magnet changes a chip's field by less than 0.1 %."""
    drift_per_k: float = -0.0012
    """Reversible loss of remanence of sintered NdFeB, -0.12 %/K (makers' datasheets)."""


@dataclass(frozen=True, slots=True)
class ElastomerParameters:
    """How a force on the skin moves the magnets.

    The stiffnesses give 152 µT/N in both directions at 10.2 mT (real: 115 µT/N on eFlesh), and
    keep the displacement at 5 N to 0.1 mm, so that the dipole law stays within a few per cent of
    a straight line.
    """

    normal_stiffness: float = 50e3
    """Stiffness per taxel, N/m. 1 MPa rubber, 16 mm square and 3–5 mm thick, has 50–85 kN/m."""
    shear_stiffness: float = 25e3
    """Stiffness per taxel, N/m."""
    spread: float = 5e-3
    """Standard deviation of the pressure under a point force, m: about the thickness."""
    full_reach: float = 12e-3
    """Distance from the nearest taxel, m, up to which the skin bears all of a contact: covers half
    a grid cell."""
    no_reach: float = 20e-3
    """Distance from the nearest taxel, m, from which the rigid body bears it all; linear between
    the two."""
    creep: float = 0.04
    """Slow part of the displacement over the prompt one: 89–178 µT in 3.9 mT are 2–5 % (table)."""
    creep_time: float = 8.0
    """Time constant of creep, s (not published; the recordings' rest settles in about 10 s)."""
    hysteresis_normal: float = 0.03
    """Width of the press-release loop over its peak; 1–6 % (table)."""
    hysteresis_shear: float = 0.08
    """Width of the loop for shear; up to 16 % (table)."""
    hysteresis_knee: float = 0.25
    """Half-width of the play over the peak: the loop is at full width after twice this."""
    hysteresis_time: float = 5.0
    """Time constant with which the rubber forgets its peak load, s."""

    def __post_init__(self) -> None:
        """Check that the rubber yields and the play is narrower than its peak; ValueError."""
        if not (self.normal_stiffness > 0 and self.shear_stiffness > 0 and self.spread > 0):
            raise ValueError("stiffnesses and spread must be above 0")
        if not 0 < self.hysteresis_knee < 0.5:
            raise ValueError(f"hysteresis_knee {self.hysteresis_knee}: above 0, below 0.5")
        if not 0 <= self.full_reach < self.no_reach:
            raise ValueError("full_reach must be less than no_reach")


@dataclass(frozen=True, slots=True)
class ChipParameters:
    """Errors of the magnetometers."""

    setting: ChipSetting = field(default_factory=ChipSetting)
    noise_xy_ut: float = 3.7
    """Standard deviation per sample of x and y, µT, at the default filter; 3–4.4 (table)."""
    noise_z_ut: float = 5.8
    """Standard deviation per sample of z, µT; 5–6.7 (table)."""
    offset_drift_xy_ut_per_k: float = 2.5
    """Bound of thermal offset drift, µT/K: ±150 µT over 60 K (table)."""
    offset_drift_z_ut_per_k: float = 4.0
    """Bound of thermal offset drift, µT/K: ±242 µT over 60 K (table)."""
    sensitivity_drift_per_k: float = 0.0005
    """Bound of relative drift per K: ±3 % over 60 K (table)."""
    cross_axis: float = 0.01
    """Bound of each off-diagonal sensitivity (table)."""
    saturation_ut: float = 50e3
    """Field on one axis at which the Hall plates saturate, µT (table)."""
    oscillator_trim: float = 0.05
    """Bound of the relative error of a chip's oscillator (table)."""
    thermometer_error_k: float = 1.0
    """Standard deviation of a chip's thermometer offset, K (assumed)."""
    reference_c: float = 25.0
    """Temperature at which drifts are zero, °C; the thermometer's own reference (table)."""


@dataclass(frozen=True, slots=True)
class ToleranceParameters:
    """Standard deviations of manufacture, cut off at twice that (assumed, hand-assembled)."""

    gap: float = 0.03e-3
    """Distance from chip to magnet, m."""
    lateral: float = 0.05e-3
    """Offset of the magnet from its chip's axis, per axis, m."""
    moment: float = 0.02
    """Dipole moment, relative."""
    magnet_tilt: float = 0.02
    """Tilt of the magnet, per axis, rad."""
    chip_tilt: float = 0.01
    """Tilt of the chip, per axis, yaw included, rad."""
    sensitivity: float = 0.01
    """Sensitivity, relative, per axis."""
    stiffness: float = 0.05
    """Stiffness, relative, per taxel."""


@dataclass(frozen=True, slots=True)
class SkinParameters:
    """All parameters of a skin. `ideal` gives one without imperfections, only crosstalk."""

    magnet: MagnetParameters = field(default_factory=MagnetParameters)
    elastomer: ElastomerParameters = field(default_factory=ElastomerParameters)
    chip: ChipParameters = field(default_factory=ChipParameters)
    tolerance: ToleranceParameters = field(default_factory=ToleranceParameters)

    def ideal(self) -> SkinParameters:
        """Copy without noise, drift, creep, hysteresis and tolerances."""
        return SkinParameters(
            magnet=replace(self.magnet, drift_per_k=0.0),
            elastomer=replace(
                self.elastomer, creep=0.0, hysteresis_normal=0.0, hysteresis_shear=0.0
            ),
            chip=replace(
                self.chip,
                noise_xy_ut=0.0,
                noise_z_ut=0.0,
                offset_drift_xy_ut_per_k=0.0,
                offset_drift_z_ut_per_k=0.0,
                sensitivity_drift_per_k=0.0,
                cross_axis=0.0,
                oscillator_trim=0.0,
                thermometer_error_k=0.0,
            ),
            tolerance=ToleranceParameters(0, 0, 0, 0, 0, 0, 0),
        )


def anyskin_parameters() -> SkinParameters:
    """Parameters of an AnySkin-like board: 5 mm gap (5.2 mT), softer, at the library's gain of 6.

    115 µT/N as on eFlesh (table). z wraps at 6.55 / 10.6 mT, beyond a press of 20 N.
    """
    return SkinParameters(
        magnet=MagnetParameters(gap=5e-3),
        elastomer=ElastomerParameters(
            normal_stiffness=27e3, shear_stiffness=13.5e3, spread=4e-3, full_reach=10e-3
        ),
        chip=ChipParameters(setting=ChipSetting(gain=6)),
    )
