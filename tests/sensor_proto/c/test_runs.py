"""The C board as a program: on a pseudo-terminal, in QEMU, in simavr, with the real tactiled."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from tactile_core.bus.messages import codec

SLOW = 60.0
"""Time limit in s for any step on a busy machine."""

TOOL = "import sys; from tactile_tools.cli import main; sys.exit(main())"


def until(condition: Callable[[], Any], what: str, seconds: float = SLOW) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError(f"{what}: not in {seconds:g} s")


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    running: list[subprocess.Popen[bytes]] = []

    def run(*words: str | Path, out: str = "out.txt") -> subprocess.Popen[bytes]:
        with (tmp_path / out).open("wb") as file:
            env = {**os.environ, "TACTILE_RUNTIME_DIR": str(tmp_path / "rt")}
            process = subprocess.Popen(
                [str(w) for w in words], cwd=tmp_path, stdout=file, stderr=file, env=env
            )
        running.append(process)
        return process

    yield run
    for process in running:
        process.kill()
        process.wait()


def stream(start: Any, folder: Path, port: str, seconds: float, *words: str) -> list[Any]:
    """Features that the real tactiled logs from the board at ``port`` in ``seconds``."""
    module = [sys.executable, "-c", "import sys; from tactiled.cli import main; sys.exit(main())"]
    daemon = start(*module, "--port", port, "--log", "run.mcap", *words, out="tactiled.txt")
    text = folder / "tactiled.txt"
    until(lambda: "streaming" in text.read_text() or daemon.poll() is not None, "streaming")
    assert daemon.poll() is None, text.read_text()
    time.sleep(seconds)
    daemon.send_signal(signal.SIGINT)
    daemon.wait(SLOW)
    with (folder / "run.mcap").open("rb") as file:
        return [
            codec().decode(schema.name, message.data)
            for schema, _, message in make_reader(file).iter_messages(
                topics=["/tactile/board0/features"]
            )
            if schema is not None
        ]


def board_check(port: str, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", TOOL, "board-check", "--port", port, *words],
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert done.returncode in (0, 1), done.stderr
    return done.stdout


def failures(told: str) -> list[str]:
    return [line for line in told.splitlines() if line.startswith("FAIL")]


def test_tactiled_streams_from_board_on_a_pty(
    start: Any, build: Callable[..., Path], tmp_path: Path
) -> None:
    program = build("board", "ports/host/main.c", "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror")
    board = start(program, "board0", out="board.txt")
    until(lambda: (tmp_path / "board0").exists(), "the port")
    features = stream(start, tmp_path, "board0", 4.0)
    assert len(features) > 20
    assert "reference board 74616374696c6501" in (tmp_path / "tactiled.txt").read_text()
    board.terminate()
    assert board.wait(SLOW) == 0
    assert not os.path.lexists(tmp_path / "board0")
    assert "cycles" in (tmp_path / "board.txt").read_text()


def test_wrong_arguments_give_one_sentence(build: Callable[..., Path]) -> None:
    program = build("board", "ports/host/main.c", "-std=c99", "-O2")
    for words, code, said in (([], 2, "usage"), (["/nowhere/board0"], 3, "give another path")):
        done = subprocess.run([program, *words], capture_output=True, text=True, check=False)
        assert done.returncode == code
        assert said in done.stderr


def test_board_on_a_pty_passes_board_check(
    start: Any, build: Callable[..., Path], tmp_path: Path, long_run: None, notes: dict[str, Any]
) -> None:
    start(build("board", "ports/host/main.c", "-std=c99", "-O2"), "board0", out="board.txt")
    until(lambda: (tmp_path / "board0").exists(), "the port")
    told = board_check(str(tmp_path / "board0"))
    assert failures(told) == []
    notes.setdefault("board_check", {})["host, pseudo-terminal"] = told.splitlines()[-1]


ARM = ["-std=c99", "-mcpu=cortex-m3", "-mthumb", "-O2", "-nostartfiles", "--specs=nosys.specs"]


def qemu(start: Any, folder: Path, image: Path, need: Callable[[str], str]) -> str:
    words = ["-M", "mps2-an385", "-display", "none", "-monitor", "none", "-serial", "pty"]
    start(need("qemu-system-arm"), *words, "-kernel", image, out="qemu.txt")
    return str(
        until(
            lambda: re.findall(r"/dev/pts/\d+", (folder / "qemu.txt").read_text()), "QEMU's port"
        )[0]
    )


def test_cortex_m3_in_qemu_passes_board_check(
    start: Any,
    build: Callable[..., Path],
    need: Callable[[str], str],
    tmp_path: Path,
    long_run: None,
    notes: dict[str, Any],
    ports: Path,
) -> None:
    need("qemu-system-arm")
    linked = ["-T", str(ports / "qemu_mps2_an385" / "link.ld")]
    source = "ports/qemu_mps2_an385/main.c"
    image = build("m3.elf", source, *ARM, *linked, compiler="arm-none-eabi-gcc")
    told = board_check(qemu(start, tmp_path, image, need))
    assert failures(told) == []
    notes.setdefault("board_check", {})["Cortex-M3, QEMU mps2-an385"] = told.splitlines()[-1]


@pytest.mark.parametrize("rate_hz", [25, 100])
def test_forces_from_cortex_m3_in_qemu_match_the_simulator(
    rate_hz: int,
    start: Any,
    build: Callable[..., Path],
    need: Callable[[str], str],
    tmp_path: Path,
    long_run: None,
    notes: dict[str, Any],
    ports: Path,
) -> None:
    """Modelled chips in the simulator's field, this driver, this board, the real tactiled."""
    need("qemu-system-arm")
    script = Path(__file__).with_name("field_table.py")
    subprocess.run(
        [sys.executable, script, "field_table.h", "truth.json"], check=True, cwd=tmp_path
    )
    make = "import sys; from sim_device.cli import main; sys.exit(main())"
    words = ["calibration", "--out", "finger.cal.toml", "--seed", "0"]
    subprocess.run([sys.executable, "-c", make, *words], check=True, cwd=tmp_path)
    image = build(
        "table.elf",
        "ports/qemu_mps2_an385/main.c",
        *ARM,
        f"-I{tmp_path}",
        '-DREFERENCE_TABLE="field_table.h"',
        "-T",
        str(ports / "qemu_mps2_an385" / "link.ld"),
        compiler="arm-none-eabi-gcc",
    )
    port = qemu(start, tmp_path, image, need)
    features = stream(
        start, tmp_path, port, 40.0, "--calibration", "finger.cal.toml", "--rate", str(rate_hz)
    )
    said = (tmp_path / "tactiled.txt").read_text()
    truth = np.array(json.loads((tmp_path / "truth.json").read_text())["left_n"])
    frame_s = 0.05
    good = [m for m in features if m.valid]
    force = np.array([m.normal_force for m in good])
    bound = np.array([m.normal_force_bound for m in good])
    captured = np.array([m.captured_ns for m in good]) / 1e9

    def expected(begun: float) -> Any:
        """Force in N at the captured instants if the board's presses started at ``begun``, s."""
        at = ((captured - begun) / frame_s) % len(truth)
        return np.interp(at, np.arange(len(truth) + 1), np.append(truth, truth[0]))

    # The start time of the emulator is not known to 10 ms; this one instant is fitted.
    offsets = captured[0] + np.arange(0, len(truth) * frame_s, 0.01)
    begun = min(offsets, key=lambda b: float(np.abs(force - expected(b)).mean()))
    wanted = expected(begun)
    error = np.abs(force - wanted)
    pressed = wanted > 1.0
    inside = float((error <= bound + 0.05).mean())
    assert pressed.sum() > 30, said
    assert inside > 0.95
    assert np.median(error[pressed]) < 0.1
    missing = int(sum(b.sequence - a.sequence for a, b in itertools.pairwise(features)))
    notes[f"qemu_{rate_hz}_hz"] = {
        "machine": f"mps2-an385, Cortex-M3, 80 modelled chips, {rate_hz} Hz",
        "features": len(features),
        "cycles": missing,
        "valid_share": round(len(good) / len(features), 3),
        "pressed_features": int(pressed.sum()),
        "median_error_pressed_n": round(float(np.median(error[pressed])), 3),
        "error_95_percent_n": round(float(np.percentile(error, 95)), 3),
        "within_the_bound_told": round(inside, 3),
        "clock_uncertainty_ms": round(1000 * float(np.median([m.uncertainty for m in good])), 2),
        "dropped": int((re.findall(r"(\d+) dropped", said) or ["0"])[-1]),
    }


def test_atmega328p_in_simavr_passes_board_check(
    start: Any,
    build: Callable[..., Path],
    need: Callable[[str], str],
    tmp_path: Path,
    long_run: None,
    notes: dict[str, Any],
    ports: Path,
) -> None:
    flags = ["-std=c99", "-mmcu=atmega328p", "-DF_CPU=16000000UL", "-Os"]
    image = build("avr.elf", "ports/avr/main.c", *flags, compiler="avr-gcc")
    if not list(Path("/usr/include").glob("simavr/sim_avr.h")):
        pytest.skip("libsimavr is not here: apt-get install libsimavr-dev libelf-dev")
    out = tmp_path / "simulate"
    words = [need("gcc"), "-O2", str(ports / "avr" / "simulate.c"), "-o", str(out)]
    subprocess.run([*words, "-lsimavr", "-lelf"], check=True)
    start(out, image, "board0", out="avr.txt")
    until(lambda: (tmp_path / "board0").exists(), "the port")
    told = board_check(str(tmp_path / "board0"))
    # On a machine too slow for simavr the emulated clock is slow, and the check reports it.
    slow = "answers clock polls with a clock of tick_hz"
    wrong = [line for line in failures(told) if slow not in line]
    assert wrong == []
    notes.setdefault("board_check", {})["ATmega328P at 16 MHz, simavr"] = told.splitlines()[-1]
    notes["simavr_slower_than_real_time"] = bool(failures(told))
