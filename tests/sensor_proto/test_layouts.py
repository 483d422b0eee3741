"""Boards with layouts of their own: declared layouts, and layouts detected from the bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto.anyskin import AnySkinDecoder
from sensor_proto.layouts import Layout, LayoutDecoder, TextDecoder
from sensor_proto.packets import FloatSamples, Received, TaxelStatus
from sensor_proto.survey import Finding, Survey

Rows = list[tuple[float, float, float, float]]
"""(t, x, y, z) of each chip."""

Write = Callable[[Rows, int], bytes]


def rows(chips: int, count: int, seed: int = 0, largest_ut: float = 1500.0) -> list[Rows]:
    """Readings of an untouched board: rest field, chip noise, and the chips' resolution."""
    rng = np.random.default_rng(seed)
    rest = rng.uniform(-largest_ut, largest_ut, (chips, 3))
    out = []
    for _ in range(count):
        field = rest + rng.normal(0, 1, (chips, 3)) * (1.5, 1.5, 2.5)
        field = np.round(field / (0.15, 0.15, 0.242)) * (0.15, 0.15, 0.242)
        celsius = np.round(rng.normal(27.0, 0.05, chips) * 45.2) / 45.2
        out.append(
            [(t, x, y, z) for t, (x, y, z) in zip(celsius.tolist(), field.tolist(), strict=True)]
        )
    return out


def floats(values: list[float], order: str = "<") -> bytes:
    return struct.pack(f"{order}{len(values)}f", *values)


def txyz(r: Rows) -> list[float]:
    return [v for chip in r for v in chip]


def xyz(r: Rows) -> list[float]:
    return [v for _, *field in r for v in field]


def xyzt(r: Rows) -> list[float]:
    return [v for t, *field in r for v in (*field, t)]


def counts(r: Rows) -> list[int]:
    return [round(v / s) for _, *f in r for v, s in zip(f, (0.15, 0.15, 0.242), strict=True)]


def xor(data: bytes) -> bytes:
    value = 0
    for byte in data:
        value ^= byte
    return bytes([value])


def checked(r: Rows, number: int) -> bytes:
    body = bytes([number % 256]) + floats(xyz(r))
    return b"\xaa\x55" + body + xor(body)


def summed(r: Rows, number: int) -> bytes:
    body = struct.pack(f">{3 * len(r)}h", *counts(r))
    return b"\xaa\x55" + body + bytes([sum(body) % 256])


def raw_temperatures(r: Rows, number: int) -> bytes:
    field = counts(r)
    values = [
        v
        for i, (t, *_) in enumerate(r)
        for v in (round((t - 25) * 45.2) + 46244 - 65536, *field[3 * i : 3 * i + 3])
    ]
    return b"\xaa\x55" + struct.pack(f"<{len(values)}h", *values)


def without_separators(r: Rows, number: int) -> bytes:
    """AnySkin text sketch: no separator between the numbers of one chip and the next."""
    return b"".join(b"%.2f\t%.2f\t%.2f\t%.2f" % chip for chip in r) + b"\r\n"


def reskin(r: Rows, number: int) -> bytes:
    return b"".join(b"%.2f\t%.2f\t%.2f\t%.2f\t" % (x, y, z, t) for t, x, y, z in r) + b"\r\n"


def numbered(r: Rows, number: int) -> bytes:
    chips = (b"%d:%.6f:%.6f:%.6f:%.6f" % (i, x, y, z, t) for i, (t, x, y, z) in enumerate(r))
    return b"\t".join(chips) + b"\r\n"


def bracketed(r: Rows, number: int) -> bytes:
    chips = (b"[S%d:%.1f,%.1f,%.1f] " % (i, x, y, z) for i, (_, x, y, z) in enumerate(r, 1))
    return b"FRAME: " + b"".join(chips) + b"\r\n"


def labelled(r: Rows, number: int) -> bytes:
    chips = (
        b"Board0Sensor%dX:%.2f\tBoard0Sensor%dY:%.2f\tBoard0Sensor%dZ:%.2f" % (i, x, i, y, i, z)
        for i, (_, x, y, z) in enumerate(r)
    )
    return b"\t".join(chips) + b"\r\n"


def three_lines(r: Rows, number: int) -> bytes:
    _, x, y, z = r[0]
    return b"X: %.4f uT\r\nY: %.4f uT\r\nZ: %.4f uT\r\n" % (x, y, z)


def millitesla(r: Rows, number: int) -> bytes:
    t, x, y, z = r[0]
    return b"magX[%.5f mT] magY[%.5f mT] magZ[%.5f mT] temperature(C)[%.2f]\r\n" % (
        x / 1000, y / 1000, z / 1000, t,
    )  # fmt: skip


def commas(r: Rows, number: int) -> bytes:
    return b",".join(b"%.2f" % v for v in xyz(r)) + b"\n"


def clocked(r: Rows, number: int) -> bytes:
    return b"%d," % (10 * number) + b",".join(b"%.2f" % v for v in xyzt(r)) + b"\n"


def survey(write: Write, chips: int = 5, count: int = 60, **options: float) -> Finding | None:
    watch = Survey()
    for number, r in enumerate(rows(chips, count, **options)):  # type: ignore[arg-type]
        watch.feed(write(r, number))
    return watch.judge()


def read(layout: str, data: list[bytes]) -> list[Received]:
    parsed = Layout.parse(layout)
    decoder = TextDecoder(parsed) if parsed.kind == "text" else LayoutDecoder(parsed)
    return [received for chunk in data for received in decoder.feed(chunk)]


# The grammar


@pytest.mark.parametrize(
    "text",
    [
        "floats:5xyz",
        "floats:5txyz,end=lf",
        "floats:20xyzt,big,start=aa55,skip=1,check=xor,end=none",
        "doubles:1xyz,end=crlf",
        "int16:5txyz,big,scale=0.3/0.484,start=aa55,check=sum,end=none",
        "int16:4xyz,scale=0.2",
        "uint16:4xyz,scale=0.2/0.3/0.4,tail=2,end=0d0a00",
        "text:5_xyzt,lead=1",
        "text:1xyz,lines=3",
    ],
)
def test_layout_text_round_trips(text: str) -> None:
    assert str(Layout.parse(text)) == text


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("skin", "floats:5xyz"),
        ("floats", "floats:5xyz"),
        ("shorts:5xyz", "int16"),
        ("floats:0xyz", "1 to 20"),
        ("floats:21xyz", "1 to 20"),
        ("floats:5xy", "x, y and z once each"),
        ("floats:5xyzx", "once each"),
        ("floats:5xyztt", "t at most once"),
        ("floats:5xyz,fast", "'fast' is not an option of floats"),
        ("floats:5xyz,end=crcr", "hexadecimal"),
        ("floats:5xyz,check=crc", "check=xor|sum"),
        ("floats:5xyz,skip=99", "0 to 16"),
        ("floats:5xyz,lead=1", "not an option"),
        ("text:5xyz,end=lf", "not an option"),
        ("int16:5xyz,scale=0", "separated by /"),
        ("int16:5xyz,scale=nan", "separated by /"),
    ],
)
def test_invalid_layout_is_refused_with_the_expected_form(text: str, named: str) -> None:
    with pytest.raises(ValueError, match="allowed") as caught:
        Layout.parse(text)
    assert named in str(caught.value)


# Frames written by hand


def samples_of(layout: str, frame: bytes) -> FloatSamples:
    (first, *_) = read(layout, [frame] * 4)
    return first.message


def test_floats_without_temperatures_end_in_lf() -> None:
    frame = bytes.fromhex("0000803f 000000c0 00409643") + b"\n"  # 1, −2, 300.5
    samples = samples_of("floats:1xyz,end=lf", frame)
    assert samples.field_ut.tolist() == [[1.0, -2.0, 300.5]]
    assert np.isnan(samples.temperature_c).all()
    assert not samples.status.any()


def test_big_endian_integers_with_checksum() -> None:
    # 10, −10, 1000 counts of 0.15, 0.15, 0.242 µT; 00+0a+ff+f6+03+e8 = 0x2ea
    frame = bytes.fromhex("aa55 000a fff6 03e8 ea")
    samples = samples_of("int16:1xyz,big,start=aa55,check=sum,end=none", frame)
    np.testing.assert_allclose(samples.field_ut, [[1.5, -1.5, 242.0]], rtol=1e-6)


def test_raw_temperatures_follow_the_datasheet() -> None:
    # 46244 + 90 is 25 + 90 / 45.2 °C; little-endian fe b4 is 46334
    frame = bytes.fromhex("feb4 0a00 f6ff e803 0d0a")
    samples = samples_of("int16:1txyz,end=crlf", frame)
    np.testing.assert_allclose(samples.temperature_c, [25 + 90 / 45.2], rtol=1e-6)
    unsigned = bytes.fromhex("0a80 f67f e883 0d0a")  # 32768 is zero
    samples = samples_of("uint16:1xyz,scale=1,end=crlf", unsigned)
    assert samples.field_ut.tolist() == [[10.0, -10.0, 1000.0]]


def test_frame_with_header_counter_and_checksum() -> None:
    body = bytes.fromhex("07 0000c841 0000803f 000000c0 00409643")  # counter, 25 °C, 1, −2, 300.5
    frame = b"\xaa\x55" + body + xor(body) + b"\r\n"
    samples = samples_of("floats:1txyz,start=aa55,skip=1,check=xor,end=crlf", frame)
    assert samples.temperature_c.tolist() == [25.0]
    assert samples.field_ut.tolist() == [[1.0, -2.0, 300.5]]


def test_text_lines_are_decoded() -> None:
    lines = [b"12.00\t1.00\t", b"25.10\t1.00\t-2.00\t300.50\r\n" * 3]
    (first, *_) = read("text:1txyz", lines)
    assert first.message.field_ut.tolist() == [[1.0, -2.0, 300.5]]
    assert first.message.temperature_c.tolist() == pytest.approx([25.1])


def test_numbers_without_separators_are_split_by_their_decimals() -> None:
    line = b"25.10\t1.00\t-2.00\t300.5026.20\t-7.00\t8.00\t-9000.10\r\n"
    got = read("text:2txyz", [line] * 4)[-1].message
    assert got.field_ut.tolist() == [[1.0, -2.0, 300.5], [-7.0, 8.0, pytest.approx(-9000.1)]]
    assert got.temperature_c.tolist() == pytest.approx([25.1, 26.2])


@pytest.mark.parametrize(
    ("line", "failed"),
    [
        (b"FRAME: [S1:1.0,2.0,3.0] [S2:ERR] [S3:7.0,8.0,9.0] \r\n", [1]),
        (b"FRAME: [S1:1.0,2.0,3.0] [S2:nan,nan,nan] [S3:7.0,8.0,9.0] \r\n", [1]),
        (b"FRAME: [S1:1.0,2.0,3.0] [S2:4.0,inf,6.0] [S3:7.0,ovf,9.0] \r\n", [1, 2]),
    ],
)
def test_failed_chip_in_text_is_flagged(line: bytes, failed: list[int]) -> None:
    good = b"FRAME: [S1:1.0,2.0,3.0] [S2:4.0,5.0,6.0] [S3:7.0,8.0,9.0] \r\n"
    got = read("text:3xyz", [good, good, good, line, good])
    assert [np.flatnonzero(r.message.status).tolist() for r in got] == [[], [], failed, []]
    assert got[2].message.status[1] == TaxelStatus.READ_FAILED


LAYOUTS = [
    "floats:5xyz,end=lf",
    "floats:3txyz,big,end=crlf",
    "floats:4xyz,start=aa55,skip=1,check=xor,end=none",
    "doubles:2xyzt,end=crlf",
    "int16:5txyz,start=aa55,check=sum,tail=1,end=0d0a",
    "int32:2xyz,big,start=a5,end=lf",
    "uint16:5xyz,start=fefe,end=none",
    "text:5txyz",
    "text:2xyz,lead=1",
]


@given(
    layout=st.sampled_from(LAYOUTS),
    sizes=st.lists(st.integers(1, 400), min_size=1, max_size=5),
    seed=st.integers(0, 99),
)
@settings(max_examples=60, deadline=None)
def test_layout_reads_what_it_writes_at_any_chunking(
    layout: str, sizes: list[int], seed: int
) -> None:
    parsed = Layout.parse(layout)
    sent = []
    for r in rows(parsed.chips, 20, seed):
        values = np.array(r, np.float32)
        status = np.zeros(parsed.chips, np.uint8)
        sent.append(FloatSamples(values[:, 1:], values[:, 0], status))
    wire = b"".join(parsed.encode(s, i) for i, s in enumerate(sent))
    chunks, at, k = [], 0, 0
    while at < len(wire):
        chunks.append(wire[at : at + sizes[k % len(sizes)]])
        at, k = at + sizes[k % len(sizes)], k + 1
    got = read(layout, chunks)
    assert len(got) >= 19  # a line is used from the second on
    step = 0.3 if parsed.kind in ("int16", "uint16", "int32") else 0.01
    for received, samples in zip(got[::-1], sent[::-1], strict=False):
        assert np.abs(received.message.field_ut - samples.field_ut).max() <= step
        assert not received.message.status.any()


# Losses


@pytest.mark.parametrize("layout", [*LAYOUTS[:7], "floats:5xyz,end=none", "int16:5xyz,end=lf"])
@pytest.mark.parametrize("cut", [3, 17])
def test_lost_bytes_do_not_shift_later_frames(layout: str, cut: int) -> None:
    parsed = Layout.parse(layout)
    exact, chunks = [], []
    for i, r in enumerate(rows(parsed.chips, 200)):
        values = np.array(r, np.float32)
        status = np.zeros(parsed.chips, np.uint8)
        frame = parsed.encode(FloatSamples(values[:, 1:], values[:, 0], status), i)
        exact.append(frame)
        chunks.append(frame[:cut] + frame[cut + 2 :] if i % 10 == 5 else frame)
    decoder = LayoutDecoder(parsed)
    got = [r.message.field_ut for chunk in chunks for r in decoder.feed(chunk)]
    whole = LayoutDecoder(parsed)
    clean = [r.message.field_ut for frame in exact for r in whole.feed(frame)]
    known = {field.tobytes() for field in clean}
    wrong = sum(field.tobytes() not in known for field in got)
    if parsed.framing is not None and parsed.framing.extra < 2 and parsed.kind == "int16":
        # x of the first chip is 2743 counts, 0x0ab7: its high byte looks like the frame end.
        assert wrong <= 2 * 20
    else:
        assert wrong == 0
    assert len(got) >= 175
    assert decoder.counters["lost_lock"] >= 15
    assert decoder.counters["discarded_bytes"] > 0


def test_line_with_missing_text_is_dropped_and_counted() -> None:
    lines = [reskin(r, i) for i, r in enumerate(rows(5, 40))]
    whole = len(read("text:5xyzt", lines))
    damaged = list(lines)
    damaged[10] = damaged[10].partition(b"\t")[2]
    damaged[20] = damaged[20].replace(b".", b"", 1)
    damaged[30] = damaged[30][:-2]
    decoder = TextDecoder(Layout.parse("text:5xyzt"))
    got = [r for line in damaged for r in decoder.feed(line)]
    assert len(got) == whole - 4  # the third joins two lines
    assert decoder.counters["discarded_bytes"] > 4 * 100


@given(chunks=st.lists(st.binary(max_size=3000), max_size=6), layout=st.sampled_from(LAYOUTS))
@settings(max_examples=60, deadline=None)
def test_noise_never_raises_and_memory_is_bounded(chunks: list[bytes], layout: str) -> None:
    parsed = Layout.parse(layout)
    decoder = TextDecoder(parsed) if parsed.kind == "text" else LayoutDecoder(parsed)
    watch = Survey()
    for chunk in chunks:
        decoder.feed(chunk)
        watch.feed(chunk)
        assert len(decoder._buffer) <= 8192
        found = watch.judge()
        assert found is None or found.layout is None or found.what


# Detection


@pytest.mark.parametrize(
    ("write", "layout"),
    [
        (lambda r, n: floats(txyz(r)) + b"\n", "floats:5txyz,end=lf"),
        (lambda r, n: floats(xyzt(r)) + b"\r\n", "floats:5xyzt,end=crlf"),
        (lambda r, n: floats(txyz(r), ">") + b"\r\n", "floats:5txyz,big,end=crlf"),
        (
            lambda r, n: b"\xaa\x55" + floats(txyz(r)) + b"\r\n",
            "floats:5txyz,start=aa55,end=crlf",
        ),
        (lambda r, n: struct.pack("<20d", *txyz(r)) + b"\r\n", "doubles:5txyz,end=crlf"),
        (without_separators, "text:5txyz"),
        (reskin, "text:5xyzt"),
        (numbered, "text:5_xyzt"),
        (bracketed, "text:5xyz"),
        (labelled, "text:5xyz"),
        (three_lines, "text:1xyz,lines=3"),
        (millitesla, "text:1xyzt,scale=1000"),
        (clocked, "text:5xyzt,lead=1"),
    ],
)
def test_unambiguous_layout_is_detected(write: Write, layout: str) -> None:
    found = survey(write)
    assert found is not None
    assert str(found.layout) == layout


@pytest.mark.parametrize(
    ("write", "what", "declare"),
    [
        (
            lambda r, n: floats(xyz(r)) + b"\r\n",
            "frames of 62 bytes ending in CR LF: 15 floats, no temperatures",
            ("floats:5xyz",),
        ),
        (
            lambda r, n: floats(xyz(r)),
            "frames of 60 bytes with neither start nor end: 15 floats, no temperatures",
            ("floats:5xyz,end=none",),
        ),
        (
            checked,
            "frames of 64 bytes beginning with AA 55 and with a check (xor): 15 floats, "
            "no temperatures",
            ("floats:5xyz",),
        ),
        (
            summed,
            "frames of 33 bytes beginning with AA 55 and with a check (sum): 15 big-endian 16-bit "
            "integers",
            ("int16:5xyz,big,start=aa55,check=sum,end=none",),
        ),
        (
            raw_temperatures,
            "frames of 42 bytes beginning with AA 55: 20 little-endian 16-bit integers",
            ("int16:5txyz,start=aa55,end=none",),
        ),
        (
            lambda r, n: b"\xaa\x55" + struct.pack("<15i", *counts(r)) + b"\r\n",
            "frames of 64 bytes beginning with AA 55 and ending in CR LF: 15 little-endian 32-bit "
            "integers",
            ("int32:5xyz,start=aa55,end=crlf",),
        ),
        (
            lambda r, n: b"\xaa\x55" + struct.pack(">15H", *(32768 + c // 10 for c in counts(r))),
            "frames of 32 bytes beginning with AA 55: 15 big-endian 16-bit integers without sign",
            ("uint16:5xyz,big,start=aa55,end=none",),
        ),
        (commas, "text, lines of 15 numbers, no temperatures and no labels among them",
         ("text:5xyz",)),
    ],
)  # fmt: skip
def test_ambiguous_layout_is_named_with_its_declaration(
    write: Write, what: str, declare: tuple[str, ...]
) -> None:
    found = survey(write)
    assert found is not None
    assert found.layout is None
    assert found.what == what
    assert found.declare == declare
    parsed = Layout.parse(declare[0])
    if parsed.kind != "text":  # the bytes around the numbers are detected
        watch = Survey(Layout.parse(declare[0].partition(",")[0] + (",big" * parsed.big)))
        for number, r in enumerate(rows(5, 60)):
            watch.feed(write(r, number))
        placed = watch.judge()
        assert placed is not None
        assert placed.layout is not None
        assert placed.layout.payload == parsed.payload


@pytest.mark.parametrize("chips", [4, 8, 12, 16, 20])
@pytest.mark.parametrize("largest_ut", [20.0, 50.0, 1500.0])
def test_chips_without_temperature_are_not_mistaken_for_fewer_with(
    chips: int, largest_ut: float
) -> None:
    """Fields of a bare board are as small as temperatures."""
    for seed in range(3):
        decoder, watch = AnySkinDecoder(), Survey()
        for r in rows(chips, 60, seed, largest_ut):
            frame = floats(xyz(r)) + b"\r\n"
            assert decoder.feed(frame) == []
            watch.feed(frame)
        found = watch.judge()
        assert found is not None
        assert found.layout is None
        assert f"floats:{chips}xyz" in found.declare


@pytest.mark.parametrize("chips", [3, 6, 12, 15])
def test_chips_with_temperature_are_detected_for_any_count(chips: int) -> None:
    for seed in range(3):
        decoder = AnySkinDecoder()
        got = [
            m for r in rows(chips, 60, seed, 20.0) for m in decoder.feed(floats(txyz(r)) + b"\r\n")
        ]
        assert decoder.magnetometers == chips
        assert len(got) == 60


def test_temperatures_after_the_field_are_not_mistaken_for_it() -> None:
    """x of the chip directly below a magnet is as small as a temperature."""
    decoder = AnySkinDecoder()
    for r in rows(5, 60, 1, 30.0):
        assert decoder.feed(floats(xyzt(r)) + b"\r\n") == []


@pytest.mark.parametrize(
    "write",
    [
        lambda r, n: b"temperature: 21.5 C\r\n",
        lambda r, n: b"boot ok, waiting for wifi\r\n",
        lambda r, n: np.random.default_rng(n).bytes(80),
        lambda r, n: bytes(500),
    ],
)
def test_other_devices_are_not_detected_as_boards(write: Write) -> None:
    assert survey(write) is None


def test_accelerometer_is_not_mistaken_for_a_skin() -> None:
    found = survey(lambda r, n: b"X: %.2f Y: %.2f Z: %.2f\r\n" % (0.1, n % 3 * 0.01, 9.81))
    assert found is not None
    assert found.layout is None
    assert "too small" in found.what


def test_banner_and_remarks_are_ignored() -> None:
    watch = Survey()
    watch.feed(b"I2C scan complete.\r\nFound MLX candidates: 0xC 0xD \r\nInit MLX[0] status=0\r\n")
    for number, r in enumerate(rows(5, 60)):
        watch.feed(reskin(r, number))
        if number % 20 == 19:
            watch.feed(b"loop time 8123 us, errors 0\r\n")
    found = watch.judge()
    assert found is not None
    assert str(found.layout) == "text:5xyzt"


def test_layout_is_detected_despite_lost_bytes() -> None:
    watch = Survey()
    for number, r in enumerate(rows(5, 90)):
        frame = floats(txyz(r)) + b"\n"
        watch.feed(frame[:30] + frame[32:] if number % 10 == 5 else frame)
    found = watch.judge()
    assert found is not None
    assert str(found.layout) == "floats:5txyz,end=lf"


def test_wrong_declaration_is_reported_with_the_right_one() -> None:
    watch = Survey(Layout.parse("floats:4xyz"))
    for r in rows(5, 60):
        watch.feed(floats(xyz(r)) + b"\r\n")
    found = watch.judge()
    assert found is not None
    assert found.layout is None
    assert "not floats:4xyz as declared" in found.what
    assert found.declare == ("floats:5xyz",)
