"""Lines on virtual time: detection of kinds, diagnosis, and several boards on a bus."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sensor_proto.anyskin import encode_anyskin
from sensor_proto.can_transfers import CanDecoder, CanEncoder, CanFrame
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import FloatSamples, Identify
from tactile_core.types import Instant
from tactiled.blocks import Chunk
from tactiled.boards.board import BoardLink
from tactiled.boards.events import Diagnosed, Found, Identified, Identity, Refusal, Refused, Sampled
from tactiled.boards.float_board import FloatLink
from tactiled.boards.line import CanLine, LineEvent, SerialLine

At = Callable[[float], Instant]


def admit_all(node: int, identity: Identity) -> Refusal | None:
    return None


def of(events: list[LineEvent], kind: type) -> list[Any]:
    return [e.event for e in events if isinstance(e.event, kind)]


def serve(line: SerialLine, board: Any, at: At, seconds: float, start: float = 0.0) -> list[Any]:
    """Run line and scripted board in steps of 1 ms; the board gets decoded messages."""
    decoder, events = SerialDecoder(), []
    for step in range(round(seconds * 1000)):
        now = start + step / 1000
        events += line.tick(at(now))
        answers = []
        for payload in line.outgoing():
            assert isinstance(payload, bytes)
            for received in decoder.feed(payload):
                answers += board.hear(received.message, now)
        data = b"".join(encode_serial(m) for m in [*answers, *board.speak(now)])
        if data:
            events += line.receive(Chunk(at(now), data))
    return events


def floats(value: float, n: int = 5) -> bytes:
    field = np.full((n, 3), value, np.float32)
    return encode_anyskin(FloatSamples(field, np.full(n, 25.0, np.float32), np.zeros(n, np.uint8)))


def feed(line: SerialLine, at: At, seconds: float, data: Callable[[int], bytes]) -> list[Any]:
    events = []
    for step in range(round(seconds * 100)):
        now = at(step / 100)
        events += line.tick(now)
        line.outgoing()
        chunk = data(step)
        if chunk:
            events += line.receive(Chunk(now, chunk))
    return events


def test_own_protocol_board_is_found_by_its_answer(board: Any, instant: At) -> None:
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0))
    events = serve(line, board, instant, 1.0)
    assert isinstance(line.links[0], BoardLink)
    assert of(events, Identified)[0].identity.model == "pad"
    assert len(of(events, Sampled)) > 100


def test_float_board_is_found_by_its_frames(instant: At) -> None:
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0), usb_serial="USB7")
    events = feed(line, instant, 2.0, lambda k: floats(100.0 + k))
    assert isinstance(line.links[0], FloatLink)
    identity = of(events, Identified)[0].identity
    assert (identity.model, identity.serial_number) == ("anyskin", "USB7")
    assert identity.shapes == ((1, 5),)
    blocks = [e.block for e in of(events, Sampled)]
    assert [b.sequence for b in blocks] == list(range(len(blocks)))
    assert len(blocks) > 180


def test_bytes_buffered_before_opening_are_not_taken_as_new(instant: At) -> None:
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0))
    old = b"".join(floats(-1.0) for _ in range(100))
    events = feed(line, instant, 2.0, lambda k: old if k == 0 else floats(1.0))
    blocks = [e.block for e in of(events, Sampled)]
    assert all(b.field_ut[0, 0] == 1.0 for b in blocks)
    assert len(blocks) > 150


def test_configured_kind_is_not_second_guessed(instant: At) -> None:
    line = SerialLine("p", admit_all, kind="tactile")
    line.connect(instant(0.0))
    events = feed(line, instant, 4.0, lambda k: floats(100.0 + k))
    (diagnosed,) = of(events, Diagnosed)
    assert "--kind" in diagnosed.remedy
    with pytest.raises(ValueError, match="anyskin"):
        SerialLine("p", admit_all, kind="skin")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (lambda k: b"\0" * 500, "zeros"),
        (lambda k: b"temperature: 21.5 C\r\n", "temperature: 21.5 C"),
        (lambda k: np.random.default_rng(k).integers(1, 256, 80, np.uint8).tobytes(), "baud"),
        (lambda k: b"", "silent"),
    ],
)
def test_port_without_a_board_is_diagnosed_once(
    instant: At, data: Callable[[int], bytes], said: str
) -> None:
    line = SerialLine("/dev/ttyX", admit_all)
    line.connect(instant(0.0), byte_time=1e-4)
    events = feed(line, instant, 6.0, data)
    (diagnosed,) = of(events, Diagnosed)
    assert "/dev/ttyX" in diagnosed.problem
    assert said in diagnosed.problem + diagnosed.remedy
    assert not of(events, Sampled)


def test_board_that_does_not_receive_is_diagnosed(board: Any, instant: At) -> None:
    board.deaf, board.streaming = True, True
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0))
    events = serve(line, board, instant, 4.0)
    (diagnosed,) = of(events, Diagnosed)
    assert "did not answer Identify" in diagnosed.problem


def test_wire_time_of_trailing_bytes_is_subtracted(board: Any, instant: At) -> None:
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0), byte_time=1e-4)
    serve(line, board, instant, 1.0)
    line.tick(instant(1.0))
    frame = encode_serial(board.sample(0, 1.0))
    tail = encode_serial(board.sample(1, 1.0))
    events = line.receive(Chunk(instant(1.1), frame + tail))
    received = [e.block.received for e in of(events, Sampled)]
    assert received == [instant(1.1 - len(tail) * 1e-4), instant(1.1)]


def test_replugged_board_continues_where_it_stopped(board: Any, instant: At) -> None:
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0))
    serve(line, board, instant, 1.0)
    line.disconnect()
    assert line.tick(instant(1.5)) == []
    board.reboot(2.0)
    line.connect(instant(2.0))
    events = serve(line, board, instant, 1.0, start=2.0)
    assert of(events, Identified)
    assert len(of(events, Sampled)) > 100


class Bus:
    """Scripted boards on a CAN bus, each with a real board's codec."""

    def __init__(self, line: CanLine, boards: dict[int, Any], at: At) -> None:
        self.line, self.boards, self.at = line, boards, at
        self.decoder = CanDecoder()
        self.encoders = {node: CanEncoder(node, False) for node in boards}
        self.questions = 0

    def run(self, start: float, seconds: float) -> list[LineEvent]:
        events: list[LineEvent] = []
        for step in range(round(seconds * 1000)):
            now = start + step / 1000
            events += self.line.tick(self.at(now))
            frames: list[CanFrame] = []
            for payload in self.line.outgoing():
                assert not isinstance(payload, bytes)
                for received in self.decoder.feed(payload):
                    everyone = received.board == 127
                    self.questions += everyone and isinstance(received.message, Identify)
                    for node, board in self.boards.items():
                        if everyone or node == received.board:
                            frames += self.say(node, board.hear(received.message, now))
            for node, board in self.boards.items():
                frames += self.say(node, board.speak(now))
            if frames:
                events += self.line.receive(Chunk(self.at(now), tuple(frames)))
        return events

    def say(self, node: int, messages: list[Any]) -> list[CanFrame]:
        return [frame for m in messages for frame in self.encoders[node].encode(m)]


def test_boards_on_a_bus_are_discovered_then_served_separately(
    make_board: Callable[..., Any], instant: At
) -> None:
    boards = {3: make_board("00000000000000a3"), 5: make_board("00000000000000a5")}
    line = CanLine("can", admit_all)
    bus = Bus(line, boards, instant)
    line.connect(instant(0.0))
    events = bus.run(0.0, 2.0)
    assert of(events, Found) == [Found((3, 5), late=False)]
    for node, board in boards.items():
        mine = [e for e in events if e.node == node]
        assert of(mine, Identified)[0].identity.serial_number == board.descriptor.serial_number
        assert len(of(mine, Sampled)) > 200
    found = next(i for i, e in enumerate(events) if isinstance(e.event, Found))
    assert all(e.node is None for e in events[: found + 1])
    assert 2 <= bus.questions <= 5


def test_late_board_is_found_by_its_status(make_board: Callable[..., Any], instant: At) -> None:
    line = CanLine("can", admit_all)
    bus = Bus(line, {3: make_board("00000000000000a3")}, instant)
    line.connect(instant(0.0))
    bus.run(0.0, 2.0)
    bus.boards[9] = make_board("00000000000000a9")
    bus.encoders[9] = CanEncoder(9, False)
    events = bus.run(2.0, 2.0)
    assert of(events, Found) == [Found((9,), late=True)]
    assert of([e for e in events if e.node == 9], Sampled)
    assert not of(events, Refused)


def test_unrequested_boards_are_counted_not_used(
    make_board: Callable[..., Any], instant: At
) -> None:
    line = CanLine("can", admit_all, nodes=frozenset({3}))
    boards = {3: make_board("00000000000000a3"), 5: make_board("00000000000000a5")}
    bus = Bus(line, boards, instant)
    line.connect(instant(0.0))
    bus.run(0.0, 2.0)
    assert set(line.links) == {3}
    assert line.rejects["strangers"] > 0


def test_bus_without_boards_is_diagnosed(instant: At) -> None:
    line = CanLine("can", admit_all)
    bus = Bus(line, {}, instant)
    line.connect(instant(0.0))
    (diagnosed,) = of(bus.run(0.0, 6.0), Diagnosed)
    assert "silent" in diagnosed.problem
    other = CanLine("can", admit_all)
    other.connect(instant(0.0))
    other.receive(Chunk(instant(0.0), (CanFrame(0x123, b"hello"),)))
    events: list[LineEvent] = []
    for step in range(60):
        events += other.tick(instant(step / 10))
    (diagnosed,) = of(events, Diagnosed)
    assert "no taxel board" in diagnosed.problem


def test_recording_needs_no_answers(
    board: Any, instant: At, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = SerialLine("p", admit_all)
    live.connect(instant(0.0))
    tape: list[Chunk] = []
    take = live.receive

    def record(chunk: Chunk) -> list[LineEvent]:
        tape.append(chunk)
        return take(chunk)

    monkeypatch.setattr(live, "receive", record)
    heard = of(serve(live, board, instant, 2.0), Sampled)
    again = SerialLine("p", admit_all, listen_only=True)
    again.connect(instant(0.0))
    events: list[LineEvent] = []
    for chunk in tape:
        events += again.receive(chunk)
        events += again.tick(chunk.received)
        assert not again.outgoing()
    blocks = [e.block for e in of(events, Sampled)]
    assert [(b.array, b.sequence) for b in blocks] == [
        (e.block.array, e.block.sequence) for e in heard
    ]
    assert of(events, Identified)


def test_other_protocol_versions_are_refused_on_a_line(board: Any, instant: At) -> None:
    board.descriptor = replace(board.descriptor, major=3)
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0))
    events = serve(line, board, instant, 4.0)
    assert "3.0" in of(events, Refused)[0].refusal.problem
    assert not of(events, Diagnosed)


def test_temporarily_quiet_board_is_not_called_deaf(board: Any, instant: At) -> None:
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0))
    serve(line, board, instant, 5.0)
    board.mute = True
    events = serve(line, board, instant, 2.0, start=5.0)
    board.mute = False
    events += serve(line, board, instant, 1.0, start=7.0)
    assert not of(events, Diagnosed)
    assert of(events, Sampled)
    board.mute = True
    (diagnosed,) = of(serve(line, board, instant, 8.0, start=8.0), Diagnosed)
    assert "silent" in diagnosed.problem
