"""CAN transports: the simulated slcan adapter and python-can's virtual bus."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import pytest

from sensor_proto.can_transfers import BusState, CanDecoder, CanEncoder, CanFrame
from sensor_proto.packets import ClockReply
from sim_device.board.slcan_adapter import DIALECTS
from sim_device.ports import PtyPort, VirtualCanPort
from tactile_core.can_bus import CanSpec, can_links
from tactile_core.types import monotonic_now
from tactiled.transports import PortBusy, PortClosed, PortGone, PortMissing, PortUnsuitable
from tactiled.transports.can_bus import CanTransport, PythonCanLink
from tests.support.waiting import becomes_true

PATIENT_S = 3.0
"""For an adapter's answer, where a test is about it: a starved machine is no reason to miss one."""

FRAMES = [CanFrame(0x100 + k, bytes([k] * (k % 9))) for k in range(40)]


@pytest.fixture
def transport(adapter: Any) -> Any:
    transport = CanTransport(f"slcan:{adapter.port.pty.link}@1000000", answer_time=PATIENT_S)
    transport.open()
    yield transport
    transport.close()


@pytest.mark.parametrize(
    ("text", "spec"),
    [
        ("socketcan:can0", CanSpec("socketcan", "can0")),
        ("slcan:/dev/ttyACM1@1000000", CanSpec("slcan", "/dev/ttyACM1", 1_000_000)),
        ("slcan:/dev/ttyACM1@500000/2000000+fd", CanSpec("slcan", "/dev/ttyACM1", 500_000,
                                                         2_000_000, True)),
        ("virtual:0", CanSpec("virtual", "0")),
        ("virtual:0+fd", CanSpec("virtual", "0", fd=True)),
    ],
)  # fmt: skip
def test_bus_specs_of_the_readme_are_accepted(text: str, spec: CanSpec) -> None:
    assert CanSpec.parse(text) == spec
    assert str(spec) == text


@pytest.mark.parametrize("text", ["", "can0", "socketcan:", ":can0", "slcan:/dev/x@fast",
                                  "slcan:/dev/x@0", "virtual:0+FD", "slcan:/dev/x@-5"])  # fmt: skip
def test_invalid_bus_is_refused_with_expected_form(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected INTERFACE:CHANNEL|allowed: a positive number"):
        CanTransport(text)


def test_frames_go_through_a_real_terminal_in_both_directions(
    adapter: Any, transport: CanTransport, read_can: Callable[..., list[CanFrame]]
) -> None:
    adapter.send(*FRAMES)
    assert read_can(transport, len(FRAMES)) == FRAMES
    transport.write(tuple(FRAMES))
    assert becomes_true(lambda: len(adapter.received) >= len(FRAMES))
    assert adapter.received == FRAMES
    assert transport.losses == {}
    assert transport.state is BusState.ACTIVE


def test_message_crosses_the_bus_intact(adapter: Any, transport: Any, read_can: Any) -> None:
    reply = ClockReply(7, 123456, 123999)
    frames = CanEncoder(5, fd=False).encode(reply)
    adapter.send(*frames)
    (received,) = CanDecoder().feed(read_can(transport, len(frames)))
    assert received.message == reply
    assert received.board == 5


def test_fd_frames_go_through_a_bus_opened_for_them(adapter: Any, read_can: Any) -> None:
    transport = CanTransport(
        f"slcan:{adapter.port.pty.link}@1000000/5000000+fd", answer_time=PATIENT_S
    )
    transport.open()
    frame = CanFrame(0x1FFFFFFF, bytes(range(64)), fd=True)
    adapter.send(frame)
    assert read_can(transport, 1) == [frame]
    transport.write((frame,))
    assert becomes_true(lambda: adapter.received == [frame])
    assert adapter.port.adapter.data_bitrate == 5_000_000
    transport.close()


def test_misuse_is_refused_locally(transport: CanTransport) -> None:
    with pytest.raises(TypeError, match="CanFrame"):
        transport.write(b"abc")
    with pytest.raises(ValueError, match=r"without \+fd"):
        transport.write((CanFrame(1, bytes(12), fd=True),))
    with pytest.raises(ValueError, match="slcan adapter has"):
        CanTransport("slcan:/dev/ttyACM0@123456")
    with pytest.raises(ValueError, match="slcan adapter has"):
        CanTransport("slcan:/dev/ttyACM0@1000000/7000000+fd")


def test_bus_off_is_reported_and_recovered(
    adapter: Any, transport: CanTransport, read_can: Any, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    adapter.set_bus_off(True)
    end = time.monotonic() + 60
    seen = None
    while seen is None and time.monotonic() < end:
        seen = transport.read(0.1)
    assert seen is not None
    first = seen.payload[0]
    assert isinstance(first, CanFrame)
    assert first.error
    assert transport.state is BusState.BUS_OFF
    assert transport.losses["can_bus-off"] == 1
    assert "bus state bus-off" in caplog.text
    adapter.set_bus_off(False)
    adapter.send(FRAMES[1])

    def back() -> bool:
        transport.read(0.02)
        adapter.send(FRAMES[1])
        return transport.state is BusState.ACTIVE

    assert becomes_true(back)
    assert transport.losses["can_restarts"] >= 1
    adapter.set_bus_off(True)
    assert becomes_true(lambda: transport.read(0.02) and transport.state is BusState.BUS_OFF)


def test_bus_off_is_recovered_while_boards_are_silent(
    adapter: Any, transport: CanTransport
) -> None:
    adapter.set_bus_off(True)
    assert becomes_true(lambda: transport.read(0.02) and transport.state is BusState.BUS_OFF)
    adapter.set_bus_off(False)
    assert becomes_true(lambda: transport.read(0.02) and transport.state is BusState.ACTIVE)


def test_bus_off_is_found_by_polling_the_adapter(adapter: Any) -> None:
    adapter.port.adapter._tells_state = False
    transport = CanTransport(f"slcan:{adapter.port.pty.link}", answer_time=PATIENT_S)
    transport.open()
    adapter.set_bus_off(True)
    assert becomes_true(lambda: transport.read(0.1) and transport.state is BusState.BUS_OFF)
    adapter.set_bus_off(False)
    assert becomes_true(lambda: transport.read(0.05) and transport.state is BusState.ACTIVE)
    transport.close()


def test_unplugged_adapter_wakes_the_reader(
    adapter: Any, transport: CanTransport, run_in_background: Any
) -> None:
    outcome = run_in_background(lambda: transport.read(600))
    time.sleep(0.05)
    adapter.stop()
    outcome.join()
    assert isinstance(outcome.error, PortGone)


def test_second_host_on_the_adapter_is_refused(adapter: Any, transport: CanTransport) -> None:
    with pytest.raises(PortBusy, match="is held by"):
        CanTransport(str(transport.spec)).open()


def test_port_without_adapter_is_recognised(
    pty: PtyPort, tmp_path: Path, run_in_background: Any
) -> None:
    outcome = run_in_background(CanTransport(f"slcan:{pty.link}", answer_time=PATIENT_S).open)
    end = time.monotonic() + 60
    while not outcome.ended and time.monotonic() < end:
        pty.send(b"X: 12.5\r\n" * 20)
        time.sleep(0.01)
    assert isinstance(outcome.error, PortUnsuitable)
    assert "sends what no slcan adapter sends" in str(outcome.error)
    with pytest.raises(PortMissing, match="no port"):
        CanTransport(f"slcan:{tmp_path / 'nothing'}").open()


def test_python_can_slcan_driver_opens_simulated_adapter(adapter: Any) -> None:
    bus: Any = can.Bus(
        interface="slcan",
        channel=str(adapter.port.pty.link),
        bitrate=500_000,
        sleep_after_open=0,
    )
    try:
        assert bus.get_version(60) == (10, 13)
        assert bus.get_serial_number(60) == "A123"
        adapter.send(CanFrame(0x1234567, b"\x01\x02"))
        message = bus.recv(60)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x1234567, b"\x01\x02")
        bus.send(can.Message(arbitration_id=0x42, data=b"\x07", is_extended_id=True))
        assert becomes_true(lambda: adapter.received == [CanFrame(0x42, b"\x07")])
        assert adapter.port.adapter.bitrate == 500_000
    finally:
        bus.shutdown()


def test_python_cans_virtual_bus_joins_simulator_and_host_in_one_process(read_can: Any) -> None:
    port = VirtualCanPort("tests/transports", fd=True)
    port.open()
    transport = CanTransport("virtual:tests/transports+fd")
    transport.open()
    frames = (*FRAMES, CanFrame(7, bytes(64), fd=True))
    port.send(frames, monotonic_now())
    assert read_can(transport, len(frames)) == list(frames)
    transport.write(frames)
    assert port.receive() == frames
    transport.close()
    port.close()


def test_frames_of_other_devices_are_counted_and_ignored(read_can: Any) -> None:
    transport = CanTransport("virtual:others")
    transport.open()
    with can.Bus(interface="virtual", channel="others") as bus:
        bus.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        bus.send(can.Message(arbitration_id=0x123, is_remote_frame=True))
        bus.send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))
        bus.send(can.Message(arbitration_id=0x5, data=b"x"))
        frames = read_can(transport, 2)
    assert frames == [CanFrame(0x40, bytes(8), error=True), CanFrame(5, b"x")]
    assert transport.losses == {"standard_id": 1, "remote_frame": 1, "can_bus-off": 1}
    transport.close()


def test_closing_wakes_a_reader_of_any_driver(run_in_background: Any) -> None:
    transport = CanTransport("virtual:closing")
    transport.open()
    outcome = run_in_background(lambda: transport.read(600))
    time.sleep(0.05)
    transport.close()
    outcome.join()
    assert isinstance(outcome.error, PortClosed)


def test_virtual_bus_with_idle_reader_neither_grows_nor_blocks() -> None:
    transport = CanTransport("virtual:sleeper")
    transport.open()
    port = VirtualCanPort("sleeper")
    port.open()
    for _ in range(120):
        port.send(tuple(FRAMES), monotonic_now())
    assert port.losses["unsent_frames"] > 0
    transport.close()
    port.close()


def test_unknown_interface_and_missing_driver_name_the_remedy() -> None:
    with pytest.raises(
        PortUnsuitable, match=r"no such CAN interface: 'socketcam'; available: .*socketcan"
    ):
        CanTransport("socketcam:can0").open()
    with pytest.raises(PortMissing, match="install the driver of the kvaser adapter"):
        CanTransport("kvaser:0").open()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="SocketCAN is of Linux")
def test_missing_can_link_is_named_with_a_remedy() -> None:
    with pytest.raises(PortMissing, match=r"no such CAN link: 'can77'.*vcan"):
        CanTransport("socketcan:can77").open()


def test_driver_read_errors_count_as_unplugged(monkeypatch: pytest.MonkeyPatch) -> None:
    link = PythonCanLink(CanSpec.parse("virtual:broken"))
    link.open()

    def fail(timeout: float) -> None:
        raise can.CanOperationError("Network is down", 100)

    assert link._bus is not None
    monkeypatch.setattr(link._bus, "recv", fail)
    with pytest.raises(PortGone, match="Network is down"):
        link.receive(0.1)
    link.close()


@pytest.mark.skipif("vcan0" not in can_links(), reason="this kernel has no vcan0")
def test_frames_go_through_socketcan(read_can: Any) -> None:
    from sim_device.ports import PythonCanPort

    port = PythonCanPort(CanSpec.parse("socketcan:vcan0"))
    port.open()
    transport = CanTransport("socketcan:vcan0")
    transport.open()
    port.send(tuple(FRAMES), monotonic_now())
    assert read_can(transport, len(FRAMES)) == FRAMES
    transport.close()
    port.close()


@pytest.mark.parametrize("dialect", [name for name in DIALECTS if name != "late"])
def test_adapters_of_every_firmware_are_opened(
    dialect: str, adapter_of: Any, read_can: Any
) -> None:
    adapter = adapter_of(dialect)
    patient_s = None if dialect == "canable" else PATIENT_S  # that one never answers
    transport = CanTransport(f"slcan:{adapter.port.pty.link}@500000", answer_time=patient_s)
    transport.open()
    try:
        adapter.send(*FRAMES)
        got = [frame for frame in read_can(transport, len(FRAMES)) if not frame.error]
        assert got == FRAMES[: len(got)]
        assert got
        transport.write(tuple(FRAMES))
        assert becomes_true(lambda: len(adapter.received) == len(FRAMES))
        assert adapter.port.adapter.bitrate == 500_000
        assert "malformed_line" not in transport.losses
    finally:
        transport.close()


def test_silent_adapter_is_opened_and_reported(
    adapter_of: Any, caplog: pytest.LogCaptureFixture
) -> None:
    transport = CanTransport(f"slcan:{adapter_of('canable').port.pty.link}")
    transport.open()
    assert "answers no command" in caplog.text
    transport.close()


def test_late_answers_are_matched_to_their_command(
    adapter_of: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """The refusal to close a closed channel arrives long after the bit rate was sent."""
    adapter = adapter_of("late")
    transport = CanTransport(f"slcan:{adapter.port.pty.link}@1000000")
    transport.open()

    def heard() -> bool:
        transport.read(0.05)
        # On a starved machine, what comes 1 s late may still be in time.
        told = "s late" in caplog.text or "answers no command" not in caplog.text
        return told and not adapter.port.adapter._held

    assert becomes_true(heard)
    for _ in range(10):
        transport.read(0.02)
    assert "refuses" not in caplog.text
    transport.close()


@pytest.mark.parametrize("dialect", ["lawicel", "println", "plain", "canable2.5"])
def test_adapter_refusing_a_command_is_rejected(dialect: str, adapter_of: Any) -> None:
    adapter = adapter_of(dialect)
    adapter.port.adapter._fd = False
    spec = f"slcan:{adapter.port.pty.link}@1000000/2000000+fd"
    with pytest.raises(PortUnsuitable, match=r"refuses the command Y2.*leave \+fd out"):
        CanTransport(spec, answer_time=PATIENT_S).open()


def test_adapter_flags_are_counted_as_bus_errors(adapter_of: Any) -> None:
    transport = CanTransport(f"slcan:{adapter_of('buserror').port.pty.link}")
    transport.open()

    def counted() -> bool:
        transport.read(0.1)
        return transport.losses.get("can_bus-error") == 1

    assert becomes_true(counted)
    assert transport.state is BusState.ACTIVE
    transport.close()
