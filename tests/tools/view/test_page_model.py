"""Bus messages into frames: pure, no process."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from tactile_core.bus.messages import MSG, diagnostic_status, header
from tactile_core.bus.topics import DIAGNOSTICS, FEATURES, FORCES, GEOMETRY
from tactile_core.geometry import finger
from tactile_core.types import Instant
from tactile_tools.view.state import HISTORY_S, MAX_BOARDS, PageModel

S = 1_000_000_000


def features(sequence: int = 1, normal: float = 3.0, valid: bool = True, bound: float = 0.2):
    patch = MSG.ContactPatch(
        array=0, side=1, taxels=3, normal_force=normal, peak_force=normal,
        force=MSG.Vector3(0.0, -normal, 0.5), centroid=MSG.Point(0.1, 0.028, 0.0),
        normal=MSG.Vector3(0.0, 1.0, 0.0), normal_force_bound=bound,
    )  # fmt: skip
    zero = MSG.Vector3(0.0, 0.0, 0.0)
    return MSG.ContactFeatures(
        header=header(0, "ee"), captured_ns=0, received_ns=0, uncertainty=0.001,
        sequence=sequence, valid=valid, reasons=[] if valid else ["taring: leave it"],
        calibrated=True, peak_force=normal, peak_side=1, peak_position=MSG.Point(0.1, 0.0, 0.0),
        normal_force=normal, wrench=MSG.Wrench(zero, zero), tip_force=0.0, tip_contact_time=0.0,
        taxels_in_contact=3, taxels_masked=0, patches=[patch], reason_codes=[],
        peak_force_bound=bound, normal_force_bound=bound, tip_force_bound=bound,
    )  # fmt: skip


def forces(status: int = 0):
    force = np.zeros((80, 3), np.float32)
    force[5] = 0.25, -0.5, -1.5
    bound = np.full(80, 0.1, np.float32)
    bound[7] = np.nan
    flags = np.zeros(80, np.uint8)
    flags[7] = status
    return MSG.TaxelForces(
        header=header(0, "ee"), captured_ns=0, received_ns=0, uncertainty=0.0, sequence=1,
        array_taxels=np.array([32, 32, 16], np.uint16), force=force.ravel(), status=flags,
        compensated=True, calibrated=True, normal_bound=bound,
    )  # fmt: skip


def geometry():
    arrays = finger().arrays
    return MSG.SkinGeometry(
        header=header(0, "ee"), serial_number="12", model="finger",
        array_name=[a.name for a in arrays],
        array_side=np.array([int(a.side) for a in arrays], np.uint8),
        array_rows=np.array([a.rows for a in arrays], np.uint16),
        array_columns=np.array([a.columns for a in arrays], np.uint16),
        position=np.zeros(240, np.float32), normal=np.zeros(240, np.float32),
        surface=np.concatenate([a.surface for a in arrays]).astype(np.float32).ravel(),
        array_posed=np.ones(3, np.bool_),
    )  # fmt: skip


def told(state: str, **values: object):
    status = diagnostic_status("tactiled/left", 0, state, "", {"state": state} | values)
    return MSG.DiagnosticArray(header(0, ""), [status])


def board(model: PageModel, now: int) -> dict:
    frame = model.frame(Instant(now))
    json.dumps(frame, allow_nan=False)
    return frame["boards"]["left"]


def test_values_are_those_of_the_messages() -> None:
    model = PageModel()
    model.take(GEOMETRY, "left", geometry(), Instant(0))
    model.take(FEATURES, "left", features(7, 3.25), Instant(S))
    model.take(FORCES, "left", forces(status=8), Instant(S))
    model.take(DIAGNOSTICS, "left", told("streaming", rate_hz=99.5, **{"drops.crc": 3}), Instant(S))
    seen = board(model, S + S // 10)
    assert seen["state"] == "streaming"
    assert seen["valid"]
    assert seen["force"]["normal"] == 3.25
    assert seen["force"]["seq"] == 7
    assert seen["force"]["sides"] == {"left": 3.25}
    assert seen["taxels"]["f"][15:18] == [250, -500, -1500]
    assert seen["taxels"]["b"][7] == -1
    assert seen["taxels"]["masked"] == [[7, 8]]
    assert (seen["rate"], seen["drops"]) == (99.5, {"crc": 3})
    layout = model.layout()["boards"]["left"]
    assert [a["side"] for a in layout["arrays"]] == ["left", "right", "tip"]
    assert sum(len(a["xy"]) for a in layout["arrays"]) == layout["taxels"] == 80


@pytest.mark.parametrize(
    ("state", "word"), [("unplugged", "plug the board in"), ("silent", "check the board")]
)
def test_missing_board_is_named_with_the_remedy(state: str, word: str) -> None:
    model = PageModel()
    model.take(FEATURES, "left", features(), Instant(S))
    model.take(DIAGNOSTICS, "left", told(state), Instant(2 * S))
    seen = board(model, 3 * S)
    assert (seen["state"], seen["valid"]) == (state, False)
    assert word in seen["reasons"][0]


def test_silence_and_end_of_a_daemon_are_distinguished() -> None:
    model = PageModel()
    model.set_alive("left", True)
    assert board(model, S)["state"] == "waiting"
    model.take(FEATURES, "left", features(), Instant(S))
    assert board(model, S + 1)["state"] == "streaming"
    assert board(model, 9 * S)["state"] == "stale"
    model.set_alive("left", False)
    assert board(model, 9 * S)["state"] == "gone"
    model.set_alive("left", True)
    model.take(FEATURES, "left", features(), Instant(10 * S))
    assert board(model, 10 * S + 1)["state"] == "streaming"


def test_a_recording_is_shown_from_the_diagnostics() -> None:
    model = PageModel()
    values = {"recording.recording": True, "recording.path": "/a/b.mcap", "recording.seconds": 2.5}
    model.take(DIAGNOSTICS, "left", told("streaming", **values), Instant(S))
    recording = board(model, S)["recording"]
    assert recording["path"] == "/a/b.mcap"
    assert recording["seconds"] == 2.5


def test_values_that_are_not_finite_become_null() -> None:
    model = PageModel()
    strange = forces()
    strange.force[:] = np.inf
    model.take(FEATURES, "left", features(normal=math.nan, bound=math.inf), Instant(S))
    model.take(FORCES, "left", strange, Instant(S))
    seen = board(model, S)
    assert seen["force"]["bound"] is None
    assert set(seen["taxels"]["f"]) == {0}


def test_history_and_boards_are_bounded() -> None:
    model = PageModel()
    for i in range(3000):
        now = Instant(i * S // 50)
        model.take(FEATURES, "left", features(i), now)
        model.frame(now)
    points = model.history()["left"]
    assert points[-1][0] - points[0][0] <= HISTORY_S
    assert len(points) < 1000
    for i in range(3 * MAX_BOARDS):
        model.take(FEATURES, f"b{i}", features(), Instant(S))
    assert len(model.boards) == MAX_BOARDS
