"""A board that sends arbitrary messages: each costs at most itself, and is counted (rows 42, 44).

Every frame has a correct CRC, so all of them reach link, pipeline and log. Time is virtual.
"""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import (
    Ack,
    AckResult,
    ArrayDescriptor,
    ChipType,
    ClockPoll,
    ClockReply,
    Descriptor,
    Identify,
    Log,
    Samples,
    SetRate,
    Start,
    Status,
)
from tactile_core.bus.messages import MAX_PAYLOAD, codec, log_message
from tactile_core.bus.topics import CONTACTS, FEATURES, FORCES, GEOMETRY, LOG, Topic
from tactile_core.geometry import Side
from tactile_core.log.info import info
from tactile_core.log.reader import read_messages
from tactile_core.log.recorder import Recorder, RecorderSettings
from tactile_core.throttle import Throttle
from tactile_core.types import NS_PER_S, Instant, WallClock, after
from tactiled.blocks import Chunk, Patch
from tactiled.board_session import FIRMWARE_BURST, SET_UP_BURST, BoardSession
from tactiled.boards.events import BoardLog
from tactiled.boards.line import SerialLine
from tactiled.calibration_store import CalibrationStore
from tactiled.journal import Journal
from tactiled.port import Port
from tactiled.publisher import MAX_PATCHES, MessageMaker
from tactiled.reader import Inbox, Wake
from tactiled.rerun import RecordedSource
from tactiled.sensing.pipeline import BoardPipeline
from tactiled.sensing.settings import PipelineSettings
from tactiled.skin_picture import SkinPicture
from tactiled.transports import Medium
from tactiled.transports.base import READ_LIMIT

TICK_HZ = 1_000_000
ITEMS = int(os.environ.get("HOSTILE_ITEMS", "20000"))


def array(number: int, rows: int = 2, columns: int = 2) -> ArrayDescriptor:
    return ArrayDescriptor(number, f"a{number}", ChipType.MLX90393, rows, columns, 8000, 150, 242)


BOARD = Descriptor(1, 0, bytes(7) + b"\xaa", "pad", "1", TICK_HZ, 493_000, (array(0), array(1)))


class MemorySink:
    """Sink without a bus: encodes messages, keeps them by topic, and logs them."""

    def __init__(self, recorder: Recorder | None = None) -> None:
        self.wall = WallClock(1_700_000_000 * NS_PER_S)
        self.recorder = recorder
        self.at = Instant(1000 * NS_PER_S)
        self.sent: Counter[str] = Counter()
        self.last: dict[str, list[bytes]] = {}
        self.texts: list[str] = []

    def now(self) -> Instant:
        return self.at

    def send(self, topic: Topic, name: str, message: Any, stamp_ns: int) -> None:
        data = codec().encode(topic, message)
        assert len(data) <= MAX_PAYLOAD
        kind = topic.template.rpartition("/")[2]
        self.sent[kind] += 1
        self.last[kind] = [*self.last.get(kind, [])[-20:], data]
        if self.recorder is not None:
            self.recorder.write(topic, name, data, self.wall.wall_ns(self.at), stamp_ns)

    def announce(self, name: str, level: int, text: str, at: Instant | None = None) -> None:
        self.texts.append(text)
        self.firmware_text(name, level, "tactiled", text, at)

    def firmware_text(
        self, name: str, level: int, speaker: str, text: str, at: Instant | None = None
    ) -> None:
        stamp_ns = self.wall.wall_ns(self.at if at is None else at)
        self.send(LOG, name, log_message(stamp_ns, level, speaker, text), stamp_ns)


class CapturingSource(RecordedSource):
    """Keeps the host's messages to the board."""

    def __init__(self) -> None:
        super().__init__("p", Medium.SERIAL)
        self.heard: list[Any] = []
        self._decoder = SerialDecoder()

    def write(self, data: Any) -> None:
        self.heard += [each.message for each in self._decoder.feed(data)]


class Rig:
    """A board on a line with its port and session, on virtual time."""

    def __init__(
        self, descriptor: Descriptor = BOARD, recorder: Recorder | None = None, settle: bool = True
    ) -> None:
        self.descriptor = descriptor
        self.sink = MemorySink(recorder)
        self.sequence = 0
        self._second = self.sink.at
        store = CalibrationStore((), strict=False)
        line = SerialLine("p", lambda node, identity: self.port.admit(node, identity))
        self.inbox = Inbox(Wake(), limit=100_000)
        self.source = CapturingSource()
        self.port = Port(
            "p", line, self.source, self.inbox, lambda nodes, late: {},
            lambda port, node, name: BoardSession(name, self.sink, store, PipelineSettings()),
            True, Journal(self.sink, "b0", "p"),
        )  # fmt: skip
        self.port.add_board(0, "b0")
        self.session = self.port.boards[0]
        line.connect(self.sink.at)
        if settle:
            for _ in range(120):  # identified, tared
                self.cycle()
            assert self.session.features is not None
            assert self.session.features.valid, self.session.features.reasons

    def ticks(self) -> int:
        return self.sink.at * TICK_HZ // NS_PER_S % (1 << 32)

    def send(self, *messages: Any, seconds: float = 0.0) -> None:
        """Process messages from the board."""
        self.sink.at = after(self.sink.at, seconds)
        data = b"".join(m if isinstance(m, bytes) else encode_serial(m) for m in messages)
        for at in range(0, len(data), READ_LIMIT):
            self.inbox.put(Chunk(self.sink.at, data[at : at + READ_LIMIT]))
        while True:
            self.port.pump(self.sink.at)
            if not self.port.behind:
                break
        if self.sink.at >= self._second:
            self._second = after(self.sink.at, 1.0)
            self.session.each_second(self.sink.at)

    def cycle(self, press: float = 0.0, seconds: float = 0.01) -> None:
        """One sampling cycle, and answers to the host; ``press``: counts along z."""
        self.sink.at = after(self.sink.at, seconds)
        answers: list[Any] = []
        for data in self._host_messages():
            answers.append(data)
        rng = np.random.default_rng(self.sequence)
        for a in self.descriptor.arrays:
            field = rng.normal(0, 20, (a.taxels, 3)).round()
            field += np.arange(a.taxels * 3).reshape(-1, 3) * 7 + 100
            checker = np.indices((a.rows, a.columns)).sum(0).ravel() % 2
            field[:, 2] += press * checker
            zeros = np.zeros(a.taxels, np.uint8)
            field = field.astype(np.int16)
            answers.append(Samples(a.array, self.sequence, self.ticks(), 2500, field, zeros))
        self.sequence = (self.sequence + 1) % (1 << 32)
        self.send(*answers)

    def _host_messages(self) -> list[Any]:
        said: list[Any] = []
        heard, self.source.heard = self.source.heard, []
        for message in heard:
            match message:
                case Identify():
                    said.append(self.descriptor)
                case ClockPoll():
                    said.append(ClockReply(message.token, self.ticks(), self.ticks()))
                case Start():
                    said.append(Ack(0x82, message.request, AckResult.OK))
                case SetRate():
                    said.append(Ack(0x84, message.request, AckResult.OK))
        return said


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Recorder]:
    made = Recorder(tmp_path / "a.mcap", RecorderSettings(min_free_bytes=0))
    yield made
    made.close(60)


def hostile_item(rng: random.Random, rig: Rig) -> Any:
    """A random item: any message with a correct CRC, or bytes that are not a frame."""
    ticks = rng.choice((0, 1, 2**31, 2**32 - 1, rng.randrange(2**32), rig.ticks()))
    kind = rng.randrange(9)
    if kind == 0:
        return Log(rng.randrange(256), ticks, rng.choice(("", "x" * 200, "grüße", "[red]")))
    if kind == 1:
        return replace(BOARD, unique_id=rng.randbytes(8), major=rng.choice((0, 1, 1, 1, 9)))
    if kind == 2:
        shape = rng.choice(((1, 1), (8, 16), (2, 2)))
        arrays = tuple(array(n, *shape) for n in range(rng.randrange(1, 17)))
        return replace(BOARD, arrays=arrays, tick_hz=rng.choice((1, 10**6, 2**32 - 1)))
    if kind == 3:
        return Status(rng.randrange(2**64), ticks, ticks, ticks, ticks, ticks, rng.randrange(256))
    if kind == 4:
        return ClockReply(rng.randrange(300), ticks, rng.randrange(2**32))
    if kind == 5:
        return Ack(rng.randrange(256), rng.randrange(400), rng.choice(list(AckResult)))
    if kind == 6:
        return rng.randbytes(rng.randrange(1, 200))
    if kind == 7:
        return BOARD
    n = rng.choice((1, 4, 4, 128))
    field = np.full((n, 3), rng.choice((-32768, 0, 32767)), np.int16)
    status = np.full(n, rng.randrange(256), np.uint8)
    sequence = rng.choice((rig.sequence, rng.randrange(2**32)))
    return Samples(rng.randrange(4), sequence, ticks, rng.randrange(-32768, 32767), field, status)


def test_pipeline_and_log_survive_many_hostile_items(
    tmp_path: Path, recorder: Recorder, caplog: pytest.LogCaptureFixture
) -> None:
    rng = random.Random(42)
    rig = Rig(recorder=recorder)
    items = [hostile_item(rng, rig) for _ in range(3000)]
    frames = [item if isinstance(item, bytes) else encode_serial(item) for item in items]
    for k in range(ITEMS // 50):
        rig.send(*rng.choices(frames, k=50), seconds=rng.choice((0.0, 0.01, 0.3)))
        if k % 40 == 0:
            rig.cycle()
    rig.send(b"\0", seconds=60.0)
    before = rig.session.sent
    for _ in range(600):  # a normal board again
        rig.cycle()
    assert rig.session.sent > before + 300
    assert rig.session.features is not None
    assert rig.session.features.valid, rig.session.features.reasons
    drops = rig.session.drops() | rig.port.drops()
    # All losses are of known kinds: there was no unexpected error.
    lost = {reason for reason, n in drops.items() if n}
    assert not {reason for reason in lost if reason.startswith(("unsent", "spoilt"))}, drops
    assert drops["texts_held_back"] > ITEMS // 100
    assert not [r for r in caplog.records if r.exc_info]
    assert recorder.close(60)
    assert recorder.trouble is None
    told = info(tmp_path / "a.mcap")
    assert told.whole
    counts = {c.topic: c.messages for c in told.channels}
    assert counts["/tactile/b0/features"] == rig.sink.sent["features"]
    # A flood cannot fill a disk: some 4,000 s at the rates of the limits.
    seconds = (rig.sink.at - 1000 * NS_PER_S) / NS_PER_S
    assert counts["/tactile/b0/log"] < 200 + 12 * seconds
    assert (tmp_path / "a.mcap").stat().st_size < 30_000_000


def largest() -> Descriptor:
    return replace(BOARD, arrays=tuple(array(n, 8, 16) for n in range(16)))


@pytest.mark.parametrize("count", [12, 16])
def test_largest_boards_work_with_every_other_taxel_pressed(
    count: int, recorder: Recorder, tmp_path: Path
) -> None:
    rig = Rig(replace(BOARD, arrays=largest().arrays[:count]), recorder)
    for _ in range(15):
        rig.cycle(press=8000.0)
    features = codec().decode(FEATURES, rig.sink.last["features"][-1])
    assert features.taxels_in_contact == count * 64
    assert 1 <= len(features.patches) <= MAX_PATCHES
    assert len(codec().decode(FORCES, rig.sink.last["forces"][-1]).force) == count * 128 * 3
    geometry = codec().decode(GEOMETRY, rig.sink.last["geometry"][-1])
    assert len(geometry.position) == len(geometry.normal) == count * 128 * 3
    # The unrolled skin, which is for pictures only, is left out when it does not fit.
    assert len(geometry.surface) == (0 if count == 16 else count * 128 * 2)
    assert any("unrolled skin" in text for text in rig.sink.texts) == (count == 16)
    parts = [codec().decode(CONTACTS, data).markers for data in rig.sink.last["contacts"]]
    starts = [i for i, part in enumerate(parts) if part[0].action == 3]
    whole = [marker for part in parts[starts[-2] : starts[-1]] for marker in part]
    assert sum(len(m.points) for m in whole if m.ns == "taxels") == count * 128
    drops = rig.session.drops()
    assert not {reason: n for reason, n in drops.items() if n and reason != "patches_cut"}
    assert recorder.close(60)
    assert info(tmp_path / "a.mcap").whole


def test_excess_patches_are_cut_to_the_strongest_and_counted() -> None:
    rig = Rig()
    maker = rig.session._maker
    cycle = rig.session.last
    assert maker is not None
    assert cycle is not None
    zero = np.zeros(3)
    patches = tuple(
        Patch(0, Side.TIP, 1, float(n), float(n), zero, zero, zero) for n in range(1024)
    )
    features = replace(cycle.features, patches=patches)
    message = maker.features(replace(cycle, features=features))
    assert len(codec().encode(FEATURES, message)) < MAX_PAYLOAD
    forces = [patch.normal_force for patch in message.patches]
    assert forces == [float(n) for n in range(1024 - MAX_PATCHES, 1024)]
    assert rig.session.drops()["patches_cut"] == 1024 - MAX_PATCHES


def test_failed_markers_do_not_stop_features(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig()
    before = rig.sink.sent["features"]

    def draw(picture: SkinPicture, *_: Any) -> Any:
        raise ZeroDivisionError("a mistake in a picture")

    monkeypatch.setattr(SkinPicture, "draw", draw)
    for _ in range(50):
        rig.cycle()
    monkeypatch.setattr(SkinPicture, "draw", lambda *_: [object()])
    for _ in range(50):
        rig.cycle()
    assert rig.sink.sent["features"] == before + 100
    assert rig.session.drops()["unsent_contacts"] == pytest.approx(10, abs=3)
    assert "a mistake in a picture" in caplog.text


@pytest.mark.parametrize("kind", ["features", "forces", "field"])
def test_unencodable_message_costs_only_itself(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    before = rig.sink.sent.copy()
    real: Callable[..., Any] = getattr(MessageMaker, kind)
    calls = []

    def every_other(maker: MessageMaker, cycle: Any) -> Any:
        calls.append(cycle)
        if len(calls) % 2:
            raise OverflowError("too far")
        return real(maker, cycle)

    monkeypatch.setattr(MessageMaker, kind, every_other)
    for _ in range(10):
        rig.cycle()
    for other in ("features", "forces", "field"):
        assert rig.sink.sent[other] - before[other] == (5 if other == kind else 10)
    assert rig.session.drops()[f"unsent_{kind}"] == 5


def test_unexpected_event_costs_only_itself_and_is_reported(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig()
    real = BoardPipeline.feed
    calls = []

    def now_and_then(pipeline: BoardPipeline, block: Any) -> Any:
        calls.append(block)
        if len(calls) % 20 == 1:
            raise RuntimeError("a mistake in the pipeline")
        return real(pipeline, block)

    monkeypatch.setattr(BoardPipeline, "feed", now_and_then)
    before = rig.sink.sent["features"]
    for _ in range(100):
        rig.cycle()
    assert rig.sink.sent["features"] >= before + 70
    assert rig.session.drops()["spoilt_events"] == 10
    assert "a mistake in the pipeline" in caplog.text


def test_text_with_impossible_stamp_is_stamped_on_arrival(
    recorder: Recorder, tmp_path: Path
) -> None:
    rig = Rig(recorder=recorder)
    for captured, text in (
        (Instant(rig.sink.at - 2147483000 * NS_PER_S), "hello from 1955"),
        (Instant(rig.sink.at - NS_PER_S), "hello"),
    ):
        rig.session.handle(BoardLog(20, captured, text))
    assert rig.session.drops()["texts_without_time"] == 1
    assert recorder.close(60)
    spoken = [
        (codec().decode(LOG, m.data), m)
        for c, m in read_messages(tmp_path / "a.mcap")
        if c.topic == LOG.channel("b0")
    ]
    old, new = [each for each in spoken if each[0].msg.startswith("hello")]
    assert "hello from 1955 (when is not known: its clock says 2147483" in old[0].msg
    assert new[0].msg == "hello"
    for _, record in (old, new):
        assert abs(record.publish_ns - record.log_ns) < 2 * NS_PER_S
    assert recorder.stats.marked == 0


def test_flood_of_serial_numbers_is_throttled_and_counted() -> None:
    rig = Rig()
    said = len(rig.sink.texts)
    for k in range(3000):
        stranger = replace(BOARD, unique_id=(k + 1000).to_bytes(8, "big"))
        rig.send(stranger, seconds=0.001)
    told = rig.sink.texts[said:]
    assert 1 <= len(told) <= 10
    held = rig.session.drops()["texts_held_back"]
    assert held >= 2900
    rig.send(b"\0", seconds=10.0)
    rig.send(b"\0", seconds=10.0)
    assert any("times more in" in text and "refused" in text for text in rig.sink.texts)


def test_flood_of_firmware_texts_is_throttled_and_counted() -> None:
    rig = Rig()
    before = rig.sink.sent["log"]
    rig.send(*(Log(40, rig.ticks(), f"flood {k}") for k in range(5000)))
    assert rig.sink.sent["log"] == before + FIRMWARE_BURST
    assert rig.session.drops()["texts_held_back"] == 5000 - FIRMWARE_BURST
    rig.send(b"\0", seconds=2.0)
    assert f"{5000 - FIRMWARE_BURST} texts held back, too many: firmware" in rig.sink.texts


def test_board_that_keeps_changing_shape_is_refused() -> None:
    rig = Rig()
    before = rig.sink.sent["geometry"]
    for k in range(200):
        rig.send(replace(BOARD, arrays=(array(0, 1, 1 + k % 100),)), seconds=0.01)
    assert rig.sink.sent["geometry"] <= before + SET_UP_BURST + 3
    assert any("describes itself anew again and again" in text for text in rig.sink.texts)


def test_throttle_passes_a_burst_then_its_rate() -> None:
    throttle = Throttle(rate=2.0, burst=3)
    passed = [throttle.allow(Instant(k * NS_PER_S // 10)) for k in range(100)]
    assert passed[:3] == [True] * 3
    assert sum(passed) == 3 + 19  # 9.9 s at 2 a second
    assert throttle.take_held() == 100 - 22
    assert throttle.take_held() == 0
    assert not throttle.allow(Instant(0))  # a clock that goes back allows nothing
