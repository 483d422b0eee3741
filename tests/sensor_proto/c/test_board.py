"""board.h as seen by a host, in the board's own time: messages, refusals and counters."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import (
    Ack,
    AckResult,
    ClockPoll,
    ClockReply,
    Descriptor,
    Identify,
    Log,
    Message,
    Reboot,
    Samples,
    SetRate,
    Start,
    Status,
)
from tactile_core.types import Instant


class PollingHost:
    """A host that polls a board every half millisecond and keeps its messages."""

    def __init__(self, board: Any) -> None:
        self.board = board
        self.us = 1000
        self.decoder = SerialDecoder()
        self.heard: list[Message] = []

    def say(self, *messages: Message) -> None:
        self.board.receive(b"".join(map(encode_serial, messages)), Instant(0))

    def run(self, ms: float, step_us: int = 500) -> None:
        end = self.us + round(1000 * ms)
        while self.us < end:
            self.us += step_us
            data = self.board.tick(Instant(self.us * 1000))
            self.heard += [r.message for r in self.decoder.feed(data)]  # type: ignore[misc]

    def of(self, kind: type[Message]) -> list[Any]:
        return [m for m in self.heard if isinstance(m, kind)]


def test_blocked_line_drops_and_counts_oldest_cycles(c_board: Any) -> None:
    host = PollingHost(c_board)
    host.say(Start(1))
    host.run(500)
    c_board.room = 0
    host.run(1000)
    c_board.room = 1 << 16
    host.run(1500)
    got = [s.sequence for s in host.of(Samples)]
    assert got == sorted(set(got))
    missing = got[-1] + 1 - len(got)
    assert missing == c_board.counters["overruns"] == host.of(Status)[-1].overruns
    assert 95 <= missing <= 101
    # The newest samples were kept until the line was free again.
    gap = next(i for i, (a, b) in enumerate(pairwise(got)) if b > a + 1)
    assert got[gap + 1] >= 146


def test_slow_line_corrupts_nothing(c_board: Any) -> None:
    host = PollingHost(c_board)
    c_board.room = 3  # of 57 bytes every 10 ms: 6 kB/s of 6 kB/s
    host.say(Identify(1), Start(2))
    host.run(3000)
    counters = host.decoder.counters
    assert counters["accepted"] + counters["empty"] == sum(counters.values())
    got = [s.sequence for s in host.of(Samples)]
    assert got[-1] + 1 - len(got) <= c_board.counters["overruns"]
    assert len(got) > 200


def test_clock_reply_precedes_samples_and_has_its_send_time(
    c_board: Any,
) -> None:
    host = PollingHost(c_board)
    host.say(Start(1))
    host.run(200)
    c_board.room = 0
    host.run(20)
    asked = host.us
    host.say(ClockPoll(7))
    host.run(100)
    c_board.room = 1 << 16
    mark = len(host.heard)
    host.run(2)
    reply = host.heard[mark]
    assert isinstance(reply, ClockReply)
    assert reply.ticks_received == asked + 500
    assert asked + 100_000 <= reply.ticks_sent <= host.us


def test_ticks_wrap_and_periods_stay_exact(c_board: Any) -> None:
    host = PollingHost(c_board)
    host.us = (1 << 32) - 600_000
    host.run(1)
    host.say(SetRate(1, 33_333), Start(2))
    host.run(2000)
    ticks = [s.ticks for s in host.of(Samples)]
    steps = [(b - a) % (1 << 32) for a, b in pairwise(ticks)]
    assert min(ticks) < 1 << 20 < max(ticks)
    assert abs(sum(steps) / len(steps) - 1e9 / 33_333) < 20
    assert all(abs(step - 30_000) <= 1000 for step in steps)


def test_delayed_board_counts_missed_cycles(c_board: Any) -> None:
    host = PollingHost(c_board)
    host.say(Start(1))
    host.run(300)
    host.us += 250_000  # board_poll was not called
    host.run(1200)
    got = [s.sequence for s in host.of(Samples)]
    assert got[-1] + 1 - len(got) == c_board.counters["overruns"]
    assert 23 <= c_board.counters["overruns"] <= 26
    assert c_board.counters["cycles"] in (got[-1] + 1, got[-1] + 2)


def test_log_lines_are_cut_between_characters_and_losses_reported(c_board: Any) -> None:
    host = PollingHost(c_board)
    c_board.log(30, "ä" * 30)
    for _ in range(3):
        c_board.log(20, "too much")
    host.run(5)
    c_board.log(20, "bell\x07")
    host.run(5)
    assert [(m.level, m.text) for m in host.of(Log)] == [
        (30, "ä" * 16),
        (30, "3 log lines lost (9: or more)"),
        (20, "bell?"),
    ]


def test_dead_chip_is_flagged_counted_and_recovers(c_board: Any) -> None:
    host = PollingHost(c_board)
    host.say(Start(1))
    host.run(300)
    c_board.chip(2, dead=True)
    host.run(1000)
    assert [int(b) for b in host.of(Samples)[-1].status] == [0, 0, 4, 0, 0]
    c_board.chip(2, resets=True)
    host.run(1000)
    assert [int(b) for b in host.of(Samples)[-1].status] == [0] * 5
    assert 95 <= host.of(Status)[-1].chip_errors <= 110


def test_commands_after_reboot_are_busy_until_restart(c_board: Any) -> None:
    host = PollingHost(c_board)
    host.say(Start(1))
    host.run(300)
    host.say(Reboot(2), Start(3))
    host.run(1100)
    said = {a.request: a.result for a in host.of(Ack)}
    assert said[2] is AckResult.OK
    assert 3 not in said or said[3] is AckResult.BUSY
    assert c_board.counters["reboots"] == 1
    status = host.of(Status)[-1]
    assert (status.reset_cause, status.cycles, status.rate_mhz) == (1, 0, 0)


def test_excess_commands_are_refused_and_counted(c_board: Any) -> None:
    host = PollingHost(c_board)
    c_board.room = 0
    host.say(*(Start(n) for n in range(20)), *(ClockPoll(n) for n in range(20)))
    host.run(20)
    c_board.room = 1 << 16
    host.run(5)
    assert [a.request for a in host.of(Ack)] == [0, 1, 2, 3]
    assert [r.token for r in host.of(ClockReply)] == [0, 1, 2, 3]
    assert c_board.counters["rx_errors"] == 32
    host.say(Identify(1))
    host.run(5)
    assert host.of(Descriptor)


def test_boards_on_a_can_bus_answer_broadcast_identify(
    c_can_board: Callable[..., Any],
) -> None:
    from sensor_proto.can_transfers import BROADCAST, CanDecoder, CanEncoder

    boards = [c_can_board(3, False), c_can_board(4, True)]
    question = CanEncoder(BROADCAST, False).encode(Identify(1))
    found = set()
    for board in boards:
        decoder = CanDecoder()
        board.receive(question, Instant(0))
        found |= {r.board for r in decoder.feed(board.tick(Instant(2_000_000)))}
    assert found == {3, 4}
