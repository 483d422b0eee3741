"""Boards without a protocol on a serial line: detected, declared, or described by their bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sensor_proto.layouts import Layout
from sensor_proto.packets import FloatSamples
from tactile_core.calibration import nominal
from tactile_core.types import Instant
from tactiled.blocks import Chunk, SampleBlock
from tactiled.boards.events import Diagnosed, Identified, Identity, Refusal, Sampled
from tactiled.boards.line import SerialLine
from tactiled.sensing.pipeline import BoardPipeline

At = Callable[[float], Instant]


def admit_all(node: int, identity: Identity) -> Refusal | None:
    return None


def frames(layout: str, count: int, seed: int = 0) -> list[bytes]:
    """Frames of a board at rest."""
    parsed = Layout.parse(layout)
    rng = np.random.default_rng(seed)
    rest = rng.uniform(-1500, 1500, (parsed.chips, 3))
    status = np.zeros(parsed.chips, np.uint8)
    out = []
    for number in range(count):
        field = (rest + rng.normal(0, 2, rest.shape)).astype(np.float32)
        celsius = (np.round(rng.normal(27, 0.05, parsed.chips) * 45.2) / 45.2).astype(np.float32)
        out.append(parsed.encode(FloatSamples(field, celsius, status), number))
    return out


def play(
    line: SerialLine, at: At, data: list[bytes], rate: float = 100.0, start: float = 0.0
) -> list[Any]:
    events: list[Any] = []
    ticked = start
    for k, chunk in enumerate(data):
        now = start + k / rate
        while ticked < now:
            ticked += 0.05
            events += [e.event for e in line.tick(at(ticked))]
            line.outgoing()
        events += [e.event for e in line.receive(Chunk(at(now), chunk))]
    return events


def of(events: list[Any], kind: type) -> list[Any]:
    return [e for e in events if isinstance(e, kind)]


@pytest.mark.parametrize(
    ("board", "sent", "read"),
    [
        ("auto", "text:5xyzt", "text:5xyzt"),
        ("anyskin", "text:5txyz", "text:5txyz"),
        ("auto", "floats:5txyz,end=lf", "floats:5txyz,end=lf"),
        ("reskin", "floats:5txyz,start=aa55,end=crlf", "floats:5txyz,start=aa55,end=crlf"),
        ("auto", "floats:10txyz,end=crlf", ""),
        ("floats:5xyz", "floats:5xyz,end=crlf", "floats:5xyz,end=crlf"),
        ("floats:5xyz", "floats:5xyz,start=aa55,skip=1,check=xor,end=none", None),
        ("int16:5txyz,big", "int16:5txyz,big,start=aa55,check=sum,end=none", None),
        ("int16:5xyz,scale=0.3/0.484,end=crlf", "int16:5xyz,scale=0.3/0.484,end=crlf", None),
        ("text:5xyz", "text:5xyz", "text:5xyz"),
        ("floats:5txyz", "floats:5txyz,end=crlf", ""),
    ],
)
def test_detected_or_declared_board_streams(
    board: str, sent: str, read: str | None, instant: At
) -> None:
    line = SerialLine("p", admit_all, board)
    line.connect(instant(0.0), usb_serial="USB7")
    events = play(line, instant, frames(sent, 300))
    assert not of(events, Diagnosed)
    identity = of(events, Identified)[0].identity
    chips = Layout.parse(sent).chips
    assert (identity.model, identity.serial_number) == ("anyskin", "USB7")
    assert identity.shapes == ((1, chips),)
    assert identity.layout == (sent if read is None else read)
    blocks = [e.block for e in of(events, Sampled)]
    assert len(blocks) > 180
    mean = np.mean([b.field_ut for b in blocks], axis=0)
    parsed = Layout.parse(sent)
    rest = np.random.default_rng(0).uniform(-1500, 1500, (chips, 3))
    np.testing.assert_allclose(mean, rest, atol=2 * max(parsed.scale))


@pytest.mark.parametrize(
    ("sent", "words", "board"),
    [
        ("floats:5xyz,end=crlf", "62 bytes ending in CR LF: 15 floats, no temperatures",
         "--kind floats:5xyz"),
        ("floats:4xyz,end=crlf", "12 floats, no temperatures", "--kind floats:4xyz"),
        ("int16:5xyz,big,start=aa55,check=sum,end=none", "big-endian 16-bit integers",
         "--kind int16:5xyz,big,start=aa55,check=sum,end=none"),
        ("text:5xyz", "lines of 15 numbers", "--kind text:5xyz"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("uart", [False, True])
def test_ambiguous_layout_is_named_once_without_blaming_the_baud_rate(
    sent: str, words: str, board: str, uart: bool, instant: At
) -> None:
    line = SerialLine("/dev/ttyACM0", admit_all)
    line.connect(instant(0.0), byte_time=1e-5 if uart else 0.0)
    events = play(line, instant, frames(sent, 600))
    (diagnosed,) = of(events, Diagnosed)
    assert words in diagnosed.problem
    assert board in diagnosed.remedy
    assert "baud" not in diagnosed.problem + diagnosed.remedy
    assert not of(events, Sampled)


@pytest.mark.parametrize(
    "data",
    [
        [bytes(300)] * 400,
        [np.random.default_rng(k).integers(1, 256, 80, np.uint8).tobytes() for k in range(400)],
        [b"boot ok\r\n"] * 400,
        [b""] * 800,
    ],
)
def test_baud_rate_is_never_blamed_on_usb(data: list[bytes], instant: At) -> None:
    line = SerialLine("/dev/ttyACM0", admit_all)
    line.connect(instant(0.0), byte_time=0.0)
    (diagnosed,) = of(play(line, instant, data), Diagnosed)
    assert "baud" not in diagnosed.problem + diagnosed.remedy


def test_declared_board_is_not_second_guessed(instant: At) -> None:
    """Twelve floats are four chips if the user declares so."""
    line = SerialLine("p", admit_all, "floats:4xyz")
    line.connect(instant(0.0))
    sent = [
        struct.pack("<12f", *(r + np.random.default_rng(k).normal(0, 0.02, 12))) + b"\r\n"
        for k, r in enumerate([np.full(12, 25.0)] * 200)
    ]
    events = play(line, instant, sent)
    assert of(events, Identified)[0].identity.shapes == ((1, 4),)


def test_board_with_changed_firmware_is_detected_again(instant: At) -> None:
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0))
    play(line, instant, frames("floats:5txyz,end=crlf", 200))
    line.disconnect()
    line.connect(instant(4.0))
    events = play(line, instant, frames("text:5xyzt", 300), start=4.0)
    assert of(events, Identified)[0].identity.layout == "text:5xyzt"
    assert len(of(events, Sampled)) > 150


def test_bytes_before_layout_detection_are_counted(instant: At) -> None:
    for board, sent in (("auto", "text:5xyzt"), ("floats:5xyz", "floats:5xyz,end=lf")):
        line = SerialLine("p", admit_all, board)
        line.connect(instant(0.0))
        data = frames(sent, 200)
        used = len(of(play(line, instant, data), Sampled))
        lost = line.rejects["discarded_bytes"]
        assert lost > 0.5 * (len(data) - used - 10) * len(data[0])


def test_slow_board_is_given_time(instant: At) -> None:
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0))
    lines = [
        b"X: %.4f uT\r\nY: %.4f uT\r\nZ: %.4f uT\r\n" % (400 + k % 3, -30, 900) for k in range(20)
    ]
    events = play(line, instant, lines, rate=2.0)
    assert not of(events, Diagnosed)
    assert of(events, Sampled)[-1].block.field_ut[0].tolist() == [401.0, -30.0, 900.0]


@pytest.mark.parametrize("text", ["skin", "floats", "floats:5", "auto:5xyz"])
def test_unknown_kind_lists_available_kinds(text: str) -> None:
    with pytest.raises(ValueError, match="floats:5xyz"):
        SerialLine("p", admit_all, text)


def test_boards_of_one_controller_are_separate_arrays(instant: At) -> None:
    """The link sees one array; the calibration splits it."""
    line = SerialLine("p", admit_all)
    line.connect(instant(0.0))
    blocks = [
        e.block for e in of(play(line, instant, frames("floats:10txyz,end=crlf", 300)), Sampled)
    ]
    pipeline = BoardPipeline(nominal("anyskin", "unknown", 10))
    cycles = [cycle for block in blocks for cycle in pipeline.feed(block)]
    assert len(cycles) == len(blocks)
    assert pipeline.counters.incomplete_cycles == pipeline.counters.unknown_array == 0
    assert cycles[-1].features.valid
    assert cycles[-1].ambient.plane.shape[0] == 2
    parts = blocks[0].split((5, 5))
    assert [p.array for p in parts] == [0, 1]
    np.testing.assert_array_equal(parts[1].field_ut, blocks[0].field_ut[5:])
    np.testing.assert_array_equal(parts[1].temperature_c, blocks[0].temperature_c[5:])
    assert blocks[0].split((10,)) == (blocks[0],)
    assert parts[0].split((5, 5)) == (parts[0],)


def test_arrays_without_poses_share_no_ambient_field(instant: At) -> None:
    """A field that changes on both is removed from each by its own fit."""
    calibration = nominal("anyskin", "unknown", 10)
    assert not any(a.geometry.posed for a in calibration.arrays)
    pipeline = BoardPipeline(calibration)
    rng = np.random.default_rng(1)
    reasons = set()
    for k in range(300):
        field = rng.normal(0, 1.5, (10, 3))
        if k > 150:
            field[:5, 2] += 900.0 * np.array([1.0, 0.4, -0.5, 0.3, 0.7])  # the first is pressed
        block = SampleBlock(
            0, k, instant(k / 100), instant(k / 100), 1e-3, field, np.full(10, 25.0),
            np.zeros(10, np.uint8),
        )  # fmt: skip
        for cycle in pipeline.feed(block):
            reasons |= {str(reason) for reason in cycle.features.reasons}
    assert reasons
    assert not any("borrowed" in reason for reason in reasons)


def test_board_without_temperatures_has_forces(instant: At) -> None:
    line = SerialLine("p", admit_all, "floats:5xyz")
    line.connect(instant(0.0))
    blocks = [
        e.block for e in of(play(line, instant, frames("floats:5xyz,end=crlf", 300)), Sampled)
    ]
    assert np.isnan(blocks[0].temperature_c).all()
    pipeline = BoardPipeline(nominal("anyskin", "unknown", 5))
    cycles = [cycle for block in blocks for cycle in pipeline.feed(block)]
    assert cycles[-1].features.valid
    assert cycles[-1].features.taxels_masked == 0
    assert np.isfinite(cycles[-1].force).all()
