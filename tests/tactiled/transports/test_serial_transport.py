"""Serial transports on real pseudo-terminals."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sensor_proto.can_transfers import CanFrame
from sensor_proto.framing import SerialDecoder
from sim_device.ports import PTY_ROOM, PtyPort
from tactile_core.types import monotonic_now
from tactiled.transports import (
    PortBusy,
    PortClosed,
    PortDenied,
    PortGone,
    PortMissing,
    PortUnsuitable,
    listing,
    make_transport,
    open_spec,
    serial_port,
)
from tactiled.transports.serial_port import SerialTransport
from tests.support.waiting import becomes_true

EVERY_BYTE = bytes(range(256))
"""Includes XON, XOFF, CR, LF, NUL, INTR, EOF: a terminal not in raw mode changes some of them."""


@pytest.fixture
def transport(pty: PtyPort) -> Any:
    transport = SerialTransport(str(pty.link))
    transport.open()
    yield transport
    transport.close()


def waiting(transport: SerialTransport) -> int:
    """Bytes that the system holds for whoever reads the port."""
    assert transport._serial is not None
    return int(transport._serial.in_waiting)


def test_bytes_go_through_unchanged_in_both_directions(
    pty: PtyPort, transport: SerialTransport, read_bytes: Callable[..., bytes]
) -> None:
    pty.send(EVERY_BYTE * 4)
    assert read_bytes(transport, 1024) == EVERY_BYTE * 4
    transport.write(EVERY_BYTE)
    got = bytearray()
    assert becomes_true(lambda: got.extend(pty.receive()) or len(got) >= 256)
    assert got == EVERY_BYTE
    assert transport.losses == {}


def test_chunk_holds_all_waiting_bytes_and_is_stamped_on_arrival(
    pty: PtyPort, transport: SerialTransport
) -> None:
    before = monotonic_now()
    pty.send(b"abc")
    pty.send(b"def")
    assert becomes_true(lambda: waiting(transport) == 6)
    chunk = transport.read(60)
    assert chunk is not None
    assert chunk.payload == b"abcdef"
    assert before < chunk.received <= monotonic_now()


def test_read_returns_after_its_timeout(transport: SerialTransport) -> None:
    start = time.monotonic()
    assert transport.read(0.05) is None
    assert time.monotonic() - start > 0.04
    assert transport.read(0) is None


def test_unplugged_port_wakes_a_waiting_reader(
    pty: PtyPort, transport: SerialTransport, run_in_background: Any
) -> None:
    outcome = run_in_background(lambda: transport.read(600))
    time.sleep(0.05)
    pty.close()
    outcome.join()
    assert isinstance(outcome.error, PortGone)
    assert str(pty.link) in str(outcome.error)


def test_bytes_before_unplugging_are_not_lost(
    pty: PtyPort, transport: SerialTransport, read_bytes: Any
) -> None:
    pty.send(b"last words")
    assert read_bytes(transport, 10) == b"last words"
    pty.close()
    with pytest.raises(PortGone):
        transport.read(60)
    transport.write(b"anybody?")
    assert transport.losses == {"write_gone_bytes": 8}


@pytest.mark.parametrize("kind", [OSError, None])
def test_io_error_counts_as_unplugged(
    transport: SerialTransport, pty: PtyPort, monkeypatch: pytest.MonkeyPatch, kind: Any
) -> None:
    def read(fd: int, size: int) -> bytes:
        if kind is None:
            return b""
        raise OSError(5, "Input/output error")

    pty.send(b"x")
    monkeypatch.setattr(serial_port.os, "read", read)
    with pytest.raises(PortGone, match="plug it in again"):
        transport.read(60)


def test_replugged_port_is_reopened_by_its_path(
    pty: PtyPort, transport: SerialTransport, read_bytes: Any
) -> None:
    pty.close()
    with pytest.raises(PortGone):
        transport.read(60)
    with pytest.raises(PortMissing):
        transport.open()
    pty.open()
    transport.open()
    pty.send(b"back")
    assert read_bytes(transport, 4) == b"back"


def other_with_number_of(pty: PtyPort, name: str) -> tuple[int, int]:
    """End ``pty`` as a kill does, leaving its link, and open another that gets its number."""
    link = os.readlink(pty.link)
    assert link == name
    pty.close()
    pty.link.symlink_to(link)
    made = os.lstat(pty.link).st_ctime_ns
    while True:
        held = os.openpty()
        taken = os.ttyname(held[1]) != name
        if not taken and os.stat(name).st_ctime_ns > made:
            return held
        for end in held:
            os.close(end)
        if taken:
            pytest.skip("another program took the number of the pseudo-terminal")
        time.sleep(0.01)  # until the clock of the file system has gone on


@pytest.mark.parametrize("by_link", [True, False])
def test_stranger_that_got_the_number_of_a_pseudo_terminal_is_left_alone(
    pty: PtyPort, by_link: bool
) -> None:
    name = os.readlink(pty.link)
    transport = SerialTransport(str(pty.link) if by_link else name)
    transport.open()
    transport.close()
    os.chmod(name, 0o660)  # for another user, later
    transport.open()  # the same one again
    transport.close()
    held = other_with_number_of(pty, name)
    try:
        with pytest.raises(PortMissing, match="another one has its number now"):
            transport.open()
        assert transport.device is None
        pty.link.unlink()
        pty.link.symlink_to(name)  # whoever makes a link to it means it
        transport = SerialTransport(str(pty.link))
        transport.open()
        transport.close()
    finally:
        for end in held:
            os.close(end)


def test_closing_from_another_thread_wakes_a_waiting_reader(
    transport: SerialTransport, run_in_background: Any
) -> None:
    outcome = run_in_background(lambda: transport.read(600))
    time.sleep(0.05)
    transport.close()
    transport.close()
    outcome.join()
    assert isinstance(outcome.error, PortClosed)
    with pytest.raises(PortClosed):
        transport.read(0)


def test_write_to_a_board_that_does_not_read_times_out_and_is_counted(
    transport: SerialTransport,
) -> None:
    for _ in range(90):
        transport.write(bytes(1024))
    assert transport.losses["write_timeout_bytes"] > 0
    transport.close()
    transport.write(b"abc")
    assert transport.losses["write_closed_bytes"] == 3


def test_serial_port_refuses_can_frames(transport: SerialTransport) -> None:
    with pytest.raises(TypeError, match="bytes"):
        transport.write((CanFrame(1, b""),))


def test_second_process_is_refused_with_the_holder_of_the_port(
    pty: PtyPort, transport: SerialTransport
) -> None:
    code = (
        "import sys\n"
        "from tactiled.transports import PortBusy\n"
        "from tactiled.transports.serial_port import SerialTransport\n"
        "try:\n    SerialTransport(sys.argv[1]).open()\n"
        "except PortBusy as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(pty.link)], capture_output=True, text=True, check=True
    )
    assert f"(pid {os.getpid()})" in done.stdout
    assert "end that process" in done.stdout


def test_second_open_in_the_same_process_is_refused(
    pty: PtyPort, transport: SerialTransport
) -> None:
    with pytest.raises(PortBusy, match="this process"):
        SerialTransport(str(pty.link)).open()


def test_missing_port_lists_available_ports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = listing.PortInfo("/dev/ttyACM7", "AnySkin", 0x2341, 0x0058, "ABC")
    monkeypatch.setattr(listing, "list_ports", lambda: [port])
    with pytest.raises(PortMissing, match=r"no port .*board9.*/dev/ttyACM7"):
        SerialTransport(str(tmp_path / "board9")).open()
    monkeypatch.setattr(listing, "list_ports", list)
    with pytest.raises(PortMissing, match="no serial port is plugged in"):
        SerialTransport(str(tmp_path / "board9")).open()


def test_non_terminal_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "board0"
    file.write_bytes(b"")
    with pytest.raises(PortUnsuitable, match="not a serial port"):
        SerialTransport(str(file)).open()
    with pytest.raises(PortUnsuitable, match="a folder"):
        SerialTransport(str(tmp_path)).open()
    with pytest.raises(PortUnsuitable, match="not a serial port"):
        SerialTransport("/dev/null").open()


def test_forbidden_port_names_group_and_udev_rule(
    pty: PtyPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Root may open everything, so the refusal of the system is simulated.
    def refuse(*args: object, **options: object) -> None:
        raise serial_port.serial.SerialException(13, "could not open port: Permission denied")

    monkeypatch.setattr(serial_port.serial, "Serial", refuse)
    with pytest.raises(PortDenied, match=r"usermod -aG \w+ .*udev rule .*idVendor"):
        SerialTransport(str(pty.link)).open()


@pytest.mark.parametrize(("port", "baud"), [("", 9600), ("usb:", 9600), ("x", 0), ("x", -5)])
def test_invalid_arguments_are_refused(port: str, baud: int) -> None:
    with pytest.raises(ValueError, match="given"):
        SerialTransport(port, baud)


@pytest.fixture
def usb(monkeypatch: pytest.MonkeyPatch) -> list[SimpleNamespace]:
    """USB ports as pyserial lists them; tests add and move them."""
    ports: list[SimpleNamespace] = []
    monkeypatch.setattr(listing.pyserial_ports, "comports", lambda: list(ports))
    return ports


def usb_port(device: str | None, serial_number: str) -> SimpleNamespace:
    return SimpleNamespace(
        device=device, description="taxel board", vid=0x2341, pid=0x58, serial_number=serial_number
    )


def test_moved_board_is_found_by_its_usb_serial_number(
    tmp_path: Path, usb: list[SimpleNamespace], read_bytes: Any
) -> None:
    first, second = PtyPort(tmp_path / "ttyACM0"), PtyPort(tmp_path / "ttyACM1")
    first.open()
    usb[:] = [usb_port(str(first.link), "E6614")]
    transport = SerialTransport(str(first.link))
    transport.open()
    assert transport.usb_serial == "E6614"
    first.close()
    usb.clear()
    with pytest.raises(PortGone):
        transport.read(60)
    with pytest.raises(PortMissing):
        transport.open()
    second.open()
    usb[:] = [usb_port(str(second.link), "E6614")]
    transport.open()
    assert transport.device == str(second.link)
    second.send(b"here")
    assert read_bytes(transport, 4) == b"here"
    transport.close()
    second.close()


def test_other_device_at_the_old_path_is_not_mistaken_for_the_board(
    pty: PtyPort, usb: list[SimpleNamespace]
) -> None:
    usb[:] = [usb_port(str(pty.link), "E6614")]
    transport = SerialTransport(str(pty.link))
    transport.open()
    transport.close()
    usb[:] = [usb_port(str(pty.link), "F0000")]
    with pytest.raises(PortMissing, match="E6614"):
        transport.open()


def test_a_port_can_be_given_by_its_usb_serial_number(
    pty: PtyPort, usb: list[SimpleNamespace]
) -> None:
    usb[:] = [usb_port("/dev/nothing", "other"), usb_port(str(pty.link), "E6614")]
    transport = SerialTransport("usb:E6614")
    transport.open()
    assert transport.device == str(pty.link)
    transport.close()
    with pytest.raises(PortMissing, match="serial number F1"):
        SerialTransport("usb:F1").open()


def test_ports_are_listed_usb_first_with_distinguishing_details(
    usb: list[SimpleNamespace],
) -> None:
    plain = SimpleNamespace(
        device="/dev/ttyS0", description="n/a", vid=None, pid=None, serial_number=None
    )
    usb[:] = [plain, usb_port("/dev/ttyACM0", "E6614")]
    listed = listing.list_ports()
    assert [p.device for p in listed] == ["/dev/ttyACM0", "/dev/ttyS0"]
    assert str(listed[0]) == "/dev/ttyACM0  2341:0058  serial E6614  taxel board"
    assert str(listed[1]) == "/dev/ttyS0"
    assert listing.find_by_serial("E6614") == listed[0]
    assert listing.find_by_serial("nobody") is None


def test_flood_of_zeros_gives_bounded_chunks_and_no_message(
    pty: PtyPort, transport: SerialTransport
) -> None:
    decoder = SerialDecoder()
    messages, total = [], 0
    for _ in range(300):
        pty.send(bytes(PTY_ROOM))
        chunk = transport.read(60)
        assert chunk is not None
        assert isinstance(chunk.payload, bytes)
        assert len(chunk.payload) <= serial_port.READ_LIMIT
        total += len(chunk.payload)
        messages += decoder.feed(chunk.payload)
    assert total > 1_000_000
    assert messages == []


def test_port_spec_selects_the_transport() -> None:
    assert type(make_transport("/dev/ttyACM0")).__name__ == "SerialTransport"
    assert type(make_transport("./board0")).__name__ == "SerialTransport"
    assert type(make_transport("usb:E6614")).__name__ == "SerialTransport"
    assert type(make_transport("/dev/serial/by-path/pci-0:1")).__name__ == "SerialTransport"
    assert type(make_transport("socketcan:can0+fd")).__name__ == "CanTransport"
    assert type(make_transport("logs/run.mcap")).__name__ == "McapTransport"


def test_open_spec_opens_the_transport(pty: PtyPort) -> None:
    transport = open_spec(str(pty.link))
    assert transport.read(0) is None
    transport.close()
