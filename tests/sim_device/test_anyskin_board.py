"""Simulated off-the-shelf board: floats, repeats and unflagged failures."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from sensor_proto.anyskin import AnySkinDecoder
from sensor_proto.packets import FloatSamples, TaxelStatus
from sim_device.board.anyskin import AnySkinBoard
from sim_device.board.catalogue import build_skin
from sim_device.faults import FaultPlan
from sim_device.skin.elastomer import Contact
from sim_device.skin.parameters import anyskin_parameters
from sim_device.skin.skin import SkinModel
from tactile_core.types import Instant

MS = 1_000_000


def stream(board: AnySkinBoard, until_ms: int, step_ms: int = 5, start_ms: int = 0) -> bytes:
    return b"".join(board.tick(Instant(ms * MS)) for ms in range(start_ms, until_ms, step_ms))


def decode(data: bytes) -> list[FloatSamples]:
    return [r.message for r in AnySkinDecoder().feed(data)]


def test_frame_is_five_times_t_x_y_z_and_crlf() -> None:
    data = stream(AnySkinBoard(build_skin("anyskin", 0)), 8)
    assert len(data) == 82
    assert data.endswith(b"\r\n")
    values = np.frombuffer(data[:-2], "<f4").reshape(5, 4)
    assert values[:, 0] == pytest.approx([23.0] * 5, abs=3)
    assert values[:, 3] == pytest.approx([5200.0] * 5, rel=0.15)


def test_streams_at_its_own_rate_and_repeats_frames() -> None:
    board = AnySkinBoard(build_skin("anyskin", 0))
    samples = decode(stream(board, 2000))
    assert len(samples) == pytest.approx(230, abs=1)
    repeats = sum(np.array_equal(a.field_ut, b.field_ut) for a, b in pairwise(samples))
    assert repeats == board.counters["repeated"] == pytest.approx(30, abs=1)


def test_rest_of_a_press_stays_below_the_wrap() -> None:
    board = AnySkinBoard(build_skin("anyskin", 0))
    place = board.skin.geometry.arrays[0].position[0]
    rest = decode(stream(board, 300))[-1].field_ut
    board.contacts = [Contact(place, np.array([-20.0, 0, 0]), 2e-3)]
    pressed = decode(stream(board, 600, start_ms=300))[-1].field_ut
    assert 1500 < pressed[0, 2] - rest[0, 2] < 4000


def test_failed_read_is_an_unflagged_frame_with_an_impossible_temperature() -> None:
    board = AnySkinBoard(
        build_skin("anyskin", 0), plan=FaultPlan.parse("seed=2,failed=skin:2@0.5s+0.5s")
    )
    samples = decode(stream(board, 1500))
    failed = [s for s in samples if s.status[2] == TaxelStatus.READ_FAILED]
    assert len(failed) == pytest.approx(57, abs=3)
    temperatures = {round(float(s.temperature_c[2]), 1) for s in failed}
    assert temperatures == {-998.1, 451.8}
    assert not any(s.status[[0, 1, 3, 4]].any() for s in samples)


def test_pause_loses_frames_and_is_counted() -> None:
    board = AnySkinBoard(build_skin("anyskin", 0))
    stream(board, 100)
    late = decode(board.tick(Instant(10_000 * MS)))
    assert len(late) == 32
    assert board.counters["overruns"] == pytest.approx(1150 - 12 - 32, abs=2)


def test_same_seed_same_bytes() -> None:
    def octets(seed: int) -> bytes:
        plan = FaultPlan.parse("seed=1,loss=0.05,flip=1e-5,failed=skin:0@0.2s")
        return stream(AnySkinBoard(build_skin("anyskin", seed), plan=plan), 800)

    assert octets(1) == octets(1)
    assert octets(1) != octets(2)


def test_wire_faults_are_counted_per_frame() -> None:
    board = AnySkinBoard(build_skin("anyskin", 0), plan=FaultPlan.parse("loss=0.1,duplicate=0.1"))
    data = stream(board, 4000)
    counters = board.counters
    assert len(data) == 82 * counters["intact"]
    assert counters["sent"] + counters["duplicated"] == counters["intact"] + counters["lost"]


def test_impossible_anyskin_boards_are_refused(flat_geometry) -> None:
    skin = SkinModel(flat_geometry((3, 7)), anyskin_parameters(), np.random.default_rng(0))
    with pytest.raises(ValueError, match="21 magnetometers: 1 to 20"):
        AnySkinBoard(skin)
    with pytest.raises(ValueError, match="reset"):
        AnySkinBoard(build_skin("anyskin", 0), plan=FaultPlan.parse("reset@1s"))
    with pytest.raises(ValueError, match="rates"):
        AnySkinBoard(build_skin("anyskin", 0), loop_rate=0.0)


def test_anyskin_board_ignores_input() -> None:
    board = AnySkinBoard(build_skin("anyskin", 0))
    board.receive(b"\x01\x02\x00", Instant(0))
    assert len(board.tick(Instant(0))) == 82
