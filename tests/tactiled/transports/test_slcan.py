"""slcan: lines written by hand from the LAWICEL manual and the Linux slcan driver."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensor_proto import can_transfers, slcan
from sensor_proto.can_transfers import BusState, CanFrame
from sim_device.board.slcan_adapter import MAX_OUTPUT, SlcanAdapter
from sim_device.board.wire import MAX_QUEUED, TimedBus, frame_seconds
from tactile_core.types import Instant

FRAME = CanFrame(0x1ABCDEF0, b"\x01\x23\xfe")
LINE = b"T1ABCDEF030123FE"  # T, 8 digits of identifier, length, data
FD_FRAME = CanFrame(0x00000100, bytes(range(12)), fd=True)
FD_LINE = b"B000001009000102030405060708090A0B"  # length code 9 stands for 12 bytes
NOW = Instant(1_000_000_000)


def opened(**options: bool) -> SlcanAdapter:
    adapter = SlcanAdapter(**options)
    adapter.feed(b"S8\rO\r")
    adapter.take_output()
    return adapter


@pytest.mark.parametrize(("frame", "line"), [(FRAME, LINE), (FD_FRAME, FD_LINE)])
def test_frames_are_encoded_and_decoded_as_in_the_manual(frame: CanFrame, line: bytes) -> None:
    assert slcan.encode_frame(frame) == line + b"\r"
    assert slcan.decode_frame(line) == frame
    assert slcan.decode_frame(line.lower().replace(line[:1].lower(), line[:1], 1)) == frame
    assert slcan.decode_frame(line + b"1F40") == frame  # with a time stamp behind it


def test_an_empty_frame_has_no_data_digits() -> None:
    assert slcan.encode_frame(CanFrame(5, b"")) == b"T000000050\r"
    assert slcan.decode_frame(b"T000000050") == CanFrame(5, b"")


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"t10021133", slcan.Rejected.STANDARD_ID),
        (b"d1009" + b"00" * 12, slcan.Rejected.STANDARD_ID),
        (b"r1002", slcan.Rejected.REMOTE),
        (b"R000001002", slcan.Rejected.REMOTE),
        (b"", slcan.Rejected.MALFORMED),
        (b"T", slcan.Rejected.MALFORMED),
        (b"T1ABCDEF030123", slcan.Rejected.MALFORMED),  # a byte short
        (b"T1ABCDEF030123FE0", slcan.Rejected.MALFORMED),  # half a byte too much
        (b"T2000000000", slcan.Rejected.MALFORMED),  # identifier of 30 bits
        (b"T1ABCDEFG0", slcan.Rejected.MALFORMED),
        (b"T000000009" + b"00" * 12, slcan.Rejected.MALFORMED),  # FD length, classic frame
        (b"T00000000A", slcan.Rejected.MALFORMED),
        (b"T1ABCDEF03 1 2 3", slcan.Rejected.MALFORMED),
        (b"T\xff0000000\xff", slcan.Rejected.MALFORMED),
    ],
)
def test_lines_without_a_usable_frame_say_why(line: bytes, reason: slcan.Rejected) -> None:
    assert slcan.decode_frame(line) is reason


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(1 << 29, b""),
        CanFrame(-1, b""),
        CanFrame(1, bytes(9)),
        CanFrame(1, bytes(9), fd=True),
        CanFrame(1, bytes(12)),
        CanFrame(1, b"", error=True),
    ],
)
def test_impossible_frames_are_refused(frame: CanFrame) -> None:
    with pytest.raises(ValueError, match=r"can be sent|data bytes"):
        slcan.encode_frame(frame)


STREAM = b"\rS8\r"[:1] + LINE + b"\r\a" + FD_LINE + b"\rt10020102\rF84\rsb128256\re2aB\rz\rxyz\r"


@given(st.lists(st.integers(0, len(STREAM)), max_size=8))
@settings(max_examples=60, deadline=None)
def test_chunking_of_adapter_bytes_does_not_matter(cuts: list[int]) -> None:
    decoder = slcan.SlcanDecoder()
    frames = []
    edges = [0, *sorted(cuts), len(STREAM)]
    for start, end in pairwise(edges):
        frames += decoder.feed(STREAM[start:end])
    assert frames[:2] == [FRAME, FD_FRAME]
    assert can_transfers.reported_state(frames[2]) is BusState.WARNING
    assert can_transfers.error_names(frames[3]) == ("bus-error",)
    assert can_transfers.reported_state(frames[4]) is BusState.BUS_OFF
    assert can_transfers.error_names(frames[5]) == (
        "protocol-violation",
        "no-acknowledgement",
        "bus-error",
    )
    assert len(frames) == 6
    assert list(decoder.answers) == [b"", b"\a", b"F84"]
    assert decoder.counters == {"standard_id": 1, "malformed_line": 1}


@given(st.binary(max_size=2000))
@settings(max_examples=100, deadline=None)
def test_noise_neither_raises_nor_accumulates(noise: bytes) -> None:
    decoder = slcan.SlcanDecoder()
    for _ in range(3):
        for frame in decoder.feed(noise):
            assert 0 <= frame.identifier < 1 << 29
    assert len(decoder.answers) <= slcan.MAX_ANSWERS
    adapter = opened()
    adapter.feed(noise * 3)
    assert len(adapter.take_output()) <= MAX_OUTPUT
    # After noise, empty lines resynchronise both ends, as a host does on opening.
    adapter.feed(b"\r\rC\r")
    adapter.feed(b"C\r" if adapter.is_open else b"")
    adapter.take_output()
    adapter.feed(b"V\r")
    assert adapter.take_output() == b"V1013\r"
    decoder.feed(b"\r")
    assert decoder.feed(LINE + b"\r") == [FRAME]


def test_an_endless_line_is_dropped() -> None:
    decoder = slcan.SlcanDecoder()
    for _ in range(100):
        decoder.feed(b"T" * 1000)
    assert decoder.counters["malformed_line"] == 100
    adapter = SlcanAdapter()
    assert adapter.feed(b"T" * 5000 + b"\r") == []
    assert adapter.take_output() == b"\a"


@pytest.mark.parametrize(
    ("answer", "state"),
    [
        (b"F00", BusState.ACTIVE),
        (b"F04", BusState.WARNING),
        (b"F24", BusState.PASSIVE),
        (b"FA4", BusState.BUS_OFF),
        (b"F", None),
        (b"Fxy", None),
        (b"V1013", None),
    ],
)
def test_status_flags_give_the_bus_state(answer: bytes, state: BusState | None) -> None:
    assert slcan.state_of_flags(answer) is state


@pytest.mark.parametrize(
    ("line", "names", "state"),
    [
        (b"sa057033", ("error-active",), BusState.ACTIVE),
        (b"sw096096", ("error-warning",), BusState.WARNING),
        (b"sp128000", ("error-passive",), BusState.PASSIVE),
        (b"sb256256", ("bus-off",), BusState.BUS_OFF),
        (b"e1a", ("no-acknowledgement",), None),
        (b"e3bcO", ("protocol-violation", "bus-error", "tx-overflow"), None),
    ],
)
def test_state_and_error_lines_become_named_error_frames(
    line: bytes, names: tuple[str, ...], state: BusState | None
) -> None:
    (frame,) = slcan.SlcanDecoder().feed(line + b"\r")
    assert frame.error
    assert can_transfers.error_names(frame) == names
    assert can_transfers.reported_state(frame) is state


def test_socketcan_error_frames_have_their_kernel_names() -> None:
    # Classes and controller bits of linux/can/error.h.
    assert can_transfers.error_names(CanFrame(0x040, bytes(8), error=True)) == ("bus-off",)
    assert can_transfers.reported_state(CanFrame(0x100, bytes(8), error=True)) is BusState.ACTIVE
    passive = CanFrame(0x004, b"\0\x20\0\0\0\0\0\0", error=True)
    assert can_transfers.error_names(passive) == ("error-passive",)
    assert can_transfers.reported_state(passive) is BusState.PASSIVE
    assert can_transfers.reported_state(CanFrame(0x020, b"", error=True)) is None
    assert can_transfers.error_names(CanFrame(0, b"", error=True)) == ("unspecified",)


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"\r", b"\r"),
        (b"C\r", b"\a"),  # it is not open
        (b"O\r", b"\a"),  # no bit rate yet
        (b"S9\r", b"\r"),
        (b"SA\r", b"\a"),
        (b"S6\r", b"\r"),
        (b"s031C\r", b"\r"),
        (b"F\r", b"\a"),  # only while open
        (b"V\r", b"V1013\r"),
        (b"N\r", b"NA123\r"),
        (b"T000000010\r", b"\a"),
        (b"Q1\r", b"\a"),
        (b"S6\rO\rS6\r", b"\r\r\a"),  # no bit rate while open
        (b"S6\rO\rF\rC\rC\r", b"\r\rF00\r\r\a"),
        (b"S6\rL\rT000000010\r", b"\r\r\a"),  # listening only
        (b"S6\rO\rT000000010\rt1000\r", b"\r\rZ\rz\r"),
        (b"S6\rO\rT00000001\r", b"\r\r\a"),
    ],
)
def test_adapter_answers_as_in_the_manual(command: bytes, answer: bytes) -> None:
    adapter = SlcanAdapter()
    adapter.feed(command)
    assert adapter.take_output() == answer


def test_bit_rates_are_those_of_the_manual() -> None:
    adapter = SlcanAdapter()
    for command, bitrate in ((b"S0", 10_000), (b"S4", 125_000), (b"S7", 800_000), (b"S8", 10**6)):
        adapter.feed(command + b"\r")
        assert adapter.bitrate == bitrate
    adapter.feed(b"s031C\r")  # SJA1000 at 16 MHz: prescaler 4, 1 + 13 + 2 quanta
    assert adapter.bitrate == 125_000
    adapter.feed(b"Y5\r")
    assert adapter.data_bitrate == 5_000_000


def test_frames_pass_only_while_channel_is_open() -> None:
    adapter = SlcanAdapter()
    adapter.deliver((FRAME,), NOW)
    assert adapter.take_output() == b""
    assert adapter.losses == {"rx_channel_closed": 1}
    adapter = opened()
    adapter.deliver((FRAME, FD_FRAME), NOW)
    assert adapter.take_output() == LINE + b"\r" + FD_LINE + b"\r"
    assert adapter.feed(LINE + b"\r" + FD_LINE + b"\r") == [FRAME, FD_FRAME]


def test_adapter_without_fd_refuses_fd_frames() -> None:
    adapter = opened(fd=False)
    assert adapter.feed(FD_LINE + b"\r") == []
    assert adapter.take_output() == b"\a"


def test_time_stamps_are_milliseconds_in_four_digits() -> None:
    adapter = SlcanAdapter()
    adapter.feed(b"S8\rZ1\rO\r")
    adapter.take_output()
    adapter.deliver((FRAME,), Instant(61_234_000_000))
    assert adapter.take_output() == LINE + b"04D2\r"  # 61,234 mod 60,000


def test_bus_off_lasts_until_channel_is_reopened() -> None:
    adapter = opened()
    adapter.set_bus_off(True)
    assert adapter.take_output() == b"sb128256\r"
    assert adapter.feed(LINE + b"\r") == []
    adapter.deliver((FRAME,), NOW)
    assert adapter.feed(b"F\r") == []
    assert adapter.take_output() == b"\aFA4\r"
    adapter.feed(b"C\rO\r")  # the fault is still there
    assert adapter.take_output() == b"\r\rsb128256\r"
    adapter.set_bus_off(False)
    assert adapter.state is BusState.BUS_OFF
    adapter.feed(b"C\rO\r")
    assert adapter.state is BusState.ACTIVE
    assert adapter.losses == {"tx_refused": 1, "rx_bus_off": 1}


def test_errors_use_the_format_of_newer_firmware() -> None:
    adapter = opened()
    adapter.report_error("aB")
    adapter.set_state(BusState.PASSIVE)
    assert adapter.take_output() == b"e2aB\rsp128128\r"


def test_frame_times_match_the_literature() -> None:
    # Davis et al. 2007: a classic 29-bit frame of 8 bytes takes at most 160 bit times, of 0 80.
    assert frame_seconds(CanFrame(1, bytes(8)), 1_000_000, 1) == pytest.approx(160e-6)
    assert frame_seconds(CanFrame(1, b""), 500_000, 1) == pytest.approx(160e-6)
    # 64 bytes in one FD frame take far less than in eight classic ones.
    fd = frame_seconds(CanFrame(1, bytes(64), fd=True), 1_000_000, 5_000_000)
    assert fd < 0.2 * 8 * 160e-6


def test_bus_carries_one_frame_at_a_time_lowest_identifier_first() -> None:
    bus = TimedBus()
    low, high = CanFrame(1, bytes(8)), CanFrame(9, bytes(8))
    bus.push([high, high, low], Instant(0))
    assert bus.pop(Instant(159_000), 1_000_000, 1) == ()
    assert bus.pop(Instant(161_000), 1_000_000, 1) == (low,)
    assert bus.pop(Instant(1_000_000), 1_000_000, 1) == (high, high)
    assert bus.load(Instant(1_000_000)) == pytest.approx(0.48)
    assert bus.load(Instant(2_000_000)) == 0


def test_overloaded_bus_drops_whole_batches_and_counts_them() -> None:
    bus = TimedBus()
    batch = [CanFrame(1, bytes(8))] * 100
    for _ in range(10):
        bus.push(batch, Instant(0))
    assert bus.waiting <= MAX_QUEUED + len(batch)
    assert bus.dropped_frames == 1000 - bus.waiting
    assert bus.waiting % 100 == 0


# Dialects

CRLF_STREAM = b"\r\n\a\r\n" + LINE + b"\r\n" + FD_LINE + b"\r\nF84\r\n\r\nsb128256\r\nz\r\n"


@given(st.lists(st.integers(3, len(CRLF_STREAM)), max_size=8))
@settings(max_examples=60, deadline=None)
def test_crlf_line_ends_are_accepted_at_any_chunking(cuts: list[int]) -> None:
    decoder = slcan.SlcanDecoder()
    frames = []
    for start, end in pairwise([0, *sorted(cuts), len(CRLF_STREAM)]):
        frames += decoder.feed(CRLF_STREAM[start:end])
    assert [f for f in frames if not f.error] == [FRAME, FD_FRAME]
    assert list(decoder.answers) == [b"", b"\a", b"F84", b""]
    assert decoder.counters == {}


def test_lf_line_ends_are_accepted() -> None:
    decoder = slcan.SlcanDecoder()
    assert decoder.feed(LINE + b"\n" + LINE + b"\n") == [FRAME, FRAME]


def test_x_marks_a_frame_with_extended_identifier() -> None:
    assert slcan.decode_frame(b"x" + LINE[1:]) == FRAME
    adapter = opened()
    assert adapter.feed(b"x" + LINE[1:] + b"\r") == [FRAME]


def test_answers_of_other_firmware_are_understood() -> None:
    decoder = slcan.SlcanDecoder()
    decoder.feed(b"\x06\r\x15\r#\r#1\rL34\rz\r")
    assert list(decoder.answers) == [b"", b"\a", b"", b"\a"]
    assert decoder.counters == {}


@pytest.mark.parametrize(
    ("flags", "names", "state"),
    [
        (b"F01", ("rx-overflow",), None),
        (b"F02", ("tx-overflow",), None),
        (b"F08", ("rx-overflow",), None),
        (b"F40", ("lost-arbitration",), None),
        (b"F80", ("bus-error",), None),
        (b"FE4", ("lost-arbitration", "bus-error"), BusState.BUS_OFF),
        (b"FA0", ("bus-error",), BusState.PASSIVE),
    ],
)
def test_flags_are_decoded_as_bus_errors(
    flags: bytes, names: tuple[str, ...], state: BusState | None
) -> None:
    state_frame, errors = slcan.SlcanDecoder().feed(flags + b"\r")
    assert can_transfers.reported_state(state_frame) is (state or BusState.ACTIVE)
    assert can_transfers.error_names(errors) == names
    assert can_transfers.reported_state(errors) is None


def test_persistent_flag_is_reported_once() -> None:
    decoder = slcan.SlcanDecoder()
    told = [len(decoder.feed(line)) for line in (b"F80\r", b"F80\r", b"F00\r", b"F80\r", b"F88\r")]
    assert told == [2, 1, 1, 2, 2]


@pytest.mark.parametrize(
    ("line", "state", "names"),
    [
        (b"E00000000", BusState.ACTIVE, ()),
        (b"E2310800C", BusState.PASSIVE, ("no-acknowledgement",)),
        (b"E31000000", BusState.BUS_OFF, ("protocol-violation", "bus-error")),
        (b"E16040000", BusState.WARNING, ("protocol-violation", "bus-error", "tx-overflow")),
    ],
)
def test_error_reports_of_newer_firmware_are_understood(
    line: bytes, state: BusState, names: tuple[str, ...]
) -> None:
    first, *rest = slcan.SlcanDecoder().feed(line + b"\r")
    assert can_transfers.reported_state(first) is state
    assert [can_transfers.error_names(f) for f in rest] == ([names] if names else [])


def test_every_bit_rate_has_a_command() -> None:
    adapter = SlcanAdapter()
    for bitrate, command in slcan.BITRATES.items():
        adapter.feed(command + b"\r")
        assert adapter.bitrate is not None
        assert abs(adapter.bitrate - bitrate) <= 50_000
    for bitrate, command in slcan.DATA_BITRATES.items():
        adapter.feed(command + b"\r")
        assert adapter.data_bitrate == bitrate
    assert set(adapter.take_output()) == {ord("\r")}
    assert slcan.BITRATES[83_300] == b"S9"
    assert slcan.DATA_BITRATES[8_000_000] == b"Y8"


def test_unknown_dialect_lists_available_dialects() -> None:
    with pytest.raises(ValueError, match="candapter"):
        SlcanAdapter(dialect="brand")
