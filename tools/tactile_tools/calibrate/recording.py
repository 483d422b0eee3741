"""A recording to calibrate from: field of a board over time, and the readings of a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tactile_core.arrays import FloatArray
from tactile_core.calibration import BoardCalibration
from tactile_core.geometry import SkinGeometry
from tactile_tools.calibrate.label_clock import LabelClock, find_clock

MIN_FRAMES = 50
"""Fewest frames and labels of a recording: fewer cannot be split into parts to fit and to test."""
TARE_S = 1.0
"""Start of a recording that must be untouched, s; its mean is the rest field."""
MIN_TARE_FRAMES = 5
"""Fewest frames of a tare."""
UNTOUCHED_SHARE = 0.03
"""A label below this share of the largest counts as untouched: the load cell's own drift at rest is
0.2 % of full scale; creep of a released skin pushes back with about 1 %."""


class RecordingError(Exception):
    """A recording cannot be used; the text names file, place, fault and remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """m frames of n taxels, and k labels.

    ``time_s`` (m,) and ``label_time_s`` (k,): s on one clock, both increasing. ``field_ut``: (m,
    3n) µT in taxel axes. ``rest_ut``: (m, 3n), the rest field of each frame where the recording has
    it (single touches, between which the rig let go), else None. ``labels``: (k, targets) in the
    targets' units. ``serial_number``: empty where the recording has none. ``label_clock``: how late
    each label is, None where that was not found. ``calibration``: that of the board while it was
    recorded, None if unknown.
    """

    path: Path
    geometry: SkinGeometry
    serial_number: str
    started: str
    time_s: FloatArray
    field_ut: FloatArray
    rest_ut: FloatArray | None
    label_time_s: FloatArray
    labels: FloatArray
    targets: tuple[str, ...]
    label_clock: LabelClock | None = None
    calibration: BoardCalibration | None = None

    @property
    def name(self) -> str:
        """Name of the recording in reports."""
        return self.path.name

    @property
    def taxels(self) -> int:
        """Number of taxels."""
        return int(self.field_ut.shape[1]) // 3

    @property
    def forces(self) -> bool:
        """Whether the labels are forces, so that a label near zero means untouched."""
        return not {"x", "y"} & set(self.targets)

    def load(self) -> FloatArray:
        """Size of each label over all targets, (k,)."""
        size: FloatArray = np.linalg.norm(self.labels, axis=1)
        return size

    def change_ut(self, start: int = 0) -> FloatArray:
        """Change of the field from the rest field, tared at frame ``start``: (m - start, 3n) µT."""
        if self.rest_ut is not None:
            change: FloatArray = self.field_ut[start:] - self.rest_ut[start:]
            return change
        if not self.forces:  # nothing in it is untouched, so any origin will do
            return np.asarray(self.field_ut[start:] - self.field_ut.mean(axis=0))
        field, time = self.field_ut[start:], self.time_s[start:]
        count = max(MIN_TARE_FRAMES, int(np.searchsorted(time, time[0] + TARE_S)))
        return np.asarray(field - field[:count].mean(axis=0))

    @property
    def lag_s(self) -> FloatArray:
        """Lag of each label when it was read, (k,) s."""
        clock = self.label_clock
        return np.zeros(len(self.label_time_s)) if clock is None else clock.lag_s

    def until(self, share: float) -> Recording:
        """The first ``share`` of the frames, and the labels up to the last of them."""
        frames = int(len(self.time_s) * share)
        end = self.time_s[frames] if frames < len(self.time_s) else np.inf
        labels = int(np.searchsorted(self.label_time_s, end))
        return replace(
            self,
            time_s=self.time_s[:frames],
            field_ut=self.field_ut[:frames],
            rest_ut=None if self.rest_ut is None else self.rest_ut[:frames],
            label_time_s=self.label_time_s[:labels],
            labels=self.labels[:labels],
            label_clock=None
            if self.label_clock is None
            else replace(self.label_clock, lag_s=self.label_clock.lag_s[:labels]),
        )


def check(recording: Recording) -> Recording:
    """Return the recording; `RecordingError` for one that no model could be fitted to."""
    path = recording.path
    for what, time in (("frames", recording.time_s), ("labels", recording.label_time_s)):
        if len(time) < MIN_FRAMES:
            raise RecordingError(
                f"{path}: {len(time)} {what}, at least {MIN_FRAMES} are needed; record for longer"
            )
        if not np.isfinite(time).all():
            raise RecordingError(f"{path}: a time of its {what} is not a finite number")
        back = np.flatnonzero(np.diff(time) <= 0)
        if len(back):
            raise RecordingError(
                f"{path}: time does not increase from number {back[0] + 1} to {back[0] + 2} of "
                f"its {what}; sort them, or take out what was recorded twice"
            )
    if not np.isfinite(recording.field_ut).all() or not np.isfinite(recording.labels).all():
        raise RecordingError(f"{path}: a value is not a finite number; take that row out")
    inside = (recording.label_time_s >= recording.time_s[0]) & (
        recording.label_time_s <= recording.time_s[-1]
    )
    if inside.mean() < 0.5:
        raise RecordingError(
            f"{path}: {100 * (1 - inside.mean()):.0f} % of the labels lie outside the time of the "
            "frames; both must be on the same clock"
        )
    if np.ptp(recording.labels, axis=0).max() == 0:
        raise RecordingError(f"{path}: every label is {recording.labels[0, 0]:g}; nothing to fit")
    if recording.forces and recording.rest_ut is None:
        load = recording.load()
        first = load[recording.label_time_s < recording.time_s[0] + TARE_S]
        if len(first) and first.max() > UNTOUCHED_SHARE * load.max():
            raise RecordingError(
                f"{path}: its first {TARE_S:g} s carry up to {first.max():.2f} N; begin recordings "
                "with the skin untouched, for that is when it is tared"
            )
    return recording


def with_clock(recording: Recording) -> Recording:
    """Return the recording with the lag of its labels, where force shows one."""
    if not recording.forces:
        return recording
    strongest = recording.labels[:, int(np.ptp(recording.labels, axis=0).argmax())]
    return replace(recording, label_clock=find_clock(recording.label_time_s, strongest))
