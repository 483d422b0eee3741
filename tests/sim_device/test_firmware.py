"""Simulated boards as a host sees them, through the real codecs."""

from __future__ import annotations

import numpy as np
import pytest

from sensor_proto.can_transfers import BROADCAST, CanDecoder, CanEncoder, segment
from sensor_proto.cobs import encode as cobs_encode
from sensor_proto.crc import crc32c
from sensor_proto.framing import encode_serial
from sensor_proto.packets import (
    OVERHEAD,
    Ack,
    AckResult,
    ClockPoll,
    ClockReply,
    Descriptor,
    Identify,
    Log,
    Reboot,
    Samples,
    SetGain,
    SetRate,
    Start,
    Status,
    Stop,
)
from sim_device.board.firmware import CanBoard, ClockParameters, SerialBoard, frame_bits
from sim_device.skin.elastomer import Contact
from sim_device.skin.environment import rotation_about
from sim_device.skin.indenter import load_script
from tactile_core.types import Instant

MS = 1_000_000


@pytest.fixture(params=["serial", "can", "canfd"])
def talk(request, real_skin, identity, host):
    """Host on each medium, with its board."""

    def make(**options):
        if request.param == "serial":
            return host(SerialBoard(real_skin(), identity, **options))
        fd = request.param == "canfd"
        return host(CanBoard(real_skin(), identity, node=5, fd=fd, **options), fd)

    return make


def acks(host) -> list[tuple[int, int, AckResult]]:
    return [(a.command, a.request, a.result) for a in host.of(Ack)]


def test_board_boots_announces_itself_and_waits_for_start(talk) -> None:
    host = talk()
    host.run(1200)
    assert [type(r.message) for _, r in host.log] == [Log, Status]
    when, log = host.log[0]
    assert when == 150
    assert "power_on" in log.message.text
    assert host.of(Status)[0].rate_mhz == 0


def test_identify_start_poll_stop(talk) -> None:
    host = talk()
    host.run(1000, {200: [Identify(1)], 300: [Start(2)], 400: [ClockPoll(99)], 800: [Stop(3)]})
    (descriptor,) = host.of(Descriptor)
    assert descriptor.serial_number == "0102030405060708"
    assert [(a.name, a.rows, a.columns, a.pitch_um) for a in descriptor.arrays] == [
        ("pad", 4, 4, 16000)
    ]
    assert (descriptor.arrays[0].lsb_xy_nt, descriptor.arrays[0].lsb_z_nt) == (300, 484)
    assert acks(host) == [(0x82, 2, AckResult.OK), (0x83, 3, AckResult.OK)]
    (reply,) = host.of(ClockReply)
    assert reply.token == 99
    assert reply.ticks_received == pytest.approx(400_000, abs=50)
    # 0.5 s at 100 Hz, the last conversion cut off by the stop.
    assert host.sequences == list(range(50))
    when = [ms for ms, r in host.log if isinstance(r.message, Samples)]
    # The first conversion begins at the command and takes 2.6 ms.
    assert when[0] == 303
    assert max(when) < 800


def test_samples_carry_the_board_clock_of_their_start(serial) -> None:
    host = serial(clock=ClockParameters(error=0.01, error_per_k=0.0))
    host.run(1200, {200: [Start(1)]})
    ticks = np.array([m.ticks for m in host.of(Samples)])
    assert ticks[0] == pytest.approx(200_000 * 1.01, abs=2)
    assert np.diff(ticks) == pytest.approx(np.full(len(ticks) - 1, 10_000), abs=1)
    # A clock 1 % fast samples 1 % faster: this is what the host has to find out.
    assert len(ticks) == 101


def test_board_clock_drifts_with_temperature(serial, calm) -> None:
    host = serial(clock=ClockParameters(error=0.0, error_per_k=-1e-3), environment=calm)
    host.run(300, {200: [ClockPoll(1)]})
    (cold,) = host.of(ClockReply)
    assert cold.ticks_received == pytest.approx(200_000, abs=1)
    warm = serial(clock=ClockParameters(error=0.0, error_per_k=-1e-3))  # 23 °C: 2 K below
    warm.run(300, {200: [ClockPoll(1)]})
    assert warm.of(ClockReply)[0].ticks_received == pytest.approx(200_000 * 1.002, abs=1)


def test_ticks_wrap_at_32_bits(serial) -> None:
    host = serial(clock=ClockParameters(error=0.0, error_per_k=0.0, start_ticks=2**32 - 300_000))
    host.run(500, {200: [Start(1)]})
    ticks = [m.ticks for m in host.of(Samples)]
    assert ticks[0] == 2**32 - 100_000
    assert ticks[10] == 0
    assert max(ticks) < 2**32
    assert host.sequences == list(range(len(ticks)))


def test_rate_is_set_within_limits(talk) -> None:
    host = talk()
    top = host.board.descriptor.max_rate_mhz
    assert top == pytest.approx(348_500, abs=500)
    commands = {
        200: [Start(1), SetRate(2, 0), SetRate(3, top + 1), SetRate(4, 50_000)],
        1200: [Stop(5)],
    }
    host.run(1300, commands)
    assert [a[2] for a in acks(host)] == [
        AckResult.OK,
        AckResult.BAD_ARGUMENT,
        AckResult.BAD_ARGUMENT,
        AckResult.OK,
        AckResult.OK,
    ]
    assert len(host.sequences) == 50
    assert host.of(Status)[0].rate_mhz == 50_000


def test_gain_changes_scale_descriptor_and_counts_together(serial, calm) -> None:
    host = serial(environment=calm)
    host.run(
        600, {200: [Start(1)], 400: [SetGain(2, 0, 1, 1, 0, 2), Identify(3)], 590: [Identify(4)]}
    )
    descriptor = host.of(Descriptor)[0].arrays[0]
    assert (descriptor.lsb_xy_nt, descriptor.lsb_z_nt) == (1202, 1936)
    assert host.of(Descriptor)[0].max_rate_mhz == pytest.approx(494_000, abs=500)
    after_ack = next(i for i, (_, r) in enumerate(host.log) if r.message == host.of(Ack)[1])
    before = [r.message for _, r in host.log[:after_ack] if isinstance(r.message, Samples)]
    after = [r.message for _, r in host.log[after_ack:] if isinstance(r.message, Samples)]
    old = np.mean([m.field[:, 2] for m in before], axis=0) * 0.484
    new = np.mean([m.field[:, 2] for m in after], axis=0) * 1.936
    assert new == pytest.approx(old, abs=8)


@pytest.mark.parametrize(
    "command",
    [
        SetGain(9, 3, 4, 0, 0, 3),  # no such array
        SetGain(9, 0, 8, 0, 0, 3),
        SetGain(9, 0, 4, 0, 0, 8),
        SetGain(9, 255, 4, 0, 0, 6),  # 13 ms: too slow for 100 Hz
    ],
)
def test_bad_gain_is_refused_and_changes_nothing(serial, command: SetGain) -> None:
    host = serial()
    host.run(300, {200: [command, Identify(1)]})
    assert acks(host) == [(0x85, 9, AckResult.BAD_ARGUMENT)]
    assert host.of(Descriptor)[0].arrays[0].lsb_xy_nt == 300


def raw_command(kind: int, payload: bytes, board: int) -> bytes:
    head = bytes([kind, board]) + len(payload).to_bytes(2, "little") + payload
    return head + crc32c(head).to_bytes(4, "little")


def test_unknown_commands_are_refused_by_number(real_skin, identity, host) -> None:
    on_serial = host(SerialBoard(real_skin(), identity))
    on_serial.run(200)
    raw = raw_command(0x9A, b"\x34\x12\x00\x01", 0)
    on_serial.board.receive(cobs_encode(raw) + b"\0", Instant(200 * MS))
    on_serial.run(210)
    assert acks(on_serial) == [(0x9A, 0x1234, AckResult.UNKNOWN_COMMAND)]

    on_can = host(CanBoard(real_skin(), identity, node=5))
    on_can.run(200)
    identifier = 2 << 26 | 0x2A5 << 16 | 0x9A << 8 | 5
    on_can.board.receive(
        segment(raw_command(0x9A, b"\x34\x12\x00\x01", 5), identifier, 0, False), Instant(200 * MS)
    )
    on_can.run(210)
    assert acks(on_can) == [(0x9A, 0x1234, AckResult.UNKNOWN_COMMAND)]


def test_garbage_from_the_host_is_counted(serial) -> None:
    host = serial()
    host.run(200)
    corrupted = bytearray(encode_serial(Start(1)))
    corrupted[3] ^= 0x10
    host.board.receive(bytes(corrupted), Instant(200 * MS))
    host.board.receive(b"\xff\xfe\xfd\0", Instant(200 * MS))
    host.board.receive(encode_serial(Log(20, 0, "not a command")), Instant(200 * MS))
    host.run(1300)
    assert not acks(host)
    assert host.of(Status)[0].rx_errors == 3


def test_reboot_answers_first_then_forgets_everything(talk) -> None:
    host = talk()
    host.run(2500, {200: [SetRate(1, 50_000), Start(2)], 1000: [Reboot(3)], 1100: [Identify(4)]})
    assert acks(host)[-1] == (0x87, 3, AckResult.OK)
    assert not host.of(Descriptor)  # it came while the board was starting
    logs = [(ms, r.message.text) for ms, r in host.log if isinstance(r.message, Log)]
    assert logs[1][0] == 1170
    assert "command" in logs[1][1]
    assert not [ms for ms, r in host.log if isinstance(r.message, Samples) and ms > 1020]
    host.run(3000, {2600: [Start(5)]})
    again = [r.message for ms, r in host.log if isinstance(r.message, Samples) and ms > 2600]
    assert again[0].sequence == 0
    assert again[0].ticks == pytest.approx((2600 - 1020) * 1000, abs=100)
    assert len(again) == 40
    status = host.of(Status)[-1]
    assert status.reset_cause == 1
    assert status.cycles < 40


def test_status_once_a_second(talk) -> None:
    host = talk()
    host.run(5200, {200: [Start(1)]})
    status = host.of(Status)
    assert [s.uptime_ms for s in status] == [1150, 2150, 3150, 4150, 5150]
    assert [s.cycles for s in status] == pytest.approx([95, 195, 295, 395, 495], abs=1)


def test_board_streams_on_when_the_host_falls_silent(serial) -> None:
    host = serial()
    host.run(8000, {200: [Start(1)]})
    assert host.sequences == list(range(780))


def test_two_boards_on_a_bus_obey_their_own_commands(real_skin, identity, host) -> None:
    first = host(CanBoard(real_skin(), identity, node=1))
    second = host(CanBoard(real_skin(), identity, node=2))
    frames = CanEncoder(2, False).encode(Identify(1))
    for each in (first, second):
        each.run(200)
        each.board.receive(frames, Instant(200 * MS))
        each.run(220)
    assert not first.of(Descriptor)
    assert len(second.of(Descriptor)) == 1
    for each in (first, second):
        each.board.receive(CanEncoder(BROADCAST, False).encode(Identify(2)), Instant(220 * MS))
        each.run(240)
        assert [r.board for _, r in each.log if isinstance(r.message, Descriptor)][-1:] == [
            each.board.node
        ]


def test_samples_show_a_press_at_its_position(serial, calm, tmp_path) -> None:
    script = tmp_path / "press.toml"
    script.write_text(
        "[[press]]\nposition_mm = [-24, -24, 0]\nnormal_n = 4\nstart_s = 0.5\nhold_s = 1\n"
    )
    host = serial(environment=calm)
    host.board.contacts = load_script(script, host.board.skin.geometry)
    host.run(1500, {200: [Start(1)]})
    fields = np.array([m.field[:, 2] for m in host.of(Samples)]) * 0.484
    rise = fields[80:100].mean(axis=0) - fields[:25].mean(axis=0)
    assert rise.argmax() == 0
    assert 400 < rise[0] < 1000
    assert host.board.skin.true_force[0, 2] == pytest.approx(-4.0, abs=0.2)


def test_contacts_and_attitude_can_be_set_from_outside(serial) -> None:
    host = serial()
    host.run(400, {200: [Start(1)]})
    host.board.contacts = [Contact(np.array([0.024, 0.024, 0.0]), np.array([0, 0, -3.0]))]
    host.board.attitude = rotation_about(np.array([1.0, 0, 0]), np.pi)
    host.run(600)
    assert host.board.skin.true_force[15, 2] == pytest.approx(-3.0, abs=0.2)
    fields = np.array([m.field[:, 2] for m in host.of(Samples)]) * 0.484
    turned = (fields[25:].mean(axis=0) - fields[:20].mean(axis=0))[:8]
    # Half a turn about x brings the field's -43 µT along z to +43.
    assert turned == pytest.approx(np.full(8, 86.6), abs=8)


def test_impossible_rates_and_nodes_are_refused(real_skin, identity) -> None:
    for rate in (0.0, -5.0, 400.0, float("nan")):
        with pytest.raises(ValueError, match="rate"):
            SerialBoard(real_skin(), identity, rate=rate)
    with pytest.raises(ValueError, match="node 127"):
        CanBoard(real_skin(), identity, node=127)


def test_backward_time_is_not_accepted(serial) -> None:
    host = serial()
    host.run(10)
    with pytest.raises(ValueError, match="back"):
        host.board.tick(Instant(5 * MS))


def test_frame_times_on_the_bus_match_the_literature() -> None:
    classic = CanEncoder(1, False).encode(ClockPoll(1))[0]
    assert len(classic.data) == 8
    # 131 bits without stuffing, at most a quarter more with it.
    assert 131 <= frame_bits(classic) <= 131 * 1.25
    assert OVERHEAD == 8


def test_foreign_can_frames_are_harmless(real_skin, identity) -> None:
    board = CanBoard(real_skin(), identity, node=5)
    decoder = CanDecoder()
    foreign = CanEncoder(6, False).encode(Log(20, 0, "from another board"))
    for ms in range(160):
        board.receive(foreign, Instant(ms * MS))
        decoder.feed(board.tick(Instant(ms * MS)))
    assert decoder.counters["accepted"] == 1
    assert board.counters["rx_errors"] == 0
