"""Boards on ports as requested from ``simdevice boards``, run on virtual time."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from sensor_proto.can_transfers import BusState, CanDecoder, CanEncoder
from sensor_proto.packets import Samples, Start
from sensor_proto.slcan import SlcanDecoder, encode_frame
from sim_device.board.catalogue import identity
from sim_device.faults import Window
from sim_device.ports_plan import BoardsRequest, Planned, parse_serial, parse_window, plan_boards
from sim_device.runner import CanServer, Runner, SerialServer
from sim_device.skin.indenter import load_script
from sim_device.status import StatusLine
from tactile_core.can_bus import CanSpec
from tactile_core.types import Instant, after
from tactiled.transports.serial_port import SerialTransport

PRESS = """
[[press]]
array = "left"
normal_n = 3.0
start_s = 5.0
ramp_s = 0.5
hold_s = 2.0
"""
START = Instant(10**12)


@pytest.fixture
def request_of(tmp_path: Path) -> BoardsRequest:
    return BoardsRequest(ptys=(tmp_path / "board0", tmp_path / "board1"), seed=40)


def test_boards_differ_but_are_reproducible(request_of: BoardsRequest, tmp_path: Path) -> None:
    wanted = replace(request_of, slcans=(tmp_path / "can0",), nodes=(3, 4), serials=(b"\0" * 8,))
    first, second = plan_boards(wanted), plan_boards(wanted)
    lines = [line for plan in first for line in plan.lines]
    assert lines == [line for plan in second for line in plan.lines]
    assert lines[0] == "finger 0000000000000000 (seed 40)"
    assert lines[1] == f"finger {identity('finger', 41).unique_id.hex()} (seed 41)"
    assert [line.split(", ")[1:] for line in lines] == [[], [], ["node 3"], ["node 4"]]
    assert [plan.connect for plan in first] == [
        f"tactiled --port {tmp_path / 'board0'}",
        f"tactiled --port {tmp_path / 'board1'}",
        f"tactiled --can slcan:{tmp_path / 'can0'}@1000000",
    ]


def test_press_and_rotation_continue_while_board_is_unplugged(
    request_of: BoardsRequest, tmp_path: Path
) -> None:
    script = tmp_path / "press.toml"
    script.write_text(PRESS)
    (plan, _) = plan_boards(replace(request_of, press=script, rotate="90deg/10s@z"))
    assert isinstance(plan.server, SerialServer)
    board: Any = plan.server.board
    replugged: Any = plan.server._make_board(4.0)
    expected = load_script(script)
    for seconds in (0.0, 5.25, 6.0):
        forces = [c.force for c in board.contacts(seconds)]
        assert np.allclose(forces, [c.force for c in expected.contacts(seconds)])
        assert np.allclose(forces, [c.force for c in replugged.contacts(seconds - 4.0)])
    assert len(board.contacts(6.0)) == 1
    world = board._sampler.environment
    assert np.allclose(world.at(10.0).attitude, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-9)
    later = replugged._sampler.environment
    assert np.allclose(later.at(6.0).attitude, world.at(10.0).attitude)


def test_unpowered_board_disappears_and_reboots(request_of: BoardsRequest) -> None:
    wanted = replace(request_of, ptys=request_of.ptys[:1], unplugged=(Window(1.0, 0.5),))
    (plan,) = plan_boards(wanted)
    server = plan.server
    assert isinstance(server, SerialServer)
    server.open()
    boards = []
    for step in range(20):
        server.service(after(START, 0.1 * step))
        boards.append(server.board if server.port.is_open else None)
    assert [k for k, board in enumerate(boards) if board is None] == [10, 11, 12, 13, 14]
    assert boards[9] is not boards[15]
    server.close()


def stepped(plan: Planned, host: SerialTransport, seconds: float, ask: bytes) -> tuple[Any, Any]:
    """Messages and counters of a host at the adapter of ``plan``, on virtual time."""
    lines, decoder, received = SlcanDecoder(), CanDecoder(), []
    for step in range(round(seconds / 0.001)):
        if step == 300:
            host.write(ask)
        plan.server.service(after(START, 0.001 * step))
        chunk = host.read(0)
        if chunk is not None:
            assert isinstance(chunk.payload, bytes)
            received += decoder.feed(lines.feed(chunk.payload))
    return received, decoder.counters


def ask_can(node: int) -> bytes:
    return b"".join(map(encode_frame, CanEncoder(node, False).encode(Start(1))))


def test_overloaded_bus_loses_whole_cycles_and_corrupts_no_message(tmp_path: Path) -> None:
    (plan,) = plan_boards(BoardsRequest(slcans=(tmp_path / "can0",)))
    assert isinstance(plan.server, CanServer)
    plan.server.open()
    host = SerialTransport(str(tmp_path / "can0"))
    host.open()
    host.write(b"S6\rO\r")  # 500 kbit/s for a board that makes 1.3 Mbit/s
    received, counters = stepped(plan, host, 2.0, ask_can(1))
    sequences = [r.message.sequence for r in received if isinstance(r.message, Samples)]
    cycles = sorted(set(sequences))
    assert 20 < len(cycles) < 80  # of 170; 500 kbit/s carry some 33 a second
    assert all(sequences.count(s) == 3 for s in cycles[:-1])
    assert {name: count for name, count in counters.items() if count} == {"accepted": len(received)}
    losses = plan.server.losses
    assert losses["bus_overrun"] == 0
    made = plan.server.boards[0].counters["cycles"]
    assert 0 <= made - len(cycles) - losses["overruns"] < 16  # the rest are still on their way
    host.close()
    plan.server.close()


def test_bus_off_of_a_board_reaches_the_adapter(tmp_path: Path) -> None:
    (plan,) = plan_boards(BoardsRequest(slcans=(tmp_path / "can0",), faults="busoff@0.5s+0.2s"))
    server = plan.server
    assert isinstance(server, CanServer)
    server.open()
    host = SerialTransport(str(tmp_path / "can0"))
    host.open()
    host.write(b"S8\rO\r")
    adapter: Any = server.port
    states = []
    for step in range(900):
        server.service(after(START, 0.001 * step))
        host.read(0)
        states.append(adapter.adapter.state)
    assert states[490] is BusState.ACTIVE
    assert states[510] is BusState.BUS_OFF
    assert states[-1] is BusState.BUS_OFF  # until the host opens the channel again
    host.write(b"C\rO\r")
    server.service(after(START, 1.0))
    assert adapter.adapter.state is BusState.ACTIVE
    host.close()
    server.close()


def test_failed_port_closes_all_other_ports(request_of: BoardsRequest) -> None:
    request_of.ptys[1].write_text("in the way")
    runner = Runner([plan.server for plan in plan_boards(request_of)])
    with pytest.raises(Exception, match="exists and is not a link"):
        runner.open()
    assert not request_of.ptys[0].is_symlink()


@pytest.mark.parametrize("text", ["5", "5s", "5s+0s", "s+s", "-1s+1s", "5s+1s+1s", "nans+1s"])
def test_invalid_time_windows_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"allowed: Ts\+Ds"):
        parse_window(text)


def test_serial_numbers_are_padded_and_validated() -> None:
    assert parse_serial("0xABC") == bytes.fromhex("0000000000000abc")
    assert parse_window("5s+1.5s") == Window(5.0, 1.5)
    for text in ("", "xyz", "1" * 17):
        with pytest.raises(ValueError, match="hexadecimal"):
            parse_serial(text)


def test_virtual_buses_can_be_served() -> None:
    spec = CanSpec.parse("virtual:servers+fd")
    (plan,) = plan_boards(BoardsRequest(cans=(spec,), nodes=(7,)))
    assert plan.connect == "tactiled --can virtual:servers+fd"
    plan.server.open()
    for step in range(400):
        plan.server.service(after(START, 0.001 * step))
    assert plan.server.sent > 0  # its log line and status
    plan.server.close()


def test_status_line_is_shown_only_on_a_terminal(
    request_of: BoardsRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    planned = plan_boards(replace(request_of, ptys=request_of.ptys[:1]))
    server: Any = planned[0].server
    terminal, pipe = io.StringIO(), io.StringIO()
    for stream, terminal_like in ((terminal, True), (pipe, False)):
        server.sent = 0
        console = Console(file=stream, force_terminal=terminal_like, width=160)
        with StatusLine(planned, console) as status:
            status.show_at(0.0)
            server.sent = 50
            server.port.send(b"abc")  # it is closed: lost
            status.show_at(0.5)
    status.sum_up()
    name = str(request_of.ptys[0])
    assert f"0.5 s  {name} 100/s lost 3" in terminal.getvalue()
    assert pipe.getvalue() == ""
    assert capsys.readouterr().err == f"{name}: 50 sent; unplugged_bytes 6\n"
