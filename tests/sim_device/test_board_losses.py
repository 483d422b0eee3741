"""Slow hosts, slow lines and planned faults: a board counts everything that is lost."""

from __future__ import annotations

from itertools import pairwise

import pytest

from sensor_proto.packets import ClockPoll, Samples, Start, Status, TaxelStatus
from sim_device.board.firmware import CanBoard, SerialBoard
from sim_device.faults import FaultPlan


def test_planned_reset_is_reported_as_watchdog_reset(serial) -> None:
    host = serial(plan=FaultPlan.parse("reset@1s"))
    host.run(2300, {200: [Start(1)]})
    assert host.of(Status)[-1].reset_cause == 2
    assert host.board.counters["reset"] == 1
    assert host.sequences[-1] < 81


def test_unread_board_counts_its_overruns_exactly(serial) -> None:
    host = serial()
    host.run(1000, {200: [Start(1)]})
    before = len(host.sequences)
    host.now_ms = 3000
    host.run(3500)
    missing = [b - a - 1 for a, b in pairwise(host.sequences)]
    assert sum(missing) == host.board.counters["overruns"] > 150
    assert host.board.counters["cycles"] == len(host.sequences) + sum(missing)
    assert len([m for m in missing if m]) == 1
    assert before < len(host.sequences)


def test_slow_line_drops_the_oldest_samples(serial) -> None:
    # 16 taxels make about 145 bytes a sample: 100 Hz need 14.5 kB/s, and there are 5.
    host = serial(line_rate=5000.0)
    host.run(3000, {200: [Start(1)]})
    sent = sum(len(piece) for piece in host.raw)
    assert 4000 * 3 < sent < 5500 * 3
    assert host.sequences == sorted(host.sequences)
    lost = host.sequences[-1] + 1 - len(host.sequences)
    assert lost > 100
    assert host.board.counters["overruns"] >= lost


def test_broken_taxels_behave_as_planned(serial) -> None:
    host = serial(
        plan=FaultPlan.parse("stuck=pad:3@0.5s,saturated=pad:0@0.5s+0.2s,failed=pad:15@0.5s+0.1s")
    )
    host.run(1000, {200: [Start(1)]})
    samples = host.of(Samples)
    early, late = samples[:29], samples[31:]
    assert not any(m.status.any() for m in early)
    assert len({m.field[3].tobytes() for m in early}) > 20
    assert len({m.field[3].tobytes() for m in late}) == 1
    saturated = [m for m in samples if m.status[0] == TaxelStatus.SATURATED]
    failed = [m for m in samples if m.status[15] == TaxelStatus.READ_FAILED]
    assert all(m.field[0, 2] == 32767 for m in saturated)
    counters = host.board.counters
    assert counters["saturated"] == len(saturated) == pytest.approx(20, abs=1)
    assert counters["failed"] == len(failed) == counters["chip_errors"] == pytest.approx(10, abs=1)
    assert counters["stuck"] == pytest.approx(50, abs=1)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("stuck=left:0", "no array 'left'; allowed: 'pad'"),
        ("stuck=pad:16", "taxels 0 to 15"),
        ("busoff@1s+1s", "busoff is a fault of CAN"),
    ],
)
def test_plans_that_do_not_fit_the_board_are_refused(serial, spec: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        serial(plan=FaultPlan.parse(spec))


def test_every_lost_sample_is_accounted_for(serial) -> None:
    spec = "seed=3,flip=2e-5,loss=0.02,duplicate=0.02,splice=0.01,byteloss=1e-5,silence@3s+0.5s"
    host = serial(plan=FaultPlan.parse(spec))
    host.run(6000, {200: [Start(1)]})
    counters = host.board.counters
    assert counters["intact"] == host.decoder.counters["accepted"]
    assert counters["sent"] + counters["duplicated"] == sum(
        counters[name] for name in ("intact", "damaged", "lost", "silenced", "held")
    )
    assert counters["silenced"] >= 50
    assert host.decoder.counters["crc"] > 0


@pytest.mark.parametrize("fd", [False, True])
def test_same_seed_same_bytes(real_skin, identity, host, fd: bool) -> None:
    plan = FaultPlan.parse("seed=5,flip=1e-5,loss=0.01,duplicate=0.01")
    commands = {200: [Start(1)], 300: [ClockPoll(2)]}

    def stream(seed: int) -> list[object]:
        one = host(CanBoard(real_skin(seed), identity, fd=fd, plan=plan), fd)
        one.run(600, commands)
        return one.raw

    def octets(seed: int) -> bytes:
        one = host(SerialBoard(real_skin(seed), identity, plan=plan))
        one.run(600, commands)
        return b"".join(one.raw)

    assert stream(1) == stream(1)
    assert octets(1) == octets(1)
    assert octets(1) != octets(2)
