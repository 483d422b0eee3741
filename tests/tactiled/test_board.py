"""The link of one board, with a scripted board in lockstep on virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from sensor_proto.packets import (
    Ack,
    AckResult,
    Descriptor,
    Identify,
    Log,
    SetRate,
    Start,
    Stop,
)
from tactile_core.types import NS_PER_S, Instant
from tactiled.boards.board import BoardLink, State
from tactiled.boards.events import (
    Answered,
    BoardLog,
    FellSilent,
    Identified,
    Identity,
    Refusal,
    Refused,
    Reset,
    Resumed,
    Sampled,
    Streaming,
)

STEP = 0.001


@dataclass
class Rig:
    """Link and board connected without delay; messages of the host may be lost."""

    link: BoardLink
    board: Any
    at: Callable[[float], Instant]
    now: float = 0.0
    lose: Iterator[bool] | None = None
    events: list[tuple[float, Any]] = field(default_factory=list)

    def run(self, seconds: float) -> list[Any]:
        first = len(self.events)
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            self.step()
        return [event for _, event in self.events[first:]]

    def step(self) -> None:
        now = self.at(self.now)
        out = list(self.board.speak(self.now))
        happened = self.link.tick(now)
        for message in self.link.outgoing():
            if self.lose is None or not next(self.lose):
                out += self.board.hear(message, self.now)
        for message in out:
            happened += self.link.receive(message, now)
        self.events += [(self.now, event) for event in happened]

    def of(self, kind: type) -> list[Any]:
        return [event for _, event in self.events if isinstance(event, kind)]


@pytest.fixture
def rig(board: Any, instant: Callable[[float], Instant]) -> Rig:
    link = BoardLink(lambda identity: None)
    link.connect(instant(0.0))
    return Rig(link, board, instant)


def test_board_is_identified_started_and_streams(rig: Rig) -> None:
    rig.run(1.0)
    assert rig.link.state is State.STREAMING
    identity = rig.of(Identified)[0].identity
    assert (identity.serial_number, identity.model) == ("00000000000000aa", "pad")
    assert identity.shapes == ((2, 2), (1, 3))
    assert rig.of(Streaming) == [Streaming(None)]
    blocks = [e.block for e in rig.of(Sampled)]
    assert len(blocks) >= 190
    np.testing.assert_allclose(blocks[0].field_ut[0], [15.0, -30.0, 72.6])
    assert blocks[0].temperature_c == pytest.approx([25.12])


def test_stamps_are_host_time_within_uncertainty(
    make_board: Callable[..., Any], instant: Callable[[float], Instant]
) -> None:
    link = BoardLink(lambda identity: None)
    rig = Rig(link, make_board(error=0.04), instant)
    link.connect(instant(0.0))
    rig.run(5.0)
    for when, event in rig.events[-50:]:
        if isinstance(event, Sampled):
            age = abs(event.block.captured - instant(when)) / NS_PER_S
            assert age <= event.block.uncertainty + STEP
            assert event.block.uncertainty < 0.01


def test_lost_commands_are_repeated_until_answered(rig: Rig) -> None:
    rng = np.random.default_rng(5)
    rig.lose = iter(lambda: bool(rng.random() < 0.5), None)
    rig.run(6.0)
    assert rig.link.state is State.STREAMING


def test_deaf_board_is_polled_ever_more_slowly(rig: Rig) -> None:
    rig.board.mute = True
    rig.run(10.0)
    asked = [m for m in rig.board.heard if isinstance(m, Identify)]
    assert 10 <= len(asked) <= 15
    assert not rig.of(Sampled)


def test_rate_is_set_before_streaming_starts(
    make_board: Callable[..., Any], instant: Callable[[float], Instant]
) -> None:
    link = BoardLink(lambda identity: None, rate=25.0)
    rig = Rig(link, make_board(), instant)
    link.connect(instant(0.0))
    rig.run(1.0)
    said = [type(m) for m in rig.board.heard if isinstance(m, SetRate | Start)]
    assert said == [SetRate, Start]
    assert rig.board.rate_mhz == 25_000
    assert rig.of(Streaming) == [Streaming(25.0)]


def test_rate_above_the_board_maximum_is_refused(
    board: Any, instant: Callable[[float], Instant]
) -> None:
    link = BoardLink(lambda identity: None, rate=600.0)
    rig = Rig(link, board, instant)
    link.connect(instant(0.0))
    rig.run(3.0)
    (refused,) = rig.of(Refused)
    assert "493" in refused.refusal.problem
    assert "600" in refused.refusal.problem
    assert not board.streaming


def test_other_major_version_is_refused_by_name(rig: Rig, descriptor: Descriptor) -> None:
    rig.board.descriptor = replace(descriptor, major=2)
    rig.run(3.0)
    (refused,) = rig.of(Refused)
    assert "2.0" in refused.refusal.problem
    assert "1.0" in refused.refusal.problem
    assert rig.link.state is State.REFUSED


def test_rejected_board_is_refused_until_admitted(
    board: Any, instant: Callable[[float], Instant]
) -> None:
    seen: list[Identity] = []
    verdicts: list[Refusal | None] = [Refusal("no calibration", "give one")]

    def admit(identity: Identity) -> Refusal | None:
        seen.append(identity)
        return verdicts[0]

    link = BoardLink(admit)
    rig = Rig(link, board, instant)
    link.connect(instant(0.0))
    rig.run(5.0)
    assert len(rig.of(Refused)) == 1
    assert not rig.of(Sampled)
    assert len(seen) >= 2
    verdicts[0] = None
    rig.run(3.0)
    assert rig.link.state is State.STREAMING


def test_other_board_on_the_same_port_is_refused_naming_both(
    rig: Rig, make_board: Callable[..., Any]
) -> None:
    first = rig.board
    rig.run(1.0)
    rig.link.disconnect()
    rig.board = make_board("00000000000000bb")
    rig.board.streaming = True
    rig.link.connect(rig.at(rig.now))
    events = rig.run(3.0)
    (refused,) = [e for e in events if isinstance(e, Refused)]
    assert "00000000000000aa" in refused.refusal.problem
    assert "00000000000000bb" in refused.refusal.problem
    assert not [e for e in events if isinstance(e, Sampled)]
    rig.board = first
    events = rig.run(3.0)
    assert [e for e in events if isinstance(e, Sampled)]


def test_silence_and_its_end_are_reported(rig: Rig) -> None:
    rig.run(2.0)
    rig.board.mute = True
    events = rig.run(0.5)
    assert [type(e) for e in events if not isinstance(e, Sampled)] == [FellSilent]
    rig.board.mute = False
    events = rig.run(0.5)
    resumed = [e for e in events if isinstance(e, Resumed)]
    assert len(resumed) == 1
    assert resumed[0].seconds >= 0.4
    assert not [e for e in events if isinstance(e, Identified)]


def test_after_long_silence_nothing_is_used_until_board_identifies(
    rig: Rig, make_board: Callable[..., Any]
) -> None:
    rig.run(2.0)
    rig.board.mute = True
    rig.run(1.5)
    assert rig.link.state is State.IDENTIFYING
    rig.board = make_board("00000000000000cc")
    rig.board.streaming = True
    events = rig.run(2.0)
    assert not [e for e in events if isinstance(e, Sampled)]
    assert [e for e in events if isinstance(e, Refused)]


def test_rebooted_board_streams_again_within_a_second(rig: Rig) -> None:
    rig.run(3.0)
    rig.board.reboot(rig.now)
    events = rig.run(1.0)
    assert [e for e in events if isinstance(e, Reset)]
    blocks = [e.block for e in events if isinstance(e, Sampled)]
    assert blocks
    assert rig.link.clock is not None
    rig.run(1.0)
    last = rig.of(Sampled)[-1].block
    assert abs(last.captured - rig.at(rig.now)) / NS_PER_S <= last.uncertainty + 0.011
    assert sum(a.tracker.missing for a in rig.link.arrays.values()) == 0


def test_stamps_stay_monotonic_through_a_reboot(rig: Rig) -> None:
    rig.run(2.0)
    rig.board.reboot(rig.now)
    rig.run(2.0)
    for array in (0, 1):
        captured = [e.block.captured for e in rig.of(Sampled) if e.block.array == array]
        assert captured == sorted(captured)


def test_reboot_while_streaming_is_detected_by_uptime_or_sequence(rig: Rig) -> None:
    rig.run(3.0)
    rig.board.reboot(rig.now)
    rig.board.streaming = True
    events = rig.run(1.5)
    assert [e for e in events if isinstance(e, Reset)]
    assert rig.link.state is State.STREAMING


def test_external_commands_are_answered(rig: Rig) -> None:
    rig.run(1.0)
    number = rig.link.request(lambda n: SetRate(n, 50_000), rig.at(rig.now))
    rig.run(0.5)
    assert rig.of(Answered) == [Answered(number, Ack(0x84, number, AckResult.OK))]
    assert rig.link.rate == 50.0


def test_unanswered_commands_time_out(rig: Rig) -> None:
    rig.run(1.0)
    rig.board.deaf = True
    number = rig.link.request(lambda n: SetRate(n, 50_000), rig.at(rig.now))
    rig.run(2.0)
    assert rig.of(Answered) == [Answered(number, None)]
    rig.link.request(lambda n: SetRate(n, 50_000), rig.at(rig.now))
    events = rig.link.disconnect()
    assert [type(e) for e in events] == [Answered]


def test_commands_to_an_unavailable_board_are_refused(rig: Rig) -> None:
    with pytest.raises(ValueError, match="not in service"):
        rig.link.request(Start, rig.at(0.0))


def test_board_refusing_the_rate_is_refused(
    make_board: Callable[..., Any], instant: Callable[[float], Instant]
) -> None:
    board = make_board(results={SetRate: AckResult.BAD_ARGUMENT})
    link = BoardLink(lambda identity: None, rate=7.0)
    rig = Rig(link, board, instant)
    link.connect(instant(0.0))
    rig.run(3.0)
    (refused,) = rig.of(Refused)
    assert "SetRate" in refused.refusal.problem


def test_closing_the_link_stops_the_board(rig: Rig) -> None:
    rig.run(1.0)
    rig.link.stop_streaming()
    rig.run(0.01)
    assert any(isinstance(m, Stop) for m in rig.board.heard)
    assert not rig.board.streaming


def test_firmware_text_is_passed_on(rig: Rig) -> None:
    rig.run(1.0)
    (event,) = rig.link.receive(Log(30, rig.board.ticks(rig.now), "hot"), rig.at(rig.now))
    assert isinstance(event, BoardLog)
    assert (event.level, event.text) == (30, "hot")


def test_samples_of_wrong_shape_are_counted_not_used(rig: Rig) -> None:
    rig.run(1.0)
    odd = replace(rig.board.sample(0, rig.now), array=7)
    assert rig.link.receive(odd, rig.at(rig.now)) == []
    short = rig.board.sample(0, rig.now)
    short = replace(short, field=short.field[:2], status=short.status[:2])
    assert rig.link.receive(short, rig.at(rig.now)) == []
    assert rig.link.counters["wrong_shape"] == 2
