"""Open recordings of any kind by path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tactile_tools.calibrate.csv_pair import read_pair
from tactile_tools.calibrate.recording import Recording, RecordingError


def open_recordings(
    paths: Sequence[Path], board: str | None = None, target: str | None = None
) -> list[Recording]:
    """Open every recording in ``paths``; `RecordingError` for the first that cannot be used.

    ``board``: which one of a log. ``target``: what the load cell of a CSV pair measured.
    """
    seen: dict[Path, Path] = {}
    out = []
    for path in paths:
        if not path.exists():
            raise RecordingError(
                f"{path}: no such file or folder; name a log (.mcap) or a folder with sensor.csv "
                "and states.csv"
            )
        if path.resolve() in seen:
            raise RecordingError(f"{path} is given twice; a model must not be tested on itself")
        seen[path.resolve()] = path
        if path.is_dir():
            out.append(read_pair(path, target))
        else:
            from tactile_tools.calibrate.log_recording import read_log

            out.append(read_log(path, board))
    return out
