"""Messages made from cycles: every value is in its field."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tactile_core.bus.messages import MAX_PAYLOAD, codec, stamp_ns
from tactile_core.bus.topics import AMBIENT, FEATURES, FIELD, FORCES, GEOMETRY, RAW
from tactile_core.calibration import BoardCalibration, nominal
from tactile_core.geometry import Side
from tactile_core.types import NS_PER_S, Instant, WallClock
from tactiled.blocks import Ambient, Chunk, Cycle, Features, Patch
from tactiled.publisher import MessageMaker, split
from tactiled.sensing.reasons import array_missing
from tactiled.transports.recorded_log import from_raw, to_raw

WALL = WallClock(offset_ns=10**18)


@pytest.fixture
def calibration() -> BoardCalibration:
    return nominal("finger", "11")


@pytest.fixture
def cycle(instant: Callable[[float], Instant]) -> Cycle:
    n = 80
    features = Features(
        valid=False,
        reasons=(array_missing("tip"),),
        peak_force=2.5,
        peak_side=Side.RIGHT,
        peak_position=np.array([0.1, -0.02, 0.03]),
        normal_force=4.0,
        wrench=np.arange(6.0),
        tip_force=0.5,
        tip_contact_time=1.25,
        taxels_in_contact=3,
        taxels_masked=16,
        patches=(
            Patch(
                array=1,
                side=Side.RIGHT,
                taxels=3,
                normal_force=4.0,
                peak_force=2.5,
                force=np.array([0.0, -4.0, 0.0]),
                centroid=np.array([0.1, 0.0, 0.0]),
                normal=np.array([0.0, -1.0, 0.0]),
                bound=0.5,
            ),
        ),
        peak_force_bound=0.5,
        normal_force_bound=0.75,
        tip_force_bound=0.25,
    )
    return Cycle(
        sequence=42,
        captured=instant(1.0),
        received=instant(1.004),
        uncertainty=0.0005,
        temperature_c=np.array([25.0, 26.0, 27.0]),
        field_ut=np.arange(3.0 * n).reshape(n, 3),
        force=np.full((n, 3), np.nan),
        normal_bound=np.full(n, 0.25),
        health=np.full(n, 32, np.uint8),
        ambient=Ambient(
            "consensus",
            np.arange(27.0).reshape(3, 3, 3),
            np.array([1.0, 0.5, 0.0]),
            np.zeros(3),
            np.zeros(3),
            np.array([True, True, False]),
        ),
        features=features,
        calibrated=True,
    )


def through(topic: Any, message: Any) -> Any:
    """Encode and decode ``message``, as for a subscriber."""
    return codec().decode(topic, codec().encode(topic, message))


def test_features_message_matches_the_pipeline(calibration: BoardCalibration, cycle: Cycle) -> None:
    seen = through(FEATURES, MessageMaker(calibration, WALL).features(cycle))
    assert stamp_ns(seen.header.stamp) == cycle.captured + WALL.offset_ns
    assert seen.header.frame_id == "ee"
    assert (seen.captured_ns, seen.received_ns, seen.sequence) == (
        cycle.captured,
        cycle.received,
        42,
    )
    assert not seen.valid
    assert seen.reasons == ["array tip missing: check its cable"]
    assert seen.reason_codes == ["array_missing:tip"]
    assert (seen.peak_force_bound, seen.normal_force_bound, seen.tip_force_bound) == (
        0.5,
        0.75,
        0.25,
    )
    assert seen.peak_side == 2
    assert seen.peak_position.y == pytest.approx(-0.02)
    assert (seen.wrench.force.z, seen.wrench.torque.x) == (2.0, 3.0)
    assert seen.patches[0].taxels == 3
    assert seen.patches[0].force.y == -4.0
    assert seen.patches[0].normal.y == -1.0
    assert seen.patches[0].normal_force_bound == 0.5


def test_forces_and_field_messages_match_the_pipeline(
    calibration: BoardCalibration, cycle: Cycle
) -> None:
    maker = MessageMaker(calibration, WALL)
    forces = through(FORCES, maker.forces(cycle))
    assert forces.array_taxels.tolist() == [32, 32, 16]
    assert np.isnan(forces.force).all()  # unhealthy taxels never show zero force
    assert len(forces.force) == 240
    assert not forces.compensated
    field = through(FIELD, maker.field(cycle))
    np.testing.assert_array_equal(field.field_ut, np.arange(240.0))
    good = replace(cycle, ambient=replace(cycle.ambient, valid=np.ones(3, bool)))
    assert through(FORCES, maker.forces(good)).compensated


def test_ambient_planes_are_in_message_order(calibration: BoardCalibration, cycle: Cycle) -> None:
    seen = through(AMBIENT, MessageMaker(calibration, WALL).ambient(cycle))
    np.testing.assert_array_equal(seen.plane, np.arange(27.0))
    assert seen.valid.tolist() == [True, True, False]


def test_geometry_message_matches_the_calibration(calibration: BoardCalibration) -> None:
    seen = through(GEOMETRY, MessageMaker(calibration, WALL).geometry(5))
    assert seen.array_name == ["left", "right", "tip"]
    assert seen.array_side.tolist() == [1, 2, 3]
    positions = seen.position.reshape(-1, 3)
    assert positions.shape == (80, 3)
    assert (positions[:32, 1] > 0).all()  # left is +y
    np.testing.assert_allclose(np.linalg.norm(seen.normal.reshape(-1, 3), axis=1), 1, rtol=1e-6)


def test_long_chunks_are_split_into_sendable_messages(
    instant: Callable[[float], Instant],
) -> None:
    data = bytes(range(256)) * 300
    chunk = Chunk(instant(0.0), data)
    parts = []
    for part in split(chunk):
        encoded = codec().encode(RAW, to_raw(part, "p", WALL))
        assert len(encoded) <= MAX_PAYLOAD
        parts.append(from_raw(codec().decode(RAW, encoded)).payload)
    assert b"".join(p for p in parts if isinstance(p, bytes)) == data


def test_system_clock_step_does_not_shift_stamps(
    calibration: BoardCalibration, cycle: Cycle, monkeypatch: pytest.MonkeyPatch
) -> None:
    maker = MessageMaker(calibration, WallClock.take())
    first = stamp_ns(maker.features(cycle).header.stamp)
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() - 3600 * NS_PER_S)
    later = replace(cycle, captured=Instant(cycle.captured + 10_000_000))
    assert stamp_ns(maker.features(later).header.stamp) - first == 10_000_000
