"""The examples that need a board run as they stand, with the fake board and tactiled."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.paths import ROOT

EXAMPLES = ROOT / "examples"
SLOW_S = 120.0


class Rig:
    """The fake board and a tactiled, in a runtime folder of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.env = os.environ | {"TACTILE_RUNTIME_DIR": str(folder / "r")}
        self.processes = [
            self.popen(sys.executable, str(EXAMPLES / "fake_board.py"), "pad"),
            self.popen(
                command("tactiled"), "--port", "pad", "--kind", "anyskin", "--wait", "--log", "l"
            ),
        ]

    def popen(self, *words: str) -> subprocess.Popen[bytes]:
        with (self.folder / "said.txt").open("ab") as said:
            return subprocess.Popen(words, cwd=self.folder, env=self.env, stdout=said, stderr=said)

    def run(self, *words: str, code: int = 0) -> str:
        done = subprocess.run(
            words, cwd=self.folder, env=self.env, capture_output=True, text=True, timeout=SLOW_S
        )
        assert done.returncode == code, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        return done.stdout if code == 0 else done.stderr

    def example(self, name: str, *words: str, code: int = 0) -> str:
        return self.run(sys.executable, str(EXAMPLES / name), *words, code=code)


def command(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("e"))
    end = time.monotonic() + SLOW_S
    # Every example needs a board that streams.
    while made.popen(
        command("tactile"), "echo", "tactile/board0/features", "--count", "1", "--timeout", "5"
    ).wait():
        assert time.monotonic() < end, (made.folder / "said.txt").read_text()
    yield made
    for process in made.processes:
        process.kill()
        process.wait()


def test_features_are_read_from_the_fake_board(rig: Rig) -> None:
    said = rig.example("read_features.py", "board0", "500")
    assert "N  shear" in said or "not valid" in said
    assert "no such board: 'left' (available: board0)" in rig.example(
        "read_features.py", "left", code=1
    )


def test_tare(rig: Rig) -> None:
    assert rig.example("tare.py").strip()


def test_record_and_read_the_log(rig: Rig) -> None:
    path = rig.example("record.py", "board0", "two-seconds").strip()
    assert path.endswith("two-seconds.mcap")
    pytest.importorskip("pandas", reason="no pandas: pip install pandas")
    said = rig.example("read_log.py", str(rig.folder / path))
    assert "forces of 5 taxels" in said


def test_a_cpp_program_decodes_what_python_does(rig: Rig) -> None:
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++: apt-get install g++")
    rig.run(command("tactile"), "cpp-header", "--out", "tactile_messages.hpp")
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-I", str(rig.folder)]
    rig.run(compiler, *flags, str(EXAMPLES / "cpp/features.cpp"), "-o", "features")
    words = [command("tactile"), "echo", "tactile/board0/features", "--count", "20", "--cdr"]
    data = subprocess.run(
        words, cwd=rig.folder, env=rig.env, capture_output=True, timeout=SLOW_S, check=True
    ).stdout
    from tactile_core.bus.messages import codec

    expected, at = [], 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        message = codec().decode("tactile_msgs/msg/ContactFeatures", data[at + 4 : at + 4 + size])
        expected.append(
            f"{message.sequence} {'valid' if message.valid else 'not valid'} "
            f"{message.normal_force:.4f} N, {len(message.patches)} contacts"
        )
        at += 4 + size
    # A truncated message is reported, and not read beyond its end.
    cut = (20).to_bytes(4, "little") + data[4:24]
    done = subprocess.run([rig.folder / "features"], input=data + cut, capture_output=True)
    lines = [line for line in done.stdout.decode().splitlines() if not line.startswith(" ")]
    assert len(expected) == 20
    assert lines[:20] == expected
    assert lines[20].startswith("not a message")
