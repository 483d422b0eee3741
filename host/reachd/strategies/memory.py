"""What a learned strategy is told of the present and of the last eight seconds.

The same code serves one reach at a time and thousands that are trained together: arrays have a row
for each reach, and are numpy's or, for training, PyTorch's tensors. Lengths are in m, angles in
rad, forces in N and N·m before they are scaled; the frames are those of `reachd.interfaces`.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_core.geometry import TIP_X

Rows = NDArray[np.float32]

DECISION_S: Final = 0.1
"""Time between decisions, s."""

LAGS: Final = (1, 2, 3, 5, 8, 12, 17, 23, 30, 40, 55, 80)
"""Decisions ago that are remembered."""

FELT: Final = (
    "total_n", "tip_n", "peak_n", "peak_x_m", "peak_y_m", "fx_n", "fy_n", "mz_nm", "touched",
)  # fmt: skip
"""What one decision's cycles felt: means of the summed and the tip's normal force and of the skin's
wrench in ``ee``; the greatest peak; where the last peak was; the share of cycles in contact."""

RECORD: Final = len(FELT) + 3 + 3
"""Numbers of a record: `FELT`, the motion since the last decision, the last action."""

PLACED: Final = RECORD + 5
"""Numbers of a past record: also where finger and contact were then, seen from the finger now."""

PRESENT: Final = 15
"""Numbers of the present besides its record."""

WIDTH: Final = RECORD + PRESENT + len(LAGS) * PLACED
"""Length of an observation."""

VERSION: Final = 1
"""Version of the observation; weights of another are refused."""

NEAR_M: Final = 0.05
"""Length that counts as 1, m."""

BOUND: Final = 5.0
"""Greatest magnitude of a number in an observation."""


class Memory:
    """The records of ``n`` reaches, and what they look like from where each finger is now.

    ``library``: numpy, or torch for arrays that are tensors on ``device``.
    """

    def __init__(self, n: int, library: Any = np, device: str = "cpu") -> None:
        self._library = library
        where = {} if library is np else {"device": device}

        def zeros(shape: tuple[int, ...], kind: Any) -> Any:
            return library.zeros(shape, dtype=kind, **where)

        self._zeros = zeros
        self._records = zeros((n, LAGS[-1] + 1, RECORD), library.float32)
        # Pose; place of the contact, in ``cupboard``.
        self._places = zeros((n, LAGS[-1] + 1, 5), library.float64)
        self._pose = zeros((n, 3), library.float64)
        self._count = zeros((n,), library.int64)  # decisions that are remembered
        self._lags = library.asarray(LAGS, **where)
        self._at = 0

    def forget(self, which: Any, pose: Any) -> None:
        """Begin the reaches ``which`` anew at ``pose`` (k, 3)."""
        self._records[which] = 0.0
        self._places[which] = 0.0
        self._pose[which], self._count[which] = pose, 0

    def observe(
        self,
        felt: Any,
        pose: Any,
        action: Any,
        goal: Any,
        state: Any,
        speeds: Any,
    ) -> Any:
        """Remember the cycles since the last decision; returns (n, `WIDTH`) in single precision.

        ``felt`` (n, 9): `FELT`. ``pose`` (n, 3): pivot's x, y, heading now. ``action`` (n, 3): what
        was decided last, as told to `learned`. ``goal`` (n, 2). ``state`` (n, 5): s left, closest
        distance so far m, part of a sweep that is left, its side (1 left, −1 right, 0 none), part
        of a jam's time without progress. ``speeds`` (n, 2): v_max m/s, ω_max rad/s.
        """
        n, xp = len(pose), self._library
        heading = pose[:, 2]
        c, s = xp.cos(heading), xp.sin(heading)
        record = self._record(felt, pose, action, speeds)
        at = self._at = (self._at + 1) % self._records.shape[1]
        self._records[:, at] = record
        self._places[:, at, :3] = pose
        px, py = felt[:, 3], felt[:, 4]
        self._places[:, at, 3] = pose[:, 0] + c * px - s * py
        self._places[:, at, 4] = pose[:, 1] + s * px + c * py
        self._pose[:] = pose
        found = self._zeros((n, WIDTH), xp.float32)
        found[:, :RECORD] = record
        found[:, RECORD : RECORD + PRESENT] = _present(xp, pose, c, s, goal, state)
        past = found[:, RECORD + PRESENT :].reshape(n, len(LAGS), PLACED)
        columns = (at - self._lags) % self._records.shape[1]
        past[:, :, :RECORD] = self._records[:, columns]
        then = self._places[:, columns]
        dx, dy = then[:, :, 0] - pose[:, :1], then[:, :, 1] - pose[:, 1:2]
        c, s = c[:, None], s[:, None]
        past[:, :, RECORD] = (c * dx + s * dy) / NEAR_M
        past[:, :, RECORD + 1] = (c * dy - s * dx) / NEAR_M
        past[:, :, RECORD + 2] = then[:, :, 2] - heading[:, None]
        touched = past[:, :, len(FELT) - 1] > 0
        dx, dy = then[:, :, 3] - pose[:, :1], then[:, :, 4] - pose[:, 1:2]
        past[:, :, RECORD + 3] = xp.where(touched, (c * dx + s * dy) / NEAR_M, 0.0)
        past[:, :, RECORD + 4] = xp.where(touched, (c * dy - s * dx) / NEAR_M, 0.0)
        # What was before the reach began is not remembered.
        past[self._count[:, None] < self._lags] = 0.0
        self._count += 1
        return xp.clip(found, -BOUND, BOUND)

    def _record(
        self,
        felt: Any,
        pose: Any,
        action: Any,
        speeds: Any,
    ) -> Any:
        xp = self._library
        record = self._zeros((len(pose), RECORD), xp.float64)
        record[:, :3] = xp.log1p(xp.clip(felt[:, :3], 0.0, None) / 2.0)
        record[:, 3] = felt[:, 3] / TIP_X
        record[:, 4] = felt[:, 4] / 0.02
        record[:, 5:7] = felt[:, 5:7] / 10.0
        record[:, 7] = felt[:, 7] / (10.0 * TIP_X)
        record[:, 8] = felt[:, 8]
        c, s = xp.cos(self._pose[:, 2]), xp.sin(self._pose[:, 2])
        moved = pose - self._pose
        way, turn = speeds[:, 0] * DECISION_S, speeds[:, 1] * DECISION_S
        record[:, 9] = (c * moved[:, 0] + s * moved[:, 1]) / way
        record[:, 10] = (c * moved[:, 1] - s * moved[:, 0]) / way
        record[:, 11] = moved[:, 2] / turn
        record[:, 12:] = action
        return xp.clip(record, -BOUND, BOUND)


def _present(
    xp: Any,
    pose: Any,
    c: Any,
    s: Any,
    goal: Any,
    state: Any,
) -> Any:
    tip_x, tip_y = pose[:, 0] + TIP_X * c, pose[:, 1] + TIP_X * s
    ex, ey = goal[:, 0] - tip_x, goal[:, 1] - tip_y
    distance = xp.hypot(ex, ey)
    error = xp.arctan2(ey, ex) - pose[:, 2]
    left, closest, sweep, side, stuck = state.T
    return xp.stack(
        [
            (c * ex + s * ey) / 0.2,
            (c * ey - s * ex) / 0.2,
            distance / 0.2,
            xp.log(xp.clip(distance, 1e-4, None) / 0.01),
            xp.sin(error),
            xp.cos(error),
            tip_x / 0.2,
            tip_y / 0.2,
            c,
            s,
            left / 20.0,
            (distance - closest) / NEAR_M,
            sweep,
            side,
            stuck,
        ],
        axis=1,
    )
