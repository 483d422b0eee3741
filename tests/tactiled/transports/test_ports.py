"""The simulator's pseudo-terminals never block, and leave nothing behind."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sim_device.ports import BACKLOG, PTY_ROOM, LinkRefused, PtyPort
from tactiled.transports.serial_port import SerialTransport
from tests.support.waiting import wait_until

KERNEL_BUFFER = 65_536
"""Bytes that a Linux terminal takes before its line discipline shows them, on a busy machine."""


def test_unread_port_drops_oldest_messages_and_counts_them(pty: PtyPort, read_bytes: Any) -> None:
    messages = [bytes([100 + k % 100]) * 99 + b"\n" for k in range(1000)]
    host = SerialTransport(str(pty.link))
    host.open()
    for message in messages:
        pty.send(message)
    lost = pty.losses["unread_messages"]
    assert lost > 0
    assert pty.losses["unread_bytes"] == 100 * lost
    assert not pty.ready
    got = bytearray()

    def all_read() -> bool:
        pty.flush()
        got.extend(read_bytes(host, 1, 0.05))
        return len(got) >= 100 * (1000 - lost)

    wait_until(all_read)
    lines = bytes(got).splitlines(keepends=True)
    assert [line for line in lines if line in set(messages)] == lines  # none is broken
    assert len(lines) == 1000 - lost
    assert lines[0] == messages[0]  # it had been sent already
    assert lines[-1] == messages[-1]
    assert len(got) <= BACKLOG + PTY_ROOM + KERNEL_BUFFER
    host.close()


def test_late_host_receives_no_stale_bytes(pty: PtyPort, read_bytes: Any) -> None:
    pty.send(b"stale")
    host = SerialTransport(str(pty.link))
    host.open()
    pty.send(b"fresh")
    assert read_bytes(host, 5) == b"fresh"
    host.close()


def test_hosts_may_connect_and_disconnect(pty: PtyPort, read_bytes: Any) -> None:
    for word in (b"one", b"two"):
        host = SerialTransport(str(pty.link))
        host.open()
        pty.send(word)
        assert read_bytes(host, 3) == word
        host.close()


def test_closing_a_port_removes_its_link(tmp_path: Path) -> None:
    port = PtyPort(tmp_path / "board0")
    port.open()
    assert os.path.realpath(port.link).startswith("/dev/")
    port.close()
    port.close()
    assert not os.path.lexists(port.link)
    port.send(b"abc")
    assert port.losses == {"unplugged_bytes": 3}
    assert port.receive() == b""


def test_stale_link_of_a_killed_run_is_replaced(tmp_path: Path) -> None:
    link = tmp_path / "board0"
    code = (
        "import os, signal, sys\n"
        "from sim_device.ports import PtyPort\n"
        "PtyPort(sys.argv[1]).open()\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(link)], check=False)
    assert link.is_symlink()
    port = PtyPort(link)
    port.open()
    assert link.exists()
    port.close()


def test_link_in_use_is_left_alone(pty: PtyPort) -> None:
    before = os.readlink(pty.link)
    with pytest.raises(LinkRefused, match="another simdevice") as caught:
        PtyPort(pty.link).open()
    assert not caught.value.foreign
    assert os.readlink(pty.link) == before


def test_foreign_files_are_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "precious"
    file.write_text("data")
    other = tmp_path / "link"
    other.symlink_to(file)
    for path in (file, other):
        with pytest.raises(LinkRefused, match="not") as caught:
            PtyPort(path).open()
        assert caught.value.foreign
    assert file.read_text() == "data"
    assert os.readlink(other) == str(file)


def test_link_replaced_meanwhile_is_not_removed(pty: PtyPort) -> None:
    pty.link.unlink()
    pty.link.write_text("somebody else's")
    pty.close()
    assert pty.link.read_text() == "somebody else's"


def test_missing_folder_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        PtyPort(tmp_path / "nowhere" / "board0").open()
