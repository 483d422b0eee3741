"""The command ``simdevice``: real processes, signals and bad input."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sensor_proto.anyskin import AnySkinDecoder
from sensor_proto.can_transfers import CanDecoder, CanEncoder
from sensor_proto.framing import SerialDecoder, encode_serial
from sensor_proto.packets import Descriptor, FloatSamples, Identify, Message, Samples, Start
from sim_device.cli import main
from tactile_core.calibration import load
from tactiled.transports import PortGone, Transport, TransportError
from tactiled.transports.can_bus import CanTransport
from tactiled.transports.serial_port import SerialTransport
from tests.support.waiting import wait_until

BOOT = 0.3
"""s, more than a board needs from power-on until it answers."""


class Launched(subprocess.Popen[str]):
    """The command, and the lines it printed at its start."""

    announced: list[str]


Launch = Callable[..., Launched]


@pytest.fixture
def launch(tmp_path: Path) -> Iterator[Launch]:
    started: list[Launched] = []

    def run(*arguments: str, lines: int = 1) -> Launched:
        process = Launched(
            [sys.executable, "-m", "sim_device", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            # Where the tests run under nohup, what they start would ignore hang-ups, too.
            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
        )
        started.append(process)
        assert process.stdout is not None
        process.announced = [process.stdout.readline() for _ in range(lines)]
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


def receive_until(
    transport: Transport, decoder: Any, enough: Callable[[list[Any]], bool], ask: Any = None
) -> list[Any]:
    """Messages of a board until ``enough``; ``ask`` makes the question sent every half second."""
    messages: list[Any] = []
    end = time.monotonic() + 60
    again = 0.0
    while not enough(messages) and time.monotonic() < end:
        if ask is not None and time.monotonic() >= again:
            transport.write(ask())
            again = time.monotonic() + 0.5
        chunk = transport.read(0.1)
        if chunk is not None:
            messages += decoder.feed(chunk.payload)
    return messages


def kinds(received: list[Any], kind: type[Message]) -> list[Any]:
    return [r.message for r in received if isinstance(r.message, kind)]


def hello() -> bytes:
    return encode_serial(Identify(1)) + encode_serial(Start(2))


def has_descriptor(messages: list[Any]) -> bool:
    return bool(kinds(messages, Descriptor)) and len(kinds(messages, Samples)) >= 9


def test_serial_board_is_announced_answers_and_streams(launch: Launch, tmp_path: Path) -> None:
    process = launch("boards", "--pty", "./board0", "--serial", "ABC")
    assert "tactiled --port board0" in process.announced[0]
    assert "0000000000000abc" in process.announced[0]
    host = SerialTransport(str(tmp_path / "board0"))
    host.open()
    received = receive_until(host, SerialDecoder(), has_descriptor, hello)
    (descriptor, *_) = kinds(received, Descriptor)
    assert descriptor.serial_number == "0000000000000abc"
    assert {s.array for s in kinds(received, Samples)} == {0, 1, 2}
    host.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_signal_ends_simdevice_cleanly_and_removes_links(
    launch: Launch, tmp_path: Path, number: signal.Signals
) -> None:
    process = launch("boards", "--pty", "board0", "--slcan", "can0", lines=2)
    assert (tmp_path / "board0").is_symlink()
    assert (tmp_path / "can0").is_symlink()
    process.send_signal(number)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []


def test_simdevice_exits_after_its_duration(launch: Launch, tmp_path: Path) -> None:
    process = launch("boards", "--pty", "board0", "--duration", "0.2")
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0
    assert "board0: " in errors
    assert list(tmp_path.iterdir()) == []


def test_simdevice_restarts_after_a_kill(launch: Launch, tmp_path: Path) -> None:
    first = launch("boards", "--pty", "board0")
    first.kill()
    first.communicate()
    assert os.path.lexists(tmp_path / "board0")
    launch("boards", "--pty", "board0")
    host = SerialTransport(str(tmp_path / "board0"))
    host.open()
    assert kinds(receive_until(host, SerialDecoder(), has_descriptor, hello), Descriptor)
    host.close()


def test_several_boards_on_one_bus_keep_their_names(launch: Launch, tmp_path: Path) -> None:
    process = launch("boards", "--slcan", "can0", "--node", "5", "--node", "9", lines=2)
    assert "node 5 → tactiled --can slcan:can0@1000000" in process.announced[0]
    host = CanTransport(f"slcan:{tmp_path / 'can0'}@1000000")
    host.open()
    encoders = [CanEncoder(node, False) for node in (5, 9)]

    def ask() -> Any:
        return tuple(frame for e in encoders for frame in e.encode(Identify(1)))

    def both(messages: list[Any]) -> bool:
        return {r.board for r in messages if isinstance(r.message, Descriptor)} == {5, 9}

    received = receive_until(host, CanDecoder(), both, ask)
    assert both(received)
    named = {r.board: r.message.serial_number for r in received if kinds([r], Descriptor)}
    assert named[5] != named[9]
    assert all(named[node] in "".join(process.announced) for node in (5, 9))
    host.close()


def test_boards_on_can_fd_stream_through_an_adapter(launch: Launch, tmp_path: Path) -> None:
    launch("boards", "--slcan", "can0", "--fd")
    host = CanTransport(f"slcan:{tmp_path / 'can0'}@1000000+fd")
    host.open()
    encoder = CanEncoder(1, True)

    def ask() -> Any:
        return encoder.encode(Identify(1)) + encoder.encode(Start(2))

    assert has_descriptor(receive_until(host, CanDecoder(), has_descriptor, ask))
    host.close()


def test_anyskin_board_streams_floats_without_commands(launch: Launch, tmp_path: Path) -> None:
    launch("boards", "--pty", "skin0", "--board", "anyskin")
    host = SerialTransport(str(tmp_path / "skin0"))
    host.open()
    received = receive_until(host, AnySkinDecoder(), lambda m: len(m) >= 20)
    assert {r.message.field_ut.shape for r in received} == {(5, 3)}
    assert isinstance(received[0].message, FloatSamples)
    host.close()


def test_unplugged_board_vanishes_and_returns_freshly_booted(
    launch: Launch, tmp_path: Path
) -> None:
    # Twice, for a starved machine may begin to listen only after the first time.
    launch("boards", "--pty", "board0", "--unplug", "2s+2s", "--unplug", "20s+5s")
    host = SerialTransport(str(tmp_path / "board0"))

    def opened() -> bool:
        with contextlib.suppress(TransportError):
            host.open()
        return host.device is not None

    wait_until(opened)
    with pytest.raises(PortGone):
        receive_until(host, SerialDecoder(), lambda m: False)
    wait_until(opened)
    received = receive_until(host, SerialDecoder(), has_descriptor, hello)
    assert min(s.sequence for s in kinds(received, Samples)) < 50
    host.close()


def test_calibration_command_describes_the_simulated_board(launch: Launch, tmp_path: Path) -> None:
    out = tmp_path / "skin.cal.toml"
    make = ["calibration", "--out", str(out), "--board", "anyskin", "--seed", "7"]
    assert main(make) == 0
    calibration = load(out)
    process = launch("boards", "--pty", "skin0", "--board", "anyskin", "--seed", "7")
    assert calibration.serial_number in process.announced[0]
    host = SerialTransport(str(tmp_path / "skin0"))
    host.open()
    received = receive_until(host, AnySkinDecoder(), lambda m: len(m) >= 20)
    host.close()
    # The rest field of this seed: mounting tolerances of different seeds differ by hundreds of µT.
    rest = calibration.arrays[0].rest_ut
    field = received[-1].message.field_ut.astype(float)
    yaw = calibration.arrays[0].geometry.chip_yaw
    turned = (field[:, 0] + 1j * field[:, 1]) * np.exp(1j * yaw)  # chip axes to taxel axes
    field[:, 0], field[:, 1] = turned.real, turned.imag
    assert abs(field - rest).max() < 150
    assert main(["calibration", "--out", str(tmp_path / "o.toml"), "--board", "anyskin"]) == 0
    assert abs(field - load(tmp_path / "o.toml").arrays[0].rest_ut).max() > 150
    # It overwrites its own file, but another board's only when told to.
    assert main(make) == 0
    assert main([*make[:-1], "8"]) == 2
    assert load(out).serial_number == calibration.serial_number
    assert main([*make[:-1], "8", "--force"]) == 0


BAD = [
    (["boards"], "no port given; allowed: --pty, --slcan and --can"),
    (["boards", "--pty", "p", "--rate", "-5"], "Hz from 0.1 to 1000"),
    (["boards", "--pty", "p", "--rate", "nan"], "'nan' given"),
    (["boards", "--pty", "p", "--rate", "900"], "900"),
    (["boards", "--pty", "p", "--duration", "0"], "'0' given; allowed"),
    (["boards", "--pty", "p", "--duration", "inf"], "'inf' given; allowed"),
    (["boards", "--pty", "p", "--seed", "-1"], "allowed: a whole number from 0"),
    (["boards", "--pty", "p", "--temperature", "500"], "°C from -40 to 85"),
    (["boards", "--pty", "p", "--rotate", "fast"], "'fast' is not understood"),
    (["boards", "--pty", "p", "--faults", "gremlins=1"], "'gremlins=1' is not understood; allowed"),
    (["boards", "--pty", "p", "--faults", "flip=2"], "probability from 0 to 1"),
    (["boards", "--pty", "p", "--faults", "busoff@1s+1s"], "busoff is a fault of CAN boards"),
    (["boards", "--pty", "p", "--faults", "stuck=nose:1"], "there is no array 'nose'"),
    (["boards", "--pty", "p", "--press", "none.toml"], "none.toml"),
    (["boards", "--pty", "p", "--unplug", "5"], "allowed: Ts+Ds"),
    (["boards", "--pty", "p", "--serial", "xyz"], "hexadecimal digits"),
    (["boards", "--pty", "p", "--serial", "1", "--serial", "2"], "2 serial numbers given for 1"),
    (["boards", "--pty", "p", "--board", "teddy"], "teddy"),
    (["boards", "--slcan", "c", "--board", "anyskin"], "use --pty"),
    (["boards", "--slcan", "c", "--unplug", "1s+1s"], "--faults busoff"),
    (["boards", "--slcan", "c", "--node", "127"], "a whole number from 0 to 126"),
    (["boards", "--can", "can0"], "invalid CAN bus 'can0'; expected INTERFACE:CHANNEL"),
    (["boards", "--can", "slcan:/dev/ttyACM0"], "use --slcan LINK"),
    (["boards", "--can", "toaster:0"], "no such CAN interface: 'toaster'"),
    (["replay", "none.csv", "--pty", "p"], "none.csv: cannot be read"),
    (["replay", "bad.csv", "--pty", "p"], "bad.csv:1: 2 columns given"),
    (["replay", "bad.csv", "--pty", "p", "--speed", "0"], "'0' given"),
    (["calibration", "--out", "x", "--serial", "1", "--serial", "2"], "more than one --serial"),
    (["boards", "--pty", "bad.csv"], "bad.csv exists and is not a link of a simulator"),
    (["frobnicate"], "frobnicate"),
    ([], "COMMAND"),
]


@pytest.mark.parametrize(("arguments", "said"), BAD, ids=lambda v: " ".join(v)[:40])
def test_bad_input_is_refused_with_allowed_values(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.csv").write_text("1,2\n")
    try:
        code = main(arguments)
    except SystemExit as ended:  # argparse
        code = int(ended.code or 0)
    assert code == 2
    errors = capsys.readouterr().err
    assert said in " ".join(errors.split())
    assert "Traceback" not in errors
    assert [p.name for p in tmp_path.iterdir()] == ["bad.csv"]


def test_system_errors_are_distinguished_from_bad_input(
    launch: Launch,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    launch("boards", "--pty", "board0")
    for arguments, said in (
        (["boards", "--pty", "board0"], "board0 is served by another simdevice; end that one"),
        (["boards", "--pty", "fresh", "--pty", "no/board0"], "a folder that exists"),
        (["boards", "--can", "socketcan:can77"], "no such CAN link: 'can77'"),
        (["calibration", "--out", "no/x.toml", "--board", "anyskin"], "cannot be written"),
    ):
        assert main(arguments) == 3
        assert said in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["board0"]


@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["boards", "--help"], ["replay", "--help"], ["calibration", "--help"]],
)
def test_help_names_units_and_defaults(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    for expected in {
        "boards": ("Hz", "°C", "µT", "default 100", "default 23", "silence@5s+2s"),
        "replay": ("µT", "25 °C", "default 1", "1 to 20 magnetometers"),
        "calibration": ("default 0", "default finger"),
        "--help": ("boards", "replay", "calibration", "Exit"),
    }[arguments[0]]:
        assert expected in text


def test_version_is_shown_by_both_forms(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["version"]) == 0
    with pytest.raises(SystemExit):
        main(["--version"])
    first, second = capsys.readouterr().out.split("\n", 1)
    assert first == second.strip()
    assert first.startswith("simdevice ")
