"""Make the calibration of a board from fitted models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from tactile_core.calibration import BoardCalibration
from tactile_core.calibration.force_model import TARGET_UNITS, Figure, NetModel
from tactile_tools.calibrate.evaluate import Judged, leave_one_out, tail20
from tactile_tools.calibrate.fit import Choice, Progress, choose, fit, quiet
from tactile_tools.calibrate.recording import Recording
from tactile_tools.calibrate.results import DEFINITIONS


def group(recordings: Sequence[Recording]) -> list[list[Recording]]:
    """Group recordings with the same targets, in the given order."""
    groups: dict[tuple[str, ...], list[Recording]] = {}
    for recording in recordings:
        groups.setdefault(recording.targets, []).append(recording)
    return list(groups.values())


def fitted(
    recordings: Sequence[Recording], progress: Progress = quiet
) -> tuple[NetModel, Choice, list[Judged]]:
    """Fit the model of one group.

    Returns it with its error figures, its choice and its judgement.
    """
    choice = choose(recordings, progress=progress)
    model = fit(recordings, choice)
    judged = tail20(recordings, progress=lambda text: progress(f"tail20: {text}"))
    figures = [
        Figure(
            f"cross-validated rmse {'+'.join(model.targets)}",
            min(score.rmse for score in choice.scores),
            TARGET_UNITS[model.targets[0]],
            "blocks of time of the recordings, and whole recordings, left out in turn",
        )
    ]
    figures += _figures("tail20", judged)
    if len(recordings) > 1:
        left_out = leave_one_out(
            recordings, progress=lambda text: progress(f"leave-one-out: {text}")
        )
        figures += _figures("leave-one-out", left_out)
        judged = left_out
    return replace(model, figures=tuple(figures)), choice, judged


def board(
    base: BoardCalibration,
    recordings: Sequence[Recording],
    nets: Sequence[NetModel],
    serial_number: str,
    now: datetime | None = None,
) -> BoardCalibration:
    """Calibration of the board: places and matrices of ``base``, scaled to the load, and ``nets``.

    The rest field is that at the start of the last recording.
    """
    when = (now or datetime.now(UTC)).isoformat(timespec="seconds").replace("+00:00", "Z")
    names = ", ".join(f"{r.name} ({r.started})" for r in recordings)
    arrays = list(base.arrays)
    if base.nominal:
        scale = share_scale(base, recordings)
        arrays = [replace(a, newton_per_ut=a.newton_per_ut * scale) for a in arrays]
        start = 0
        rest = recordings[-1].field_ut[0] - recordings[-1].change_ut()[0]
        for i, array in enumerate(arrays):
            n = array.geometry.taxels
            own = rest[3 * start : 3 * (start + n)].reshape(n, 3)
            arrays[i] = replace(array, rest_ut=np.array(own))
            start += n
    return BoardCalibration(
        serial_number=serial_number,
        model=base.model,
        frame=base.frame,
        created=when,
        provenance=f"fitted to {names}",
        nominal=False,
        arrays=tuple(arrays),
        nets=tuple(nets),
    )


def share_scale(base: BoardCalibration, recordings: Sequence[Recording]) -> float:
    """Factor on the matrices of ``base`` that makes their sum the measured normal force.

    One if no recording has a normal force: the matrices then divide what the models say among the
    taxels.
    """
    sums, loads = [], []
    for recording in recordings:
        if "normal" not in recording.targets:
            continue
        change = recording.change_ut()
        total, start = np.zeros(len(change)), 0
        for array in base.arrays:
            channels = 3 * array.geometry.taxels
            force = change[:, start : start + channels] @ array.newton_per_ut.T
            total -= force[:, 2::3].sum(axis=1)
            start += channels
        sums.append(np.interp(recording.label_time_s, recording.time_s, total))
        loads.append(recording.labels[:, recording.targets.index("normal")])
    if not sums:
        return 1.0
    sum_, load = np.concatenate(sums), np.concatenate(loads)
    scale = float(sum_ @ load / (sum_ @ sum_)) if sum_.any() else 1.0
    return scale if scale > 0 else 1.0


def _figures(split: str, judged: Sequence[Judged]) -> list[Figure]:
    return [
        Figure(
            f"{split} rmse {target} {each.recording.name}",
            float(each.rmse[i]),
            TARGET_UNITS[target],
            DEFINITIONS[split],
        )
        for each in judged
        for i, target in enumerate(each.model.targets)
    ]
