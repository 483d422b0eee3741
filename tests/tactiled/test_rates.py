"""Boards from 0.5 Hz to 1 kHz are detected, served and watched without false alarms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sensor_proto.anyskin import encode_anyskin
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import Descriptor, FloatSamples
from tactile_core.calibration import nominal
from tactile_core.types import Instant
from tactiled.blocks import Chunk, Cycle, SampleBlock
from tactiled.boards.clock import SLOWEST_S, Pace
from tactiled.boards.events import (
    Diagnosed,
    FellSilent,
    Identity,
    Refusal,
    Reset,
    Resumed,
    Sampled,
    Waiting,
)
from tactiled.boards.line import SerialLine
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings

At = Callable[[float], Instant]
RATES = [0.5, 1.0, 2.0, 5.0, 60.0, 1000.0]


def admit_all(node: int, identity: Identity) -> Refusal | None:
    del node, identity
    return None


def floats(rng: np.random.Generator, cut: int = 0) -> bytes:
    field = rng.normal(100, 3, (5, 3)).astype(np.float32)
    samples = FloatSamples(field, np.full(5, 25.0, np.float32), np.zeros(5, np.uint8))
    return encode_anyskin(samples)[cut:]


def play_floats(line: SerialLine, at: At, rate: float, frames: int, until: float) -> list[Any]:
    """Run a float board whose first frame is cut; the line ticks every 10 ms."""
    rng, events, sent = np.random.default_rng(0), [], 0
    line.connect(at(0.0))
    step = min(0.01, 1 / rate)
    for k in range(round(until / step)):
        now = k * step
        events += line.tick(at(now))
        line.outgoing()
        if sent < frames and now >= (sent + 0.3) / rate:
            events += line.receive(Chunk(at(now), floats(rng, 33 if sent == 0 else 0)))
            sent += 1
    return [event.event for event in events]


@pytest.mark.parametrize("rate", RATES)
def test_float_board_is_found_and_never_called_silent(rate: float, instant: At) -> None:
    line, frames = SerialLine("p", admit_all), max(20, round(4 * rate))
    events = play_floats(line, instant, rate, frames, frames / rate)
    blocks = [e.block for e in events if isinstance(e, Sampled)]
    assert len(blocks) >= frames - 6 - rate * 0.6
    assert not [e for e in events if isinstance(e, FellSilent | Resumed | Diagnosed)]
    stamps = [block.captured for block in blocks]
    assert len(set(stamps)) == len(stamps)
    if rate <= 1.0:
        (waiting,) = [e for e in events if isinstance(e, Waiting)]
        assert f"bytes every {1 / rate:.1f} s" in waiting.text


@pytest.mark.parametrize("rate", RATES)
def test_stopped_float_board_is_called_silent_after_its_own_period(
    rate: float, instant: At
) -> None:
    line, frames = SerialLine("p", admit_all), max(16, round(2 * rate))
    last = (frames - 0.7) / rate
    limit = max(0.2, 3 / rate)
    events = play_floats(line, instant, rate, frames, last + limit + max(0.1, 0.3 / rate))
    (silence,) = [e for e in events if isinstance(e, FellSilent)]
    assert limit <= silence.seconds <= limit * 1.1 + 0.05


def test_rare_garbage_is_reported_as_such(instant: At) -> None:
    rng = np.random.default_rng(1)
    line, told = SerialLine("p", admit_all), []
    line.connect(instant(0.0))
    for k in range(4000):
        now = k * 0.01
        told += [(now, e.event) for e in line.tick(instant(now))]
        line.outgoing()
        if k % 100 == 50:
            line.receive(Chunk(instant(now), rng.integers(0, 256, 90, np.uint8).tobytes()))
    diagnosed = [(now, e) for now, e in told if isinstance(e, Diagnosed)]
    assert 10 < diagnosed[0][0] < 20
    assert "no valid frame" in diagnosed[0][1].problem


def test_flood_of_garbage_is_reported_within_three_seconds(instant: At) -> None:
    rng = np.random.default_rng(1)
    line, told = SerialLine("p", admit_all), []
    line.connect(instant(0.0))
    for k in range(500):
        told += [(k * 0.01, e.event) for e in line.tick(instant(k * 0.01))]
        line.outgoing()
        line.receive(Chunk(instant(k * 0.01), rng.integers(0, 256, 90, np.uint8).tobytes()))
    assert [now for now, e in told if isinstance(e, Diagnosed)] == [pytest.approx(3.0, abs=0.05)]
    assert not [e for _, e in told if isinstance(e, Waiting)]


def play_board(line: SerialLine, board: Any, at: At, seconds: float, step: float) -> list[Any]:
    decoder, events = SerialDecoder(), []
    line.connect(at(0.0))
    for k in range(round(seconds / step)):
        now = k * step
        events += line.tick(at(now))
        answers = []
        for payload in line.outgoing():
            assert isinstance(payload, bytes)
            for received in decoder.feed(payload):
                answers += board.hear(received.message, now)
        data = b"".join(encode_serial(m) for m in [*answers, *board.speak(now)])
        if data:
            events += line.receive(Chunk(at(now), data))
    return [event.event for event in events]


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("says", ["its rate", "nothing", "another rate"])
def test_own_protocol_board_is_served_at_any_rate(
    rate: float, says: str, make_board: Callable[..., Any], instant: At
) -> None:
    board = make_board(period=1 / rate)
    board.rate_mhz = {"its rate": round(rate * 1000), "nothing": 0, "another rate": 100_000}[says]
    seconds = max(3.0, 12 / rate)
    events = play_board(SerialLine("p", admit_all), board, instant, seconds, min(0.005, 1 / rate))
    assert len([e for e in events if isinstance(e, Sampled)]) >= 2 * (seconds * rate * 0.8 - 2)
    assert not [e for e in events if isinstance(e, Reset)]
    if says != "another rate":  # the reported rate is used until the actual one is measured
        assert not [e for e in events if isinstance(e, FellSilent | Resumed)]


def test_measured_rate_counts_not_the_reported_one() -> None:
    pace = Pace()
    assert pace.silence_limit(said_hz=0.001) == 3 * SLOWEST_S
    for k in range(5):
        pace.heard(Instant(k * 10_000_000), k)
    assert pace.silence_limit(said_hz=0.001) == 0.2
    assert pace.silence_limit(asked_hz=0.1) == 0.2
    pace.restart()
    assert pace.silence_limit(asked_hz=0.1) == pytest.approx(30.0)


def test_bursts_do_not_look_like_a_fast_board() -> None:
    pace = Pace()
    for k in range(40):
        pace.heard(Instant(k // 10 * 1_000_000_000), k)
    assert pace.period == pytest.approx(0.1)


def cycles_of(
    pipeline: BoardPipeline, at: At, rate: float, count: int, **marks: Any
) -> list[Cycle]:
    rng, out = np.random.default_rng(2), []
    for k in range(count):
        block = SampleBlock(
            array=0, sequence=k, captured=at(k / rate), received=at(k / rate + 0.002),
            uncertainty=0.01, field_ut=rng.normal(100.0, 2.0, (5, 3)),
            temperature_c=np.full(5, 25.0), status=np.zeros(5, np.uint8), **marks,
        )  # fmt: skip
        out += pipeline.feed(block)
    return out


@pytest.mark.parametrize("rate", RATES)
def test_first_tare_takes_enough_cycles_at_any_rate(rate: float, instant: At) -> None:
    pipeline = BoardPipeline(nominal("anyskin", "s"), PipelineSettings())
    count = max(12, round(rate))
    cycles = cycles_of(pipeline, instant, rate, count)
    report = pipeline.tare_report
    assert report is not None
    assert report.accepted, report.message
    assert report.cycles >= 8
    assert cycles[-1].features.valid
    assert not np.count_nonzero(cycles[-1].health)


def test_features_are_marked_while_the_board_clock_is_unusable(instant: At) -> None:
    pipeline = BoardPipeline(nominal("anyskin", "s"), PipelineSettings())
    good = cycles_of(pipeline, instant, 100.0, 100)[-1].features
    assert good.valid
    pipeline = BoardPipeline(nominal("anyskin", "s"), PipelineSettings())
    bad = cycles_of(pipeline, instant, 100.0, 100, clock_usable=False)[-1].features
    assert not bad.valid
    assert bad.codes == ("clock_unusable",)
    assert "clock" in bad.reasons[0].text


def test_changed_tick_rate_is_reported_after_reconnect(
    make_board: Callable[..., Any], descriptor: Descriptor, instant: At
) -> None:
    line, board = SerialLine("p", admit_all), make_board()
    play_board(line, board, instant, 1.0, 0.01)
    again = replace(descriptor, tick_hz=1000)
    events = line.receive(Chunk(instant(1.0), encode_serial(again)))
    (reset,) = [e.event for e in events if isinstance(e.event, Reset)]
    assert "1000" in reset.reason
    assert "1000000" in reset.reason
