"""Nominal calibrations from typical figures, for boards that were never calibrated.

Positions are right for a known model; forces are accurate to within a factor of about two. The rest
field is unknown and must be tared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sensor_proto.packets import ArrayDescriptor, Descriptor
from tactile_core.arrays import FloatArray
from tactile_core.calibration.types import ArrayCalibration, BoardCalibration
from tactile_core.geometry import (
    ANYSKIN_CHIPS,
    ArrayGeometry,
    Side,
    SkinGeometry,
    anyskin,
    finger,
    grid_on_plane,
)

SENSITIVITY_UT_PER_N = {"finger": (152.0, 152.0), "anyskin": (115.0, 115.0)}
"""Field in µT per N of shear and of normal force, on the nearest magnetometer.

``anyskin``: eFlesh recordings, 34 N → 3.9 mT. ``finger``: a magnet 4 mm above its chip changes the
field by 3.8 mT/mm sideways (8.0 towards it), and a 16 mm pad yields 1 mm under 25 N of shear (50 N
of pressure). A pad is half as stiff in shear as in pressure and its magnet half as effective, so
that both directions are equal.
"""

REFERENCE_C = 25.0
ANYSKIN_PITCH = 0.008
"""Distance in m between neighbouring magnetometers of an AnySkin board."""
ANYSKIN_BOARD_PITCH = 0.030
"""Distance in m between the centres of AnySkin boards on one controller, until a file gives their
places: far enough apart to be shown. They sit on different fingers or jaws, so nothing follows from
it."""
MAX_ANYSKIN_MAGNETOMETERS = 20
"""Four boards of five on one controller."""

NOMINAL_MODELS = ("finger", "anyskin")


def nominal_newton_per_ut(taxels: int, shear: float, normal: float) -> FloatArray:
    """Force matrix, (3n, 3n) N/µT, without coupling, from µT/N of shear and of normal force.

    Magnets point away from the chips: a press (negative z) brings them nearer and raises B_z; a
    force along +x moves them towards +x and raises B_x.
    """
    return np.diag(np.tile([1 / shear, 1 / shear, -1 / normal], taxels))


def nominal(
    model: str,
    serial_number: str,
    magnetometers: int | None = None,
    arrays: Sequence[int] | None = None,
) -> BoardCalibration:
    """Nominal calibration of ``model``, one of `NOMINAL_MODELS`; ValueError for any other.

    ``magnetometers``: of an ``anyskin`` controller, 1 to 20, numbered as on its bus. ``arrays``:
    number of magnetometers of each board; None: fives if they divide the total, otherwise one
    array. The relative places of several boards are unknown, so their arrays are not ``posed``.
    """
    if model == "finger":
        if magnetometers is not None:
            raise ValueError("magnetometers is a property of anyskin boards alone")
        return _with_typical_figures(finger(), serial_number, "finger of the default end-effector")
    if model == "anyskin":
        count = sum(arrays) if magnetometers is None and arrays else magnetometers or ANYSKIN_CHIPS
        return _with_typical_figures(_anyskin_controller(count, arrays), serial_number, "AnySkin")
    raise ValueError(f"no nominal figures for model {model!r}; there are {NOMINAL_MODELS}")


def nominal_from_descriptor(descriptor: Descriptor) -> BoardCalibration:
    """Nominal calibration of the board that sent ``descriptor``.

    A known model whose arrays have the expected shapes gets that model's geometry. Any other gets
    flat grids with the descriptor's rows, columns and pitch, all at the tip and not ``posed``.
    """
    shapes = [(a.rows, a.columns) for a in descriptor.arrays]
    if descriptor.model == "finger":
        geometry = finger()
        if shapes == [(a.rows, a.columns) for a in geometry.arrays]:
            return _with_typical_figures(
                geometry, descriptor.serial_number, "finger, by its descriptor"
            )
    geometry = SkinGeometry(
        descriptor.model, "ee", tuple(_flat(array) for array in descriptor.arrays)
    )
    return _with_typical_figures(
        geometry, descriptor.serial_number, "flat grids from the descriptor, place unknown"
    )


def _with_typical_figures(
    geometry: SkinGeometry, serial_number: str, what: str
) -> BoardCalibration:
    sensitivity = SENSITIVITY_UT_PER_N.get(geometry.model, SENSITIVITY_UT_PER_N["anyskin"])
    return BoardCalibration(
        serial_number=serial_number,
        model=geometry.model,
        frame=geometry.frame,
        created="1970-01-01T00:00:00Z",  # typical figures have no date of measurement
        provenance=f"nominal figures, not measured: {what}",
        nominal=True,
        arrays=tuple(
            ArrayCalibration(
                geometry=array,
                rest_ut=np.zeros((array.taxels, 3)),
                drift_ut_per_k=np.zeros((array.taxels, 3)),
                reference_c=REFERENCE_C,
                newton_per_ut=nominal_newton_per_ut(array.taxels, *sensitivity),
            )
            for array in geometry.arrays
        ),
    )


def default_arrays(magnetometers: int) -> tuple[int, ...]:
    """Default number of magnetometers of each board of an AnySkin controller."""
    boards, rest = divmod(magnetometers, ANYSKIN_CHIPS)
    return (magnetometers,) if rest else (ANYSKIN_CHIPS,) * boards


def _anyskin_controller(magnetometers: int, arrays: Sequence[int] | None) -> SkinGeometry:
    """Boards of one controller side by side; a board without five magnetometers is a plain row."""
    if not 1 <= magnetometers <= MAX_ANYSKIN_MAGNETOMETERS:
        raise ValueError(
            f"{magnetometers} magnetometers: an AnySkin controller reads 1 to "
            f"{MAX_ANYSKIN_MAGNETOMETERS}"
        )
    sizes = default_arrays(magnetometers) if arrays is None else tuple(arrays)
    if sum(sizes) != magnetometers or min(sizes) < 1:
        raise ValueError(
            f"arrays of {' + '.join(map(str, sizes))} magnetometers for a board that has "
            f"{magnetometers}; allowed: whole numbers above 0 that add up to {magnetometers}"
        )
    five = anyskin().arrays[0]
    middle = (len(sizes) - 1) / 2
    return SkinGeometry(
        "anyskin",
        "ee",
        tuple(
            _board(
                five,
                five.name if len(sizes) == 1 else f"{five.name}{i}",
                size,
                (i - middle) * ANYSKIN_BOARD_PITCH,
            )
            for i, size in enumerate(sizes)
        ),
    )


def _board(five: ArrayGeometry, name: str, size: int, sideways: float) -> ArrayGeometry:
    """One board of ``size`` magnetometers, ``sideways`` m along its x from the place of ``five``.

    Its mounting is unknown, so it is not posed.
    """
    axes = five.rotation[0]
    shift = sideways * axes[:, 0]
    if size == five.taxels:
        return replace(five, name=name, position=five.position + shift, posed=False)
    surface = np.zeros((size, 2))
    surface[:, 0] = (np.arange(size) - (size - 1) / 2) * ANYSKIN_PITCH
    return ArrayGeometry(
        name=name,
        side=five.side,
        rows=1,
        columns=size,
        position=five.position[0] + shift + surface @ axes[:, :2].T,
        rotation=np.broadcast_to(axes, (size, 3, 3)).copy(),
        surface=surface,
        chip_yaw=np.zeros(size),
        posed=False,
    )


def _flat(array: ArrayDescriptor) -> ArrayGeometry:
    tip = finger().arrays[-1]
    axes = np.column_stack([(0, 1.0, 0), (0, 0, 1.0), (1.0, 0, 0)])
    pitch = array.pitch_um * 1e-6
    grid = grid_on_plane(
        array.name or f"array{array.array}",
        Side.TIP,
        (array.rows, array.columns),
        (pitch, pitch),
        (float(tip.position[:, 0].max()), 0.0, 0.0),
        axes,
    )
    return replace(grid, posed=False)
