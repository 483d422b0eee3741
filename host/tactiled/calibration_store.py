"""The calibrations that the user gave, and the choice of one for a board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tactile_core.calibration import (
    BoardCalibration,
    CalibrationMismatch,
    load,
    loads,
    nominal,
    nominal_from_descriptor,
)
from tactile_core.calibration.file import SUFFIX
from tactile_core.calibration.nominal import default_arrays
from tactile_core.log.reader import LogReader
from tactile_core.log.records import AttachmentRecord
from tactiled.boards.events import Identity, Refusal

UNNUMBERED = "unknown"
"""Serial number in the nominal calibration of a board that has none."""


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The calibration to use. ``path``: None for nominal figures. ``warning``: may be empty."""

    calibration: BoardCalibration
    path: Path | None
    warning: str = ""


class CalibrationStore:
    """Calibration files by serial number.

    ``strict``: refuse a board without a file rather than use nominal figures. Set when there are as
    many files as ports, because then one of the files must be wrong.
    """

    def __init__(self, paths: Sequence[Path], strict: bool) -> None:
        self._paths = tuple(paths)
        self._strict = strict
        self._files: dict[Path, BoardCalibration] = {}
        self.reload()

    def reload(self) -> None:
        """Read every file again; `CalibrationError`, and nothing changes, when one is bad."""
        self._files = {path: load(path) for path in self._paths}

    def adopt_from_log(self, log: Path, board: str) -> None:
        """Use the calibration that ``board`` was recorded with, unless files were given.

        Nominal figures are not adopted: they follow from the board's descriptor.
        """
        if self._paths:
            return
        with LogReader(log) as reader:
            for event in reader.events():
                if isinstance(event, AttachmentRecord) and event.name == f"{board}{SUFFIX}":
                    text = reader.read_at(event.position, event.size).decode("utf-8", "replace")
                    calibration = loads(text, f"{log}: {event.name}")
                    if not calibration.nominal:
                        self._files[log] = calibration
                    return

    def add(self, source: Path, calibration: BoardCalibration) -> None:
        """Add a calibration that has no file; it replaces any other of that board."""
        serial = calibration.serial_number
        self._files = {p: c for p, c in self._files.items() if c.serial_number != serial}
        self._files[source] = calibration

    def choose(self, identity: Identity) -> Choice | Refusal:
        """Choose the calibration for a board, or say why there is none."""
        own = [(p, c) for p, c in self._files.items() if c.serial_number == identity.serial_number]
        if own:
            path, calibration = own[-1]
            return _fitting(identity, calibration, path)
        if not identity.serial_number:
            alike = [
                (p, c)
                for p, c in self._files.items()
                if c.model == identity.model and _alike(identity, c)
            ]
            if len(alike) == 1:
                path, calibration = alike[0]
                warning = (
                    f"{path} is of board {calibration.serial_number}; the {identity} cannot "
                    "confirm that it is that one"
                )
                return Choice(calibration, path, warning)
        if self._files and self._strict:
            path, calibration = next(iter(self._files.items()))
            named = CalibrationMismatch(
                calibration.serial_number, identity.serial_number or UNNUMBERED, str(path)
            )
            problem, _, remedy = str(named).partition("; ")
            return Refusal(problem, remedy)
        return _nominal(identity)


def _nominal(identity: Identity) -> Choice | Refusal:
    if identity.descriptor is not None:
        calibration = nominal_from_descriptor(identity.descriptor)
    else:
        serial, count, arrays = identity.serial_number, identity.taxels, identity.arrays
        if arrays is not None and sum(arrays) != count:
            return Refusal(
                f"--arrays {'+'.join(map(str, arrays))} names {sum(arrays)} magnetometers, the "
                f"{identity} has {count}",
                f"give numbers that add up to {count}, such as "
                f"{'+'.join(map(str, default_arrays(count)))}",
            )
        calibration = nominal(identity.model, serial or UNNUMBERED, count, arrays)
    warning = f"no calibration for {identity}: nominal figures, forces accurate to a factor of two"
    return Choice(calibration, None, warning)


def _fitting(identity: Identity, calibration: BoardCalibration, path: Path) -> Choice | Refusal:
    if _alike(identity, calibration):
        return Choice(calibration, path)
    if identity.arrays is not None and calibration.geometry.taxels == identity.taxels:
        return Refusal(
            f"{path} describes arrays of {_text(_shapes(calibration))} taxels, --arrays says "
            f"{'+'.join(map(str, identity.arrays))}",
            "leave --arrays out: the file knows",
        )
    return Refusal(
        f"{path} describes arrays of {_text(_shapes(calibration))} taxels, {identity} has "
        f"{_text(identity.shapes)}",
        "calibrate the board again: its firmware or its arrays have changed since",
    )


def _alike(identity: Identity, calibration: BoardCalibration) -> bool:
    """Whether a calibration has the same arrays as the board.

    A descriptor lists the arrays; for a board without one, the arrays of the file are believed.
    """
    if identity.descriptor is not None:
        return _shapes(calibration) == identity.shapes
    sizes = tuple(array.geometry.taxels for array in calibration.arrays)
    return sum(sizes) == identity.taxels and identity.arrays in (None, sizes)


def _shapes(calibration: BoardCalibration) -> tuple[tuple[int, int], ...]:
    return tuple((a.geometry.rows, a.geometry.columns) for a in calibration.arrays)


def _text(shapes: tuple[tuple[int, int], ...]) -> str:
    return " + ".join(f"{rows} × {columns}" for rows, columns in shapes)
