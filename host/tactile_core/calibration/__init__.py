"""Calibration of one board: where its taxels are and how field becomes force.

Import from here; types, files and nominal figures are in separate modules.
"""

from __future__ import annotations

from tactile_core.calibration.file import FORMAT_VERSION, load, loads, save, saves
from tactile_core.calibration.nominal import NOMINAL_MODELS, nominal, nominal_from_descriptor
from tactile_core.calibration.types import (
    ArrayCalibration,
    BoardCalibration,
    CalibrationError,
    CalibrationMismatch,
)

__all__ = [
    "FORMAT_VERSION",
    "NOMINAL_MODELS",
    "ArrayCalibration",
    "BoardCalibration",
    "CalibrationError",
    "CalibrationMismatch",
    "load",
    "loads",
    "nominal",
    "nominal_from_descriptor",
    "save",
    "saves",
]
