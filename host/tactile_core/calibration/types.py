"""Values of a board's calibration: places of its taxels, rest fields and force model."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from tactile_core.arrays import FloatArray
from tactile_core.calibration.force_model import NetModel
from tactile_core.geometry import ArrayGeometry, SkinGeometry

YAW_DECIMALS = 9
"""Files hold chip yaw in degrees; with this many decimals, degrees → radians → degrees is the
identity, so that saving and loading keeps the hash."""


class CalibrationError(ValueError):
    """Unusable calibration; the text names file, key, value and what is allowed."""


class CalibrationMismatch(CalibrationError):  # noqa: N818 - users know the name from messages
    """Calibration of another board; the text names both serial numbers."""

    def __init__(self, calibrated: str, board: str, source: str = "the calibration") -> None:
        self.calibrated = calibrated
        self.board = board
        super().__init__(
            f"{source} belongs to board {calibrated!r}, but the board on the port is {board!r}; "
            f"give the calibration file of {board!r}, or none to run with nominal figures"
        )


@dataclass(frozen=True, slots=True, eq=False)
class ArrayCalibration:
    """Calibration of one array of n taxels; vectors in taxel axes (after undoing the chips' yaw).

    ``rest_ut``: (n, 3) µT unloaded, at ``reference_c`` °C. ``drift_ut_per_k``: (n, 3) µT/K.
    ``newton_per_ut``: (3n, 3n) N/µT; the taxels' forces, one after another, are this matrix times
    their fields (without rest, drift and ambient field). Off-diagonal blocks undo crosstalk.
    """

    geometry: ArrayGeometry
    rest_ut: FloatArray
    drift_ut_per_k: FloatArray
    reference_c: float
    newton_per_ut: FloatArray

    def __post_init__(self) -> None:
        """Reject shapes that do not match the geometry, and numbers that are not finite."""
        n = self.geometry.taxels
        for label, array, shape in (
            ("rest_ut", self.rest_ut, (n, 3)),
            ("drift_ut_per_k", self.drift_ut_per_k, (n, 3)),
            ("newton_per_ut", self.newton_per_ut, (3 * n, 3 * n)),
        ):
            if array.shape != shape:
                raise CalibrationError(
                    f"array {self.geometry.name!r}: {label} is {array.shape}, not {shape}"
                )
            if not np.isfinite(array).all():
                raise CalibrationError(f"array {self.geometry.name!r}: {label} is not finite")
        if not np.isfinite(self.reference_c):
            raise CalibrationError(f"array {self.geometry.name!r}: reference_c is not finite")


@dataclass(frozen=True, slots=True, eq=False)
class BoardCalibration:
    """Calibration of the board with ``serial_number``.

    ``nominal``: from typical figures instead of measurements of this board; the rest field is then
    unknown and must be tared. ``nets``: fitted models of the whole contact, each with its own
    targets; the arrays' matrices then only distribute it over the taxels.
    """

    serial_number: str
    model: str
    frame: str
    created: str  # ISO 8601
    provenance: str
    nominal: bool
    arrays: tuple[ArrayCalibration, ...]
    nets: tuple[NetModel, ...] = ()

    def __post_init__(self) -> None:
        """Reject models for another number of taxels, and two models for one target."""
        taxels = sum(array.geometry.taxels for array in self.arrays)
        seen: set[str] = set()
        for i, net in enumerate(self.nets):
            if net.taxels != taxels:
                raise CalibrationError(
                    f"net[{i}] is for {net.taxels} taxels, the board has {taxels}"
                )
            for target in net.targets:
                if target in seen:
                    raise CalibrationError(f"net[{i}]: another model predicts {target!r} already")
                seen.add(target)

    @property
    def geometry(self) -> SkinGeometry:
        """Geometry of the whole board."""
        return SkinGeometry(self.model, self.frame, tuple(a.geometry for a in self.arrays))

    @property
    def hash(self) -> str:
        """SHA-256 of the whole calibration, 64 hex digits; unchanged by saving and loading."""
        digest = hashlib.sha256()

        def text(value: str) -> None:
            data = value.encode()
            digest.update(len(data).to_bytes(4, "little") + data)

        def numbers(value: FloatArray) -> None:
            digest.update(np.ascontiguousarray(value + 0.0, "<f8").tobytes())  # -0 is hashed as 0

        for value in (self.serial_number, self.model, self.frame, self.created, self.provenance):
            text(value)
        text("nominal" if self.nominal else "measured")
        for array in self.arrays:
            g = array.geometry
            text(f"{g.name}/{int(g.side)}/{g.rows}x{g.columns}{'' if g.posed else '/unposed'}")
            for place in (g.position, g.rotation, g.surface, yaw_degrees(g.chip_yaw)):
                numbers(place)
            numbers(array.rest_ut)
            numbers(array.drift_ut_per_k)
            numbers(np.array([array.reference_c]))
            numbers(array.newton_per_ut)
        for net in self.nets:
            net.digest(text, numbers)
        return digest.hexdigest()

    def require_board(self, serial_number: str, source: str = "the calibration") -> None:
        """Raise `CalibrationMismatch` unless the calibration belongs to that board."""
        if serial_number != self.serial_number:
            raise CalibrationMismatch(self.serial_number, serial_number, source)


def yaw_degrees(yaw: FloatArray) -> FloatArray:
    """Convert chip yaw from rad to degrees, rounded as in files."""
    return np.asarray(np.round(np.rad2deg(yaw), YAW_DECIMALS) + 0.0, np.float64)
