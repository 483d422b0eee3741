"""Read a folder with a CSV pair, as the eFlesh characterisation rig writes it.

``sensor.csv[.gz]``: time, s; then x, y, z of each magnetometer, µT, in chip axes.
``states.csv[.gz]``: time, s; probe x, y, z, mm; and, where there is a load cell, gram-force, with
-1 for no reading. ``sensor_post_baselines.csv[.gz]``: the same frames over the rest field that the
rig took again between touches; used only for recordings of single touches.
"""

from __future__ import annotations

import gzip
import zlib
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from tactile_core.arrays import FloatArray
from tactile_core.calibration.nominal import MAX_ANYSKIN_MAGNETOMETERS, nominal
from tactile_core.geometry import SkinGeometry
from tactile_tools.calibrate.recording import Recording, RecordingError, check, with_clock

NEWTON_PER_GRAM_FORCE = 9.80665e-3
NO_READING = -1.0
MAX_BYTES = 512 << 20
"""Largest file, unpacked, bytes: ten hours of four boards. More is a mistake."""
TARGETS = ("normal", "shear")
LATEST_S = 4.1e9  # the year 2099; a later time is in ms or wrong


def is_pair(path: Path) -> bool:
    """Return whether ``path`` is a folder that might hold a CSV pair."""
    return path.is_dir()


def read_pair(path: Path, target: str | None = None) -> Recording:
    """Read the recording in folder ``path``; `RecordingError` names file, line and remedy.

    ``target``: what the load cell measured, one of `TARGETS`. None: shear if the folder is called
    ``shear…``, else normal force.
    """
    sensor = _read(path, "sensor")
    states = _read(path, "states")
    columns = sensor.shape[1] - 1
    if columns % 3 or not 1 <= columns // 3 <= MAX_ANYSKIN_MAGNETOMETERS:
        raise RecordingError(
            f"{path}/sensor.csv: {columns + 1} columns; allowed: time and then x, y, z of 1 to "
            f"{MAX_ANYSKIN_MAGNETOMETERS} magnetometers"
        )
    n = columns // 3
    geometry = nominal("anyskin", "unknown", n).geometry
    field = to_taxel_axes(sensor[:, 1:], geometry)
    rest = None
    targets: tuple[str, ...] = ("x", "y")
    if states.shape[1] == 5:
        read = states[:, 4] != NO_READING
        labels = states[read, 4:] * NEWTON_PER_GRAM_FORCE
        label_time = states[read, 0]
        measured = "shear" if path.name.startswith("shear") else "normal"
        targets = (target or measured,)
    elif states.shape[1] == 4:
        labels, label_time = states[:, 1:3], states[:, 0]
        rest = _rests(path, sensor, geometry)
    else:
        raise RecordingError(
            f"{path}/states.csv: {states.shape[1]} columns; allowed: time, x, y, z in mm, and "
            "gram-force where there is a load cell"
        )
    begin = float(sensor[0, 0])
    if not 0 <= begin < LATEST_S:
        raise RecordingError(f"{path}/sensor.csv: first time {begin:g}; allowed: s since 1970")
    whole = check(
        Recording(
            path=path,
            geometry=geometry,
            serial_number="",
            started=datetime.fromtimestamp(begin, UTC).isoformat(timespec="seconds"),
            time_s=sensor[:, 0] - begin,
            field_ut=field,
            rest_ut=rest,
            label_time_s=label_time - begin,
            labels=labels,
            targets=targets,
        )
    )
    return with_clock(whole)


def to_taxel_axes(field: FloatArray, geometry: SkinGeometry) -> FloatArray:
    """Rotate a field (m, 3n) µT from chip axes to taxel axes, undoing the yaw of each chip."""
    yaw = np.concatenate([a.chip_yaw for a in geometry.arrays])
    out = field.reshape(len(field), -1, 3).copy()
    x, y = out[..., 0].copy(), out[..., 1].copy()
    out[..., 0] = np.cos(yaw) * x - np.sin(yaw) * y
    out[..., 1] = np.sin(yaw) * x + np.cos(yaw) * y
    return out.reshape(field.shape)


def _rests(path: Path, sensor: FloatArray, geometry: SkinGeometry) -> FloatArray | None:
    """Rest field of each frame, from what the rig subtracted; None where it did not write that."""
    if _find(path, "sensor_post_baselines") is None:
        return None
    over_rest = _read(path, "sensor_post_baselines")
    if over_rest.shape != sensor.shape or (over_rest[:, 0] != sensor[:, 0]).any():
        raise RecordingError(
            f"{path}/sensor_post_baselines.csv: its frames are not those of sensor.csv; take the "
            "file away to do without"
        )
    return to_taxel_axes(sensor[:, 1:] - over_rest[:, 1:], geometry)


def _find(path: Path, stem: str) -> Path | None:
    for suffix in (".csv.gz", ".csv"):
        if (path / (stem + suffix)).is_file():
            return path / (stem + suffix)
    return None


def _read(path: Path, stem: str) -> FloatArray:
    """Read the numbers of one CSV file, (rows, columns)."""
    file = _find(path, stem)
    if file is None:
        raise RecordingError(f"{path}: holds no {stem}.csv or {stem}.csv.gz; name a recording")
    try:
        with gzip.open(file, "rb") if file.suffix == ".gz" else file.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise RecordingError(f"{file}: cannot be read ({error}); copy it again") from error
    if len(data) > MAX_BYTES:
        raise RecordingError(f"{file}: over {MAX_BYTES >> 20} MiB unpacked; split it")
    try:
        lines = data.decode("ascii").split("\n")
    except UnicodeDecodeError as error:
        raise RecordingError(f"{file}: not text; allowed: numbers and commas") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            row = [float(value) for value in line.split(",")]
        except ValueError as error:
            if number == 1:
                continue  # a line of column names
            raise RecordingError(f"{file}, line {number}: {error}; allowed: numbers") from error
        if rows and len(row) != len(rows[0]):
            raise RecordingError(
                f"{file}, line {number}: {len(row)} columns, {len(rows[0])} before; every line "
                "must have as many"
            )
        rows.append(row)
    if not rows:
        raise RecordingError(f"{file}: empty; record again")
    return np.array(rows)
